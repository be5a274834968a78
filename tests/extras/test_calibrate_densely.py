"""Focal lengths of uncalibrated captures from dense matches: landmarks may be biased, images aren't."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture import Capture
from mifit.capture.landmark_files import Landmarks, write_landmarks
from mifit.capture.transforms import Shot, View, write_transforms
from mifit.core.image import write_image
from mifit.extras.bundle import Bundle, Freedom, Sightings, adjust_bundle
from mifit.extras.calibrate_densely import calibrate_capture
from mifit.extras.check_calibration import explain_matches
from mifit.morphable import MorphableModel
from tests.stages.memory_capture import make_capture

BOTH = ("left", "right")
TURNS = [(0, 0, 0), (-8, 14, 3), (9, -12, -4)]
FOCAL = 680.0
PRIOR = (np.array([1.8 * 340]), 0.7)


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=30, expression=20, albedo=10)


@pytest.fixture(scope="module")
def uncalibrated(model, tmp_path_factory) -> Capture:
    """A turning, painted head; its landmarks are off by 6 pixels, each the same way in every image."""
    folder: Path = tmp_path_factory.mktemp("uncalibrated")
    scene, shots = make_capture(model, TURNS, seed=3), []
    bias = 6.0 * np.random.default_rng(5).normal(size=(68, 2)) / np.sqrt(2)
    for (name, t), frame in scene.frames.items():
        shot = Shot(name, t, folder / f"{name}{t}.png", landmarks=folder / f"{name}{t}.json")
        write_image(shot.image, frame.image)
        write_landmarks(shot.landmarks, Landmarks(frame.landmarks + bias, frame.visible))
        shots.append(shot)
    views = [replace(View.of(scene.camera(name)), world_to_camera=None, intrinsics=None) for name in BOTH]
    write_transforms(folder / "transforms.json", views, shots, "cm")
    return Capture.load(folder)


def test_matches_give_the_focal_length_that_biased_landmarks_miss(model, uncalibrated) -> None:
    from mifit.extras.calibrate_heads import calibrate_heads

    marks, modes = model.mean[model.landmarks], model.identity[model.landmarks]
    by_landmarks = calibrate_heads(uncalibrated, marks, modes).capture.camera("left").fx
    assert abs(by_landmarks / FOCAL - 1) > 0.1
    found = calibrate_capture(uncalibrated, model, BOTH, (0, 1, 2))
    left, right = (found.capture.camera(name) for name in BOTH)
    assert left.fx == left.fy == right.fx == pytest.approx(FOCAL, rel=0.02)
    turn = right.rotation @ left.rotation.T
    assert np.degrees(Rotation.from_matrix(turn).magnitude()) == pytest.approx(40.0, abs=1.0)
    assert not found.capture.calibrated
    assert found.deviation is not None and found.deviation < 0.03
    assert found.residual is not None and found.residual < 0.4
    assert f"focal length {left.fx:.0f} pixels (+- " in found.note
    assert f"residual {found.residual:.2f} pixels; landmarks gave {by_landmarks:.0f}" in found.note


def test_two_images_leave_the_landmarks_value_and_say_so(model, uncalibrated) -> None:
    from mifit.extras.calibrate_heads import calibrate_heads

    marks, modes = model.mean[model.landmarks], model.identity[model.landmarks]
    by_landmarks = calibrate_heads(uncalibrated, marks, modes, timesteps=[0]).capture
    found = calibrate_capture(uncalibrated, model, BOTH, (0,))
    assert found.deviation is None and found.residual is None
    assert found.capture.camera("left").fx == pytest.approx(by_landmarks.camera("left").fx)
    assert found.note.endswith("is from landmarks, which may be off by a third: 2 images can't tell more, expected 3")


def test_one_camera_leaves_the_landmarks_value_and_says_so(model, uncalibrated) -> None:
    found = calibrate_capture(uncalibrated, model, ("left",), (0, 1, 2))
    assert found.deviation is None
    assert found.note.endswith("one camera can't tell expressions from perspective, expected two")


def test_many_sightings_are_thinned_by_whole_tracks(model, uncalibrated, monkeypatch) -> None:
    from mifit.extras import tracks

    given, found = [], []
    follow = tracks.follow_points
    monkeypatch.setattr("mifit.extras.tracks.follow_points", given.append)
    with pytest.raises(AttributeError):  # nothing is handed on
        calibrate_capture(uncalibrated, model, BOTH, (0, 1, 2))
    for most in (10**6, 3000):
        monkeypatch.setattr(tracks, "MOST_SIGHTINGS", most)
        found.append(follow(*given))
    whole, thinned = found
    assert len(whole.point) > 3000 >= 0.5 * len(thinned.point) and len(thinned.point) < 0.7 * len(whole.point)
    assert np.bincount(thinned.point).min() >= 3
    assert set(thinned.texel) <= set(whole.texel) and len(thinned.texel) == thinned.point.max() + 1


def exact(turns, expressions=0.0, points=400):
    """Points of a ball's front before two cameras 40 degrees apart, and the bundle that explains their projections."""
    rng = np.random.default_rng(1)
    at = rng.normal(size=(points, 3)) * (1, 1, 0.4)
    at *= 9.0 / np.linalg.norm(at / (1, 1, 0.6), axis=1, keepdims=True)
    modes = rng.normal(size=(points, 3, 2))
    flip = np.diag([1.0, -1.0, -1.0])
    heads = np.tile(np.eye(4), (len(turns), 1, 1))
    heads[:, :3, :3] = [flip @ Rotation.from_rotvec(turn, degrees=True).as_matrix() for turn in turns]
    heads[:, :3, 3] = (0, 0, 70)
    cameras = np.tile(np.eye(4), (2, 1, 1))
    cameras[1, :3, :3] = Rotation.from_rotvec([0, 40, 0], degrees=True).as_matrix()
    cameras[1, :3, 3] = (0, 0, 70) - cameras[1, :3, :3] @ (0, 0, 70)  # both look at the head
    expression = expressions * rng.normal(size=(len(turns), 2))
    expression[0] = 0
    truth = Bundle(np.full(2, FOCAL), cameras, heads, at, expression)
    point, camera, step = (a.ravel() for a in np.meshgrid(range(points), (0, 1), range(len(turns)), indexing="ij"))
    moved = at[point] + np.einsum("mck,mk->mc", modes[point], expression[step])
    world = np.einsum("mij,mj->mi", heads[step, :3, :3], moved) + heads[step, :3, 3]
    seen = np.einsum("mij,mj->mi", cameras[camera, :3, :3], world) + cameras[camera, :3, 3]
    return truth, Sightings(FOCAL * seen[:, :2] / seen[:, 2:], point, camera, step, 0.3), modes


def freedom(start: Bundle, group=(0, 0)) -> Freedom:
    """One focal length, loosely known; -1: a camera's own."""
    return Freedom.of_focals(np.array(group), start.focal, *PRIOR)


def shaken(truth: Bundle) -> Bundle:
    """A start as landmarks give it: a focal length that is 25 per cent short, poses and points that are off."""
    rng = np.random.default_rng(2)
    heads = truth.heads.copy()
    heads[:, :3, 3] += rng.normal(size=(len(heads), 3))
    points = truth.points + 0.3 * rng.normal(size=truth.points.shape)
    return replace(truth, focal=0.75 * truth.focal, heads=heads, points=points, expression=0 * truth.expression)


@pytest.mark.parametrize("expressions", [0.0, 0.2])
def test_exact_matches_give_the_focal_length_whatever_the_face_does(expressions: float) -> None:
    truth, seen, modes = exact(TURNS, expressions)
    start = shaken(truth)
    found = adjust_bundle(start, seen, freedom(start), modes)
    assert found.settled
    assert found.bundle.focal == pytest.approx(FOCAL, rel=2e-3)
    assert found.residual < 0.02
    angle = Rotation.from_matrix(found.bundle.cameras[1, :3, :3]).magnitude()
    assert np.degrees(angle) == pytest.approx(40.0, abs=0.1)


def test_the_deviation_is_that_of_repeated_noise() -> None:
    truth, seen, modes = exact(TURNS, points=150)
    rng, logs, told = np.random.default_rng(3), [], []
    for _ in range(12):
        noisy = replace(seen, pixels=seen.pixels + 0.3 * rng.normal(size=seen.pixels.shape))
        found = adjust_bundle(truth, noisy, freedom(truth), modes)
        logs.append(np.log(found.bundle.focal[0]))
        told.append(found.deviations[0])
    assert np.mean(told) == pytest.approx(np.std(logs, ddof=1), rel=0.6)  # twelve samples give it to 20 %


def test_two_views_of_a_head_that_keeps_still_determine_no_focal_length() -> None:
    truth, seen, modes = exact(TURNS[:1])
    noisy = replace(seen, pixels=seen.pixels + 0.3 * np.random.default_rng(3).normal(size=seen.pixels.shape))
    found = adjust_bundle(truth, noisy, freedom(truth), modes)
    assert found.deviations[0] > 0.1


def test_known_focal_lengths_stay() -> None:
    truth, seen, modes = exact(TURNS)
    start = replace(shaken(truth), focal=truth.focal * (1.0, 0.8))
    found = adjust_bundle(start, seen, freedom(start, (-1, 0)), modes)
    assert found.bundle.focal[0] == FOCAL
    assert found.bundle.focal[1] == pytest.approx(FOCAL, rel=2e-3)


MISTAKES = {
    "none": lambda truth: (truth, 0.0),
    "focal lengths": lambda truth: (replace(truth, focal=1.15 * truth.focal), 0.0),
    "one focal length": lambda truth: (replace(truth, focal=truth.focal * (1.0, 1.15)), 0.0),
    "turn": lambda truth: (replace(truth, cameras=np.stack([truth.cameras[0], turned(1.0) @ truth.cameras[1]])), 0.0),
    "principal point": lambda truth: (truth, 20.0),
}


def turned(degrees: float):
    """A turn about the vertical."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, degrees, 0], degrees=True).as_matrix()
    return turn


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_calibration_is_named_with_its_correction(name: str) -> None:
    truth, seen, modes = exact(TURNS, 0.2)
    start, shift = MISTAKES[name](truth)
    pixels = seen.pixels + 0.3 * np.random.default_rng(4).normal(size=seen.pixels.shape)
    pixels[seen.camera == 1, 0] += shift
    found = explain_matches(start, replace(seen, pixels=pixels), modes, BOTH)
    told = {(one.camera, len(one.value)): one for one in found.errors}
    assert [one.code for one in found.diagnostics] == ([] if name == "none" else ["calibration-doubtful"])
    assert len(told) == 5 and found.points == 400 and len(found.lines) == 6
    if name == "none":
        assert found.residual < 0.5 and not any(one.large for one in found.errors)
        return
    camera, text = {
        "focal lengths": (None, "all focal lengths by -13"),
        "one focal length": ("right", "the focal length of right by -13"),
        "turn": ("right", "a turn of right by 1.0"),
        "principal point": ("right", "pixels)"),
    }[name]
    assert text in found.diagnostics[0].text and found.diagnostics[0].camera in (camera, None)
    if name in ("turn", "principal point"):
        degrees = {"turn": -1.0, "principal point": np.degrees(np.arctan(20.0 / FOCAL))}[name]
        assert told["right", 3].value[1] == pytest.approx(degrees, abs=0.15)
    else:
        assert told[camera, 1].value[0] == pytest.approx(1 / 1.15 - 1, abs=0.03)
