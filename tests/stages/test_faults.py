"""Stage 1's names for what is wrong with a calibration: each mistake is made and must be the one that is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_capture import look_at_head

from mifit.morphable import MorphableModel
from mifit.stages.geometry.faults import (
    MISTAKES,
    calibration_fault,
    calibration_warnings,
    delayed_camera,
    unseen_warnings,
)
from mifit.stages.geometry.landmarks import LandmarkView
from mifit.stages.geometry.parameters import exponential
from mifit.stages.geometry.points import PointBasis

LOCATION = next(iter(MISTAKES))
NOISE = 1.0
"""Of a landmark coordinate, pixels."""


@pytest.fixture(scope="module")
def model():
    return MorphableModel.load("builtin:coarse").subset(identity=30, expression=20, albedo=10)


def seen(model, lag=0, steps=6):
    """Landmarks of a head that turns, in two views of which the second is some timesteps late."""
    rng = np.random.default_rng(4)
    identity = rng.normal(size=model.n_identity)
    neutral = model.shape(identity)[model.landmarks]
    elsewhere = np.eye(4)  # the head isn't the world's origin, nor are its axes the world's
    elsewhere[:3, :3], elsewhere[:3, 3] = exponential(np.array([0.7, -0.4, 0.3])), (12.0, -35.0, 21.0)
    views = []
    for step in range(steps):
        for name, degrees, late in (("left", -22, 0), ("right", 18, lag)):
            camera = look_at_head(name, degrees, 680, 480)
            s = step - late
            turn = exponential(np.array([0.05 * np.sin(1.9 * s), 0.12 * np.sin(1.1 * s + 0.4), 0.04 * np.cos(1.5 * s)]))
            world = neutral @ turn.T + 0.6 * np.array([np.sin(1.3 * s), np.cos(0.9 * s), np.sin(0.7 * s)])
            pixels = camera.project(world) + NOISE * rng.normal(size=(68, 2))
            camera = replace(camera, world_to_camera=camera.world_to_camera @ np.linalg.inv(elsewhere))
            basis = PointBasis.at_vertices(model, model.landmarks)
            views.append(LandmarkView(step, camera, np.arange(68), model.landmarks, pixels, 1.0, basis))
    return views


def miscalibrated(views, change):
    """The same landmarks under other world-to-camera matrices."""
    return [replace(v, camera=replace(v.camera, world_to_camera=change(v.camera.world_to_camera))) for v in views]


def named(model, views):
    return calibration_fault(views, model.mean[model.landmarks].astype(np.float64), 1.0)


def test_a_right_calibration_has_no_fault(model):
    views = seen(model)
    assert named(model, views) is None
    assert calibration_warnings(views, model, 1.0, 200.0) == []


@pytest.mark.parametrize("mistake", list(MISTAKES))
def test_every_mistake_is_named(model, mistake):
    """Made by the inverse of what corrects it."""
    undo = MISTAKES[mistake]
    right = seen(model)
    pose = right[0].camera.world_to_camera
    inverses = [other for other in MISTAKES.values() if np.allclose(undo(other(pose)), pose)]
    assert inverses, "each correction is undone by one of the others"
    wrong = miscalibrated(right, inverses[0])
    assert named(model, wrong) == mistake
    assert any(mistake in one.text for one in calibration_warnings(wrong, model, 1.0, 200.0))


def test_mistakes_that_look_alike_are_all_named(model):
    """With the head at the world's origin and axes, a location for a translation is as good as an inverted matrix."""
    centred = [
        replace(v, camera=replace(look_at_head(v.camera.name, d, 680, 480), name=v.camera.name))
        for v, d in zip(seen(model), [-22, 18] * 6, strict=True)
    ]
    found = named(model, miscalibrated(centred, MISTAKES[LOCATION]))
    assert found is not None and LOCATION in found


def test_one_view_names_nothing(model):
    views = [v for v in miscalibrated(seen(model), MISTAKES[LOCATION]) if v.camera.name == "left"]
    assert named(model, views) is None


def test_landmarks_that_no_face_has_name_nothing(model):
    rng = np.random.default_rng(1)
    views = [replace(v, pixels=rng.uniform((0, 0), (680, 480), (68, 2))) for v in seen(model)]
    assert named(model, views) is None


@pytest.mark.parametrize("lag", [-2, 1, 3])
def test_a_late_camera_is_named(model, lag):
    views = seen(model, lag, steps=8)
    assert delayed_camera(views) == ("right", lag)
    assert any("right looks" in one.text for one in calibration_warnings(views, model, 1.0, 1.0))


def test_cameras_in_step_are_not_called_late(model):
    assert delayed_camera(seen(model, 0, steps=8)) is None


def test_a_camera_that_never_shows_the_face_is_named_with_what_to_look_at():
    blind = {("left", 0), ("right", 0), ("right", 1)}
    (found,) = unseen_warnings(blind, ("left", "right"), 2, 1000.0)
    assert found.camera == "right" and "1000 mm" in found.text and "left taken for right" in found.text
    assert unseen_warnings({("left", 0)}, ("left", "right"), 2, 1000.0) == []
