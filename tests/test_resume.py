"""A fit that is killed goes on, and ends with what an uninterrupted one gives."""

import json
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from mifit.core.image import read_image


def command(capture, out, config, *more):
    return [
        sys.executable, "-m", "mifit", "fit", str(capture), "--out", str(out), "--model", "builtin:coarse",
        "--timesteps", "0", "--config", str(config), "--quiet", *more,
    ]  # fmt: skip


@pytest.mark.slow
def test_killed_at_random_moments_and_resumed(tiny_capture, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text('[reflectance]\ntexture_size = 64\nshading = "prefiltered"\nexponent = 100\n')
    started = time.perf_counter()
    subprocess.run(command(tiny_capture, tmp_path / "whole", config), check=True, capture_output=True)
    seconds = time.perf_counter() - started

    kills, chance = 0, random.Random(4)
    while kills < 3:
        process = subprocess.Popen(command(tiny_capture, tmp_path / "killed", config, "--resume"))
        try:
            process.wait(chance.uniform(0.3, 0.95) * seconds)
            break  # it was faster this time
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
    assert kills
    subprocess.run(command(tiny_capture, tmp_path / "killed", config, "--resume"), check=True, capture_output=True)

    whole, again = (json.loads((tmp_path / name / "result.json").read_text()) for name in ("whole", "killed"))
    np.testing.assert_allclose(again["lighting"]["radiance"], whole["lighting"]["radiance"], atol=1e-3)
    np.testing.assert_allclose(again["timesteps"][0]["translation"], whole["timesteps"][0]["translation"], atol=1e-4)
    for name in ("diffuse", "specular", "normal_object_0000"):
        a, b = (read_image(tmp_path / folder / "maps" / f"{name}.exr") for folder in ("whole", "killed"))
        assert np.abs(np.asarray(a) - np.asarray(b)).max() < 5e-3, name
    assert not list((tmp_path / "killed").glob("**/.*.part*"))
