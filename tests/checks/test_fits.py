"""What is told of a capture by its fit, and by `mifit doctor`."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

import mifit
from mifit.capture import Capture
from mifit.cli import main
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import Report
from mifit.morphable import MorphableModel
from mifit.stages.checks.fit_checks import INCONSISTENT, check_fit, judged
from mifit.stages.checks.landmark_model import noise_of
from tests.checks.wrong_captures import make
from tests.output.conftest import ball_result

PAIR = ("left", "right")


@pytest.mark.parametrize(
    ("found", "outcome"),
    [
        ([], "converged"),
        ([Diagnostic("gain-unknown", "text")], "converged"),
        ([Diagnostic("mirrored", "text", "fault")], INCONSISTENT),
        ([Diagnostic("views-disagree", "text")], INCONSISTENT),
    ],
)
def test_a_fit_whose_images_contradict_one_another_has_not_converged(found, outcome):
    result = ball_result()
    parts = {"geometry": result.geometry, "reflectance": result.reflectance, "normals": result.normals}
    parts = {part: dataclasses.replace(one, report=Report("converged")) for part, one in parts.items()}
    assert {one.report.outcome for one in judged(parts, found).values()} == {outcome}
    mine = dataclasses.replace(parts["geometry"], report=Report("converged", warnings=tuple(found)))
    assert {one.report.outcome for one in judged({**parts, "geometry": mine}, []).values()} == {outcome}


@pytest.mark.parametrize("shift", [0.0, 0.6, 1.0])
def test_landmarks_beside_the_fitted_face_are_named(shift, shared, monkeypatch):
    """Of the true face of a capture, whose landmarks are moved by parts of a detector's deviation."""
    from mifit.stages.checks import fit_checks

    folder = shared / "captures/soft"
    capture = Capture.load(folder)
    model = MorphableModel.load(str(shared / "models/ict_facekit/ict_facekit_head.npz"))
    with np.load(sorted((folder / "truth").glob("*0000*.npz"))[0]) as truth:
        vertices = truth["vertices"].astype(np.float32)
    geometry = dataclasses.replace(ball_result().geometry, timesteps=(0,), vertices=vertices[None])
    shots = fit_checks.landmark_shots(capture, PAIR, (0,))
    by = shift * noise_of(shots)
    moved = [dataclasses.replace(shot, pixels=shot.pixels + np.array([0.0, by])) for shot in shots]
    monkeypatch.setattr(fit_checks, "landmark_shots", lambda *_: moved)
    found = check_fit(capture, model, geometry, PAIR)
    assert [one.code for one in found] == (["landmarks-shifted"] if shift > 0.8 else [])
    assert not found or "in all cameras alike, expected within 5.5" in found[0].text


@pytest.mark.parametrize(
    ("name", "code", "verdict"),
    [("BGR in one", 3, "camera right: wrong"), ("one turned, yaw", 0, "camera right: sound")],
)
def test_doctor_examines_a_capture(name, code, verdict, shared, tmp_path, capsys):
    folder = str(make(name, shared / "captures/soft", tmp_path, timesteps=2))
    options = ["--model", "builtin:coarse", "--quiet", "--strict"]
    assert main(["doctor", folder, *options]) == code
    out, err = capsys.readouterr()
    assert verdict in out and "camera left: sound" in out
    assert ("mifit: fault: camera right" in err) == (code == 3)
    assert main(["doctor", folder, "--json", *options]) == code
    document = json.loads(capsys.readouterr().out)
    assert set(document["cameras"]) == set(PAIR) and all(0 < value < 10 for value in document["cameras"].values())
    assert [one["code"] for one in document["findings"]] == (["channels-exchanged"] if code else [])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["landmarks shifted", "one turned, yaw"])
def test_faults_that_no_image_shows_are_not_taken_for_others(name, shared, tmp_path, variant):
    """docs/limits.md has both: no other fault is named in their place."""
    capture = Capture.load(make(name, shared / "captures/soft", tmp_path, timesteps=2))
    found = mifit.fit(capture, MorphableModel.load("builtin:coarse"), PAIR, until="geometry")
    assert not [one.code for one in found.diagnostics if one.severity != "note"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        ("gloss", PAIR),
        ("hard", PAIR),
        ("emily", ("c3", "c4")),
        ("scan_city", PAIR),
        ("scan_studio", PAIR),
        ("scan_sun", PAIR),
    ],
)
def test_cheap_fits_of_good_captures_say_nothing(name, cameras, shared, variant):
    capture = Capture.load(shared / "captures" / name)
    found = mifit.fit(capture, MorphableModel.load("builtin:coarse"), cameras, (0,), until="geometry")
    assert [one.text for one in found.diagnostics if one.severity != "note"] == []
