"""Falloff of lenses: found on captures whose corners were darkened, and not where sheen might do the same."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from stages.normal_scene import camera
from stages.reflectance_scene import lighting, turning_dome

from mifit import Capture
from mifit.config import GeometryConfig
from mifit.stages.falloff import LEAST, estimate_falloff, find_falloff, shared_lenses
from mifit.stages.image_factors import MAP_SIZE
from mifit.stages.observations import Surface

CAMERAS = ("left", "right")
DARKER = 0.5
CONFIG = GeometryConfig()


@pytest.fixture(scope="module")
def grey(variant):
    """With sheen, in light of one colour."""
    radiance = np.repeat(lighting().mean(axis=1, keepdims=True), 3, axis=1)
    return turning_dome(gloss=0.04, depth=2.0, swing=0.4, radiance=radiance)


@pytest.fixture(scope="module")
def colourful(variant):
    """With more sheen, in light that has another colour from every side."""
    return turning_dome(gloss=0.12, depth=2.0, swing=0.4)


def transmission(view, falloff):
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    square = ((x - view.cx) ** 2 + (y - view.cy) ** 2) / (0.25 * (view.width**2 + view.height**2))
    return np.exp(-falloff * square)[..., None]


def without_lens(scene, falloff, contrast):
    """`Capture.with_lenses` of a scene."""
    frames = {}
    for (name, t), frame in scene.frames.items():
        image = frame.image / transmission(scene.camera(name), falloff.get(name, 0.0))
        frames[name, t] = replace(frame, image=(image ** (1.0 / contrast.get(name, 1.0))).astype(np.float32))
    return replace(scene, frames=frames)


def through_lens(scene, falloff, gain=1.0, contrast=1.0):
    """The scene with the corners of all images darker, the right camera's in another exposure and contrast."""
    frames = {}
    for (name, t), frame in scene.frames.items():
        image = frame.image * transmission(scene.camera(name), falloff)
        image = (gain * image) ** contrast if name == "right" else image
        frames[name, t] = replace(frame, image=image.astype(np.float32))
    return replace(scene, frames=frames)


def found(scene):
    surface = Surface(scene, scene.model, scene.geometry, CAMERAS, MAP_SIZE)
    return estimate_falloff(surface, scene.geometry, [scene.camera(name) for name in CAMERAS])


def test_a_lens_that_is_bright_all_over_stays(grey):
    assert found(grey) == ({}, {})
    assert found(through_lens(grey, 0.5 * LEAST)) == ({}, {})


def test_sheen_in_light_of_many_colours_is_neither(colourful):
    """Falloff seems to be .98 there, and is as uncertain as the light's tint is."""
    assert found(colourful) == ({}, {})


def test_darker_corners_are_told_from_sheen(grey):
    falloff, contrast = found(through_lens(grey, DARKER))
    assert falloff["left"] == falloff["right"] == pytest.approx(DARKER, abs=0.05) and not contrast


def test_contrast_and_falloff_are_told_from_each_other_and_from_gains(grey):
    falloff, contrast = found(through_lens(grey, DARKER, gain=1.25, contrast=1.15))
    assert falloff["left"] == falloff["right"] == pytest.approx(DARKER, abs=0.06)
    assert set(contrast) == {"right"} and contrast["right"] == pytest.approx(1.15, abs=0.03)
    falloff, contrast = found(through_lens(grey, 0.0, gain=0.8, contrast=1 / 1.15))
    assert not falloff and contrast["right"] == pytest.approx(1 / 1.15, abs=0.03)


def test_brighter_corners_are_no_lens(grey):
    assert found(through_lens(grey, -DARKER))[0] == {}
    assert found(through_lens(grey, 2.0))[0] == {}  # seven eighths of the light would be gone


def test_the_geometry_carries_what_was_found(grey):
    scene, geometry = through_lens(grey, DARKER), grey.geometry
    told = find_falloff(scene, scene.model, geometry, CAMERAS, CONFIG)
    assert told.falloff == found(scene)[0] and told.report.seconds > geometry.report.seconds
    assert find_falloff(scene, scene.model, geometry, CAMERAS[:1], CONFIG) is geometry
    still = geometry.at((0,))
    assert find_falloff(scene, scene.model, still, CAMERAS, CONFIG) is still


def test_gains_are_found_again_without_the_contrast(grey):
    scene = through_lens(grey, DARKER, gain=1.25, contrast=1.15)
    scene.with_lenses = partial(without_lens, scene)
    before = replace(grey.geometry, gains={"left": (1.0, 1.0, 1.0), "right": (1.1, 1.05, 1.0)})
    told = find_falloff(scene, scene.model, before, CAMERAS, CONFIG)
    assert told.gains["right"] == pytest.approx((1.25, 1.25, 1.25), rel=0.05)
    off = replace(CONFIG, falloff=False, contrast=False)
    plain = find_falloff(scene, scene.model, before, CAMERAS, off)
    assert not plain.falloff and not plain.contrast and plain.gains == before.gains


def test_cameras_of_one_size_and_focal_length_share_a_lens():
    left, right = camera("left", 0.0), camera("right", 0.3)
    assert shared_lenses([left, right, replace(left, fx=1.02 * left.fx)]) == [0, 0, 0]
    assert shared_lenses([left, replace(right, fx=1.2 * left.fx), right, replace(right, width=200)]) == [0, 1, 0, 2]


def test_a_capture_read_without_falloff(tiny_capture):
    capture = Capture.load(tiny_capture)
    name, t = capture.cameras[0], capture.timesteps[0]
    plain, view = capture.frame(name, t), capture.camera(name)
    corrected = capture.with_lenses({name: DARKER}, {})
    ratio = corrected.frame(name, t).image.astype(np.float64) / np.maximum(plain.image, 1e-6)
    lit = plain.image.min(axis=2) > 0.05
    square = (np.argwhere(lit)[:, ::-1] + 0.5 - [view.cx, view.cy]) / (0.5 * np.hypot(view.width, view.height))
    expected = np.exp(DARKER * (square**2).sum(axis=1))
    assert lit.any() and np.allclose(ratio[lit], expected[:, None], rtol=1e-4)
    both = corrected.with_exposures({(name, t): 2.0}).frame(name, t).image
    assert np.allclose(both, corrected.frame(name, t).image / 2, rtol=1e-5)
    assert capture.frame(name, t) is plain and not corrected.frame(name, t).image.flags.writeable
    assert corrected.frame(capture.cameras[1], t) is capture.frame(capture.cameras[1], t)
    assert corrected.digest() == capture.digest()
    steep = capture.with_lenses({}, {name: 1.25}).frame(name, t).image
    assert np.allclose(steep[lit] ** 1.25, plain.image[lit], rtol=1e-4)
