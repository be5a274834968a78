"""Gains and exposures: found where images were multiplied by known factors, and not where there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import turning_dome

from mifit import Capture
from mifit.config import PhotometryConfig
from mifit.core.photometry import Photometry
from mifit.stages.photometry import Factors, Solution, find_photometry

CAMERAS = ("left", "right")
GAIN = (1.25, 0.9, 1.1)
CHANGED = (1.0, 1.3, 0.8, 1.1)


@pytest.fixture(scope="module")
def dome(variant):
    """Turned by as much as heads are, with strong specular reflection."""
    return turning_dome(gloss=0.12, depth=2.0, swing=0.4)


def exposed(scene, factors):
    """The scene with images multiplied by factors of camera and timestep."""
    frames = {
        key: replace(f, image=(f.image * np.float32(factors(*key))).astype(np.float32))
        for key, f in scene.frames.items()
    }
    return replace(scene, frames=frames)


def found(scene, cameras=CAMERAS, steps=4, config=None):
    return find_photometry(scene, scene.model, scene.geometry.at(range(steps)), cameras, config)


def test_equal_cameras_of_one_exposure_stay(dome):
    """Although the dome turns under a light from one side, and its specular reflection with it."""
    assert found(dome) == Photometry() and not found(dome)


def test_gains_are_found_on_a_glossy_surface(dome):
    told = found(exposed(dome, lambda name, t: GAIN if name == "right" else 1.0))
    assert told.gain["left"] == (1.0, 1.0, 1.0) and not told.exposure
    assert np.allclose(told.gain["right"], GAIN, rtol=0.04)


def test_a_third_camera_has_its_own_gain(dome):
    told = found(exposed(dome, lambda name, t: 0.7 if name == "third" else 1.0), ("left", "right", "third"))
    assert np.allclose(told.gain["third"], 0.7, rtol=0.05) and np.allclose(told.gain["right"], 1.0, rtol=0.04)


def test_an_exposure_that_changes_with_time(dome):
    told = found(exposed(dome, lambda name, t: CHANGED[t]))
    left, right = ([told.exposure[name, t] for t in range(4)] for name in CAMERAS)
    assert left == right and not told.gain  # both changed alike
    assert np.allclose(left, CHANGED, rtol=0.03)


def test_cameras_that_change_by_themselves(dome):
    own = {"left": CHANGED, "right": (1.0, 0.75, 1.2, 1.1)}
    told = found(exposed(dome, lambda name, t: own.get(name, CHANGED)[t]))
    for name in CAMERAS:
        assert np.allclose([told.exposure[name, t] for t in range(4)], own[name], rtol=0.05)


def test_gains_and_exposures_together(dome):
    told = found(exposed(dome, lambda name, t: CHANGED[t] * np.array(GAIN if name == "right" else 1.0)))
    assert np.allclose(told.gain["right"], GAIN, rtol=0.04)
    assert np.allclose([told.exposure["right", t] for t in range(4)], CHANGED, rtol=0.03)


def test_where_nothing_can_be_found_nothing_is(dome):
    scaled = exposed(dome, lambda name, t: GAIN if name == "right" else 1.0)
    assert not found(scaled, steps=1) and not found(scaled, config=PhotometryConfig(enabled=False))
    blind = scaled.changed(lambda f: replace(f, valid=np.zeros_like(f.valid)))
    assert not found(blind)


def test_the_first_camera_and_timestep_are_the_reference():
    factors = Factors.of(np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]))
    assert list(factors.group) == ["gain"] * 3 + ["exposure", "own"]
    assert not factors.design[0].any()
    assert (factors.design[3] == [[1, 0, 0, 1, 1], [0, 1, 0, 1, 1], [0, 0, 1, 1, 1]]).all()
    assert factors.only(["exposure"]).design[:, 0, 0].tolist() == [0, 0, 1, 1]


def test_a_capture_is_read_over_its_factors(tiny_capture):
    capture = Capture.load(tiny_capture)
    name, t = capture.cameras[0], capture.timesteps[0]
    plain = capture.frame(name, t)
    changed = capture.with_photometry(Photometry({name: (2.0, 1.0, 0.5)}, {(name, t): 2.0}))
    assert np.allclose(changed.frame(name, t).image, plain.image / np.float32((4.0, 2.0, 1.0)))
    assert np.array_equal(changed.frame(name, t).valid, plain.valid)
    assert np.array_equal(changed.frame(capture.cameras[1], t).image, capture.frame(capture.cameras[1], t).image)
    assert np.array_equal(capture.frame(name, t).image, plain.image)  # what is kept isn't changed
    assert not changed.frame(name, t).image.flags.writeable and changed.digest() == capture.digest()


def test_factors_round_trip_and_damaged_ones_are_refused():
    photometry = Photometry({"a": (1.0, 1.0, 1.0), "b": (1.2, 0.9, 1.0)}, {("b", 7): 0.5})
    assert Photometry.from_document(photometry.document()) == photometry
    for damaged in ({"gain": {"a": [1.0, 2.0]}}, {"gain": {"a": [1.0, 0.0, 1.0]}}, {"exposure": {"a": {"0": -1.0}}}):
        with pytest.raises(ValueError, match="positive"):
            Photometry.from_document(damaged)


def test_a_factor_counts_where_it_is_far_from_1_and_surely_so():
    factors = Factors.of(np.array([0, 1]), np.array([0, 0]))
    groups = {
        deviation: Solution(factors, np.array([0.2, 0.01, 0.01]), np.full(3, deviation)).sure()
        for deviation in (0.01, 0.2)
    }
    assert groups == {0.01: ["gain"], 0.2: []}
