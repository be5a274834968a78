"""Exposures of images: found on captures whose timesteps were scaled by known factors, and not where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import turning_dome

from mifit import Capture
from mifit.stages.exposures import estimate_exposures
from mifit.stages.image_factors import MAP_SIZE
from mifit.stages.observations import Surface

CAMERAS = ("left", "right")
CHANGED = (1.0, 1.3, 0.8, 1.1)


@pytest.fixture(scope="module")
def dome(variant):
    """Turned by as much as heads are: by three times that, light from other sides looks like another exposure."""
    return turning_dome(gloss=0.12, depth=2.0, swing=0.4)


def exposed(scene, factors):
    """The scene with each camera's images multiplied, by timestep."""
    frames = {
        (name, t): replace(f, image=f.image * np.float32(factors[name][t])) if name in factors else f
        for (name, t), f in scene.frames.items()
    }
    return replace(scene, frames=frames)


def found(scene, steps=4):
    geometry = scene.geometry.at(range(steps))
    return estimate_exposures(Surface(scene, scene.model, geometry, CAMERAS, MAP_SIZE), geometry, CAMERAS)


def test_images_of_one_exposure_stay(dome):
    """Although the dome turns under a light from one side, and its colours with it."""
    assert found(dome) == {}
    assert found(dome, steps=1) == {}


def test_a_changing_exposure_is_told_from_shading(dome):
    told = found(exposed(dome, dict.fromkeys(CAMERAS, CHANGED)))
    assert told["left"] == told["right"]  # both changed alike
    assert np.allclose(told["left"], CHANGED, rtol=0.02)


def test_cameras_that_change_by_themselves(dome):
    other = (1.0, 0.75, 1.2, 1.1)
    told = found(exposed(dome, {"left": CHANGED, "right": other}))
    assert np.allclose(told["left"], CHANGED, rtol=0.05) and np.allclose(told["right"], other, rtol=0.05)
    assert told["left"][0] == told["right"][0] == 1.0


def test_a_brighter_camera_is_no_changed_exposure(dome):
    """That is a gain, the same at all timesteps."""
    assert found(exposed(dome, {"right": (1.4,) * 4})) == {}


def test_images_are_divided_by_what_was_found(dome):
    told = replace(dome.geometry, exposures={"left": CHANGED})
    assert told.exposed == {("left", t): f for t, f in enumerate(CHANGED)}
    assert told.at((2, 1)).exposed == {("left", 2): 0.8, ("left", 1): 1.3}


def test_a_capture_read_in_other_exposures(tiny_capture):
    capture = Capture.load(tiny_capture)
    name, t = capture.cameras[0], capture.timesteps[0]
    plain = capture.frame(name, t)
    changed = capture.with_exposures({(name, t): 2.0})
    assert np.array_equal(changed.frame(name, t).image, plain.image / 2)
    assert np.array_equal(changed.frame(name, t).valid, plain.valid)
    assert np.array_equal(changed.frame(capture.cameras[1], t).image, capture.frame(capture.cameras[1], t).image)
    assert np.array_equal(capture.frame(name, t).image, plain.image)  # what is kept isn't changed
    assert not changed.frame(name, t).image.flags.writeable
    assert changed.digest() == capture.digest()
