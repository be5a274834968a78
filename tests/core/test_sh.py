from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mifit.core import sh
from mifit.core.image import read_image
from mifit.errors import InputError


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def lighting(order: int, seed: int = 0) -> sh.SHLighting:
    return sh.SHLighting(np.random.default_rng(seed).normal(size=(order * order, 3)))


def rotation(seed: int = 0) -> np.ndarray:
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def test_the_basis_is_that_of_drjit(variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    d = directions(500)
    expected = dr.sh_eval(mi.Vector3f(d.T.astype(np.float32)), 8)
    expected = np.stack([np.broadcast_to(np.array(y), 500) for y in expected], axis=1)
    assert np.abs(sh.basis(d, 9) - expected).max() < 5e-6


def test_the_first_bands_have_the_stated_signs() -> None:
    x, y, z = d = np.array([0.36, 0.48, 0.8])
    k = math.sqrt(3 / (4 * math.pi))
    assert np.allclose(sh.basis(d, 2), [math.sqrt(1 / (4 * math.pi)), -k * y, k * z, -k * x])


@pytest.mark.parametrize("order", [1, 3, 9, 16])
def test_the_basis_is_orthonormal(order: int) -> None:
    d, w = sh.quadrature(order)
    y = sh.basis(d, order)
    assert np.abs(y.T @ (w[:, None] * y) - np.eye(order * order)).max() < 1e-12


def test_the_gradient_agrees_with_differences() -> None:
    d, step = directions(200), 1e-6
    values, gradient = sh.basis_gradient(d, 9)
    assert np.array_equal(values, sh.basis(d, 9))
    for axis in range(3):
        e = step * np.eye(3)[axis]
        difference = (sh.basis(d + e, 9) - sh.basis(d - e, 9)) / (2 * step)
        assert np.abs(gradient[..., axis] - difference).max() < 1e-7


@pytest.mark.parametrize("order", [1, 3, 8])
def test_turning_is_the_change_under_small_rotations(order):
    c, step = np.random.default_rng(0).normal(size=(order * order, 3)), 1e-5
    for axis, change in zip(np.eye(3), sh.turning(c), strict=True):
        turns = [Rotation.from_rotvec(-s * step * axis).as_matrix() for s in (1, -1)]
        after, before = (sh.rotation_matrix(turn, order) @ c for turn in turns)
        np.testing.assert_allclose(change, (after - before) / (2 * step), atol=1e-7)


def test_cosine_coefficients_are_the_published_ones() -> None:
    expected = np.array([1, 2 / 3, 1 / 4, 0, -1 / 24, 0, 1 / 64]) * np.pi
    assert np.allclose(sh.cosine_coefficients(7), expected)


def test_irradiance_is_the_integral_of_radiance() -> None:
    light = lighting(3)
    d, w = sh.quadrature(400)
    for n in directions(3, 5):
        expected = (w * np.maximum(d @ n, 0)) @ light.evaluate(d)
        assert np.abs(light.irradiance(n) - expected).max() < 1e-4


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 6), st.integers(0, 10_000))
def test_rotating_the_lighting_rotates_the_field(order: int, seed: int) -> None:
    light, r, d = lighting(order, seed), rotation(seed), directions(20, seed)
    turned = light.rotate(r)
    assert np.allclose(turned.evaluate(d @ r.T), light.evaluate(d), atol=1e-10)
    assert np.allclose(turned.rotate(r.T).coefficients, light.coefficients, atol=1e-10)


def test_projection_recovers_a_band_limited_environment() -> None:
    light = lighting(4)
    image = light.to_latlong(128, 256)
    assert np.abs(sh.SHLighting.from_envmap(image, order=4).coefficients - light.coefficients).max() < 2e-3
    assert sh.latlong_solid_angles(64, 128).sum() * 128 == pytest.approx(4 * np.pi)


def test_pixels_of_an_environment_look_along_the_stated_directions() -> None:
    found = sh.latlong_directions(4, 8)
    for row, column in ((0, 0), (1, 2), (3, 7)):
        phi, theta = 2 * np.pi * (column + 0.5) / 8, np.pi * (row + 0.5) / 4
        expected = (np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta))
        assert found[row, column] == pytest.approx(expected)


def test_the_lat_long_convention_is_that_of_mitsubas_envmap(variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    light = lighting(3, 7)
    offset = 3.0 * np.abs(light.coefficients).sum()
    image = (light.to_latlong(256, 512) + offset).astype(np.float32)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(image)})
    d = directions(300, 3)
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = mi.Vector3f(-d.T.astype(np.float32))
    seen = np.array(emitter.eval(si)).T
    assert np.abs(seen - offset - light.evaluate(d)).max() < 0.01 * np.abs(light.evaluate(d)).max()


def test_a_file_is_projected(tmp_path, variant: str) -> None:
    import mitsuba as mi

    image = np.abs(lighting(3).to_latlong(32, 64)).astype(np.float32)
    path = tmp_path / "sky.exr"
    mi.Bitmap(image).write(str(path))
    assert np.allclose(sh.SHLighting.from_envmap(path).coefficients, sh.project_latlong(image, 3), atol=1e-5)
    with pytest.raises(InputError, match=r"nothing\.exr"):
        sh.SHLighting.from_envmap(tmp_path / "nothing.exr")


def test_a_measured_environment_is_approximated(shared) -> None:
    """Irradiance of the pixels: Ramamoorthi and Hanrahan have 9 % for three bands at worst, 1 % on average."""
    path = shared / "hdri" / "studio.hdr"
    image = read_image(path).astype(np.float64)
    d = sh.latlong_directions(*image.shape[:2])
    flux = image * sh.latlong_solid_angles(*image.shape[:2])[:, None, None]
    normals = directions(6)
    expected = np.array([np.einsum("hw,hwc->c", np.maximum(d @ n, 0), flux) for n in normals])
    for order, tolerance in ((3, 0.09), (9, 0.02)):
        error = sh.SHLighting.from_envmap(path, order).irradiance(normals) - expected
        assert np.abs(error).max() < tolerance * expected.max()


def test_the_dominant_direction_points_at_the_light() -> None:
    d = directions(1, 4)[0]
    light = sh.SHLighting(np.outer(sh.basis(d, 3), [1.0, 0.8, 0.6]))
    assert np.allclose(light.dominant_direction(), d)


def test_lighting_without_a_direction_has_a_stated_one() -> None:
    for c in (np.zeros((9, 3)), np.eye(9, 3) * [[1.0, 0, 0]], np.ones((1, 3))):
        light = sh.SHLighting(c)
        assert light.dominant_direction().tolist() == [0.0, 0.0, 1.0]


def test_truncation() -> None:
    light = lighting(4)
    assert np.array_equal(light.truncate(2).coefficients, light.coefficients[:4])
    assert np.array_equal(light.truncate(5).coefficients[:16], light.coefficients)
    assert not light.truncate(5).coefficients[16:].any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sh.SHLighting(np.zeros((5, 3))), "found 5 of them, expected a square number"),
        (lambda: sh.SHLighting(np.zeros((9, 4))), r"found shape \(9, 4\), expected \(B\*B, 3\)"),
        (lambda: sh.SHLighting(np.full((4, 3), np.nan)), "not finite"),
        (lambda: sh.basis(np.zeros((2, 2)), 3), r"expected \(\.\.\., 3\)"),
        (lambda: sh.basis(np.zeros((2, 3)), 0), "found 0, expected the number of bands"),
        (lambda: sh.rotation_matrix(2 * np.eye(3), 3), "rotation"),
        (lambda: sh.project_latlong(np.zeros((4, 8)), 3), r"expected \(height, width, 3\)"),
        (lambda: sh.project_latlong(np.zeros((4, 8, 3)), 3), "found 4 rows, expected 6 or more"),
        (lambda: sh.project_latlong(np.full((8, 8, 3), np.inf), 3), "not finite"),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
