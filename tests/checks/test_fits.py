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
from mifit.stages.find_surface import ALIKE
from tests.checks.wrong_captures import another_person, make, read, write
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


@pytest.mark.parametrize("shift", [0.0, 1.2, 1.8])
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
    assert [one.code for one in found] == (["landmarks-shifted"] if shift > 1.5 else [])
    assert not found or "in all cameras alike, expected within 10.3" in found[0].text


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


def said_of(folder, cameras):
    """What is said of a fit of a capture's first timestep, besides notes."""
    model = MorphableModel.load("builtin:coarse")
    config = mifit.FitConfig(surface=mifit.SurfaceConfig(finest=1))
    found = mifit.fit(Capture.load(folder), model, cameras, (0,), config, until="geometry")
    return [(one.code, one.text) for one in found.diagnostics if one.severity != "note"]


@pytest.mark.slow
def test_a_fault_that_no_image_shows_is_not_taken_for_another(shared, tmp_path, variant):
    """docs/limits.md has it: no other fault is named in its place."""
    assert said_of(make("one turned, yaw", shared / "captures/soft", tmp_path, 1), PAIR) == []


@pytest.mark.slow
def test_landmarks_that_lie_beside_the_face_are_named_after_a_fit(shared, tmp_path, variant):
    found = said_of(make("landmarks shifted", shared / "captures/scan_city", tmp_path, 1), PAIR)
    assert {code for code, _ in found} == {"landmarks-shifted"}  # of the fitted face alone: the test of `check_fit`


@pytest.mark.slow
def test_two_people_are_told_by_their_skin(shared, tmp_path, capsys, variant):
    rough = read(shared / "captures/soft", 1)
    another_person(rough, "right", "hard")
    command = ["doctor", str(write(rough, tmp_path)), "--model", "builtin:coarse", "--quiet", "--dense", "--json"]
    assert main(command) == 0
    said = json.loads(capsys.readouterr().out)
    assert "skin-differs" in {one["code"] for one in said["findings"]}
    assert said["calibration"]["points"] == 0  # one moment tests none
    assert abs(said["likeness"]["left, right"]) < ALIKE - 0.15 and said["epipolar_pixels"]["left, right"] > 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("name", "cameras"), [("gloss", PAIR), ("emily", ("c3", "c4")), ("scan_city", PAIR)])
def test_fits_of_good_captures_say_nothing(name, cameras, shared, tmp_path, variant):
    folder = write(read(shared / "captures" / name, 1, cameras=cameras), tmp_path)
    assert said_of(folder, cameras) == []
