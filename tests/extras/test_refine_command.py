"""`mifit fit --timesteps auto` and `mifit track --refine`, from a capture to a report."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mifit.cli import main

CONFIG = """
[geometry]
rounds = 1
[surface]
finest = 3
[reflectance]
texture_size = 32
shading = "prefiltered"
bands = 4
exponent = 100
max_iterations = 5
[normals]
max_iterations = 5
"""


@pytest.mark.slow
def test_frames_are_chosen_and_mend_the_maps_by_which_others_are_tracked(capsys, tiny_capture, tmp_path):
    from mifit.result import Reconstruction

    out, config = tmp_path / "result", tmp_path / "c.toml"
    config.write_text(CONFIG)
    fit = ["fit", tiny_capture, "--out", out, "--model", "builtin:coarse", "--config", config, "--timesteps", "auto:2"]
    assert main([str(part) for part in fit]) == 0
    said = capsys.readouterr().err
    before = Reconstruction.load(out)
    assert len(before.timesteps) == 2
    assert all(f"Timestep {t}: " in said for t in before.timesteps)
    assert "was fitted: nearest to the middle of all poses" in (out / "report.html").read_text()
    track = ["track", str(tiny_capture), "--result", str(out), "--refine", "--quiet"]
    assert main(track) == 0, capsys.readouterr().err
    after = Reconstruction.load(out)
    assert sorted(after.timesteps) == [0, 1, 2] and sorted(after.normals.timesteps) == [0, 1, 2]
    refined = after.reflectance.report.details["refined"]
    assert refined["timesteps"] == [0, 1, 2] and refined["left_out"] == {}
    assert np.abs(after.reflectance.diffuse - before.reflectance.diffuse).max() > 0
    assert "Maps and lighting are from 3 frames" in (out / "report.html").read_text()
    document = json.loads((out / "result.json").read_text())
    assert {t["timestep"] for t in document["timesteps"] if t["tracked"]} == {0, 1, 2} - set(before.timesteps)


@pytest.mark.parametrize("text", ["auto:0", "auto:x", "auto:", "auto4"])
def test_a_count_that_is_none_is_bad_usage(capsys, tmp_path, text):
    with pytest.raises(SystemExit) as ended:
        main(["fit", str(tmp_path), "--out", str(tmp_path / "o"), "--timesteps", text])
    assert ended.value.code == 2
    assert "--timesteps" in capsys.readouterr().err
