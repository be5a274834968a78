"""Stage 1c: bumps that matches between views leave go, because shading and highlights show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from stages.reflectance_scene import turning_dome

from mifit.config import ReflectanceConfig
from mifit.core.mesh import vertex_normals
from mifit.core.mesh_solve import interior_vertices
from mifit.stages import refine_surface as module
from mifit.stages.refine_surface import Field, Patch, refine_surface

pytestmark = pytest.mark.usefixtures("variant")
BOTH = ("left", "right")
BANDS = ReflectanceConfig(bands=4, exponent=60.0, specular_albedo=0.15)


def bump(vertices, height=0.05):
    """Heights over the dome; zero at its border."""
    x, y = vertices[:, 0], vertices[:, 1]
    return height * np.sin(5 * x) * np.sin(4 * y) * (1 - x**2) * (1 - y**2)


def bumped(scene):
    """The true geometry with bumps."""
    model, true = scene.model, scene.geometry
    normal = vertex_normals(model.mean.astype(np.float64), model.faces)
    moved = bump(model.mean)[:, None] * normal
    world = moved @ true.rotation.transpose(0, 2, 1)
    return replace(true, displacement=moved.astype(np.float32), vertices=(true.vertices + world).astype(np.float32))


def off(scene, geometry):
    """Root mean square distance from the true vertices inside the face."""
    inside = interior_vertices(scene.model.faces, scene.model.face_mask, len(scene.model.mean))
    return float(np.sqrt(np.mean((geometry.vertices - scene.geometry.vertices)[:, inside] ** 2) * 3))


@pytest.fixture(scope="module", autouse=True)
def small_maps():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "LARGEST_MAP", 96)
        yield


@pytest.fixture(scope="module")
def scene(variant):
    return turning_dome("shadowed", steps=2)


@pytest.fixture(scope="module")
def refined(scene):
    return refine_surface(scene, scene.model, bumped(scene), BOTH, BANDS)


def test_bumps_go(scene, refined):
    assert off(scene, refined) < 0.45 * off(scene, bumped(scene))


def test_a_true_surface_stays(scene):
    assert off(scene, refine_surface(scene, scene.model, scene.geometry, BOTH, BANDS)) < 0.35 * off(
        scene, bumped(scene)
    )


def test_vertices_follow_the_displacement(scene, refined):
    start = bumped(scene)
    by = (refined.displacement - start.displacement).astype(np.float64)
    assert_allclose(refined.vertices, start.vertices + by @ start.rotation.transpose(0, 2, 1), atol=1e-6)
    outside = ~interior_vertices(scene.model.faces, scene.model.face_mask, len(by))
    assert not by[outside].any() and by[~outside].any()
    assert refined.report.details["phases"][-1]["name"] == "shading"


def test_one_view_leaves_the_surface(scene):
    start = bumped(scene)
    assert refine_surface(scene, scene.model, start, ("left",), BANDS) is start
    assert refine_surface(scene, scene.model, start, BOTH, replace(BANDS, robust=False)) is start


def test_tilts_are_the_slopes_of_heights(scene):
    """The linear map from heights to normals is the derivative of the mesh's own normals."""
    model, field = scene.model, Field.of(scene.model, scene.geometry, 0.01)
    height = bump(model.mean, 1e-4)[field.free]
    shape = model.mean.astype(np.float64)
    turned = vertex_normals(shape + field.displacement(height), model.faces) - vertex_normals(shape, model.faces)
    found = np.stack([slope @ height for slope in field.slope], axis=1)
    inner = np.abs(model.mean[:, :2]).max(axis=1) < 0.8
    assert_allclose(found[inner], turned[inner], atol=0.1 * np.abs(turned).max())


def test_eliminated_albedos_leave_no_negative_curvature(scene, monkeypatch):
    seen = []
    monkeypatch.setattr(module, "_settle", lambda patch, field, height: (seen.append((patch, field)), (height, 0.0))[1])
    refine_surface(scene, scene.model, bumped(scene), BOTH, BANDS)
    patch, field = seen[0]
    assert isinstance(patch, Patch)
    blocks, sides = patch.equations(np.zeros_like(field.normal), field.normal, 0.02)
    assert np.isfinite(blocks).all() and np.isfinite(sides).all()
    assert_array_equal(blocks, blocks.transpose(0, 2, 1))
    assert np.linalg.eigvalsh(blocks).min() > -1e-3 * np.abs(blocks).max()


def test_texels_that_one_image_sees_say_nothing(scene):
    """Each camera's images show another half of the face: nothing is measured, and nothing fails."""

    def half(frame, left):
        valid = frame.valid.copy()
        columns = np.flatnonzero(valid.any(axis=0))
        middle = (columns[0] + columns[-1]) // 2
        valid[:, middle - 20 :] &= not left
        valid[:, : middle + 20] &= left
        return replace(frame, valid=valid)

    frames = {(name, t): half(frame, name == "left") for (name, t), frame in scene.frames.items() if name in BOTH}
    start = scene.geometry.at((0,))
    found = refine_surface(replace(scene, frames=frames), scene.model, start, BOTH, BANDS)
    assert_allclose(found.vertices, start.vertices, atol=2e-3)


def test_light_that_is_off_smoothly_bends_the_surface_less(scene, monkeypatch):
    """Shades that change slowly over the face, other ones in each image, are the light's."""

    def shaded(frame, turn):
        y, x = np.mgrid[-1 : 1 : frame.image.shape[0] * 1j, -1 : 1 : frame.image.shape[1] * 1j]
        shade = 1.0 + 0.05 * (np.cos(turn) * x + np.sin(turn) * y)
        return replace(frame, image=(frame.image * shade[..., None]).astype(np.float32))

    frames = {key: shaded(scene.frames[key], 1.0 + 2.0 * k) for k, key in enumerate(sorted(scene.frames))}
    given = replace(scene, frames=frames), scene.model, scene.geometry, BOTH, BANDS
    bent = off(scene, refine_surface(*given))
    monkeypatch.setattr(module, "LIGHT_MM", 100.0)
    assert bent < 0.85 * off(scene, refine_surface(*given))
