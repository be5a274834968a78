"""The albedo of eyes without what mirrors itself in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, turning_dome

from mifit.config import ReflectanceConfig
from mifit.stages import infer_reflectance as stage
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.reflectance.beneath_film import REFLECTANCE, lower

CONFIG = ReflectanceConfig(texture_size=SIZE, shading="prefiltered", bands=4, exponent=EXPONENT, smoothness_weight=1e-5)


def views(*ratios: float) -> tuple[np.ndarray, np.ndarray]:
    """Colours of one texel with these albedos in views that are lit differently, and what they show of white."""
    white = np.linspace(0.5, 1.0, len(ratios), dtype=np.float32)[None, :, None].repeat(3, axis=2)
    return white * np.float32(ratios)[None, :, None], white


@pytest.mark.parametrize(
    ("ratios", "expected"),
    [
        ((0.3,), 0.3),
        ((0.9, 0.3), 0.3),
        ((0.3, 0.9, 0.31, 0.5), 0.31),
        ((0.1, 0.6, 0.61, 0.62, 0.63, 0.64, 0.65, 2.0), 0.61),  # an iris that looked here once
    ],
)
def test_one_of_the_lower_views_counts(ratios, expected) -> None:
    colour, white = views(*ratios)
    found, known = lower(colour, white, np.ones(white.shape[:2]))
    assert known.all()
    np.testing.assert_allclose(found, expected - REFLECTANCE, atol=1e-6)


def test_views_that_measure_nothing_don_t_count() -> None:
    colour, white = views(0.2, 0.9, 0.5)
    found, known = lower(colour, white, np.array([[0.0, 1.0, 1.0]]))
    np.testing.assert_allclose(found, 0.5 - REFLECTANCE, atol=1e-6)
    found, known = lower(colour, white, np.zeros((1, 3)))
    assert not known.any() and np.isfinite(found).all()


def test_a_highlight_stays_in_its_own_light_alone(variant, monkeypatch) -> None:
    """Part of the dome stands in for an eye, on which one of both cameras sees a lamp at every timestep."""
    scene = turning_dome(gloss=0.0)
    model = scene.model
    chosen = np.linalg.norm(model.mean[model.faces].mean(axis=1)[:, :2] - (0.1, 0.1), axis=1) < 0.3
    monkeypatch.setattr(stage, "eyeball_faces", lambda model: chosen)
    clean = infer_reflectance(scene, model, scene.geometry, ("left", "right"), CONFIG)
    for timestep in scene.geometry.timesteps:
        frame = scene.frames["left", timestep]
        rows, columns = (
            np.mgrid[: frame.valid.shape[0], : frame.valid.shape[1]]
            - np.argwhere(frame.valid).mean(axis=0)[:, None, None]
        )
        lamp = (np.hypot(rows, columns) < 6) & frame.valid
        scene.frames["left", timestep] = replace(frame, image=frame.image + np.float32(0.5) * lamp[..., None])
    found = infer_reflectance(scene, model, scene.geometry, ("left", "right"), CONFIG)
    eye = found.lit_eyes.any(axis=-1)
    painted = np.abs(found.lit_diffuse - clean.lit_diffuse).max(axis=-1)
    assert (painted[eye] > 0.02).sum() > 10
    assert np.abs(found.diffuse - clean.diffuse)[eye].max() < 0.005
    level = clean.lit_eyes[eye].mean() - REFLECTANCE
    assert clean.diffuse[eye].mean() == pytest.approx(level, abs=0.01)
    unlike_eyes = ~eye & (found.confidence > 0)
    relief = 1.0 if found.relief is None else found.relief[unlike_eyes, None]
    np.testing.assert_array_equal(found.lit_diffuse[unlike_eyes], found.diffuse[unlike_eyes] * relief)
