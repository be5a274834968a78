"""The compact light in saved results, renders and relighting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import DistantLight
from mifit.core.mesh import normalize
from mifit.core.sh import basis
from mifit.output.deferred import _mesh_normals, surface_material, visible_surface
from mifit.result import Reconstruction

TOWARDS = normalize(np.array([0.6, 0.5, 0.6]))
POWER = np.array([2.0, 1.5, 1.0])


@pytest.fixture(scope="module")
def keyed(ball):
    """The ball without refined normals under a compact light besides."""
    light = DistantLight(TOWARDS, 0.01, POWER)
    illumination = replace(ball.reflectance.illumination, lights=(light,))
    reflectance = replace(ball.reflectance, shading_model="prefiltered", illumination=illumination)
    return replace(ball, reflectance=reflectance, normals=None, mesh=None)


def without_light(result):
    dark = replace(result.illumination, lights=())
    return replace(result, reflectance=replace(result.reflectance, illumination=dark))


def test_it_survives_saving(keyed, tmp_path):
    keyed.save(tmp_path)
    (light,) = Reconstruction.load(tmp_path, keyed.model).illumination.lights
    np.testing.assert_array_equal(light.direction, TOWARDS)
    np.testing.assert_array_equal(light.colour, POWER)
    assert light.radius == 0.01


def test_it_adds_its_cosine_to_a_render(keyed, variant):
    camera = keyed.cameras[0]
    plain = without_light(keyed)
    added = (keyed.render(camera, 0, "diffuse", samples=1) - plain.render(camera, 0, "diffuse", samples=1))[..., :3]
    surface = visible_surface(keyed, camera, 0, 1)
    normal = _mesh_normals(keyed, surface, 0)
    cosine = np.maximum(normal @ TOWARDS, 0.0)
    expected = surface_material(keyed, surface, 0).diffuse * cosine[:, None] / np.pi * POWER
    clear = cosine > 0.3  # nearer the terminator facets shadow themselves, and on a ball nothing else does
    got = added.reshape(-1, 3)[surface.pixel]
    assert clear.sum() > 500
    np.testing.assert_allclose(got[clear], expected[clear], atol=5e-3)
    np.testing.assert_allclose(got[normal @ TOWARDS < -0.05], 0.0, atol=1e-6)


def test_harmonics_show_it_as_far_as_they_can(keyed):
    extra = keyed.lighting.coefficients - keyed.illumination.radiance
    np.testing.assert_allclose(extra, np.outer(basis(TOWARDS, 3), POWER), atol=1e-3)


def test_relighting_takes_it_away(keyed):
    lit = keyed.relight(np.ones((16, 32, 3), np.float32), exposure="auto")
    assert lit.illumination.lights == ()
    # The mean radiance is kept, the compact light's part of it included.
    np.testing.assert_allclose(
        lit.lighting.coefficients[0].mean(), keyed.lighting.coefficients[0] @ [0.2126, 0.7152, 0.0722], rtol=1e-5
    )


def test_path_tracing_has_it_too(keyed):
    """On a convex ball without ambient term a directional emitter adds what local shading adds."""
    camera = keyed.cameras[0]
    plain = without_light(keyed)
    added = {}
    for integrator, samples in (("local", 2), ("path", 128)):
        images = [r.render(camera, 0, "diffuse", integrator, samples, seed=1) for r in (keyed, plain)]
        added[integrator] = (images[0] - images[1])[images[0][..., 3] == 1][:, :3]
    bright = added["local"][:, 0] > 0.1
    assert bright.sum() > 500
    np.testing.assert_allclose(added["path"][bright].mean(0), added["local"][bright].mean(0), rtol=0.02)
