"""Gains of cameras: found on captures whose right camera was scaled by known factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import turning_dome
from stages.test_infer_reflectance import held_out, infer

from mifit.core.estimate import GeometryEstimate
from mifit.stages.gains import estimate_gains
from mifit.stages.image_factors import MAP_SIZE
from mifit.stages.observations import Observations, Surface
from mifit.synth.compose import expose

SCALE = (1.25, 0.9, 1.1)


def scaled(scene, camera="right", scale=SCALE):
    """The same scene with one camera's images multiplied."""
    frames = {
        key: replace(f, image=f.image * np.float32(scale)) if key[0] == camera else f for key, f in scene.frames.items()
    }
    return replace(scene, frames=frames)


@pytest.fixture(scope="module", autouse=True)
def fewer_points():
    """A third of the points: the dome is smooth, and its images are without noise."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mifit.stages.gains.POINTS", 1300)
        yield


def gains_of(scene, cameras=("left", "right"), **options):
    return estimate_gains(
        Surface(scene, scene.model, scene.geometry, cameras, MAP_SIZE), scene.geometry, cameras, **options
    )


@pytest.fixture(scope="module")
def dome(variant):
    return turning_dome(gloss=0.12)


@pytest.fixture(scope="module")
def gains(dome, fewer_points):
    return gains_of(scaled(dome))


def test_gains_are_found_on_a_glossy_surface(gains):
    assert gains["left"] == (1.0, 1.0, 1.0)
    assert np.allclose(gains["right"], SCALE, rtol=0.02)


def test_scaling_a_camera_scales_its_gains_and_no_more(dome, gains):
    """What is trusted and chosen doesn't depend on how unequal the cameras are."""
    equal = gains_of(dome)
    assert np.allclose(np.divide(gains["right"], equal["right"]), SCALE, rtol=0.005)


def test_the_fit_is_as_good_as_without_the_scaling(dome):
    """Against photographs with the noise of a sensor, as ``evaluate`` measures it."""
    rng = np.random.default_rng(0)
    noisy = dome.changed(lambda f: replace(f, image=np.where(f.valid[..., None], expose(f.image, rng), 0)))
    images = scaled(noisy)
    gains = gains_of(images)
    plain = held_out(noisy, infer(noisy))
    mended = held_out(noisy, infer(images, gains=gains))
    spoilt = held_out(noisy, infer(images))
    assert 20 * np.log10(mended / plain) < 0.3
    assert 20 * np.log10(spoilt / plain) > 1.0  # or else the test shows nothing


def test_unequal_cameras_are_brought_to_the_first(dome, gains):
    images = scaled(dome)
    corrected = Surface(images, dome.model, replace(dome.geometry, gains=gains), ("left", "right"), 32)
    true = Surface(dome, dome.model, dome.geometry, ("left", "right"), 32)
    rows = np.arange(len(true))
    a, b = corrected.observe(rows), true.observe(rows)
    assert np.allclose(a.colour[b.weight > 0], b.colour[b.weight > 0], rtol=0.02, atol=1e-4)


def test_a_third_camera(dome):
    cameras = ("left", "right", "third")
    found = gains_of(scaled(dome, "third", (0.7, 0.7, 0.7)), cameras)
    assert np.allclose(found["third"], 0.7, rtol=0.02) and np.allclose(found["right"], 1.0, rtol=0.02)


def test_a_camera_that_shares_nothing_is_left_out(dome):
    blind = replace(
        dome,
        frames={
            key: replace(f, valid=np.zeros_like(f.valid)) if key[0] == "right" else f for key, f in dome.frames.items()
        },
    )
    assert set(gains_of(blind)) == {"left"}


def test_the_tint_of_sheen_is_the_line_along_which_ratios_scatter() -> None:
    from mifit.stages.gains import _sheen_tint

    rng = np.random.default_rng(0)
    line, across = np.array([0.3, 0.5, 0.8]), np.array([0.5, -0.3, 0.0])
    line, across = line / np.linalg.norm(line), across / np.linalg.norm(across)
    ratio = (
        np.array([0.2, -0.1, 0.1])
        + rng.normal(size=(4000, 1)) * 0.1 * line
        + rng.normal(size=(4000, 1)) * 0.02 * across
    )
    towards = np.tile(np.float32([0, 0, 1]), (4000, 2, 1))
    seen = Observations(
        texel=np.arange(4000),
        face=np.zeros(4000, np.int32),
        barycentric=np.zeros((4000, 3), np.float32),
        step=np.zeros(2, np.int64),
        camera=np.arange(2),
        colour=np.exp(np.stack([np.full_like(ratio, np.log(0.3)), np.log(0.3) + ratio], axis=1)).astype(np.float32),
        weight=np.ones((4000, 2), np.float32),
        clipped=np.zeros((4000, 2), bool),
        right=np.ones((4000, 2), np.float32),
        point=towards[:, :1],
        normal=towards[:, :1],
        view=towards,
    )
    tint = _sheen_tint(seen)
    assert np.allclose(tint @ line, line, atol=0.02)
    assert 0.15 < across @ tint @ across < 0.45  # a fifth, and more where far ratios along the line count less
    assert abs(np.linalg.eigvalsh(tint)[0]) < 0.01


def test_gains_are_one_unless_known(dome):
    assert isinstance(dome.geometry, GeometryEstimate)
    assert (dome.geometry.gain("left") == 1).all() and dome.geometry.gains == {}


def test_cameras_differ_from_a_tenth_on_whatever_part_of_the_ratios_is_sheen() -> None:
    from mifit.stages.gains import differ

    def log(*right):
        return np.log([(1.0, 1.0, 1.0), right])

    assert not differ(log(1.04, 0.97, 1.08))
    assert differ(log(1.25, 0.9, 1.1)) and differ(log(1.0, 0.88, 1.0))
    assert differ(log(1.25, 0.9, 1.1), log(1.2, 0.85, 1.0))
    assert not differ(log(1.02, 1.03, 1.04), log(0.94, 0.9, 0.87))  # the lighting alone says so
    assert not differ(log(1.2, 1.2, 1.2), log(1.05, 1.04, 1.03))
    assert not differ(log(1.2, 1.0, 1.0), log(0.8, 1.0, 1.0))


def test_sheen_that_the_lighting_takes_for_granted_makes_no_gain(dome, monkeypatch):
    """As on meshes that are millimetres off: the cameras' ratios agree, and the lighting says that they shouldn't."""
    opinion = np.log([(1.0, 1.0, 1.0), (0.94, 0.9, 0.87)])
    monkeypatch.setattr("mifit.stages.gains._from_lighting", lambda seen, albedo, ratios, *_: ratios + opinion)
    assert gains_of(dome, certain=True) == {}
    always = gains_of(dome)
    assert abs(np.log(always["right"])).max() > 0.1  # or else the test shows nothing


def test_a_difference_that_the_lighting_takes_for_sheen_is_not_certain(dome, monkeypatch):
    images = scaled(dome, scale=(1.1, 1.15, 1.2))
    opinion = np.log([(1.0, 1.0, 1.0), (0.92, 0.9, 0.87)])
    assert set(gains_of(images, certain=True)) == {"left", "right"}
    monkeypatch.setattr("mifit.stages.gains._from_lighting", lambda seen, albedo, ratios, *_: ratios + opinion)
    assert gains_of(images, certain=True) == {}


def test_a_true_gain_is_certain(dome, gains):
    assert gains_of(scaled(dome), certain=True) == gains
