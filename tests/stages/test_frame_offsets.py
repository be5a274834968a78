"""Cameras out of step, told by a head that moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_capture import make_capture

from mifit.core.estimate import GeometryEstimate, Report
from mifit.morphable import MorphableModel
from mifit.stages.surface.frame_offsets import FrameOffset, frame_offset_warnings, frame_offsets

BOTH, FRAMES, HALVES = ("left", "right"), 8, 2


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=10, expression=5, albedo=5)


@pytest.fixture(scope="module")
def film(model):
    """A nodding head at every half frame."""
    times = np.arange(HALVES * FRAMES) / HALVES
    nods = 2.5 * np.sin(2.0 * np.pi * times / 16.0)
    return make_capture(model, [(nod, 0.5 * nod, 0) for nod in nods], width=340, height=240, frown=0.0, shift=0.0)


def out_of_step(film, later):
    """Frames of both cameras, those of the right one ``later`` half frames after the left one's."""
    last = HALVES * FRAMES - 1
    at = {"left": [HALVES * t for t in range(FRAMES)], "right": [min(HALVES * t + later, last) for t in range(FRAMES)]}
    frames = {(name, t): film.frames[name, at[name][t]] for name in BOTH for t in range(FRAMES)}
    return replace(film, frames=frames)


def geometry(model, film, later=0):
    """The head as a fit of both cameras finds it: between the two."""
    whole = film.vertices.astype(np.float64)
    one = whole[[HALVES * t for t in range(FRAMES)]]
    other = whole[[min(HALVES * t + later, len(whole) - 1) for t in range(FRAMES)]]
    count = len(one)
    return GeometryEstimate(
        timesteps=tuple(range(count)),
        identity=np.zeros(model.n_identity),
        albedo=np.zeros(model.n_albedo),
        expression=np.zeros((count, model.n_expression)),
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        translation=np.zeros((count, 3)),
        scale=1.0,
        vertices=(0.5 * (one + other)).astype(np.float32),
        vertex_albedo=model.mean_albedo,
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report("converged"),
    )


def test_cameras_in_step_are_so(model, film):
    found = frame_offsets(out_of_step(film, 0), model, geometry(model, film), BOTH)
    assert list(found) == ["right"]
    assert abs(found["right"].frames) < 0.05
    assert frame_offset_warnings(found, "left") == []


def test_half_a_frame_is_told_with_its_sign(model, film):
    found = frame_offsets(out_of_step(film, 1), model, geometry(model, film, 1), BOTH)
    assert found["right"].frames == pytest.approx(0.5, abs=0.08)
    assert found["right"].deviation < 0.1
    (warning,) = frame_offset_warnings(found, "left")
    assert warning.camera == "right" and "later" in warning.text


def test_a_calibration_that_is_off_is_no_offset_in_time(model, film):
    """The right camera's images lie a pixel too high in all frames."""
    capture = out_of_step(film, 0)
    moved = {
        key: replace(frame, image=np.roll(frame.image, -1, axis=0)) if key[0] == "right" else frame
        for key, frame in capture.frames.items()
    }
    found = frame_offsets(replace(capture, frames=moved), model, geometry(model, film), BOTH)
    assert abs(found["right"].frames) < 0.1


def test_a_still_head_tells_nothing(model, film):
    found = geometry(model, film)
    still = replace(found, vertices=np.repeat(found.vertices[:1], FRAMES, axis=0))
    assert frame_offsets(out_of_step(film, 1), model, still, BOTH) == {}


def test_single_timesteps_tell_nothing(model, film):
    found = geometry(model, film)
    assert frame_offsets(film, model, found.at((0, 2, 4, 6)), BOTH) == {}


def test_what_is_uncertain_is_no_warning():
    assert frame_offset_warnings({"right": FrameOffset(0.4, 0.2)}, "left") == []
    assert "earlier" in frame_offset_warnings({"right": FrameOffset(-0.4, 0.05)}, "left")[0].text
