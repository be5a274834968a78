"""Light that mesh and lighting don't explain: shown under the capture's own light, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import Illumination
from mifit.output.surface import surface_maps
from mifit.result import Reconstruction
from tests.output.conftest import ball_camera, ball_result


@pytest.fixture(scope="module")
def parted(variant):
    """A result with smooth skin and residual shading, and one with their product as albedo."""
    whole = ball_result()
    found = whole.reflectance.diffuse
    residual_shading = np.linspace(0.6, 1.2, len(found), dtype=np.float32)[:, None, None] * np.ones_like(found)
    skin = replace(whole.reflectance, diffuse=found / residual_shading, residual_shading=residual_shading)
    return replace(whole, reflectance=skin), whole


def test_its_own_light_shows_the_product(parted):
    result, whole = parted
    for method in ("diffuse", "full"):
        shown = result.render(ball_camera(), 0, method)
        np.testing.assert_allclose(shown, whole.render(ball_camera(), 0, method), atol=1e-5)
    traced = [r.render(ball_camera(size=24), 0, "diffuse", "path", 16) for r in parted]
    np.testing.assert_allclose(*traced, atol=1e-3)


def test_another_light_shows_skin_alone(parted):
    result, whole = parted
    light = Illumination(np.float64([[0.9, 0.8, 0.7]]))
    bare = replace(whole, reflectance=replace(result.reflectance, residual_shading=None))
    shown = result.relight(light)
    assert shown.reflectance.residual_shading is None
    np.testing.assert_array_equal(shown.render(ball_camera(), 0), bare.relight(light).render(ball_camera(), 0))
    assert np.abs(shown.render(ball_camera(), 0) - whole.relight(light).render(ball_camera(), 0)).max() > 0.02


def test_files_without_a_light_hold_skin(parted):
    result, whole = parted
    skin, lit = surface_maps(result, 0, skin=True).diffuse, surface_maps(result, 0).diffuse
    np.testing.assert_allclose(lit, surface_maps(whole, 0).diffuse, atol=1e-6)
    assert np.abs(skin - lit).max() > 0.05


def test_it_is_kept_in_the_folder(parted, tmp_path):
    result, whole = parted
    result.save(tmp_path / "result")
    loaded = Reconstruction.load(tmp_path / "result", model=result.model)
    np.testing.assert_array_equal(loaded.reflectance.residual_shading, result.reflectance.residual_shading)
    np.testing.assert_array_equal(loaded.reflectance.diffuse, result.reflectance.diffuse)
    whole.save(tmp_path / "result", force=True)
    assert Reconstruction.load(tmp_path / "result", model=result.model).reflectance.residual_shading is None
