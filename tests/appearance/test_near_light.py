"""A compact light at a place: cosine, lobe, inverse square, shadows, and what it becomes far away."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import NearLight, light_from
from mifit.appearance.lobe import Lobe
from mifit.appearance.occlusion import Occlusion
from mifit.appearance.reference import compact_light
from mifit.core.mesh import normalize
from mifit.core.sh import basis
from mifit.errors import InputError
from mifit.render.gbuffer import SurfaceScene
from tests.shaded import appearance

FLASH = NearLight(np.array([3.0, 4.0, 12.0]), 0.5, np.array([2.0, 1.5, 1.0]), np.array([0.0, 1.0, 0.0]))
ALL = np.uint32(0xFFFF)


def surface(count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points about the origin, their normals, and directions towards the eye."""
    rng = np.random.default_rng(0)
    p, n = rng.normal(size=(count, 3)), normalize(rng.normal((0.0, 0.0, 1.0), size=(count, 3)))
    v = normalize(n + 0.6 * rng.normal(size=(count, 3)))
    return p, n, np.where((n * v).sum(1, keepdims=True) > 0, v, -v)


@pytest.mark.parametrize("fresnel", [None, 8.0])
def test_each_point_has_its_own_directions_and_strength(variant, fresnel):
    p, n, v = surface()
    seen = np.random.default_rng(1).integers(0, 1 << 16, len(p)).astype(np.uint32)
    look = appearance(np.zeros((1, 3)), 30.0, "prefiltered", True, fresnel, lights=(FLASH,))
    matt, glossy = (found[:, -1] for found in look.transfers(n, v, Occlusion(visible=(seen,)), p))
    expected = []
    for i in range(len(p)):
        towards = normalize(FLASH.samples() - p[i])
        bits = (seen[i] >> np.arange(16)) & 1
        nearer = FLASH.distance**2 / ((FLASH.position - p[i]) ** 2).sum()
        pair = compact_light(n[i : i + 1], v[i : i + 1], towards, bits[None], Lobe(30.0, fresnel, True))
        expected.append([nearer * float(x[0]) for x in pair])
    np.testing.assert_allclose(matt, np.array(expected)[:, 0], atol=1e-6)
    np.testing.assert_allclose(glossy, np.array(expected)[:, 1], atol=2e-4 * np.max(expected))


def test_a_surface_that_faces_it_receives_its_intensity_over_the_squared_distance(variant):
    light = replace(FLASH, radius=0.0)
    towards = light.direction
    distances = np.array([1.0, 2.0, 5.0, 13.0])
    points = light.position - distances[:, None] * towards
    look = appearance(np.zeros((1, 3)), 30.0, "prefiltered", lights=(light,))
    facing = np.tile(towards, (4, 1))
    shaded, _ = look.shade(facing, facing, Occlusion(visible=(np.full(4, ALL),)), points)
    np.testing.assert_allclose(np.pi * shaded, light.intensity / distances[:, None] ** 2, rtol=1e-5)
    np.testing.assert_allclose(light.intensity, light.colour * light.distance**2)


def test_its_shadows_spread_and_end_at_it(variant):
    # A floor at z = 0, a roof over x < 0 at z = 1, and another one over everything at z = 9, above the light.
    corners = np.array([[-9, -9], [9, -9], [9, 9], [-9, 9]])
    half = np.minimum(corners, [0, 9])
    heights = [np.insert(xy, 2, z, axis=1) for xy, z in ((corners, 0), (half, 1), (corners, 9))]
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    scene = SurfaceScene(np.concatenate(heights).astype(np.float64), np.concatenate([faces, faces + 4, faces + 8]))
    x = np.linspace(-4, 4, 81) + 0.03
    points, up = np.stack([x, 0 * x, 0 * x], axis=1), np.tile([0.0, 0, 1], (81, 1))
    light = NearLight(np.array([1.0, 0.0, 4.0]), 0.0, np.ones(3), np.zeros(3))
    # From (1, 0, 4) past the edge at (0, ., 1): the shadow on the floor begins a third further on, at -1/3.
    np.testing.assert_array_equal(light.visible(scene, points, up) != 0, x > -1.0 / 3.0)
    wide = replace(light, radius=1.0).visible(scene, points, up)
    share = [bin(bits).count("1") / 16 for bits in wide]
    assert share[0] == 0.0 and share[-1] == 1.0 and any(0.3 < s < 0.7 for s in share)
    assert not light.visible(scene, points, -up).any()  # below the horizon
    with pytest.raises(InputError, match="targets: found 33"):
        scene.open_to(points, up, np.zeros((33, 3)))


def test_harmonics_are_those_that_its_centre_receives(variant):
    light = replace(FLASH, radius=0.0)
    towards = normalize(FLASH.position - FLASH.centre)
    np.testing.assert_allclose(light.coefficients(3), np.outer(basis(towards, 3), light.colour))


def test_it_is_carried_around_the_origin_or_a_point():
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    turned = FLASH.rotated(turn)
    np.testing.assert_allclose(turned.position, turn @ FLASH.position)
    np.testing.assert_allclose(turned.direction, turn @ FLASH.direction)
    np.testing.assert_allclose(turned.intensity, FLASH.intensity)
    np.testing.assert_allclose(FLASH.rotated(turn, FLASH.position).position, FLASH.position)


def test_json_brings_it_back():
    again = light_from(json.loads(json.dumps(FLASH.document())))
    assert isinstance(again, NearLight)
    for name in ("position", "radius", "colour", "centre", "intensity"):
        np.testing.assert_allclose(getattr(again, name), getattr(FLASH, name), rtol=1e-12)
    with pytest.raises(ValueError, match="expected three finite numbers"):
        light_from(FLASH.document() | {"position": [0.0, np.nan, 1.0]})
    with pytest.raises(InputError, match="in the centre"):
        light_from(FLASH.document() | {"position": FLASH.centre.tolist()})


def test_without_points_it_says_what_is_missing(variant):
    _, n, v = surface(5)
    look = appearance(np.zeros((1, 3)), 30.0, "prefiltered", lights=(FLASH,))
    with pytest.raises(InputError, match="found no points"):
        look.shade(n, v, Occlusion(visible=(np.full(5, ALL),)))


def test_a_report_says_how_far_away_it_is():
    assert "12.73 units (127 mm) from the head's middle" in FLASH.describe(10.0)
    assert "mm" not in FLASH.describe()
