"""Wrong captures are named before they are fitted, and good ones are not questioned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mifit.capture import Capture
from mifit.capture.detect import available
from mifit.morphable import MorphableModel
from mifit.stages.checks import capture_checks
from mifit.stages.checks.capture_checks import check_capture
from mifit.stages.checks.landmark_model import Shot
from mifit.synth import synthesize
from tests.checks.wrong_captures import WRONG, frontal, make, read, write

PAIR = ("left", "right")
NAMED = {
    "one mirrored": ("mirrored", "right"),
    "one mirrored, landmarks along": ("flipped", "right"),
    "landmarks swapped": ("landmarks-swapped", None),
    "cameras swapped": ("cameras-swapped", None),
    "upside down": ("upside-down", None),
    "right copies left": ("images-copied", "right"),
    "principal point": ("principal-point", "left"),
    "fy": ("pixels-not-square", "left"),
    "focal 2": ("lengths-wrong", None),
    "one turned, pitch": ("camera-turned", None),
    "inches": ("lengths-wrong", None),
    "landmarks at twice the scale": ("landmarks-doubled", None),
    "one late": ("camera-delayed", "right"),
    "BGR in both": ("channels-exchanged", "left"),
    "BGR in one": ("channels-exchanged", "right"),
    "sRGB codes in EXR": ("encoded-as-linear", "left"),
    "lengths x 10": ("lengths-wrong", None),
    "all mirrored": ("cameras-swapped", None),
    "feet": ("lengths-wrong", None),
    "one upside down": ("upside-down", "left"),
    "one landmarks swapped": ("landmarks-swapped", "left"),
    "landmarks x and y exchanged": ("landmarks-transposed", None),
    "landmarks from below": ("landmarks-from-below", None),
    "timestep repeated": ("timesteps-alike", None),
    "OpenCV axes": ("poses-axes", None),
    "intrinsics of the full image": ("intrinsics-doubled", None),
    "world-to-camera": ("poses-inverted", None),
    "sRGB codes in EXR, one": ("encoded-as-linear", "left"),
    "right mirrors left": ("images-copied", "right"),
    "landmarks shifted": ("landmarks-shifted", "left"),
}
"""The first finding of each: code and camera."""
UNKNOWABLE = {
    "both mirrored, swapped", "focal 1.15", "baseline", "one turned, yaw", "linear in PNG", "tone curve",
    "lens left out", "two people",
}  # fmt: skip
"""What no image shows; docs/limits.md says why, and what it costs."""
MOMENTS = {"one late": 5, "timestep repeated": 2}
"""Timesteps that a mistake needs to be seen, where one is too few."""
SAID = {
    "inches": "lengths of the cameras are in inches, the capture says one is 10 mm; multiply the translations by 2.54",
    "feet": "multiply the translations by 30.48",
    "lengths x 10": 'in millimetres, the capture says one is 10 mm; correct "units" in transforms.json, or',
    "all mirrored": ", or all cameras: images are mirrored",
    "one late": "camera right is 1 timestep late",
    "one turned, pitch": "landmarks of camera right lie (",
    "upside down": "turn them by 180 degrees",
    "landmarks shifted": "landmarks lie (12, -1) pixels from where a detector sees them, expected within 5",
}


def test_every_wrong_capture_has_its_place():
    assert set(NAMED) | UNKNOWABLE == set(WRONG)


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


def findings(capture: Capture, model: MorphableModel, cameras=PAIR):
    return check_capture(capture, model, cameras, capture.timesteps[:4])


@pytest.mark.parametrize("name", NAMED)
def test_what_is_wrong_is_named(name, shared, model, tmp_path):
    if name == "landmarks shifted" and not available()["mediapipe"]:
        pytest.skip("the networks that find landmarks are not here: mifit doctor --install landmarks")
    capture = Capture.load(make(name, shared / "captures/soft", tmp_path, timesteps=MOMENTS.get(name, 1)))
    found = findings(capture, model)
    assert (found[0].code, found[0].camera) == NAMED[name], [one.text for one in found]
    assert SAID.get(name, "") in found[0].text
    others = {one.code for one in found[1:] if one.severity == "fault"} - {found[0].code}
    assert not others or name == "world-to-camera"


@pytest.mark.parametrize("name", sorted(UNKNOWABLE))
def test_what_no_image_tells_is_not_called_something_else(name, shared, model, tmp_path):
    capture = Capture.load(make(name, shared / "captures/soft", tmp_path, timesteps=2))
    assert findings(capture, model) == []


@pytest.mark.parametrize(("shift", "single", "named"), [(0.0, 0.5, 0), (1.2, 1.0, 0), (1.9, 1.0, 2), (1.9, 2.5, 0)])
def test_a_shift_is_told_from_what_detectors_differ_by(shift, single, named, shared, monkeypatch):
    """In deviations of a landmark; where single ones lie off as well, it is the detector that fails."""
    capture = Capture.load(shared / "captures/soft")
    shots = iter(capture_checks.landmark_shots(capture, PAIR, (0,)))
    rng = np.random.default_rng(0)

    class Other:
        def detect(self, image):
            pixels = next(shots).pixels
            noise = capture_checks.noise_of([Shot(capture.camera("left"), 0, pixels)])
            return pixels - (0.0, shift * noise) + single / 1.2 * noise * rng.normal(size=(68, 2))

    monkeypatch.setattr(capture_checks, "available", lambda: {"mediapipe": True})
    monkeypatch.setattr(capture_checks, "open_detector", lambda name: Other())
    found = capture_checks.shift_diagnostics(capture, PAIR, 0)
    assert [(one.code, one.severity) for one in found] == [("landmarks-shifted", "fault")] * named


@pytest.mark.parametrize("half", [False, True])
def test_a_detector_that_fails_on_a_profile_is_named(half, shared, model, tmp_path):
    views = ("c3", "c1", "c6")  # a front and the profiles
    rough = read(shared / "captures/emily", 1, cameras=views)
    frontal(rough.of("c6"), rough.frames["c3", 0], half)
    found = findings(Capture.load(write(rough, tmp_path)), model, views)
    assert [(one.code, one.camera) for one in found] == [("landmarks-unexplained", "c6")]


@pytest.mark.parametrize("name", ["soft", "gloss", "hard", "scan_city", "scan_studio", "scan_sun"])
def test_good_captures_are_not_questioned(name, shared, model):
    capture = Capture.load(shared / "captures" / name)
    assert findings(capture, model) == [] and findings(capture, model, PAIR[:1]) == []


@pytest.mark.parametrize(
    "cameras", [("c3", "c4"), ("c2", "c5"), ("c1", "c4"), ("c6", "c7"), ("c3",), tuple(f"c{k}" for k in range(1, 8))]
)
def test_views_of_a_measured_head_are_not_questioned(cameras, shared, model):
    assert findings(Capture.load(shared / "captures/emily"), model, cameras) == []


def test_a_capture_made_here_is_not_questioned(tiny_capture: Path, model):
    assert findings(Capture.load(tiny_capture), model) == []


def test_a_face_of_fifty_pixels_is_too_small_for_a_detector_to_judge(variant, model, tmp_path):
    size = {"width": 120, "height": 90, "spp": 16}
    synthesize(tmp_path / "capture", timesteps=1, model="builtin:coarse", seed=0, **size)
    assert findings(Capture.load(tmp_path / "capture"), model) == []


def test_black_images_are_no_copies(shared, model, tmp_path):
    rough = read(shared / "captures/soft", 2, cameras=PAIR)
    for frame in rough.of(*PAIR):
        frame["image"] = 0 * frame["image"]
    assert not {one.code for one in findings(Capture.load(write(rough, tmp_path)), model)} & {
        "images-copied",
        "timesteps-alike",
    }
