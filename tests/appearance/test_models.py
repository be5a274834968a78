"""The Dr.Jit shading functions against the float64 forms, and at the edges of their domain."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.appearance.formation import shade_bent
from mifit.appearance.lobe import normalization
from mifit.appearance.models import PaperModel
from mifit.core import sh
from mifit.errors import InputError
from tests import reference
from tests.shaded import appearance, diffuse_matrix, shade_points, shadows, specular_matrix

MODELS = ("paper", "prefiltered", "shadowed")


def scene(count: int = 200, order: int = 3, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normals, views on their side, and radiance coefficients."""
    rng = np.random.default_rng(seed)
    n, v = rng.normal(size=(2, count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    v *= np.sign((n * v).sum(1))[:, None]
    c = rng.normal(size=(order * order, 3))
    c[0] = 4.0
    return n, v, c


@pytest.mark.parametrize("order", [1, 2, 3, 5, 8])
def test_diffuse_is_irradiance_over_pi(variant: str, order: int) -> None:
    n, v, c = scene(order=order)
    diffuse, _ = shade_points(n, v, np.full((200, 3), 0.7), np.zeros(200), c, 0.05, 5.0, "prefiltered")
    expected = 0.7 / np.pi * sh.SHLighting(c).irradiance(n) + 0.05
    assert np.abs(diffuse - expected).max() < 1e-5
    assert np.abs(diffuse_matrix(n, order) @ c - expected / 0.7 + 0.05 / 0.7).max() < 2e-5


@pytest.mark.parametrize("exponent", [1.0, 5.0, 50.0, 1000.0])
def test_the_prefiltered_lobe_integrates_the_brdf(variant: str, exponent: float) -> None:
    n, v, _ = scene(60)
    facing = (n * v).sum(1) > 0.25
    n, v = n[facing], v[facing]
    matrix = specular_matrix(n, v, np.zeros((9, 3)), exponent, "prefiltered")
    d, w = sh.quadrature(160)
    y = sh.basis(d, 3)
    brdf = [reference.specular_brdf(d, vi, ni, exponent) * np.maximum(d @ ni, 0) for ni, vi in zip(n, v, strict=True)]
    exact = (np.array(brdf) * w) @ y
    assert np.linalg.norm(matrix - exact) < 0.04 * np.linalg.norm(exact)
    plain = specular_matrix(n, v, np.zeros((9, 3)), exponent, "prefiltered", normalized=False)
    assert np.allclose(plain * np.pi * normalization(exponent), matrix, rtol=1e-4, atol=1e-6)


def test_the_papers_model_is_the_papers_formula(variant: str) -> None:
    n, v, c = scene()
    light = sh.SHLighting(c)
    d = light.dominant_direction()
    shading = light.irradiance(n) / np.pi
    h = v + d
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    cosine, power = n @ d, np.maximum((n * h).sum(1), 0) ** 5.0
    _, specular = shade_points(n, v, np.ones((200, 3)), np.full(200, 0.4), c, 0.0, 5.0, "paper")
    lit = cosine > 0.5
    expected = 0.4 * shading * (power / np.where(lit, cosine, 1.0))[:, None]
    assert lit.sum() > 20
    assert np.abs(specular[lit] / expected[lit] - 1).max() < 0.041
    guarded = (
        0.4 * shading * (power * np.maximum(cosine, 0) / (np.maximum(cosine, 0) ** 2 + PaperModel.guard**2))[:, None]
    )
    assert np.abs(specular - guarded).max() < 1e-3 * np.abs(guarded).max()


@pytest.mark.parametrize("model", MODELS)
def test_the_matrices_give_the_same_image(variant: str, model: str) -> None:
    n, v, c = scene()
    open_sky = diffuse_matrix(n, 3)
    traced = 0.6 * open_sky
    diffuse, specular = shade_points(n, v, np.ones((200, 3)), np.ones(200), c, 0.0, 20.0, model, traced)
    matrix = specular_matrix(n, v, c, 20.0, model, traced)
    assert np.abs(matrix @ c - specular).max() < 1e-5
    assert np.abs((traced if model == "shadowed" else open_sky) @ c - diffuse).max() < 1e-5


def test_without_shadows_shadowed_is_prefiltered(variant: str) -> None:
    n, v, c = scene()
    arguments = (n, v, np.ones((200, 3)), np.ones(200), c, 0.0, 5.0)
    free = shade_points(*arguments, "prefiltered")
    open_sky = shade_points(*arguments, "shadowed", diffuse_matrix(n, 3))
    dark = shade_points(*arguments, "shadowed", np.zeros((200, 9)))
    assert np.abs(free[0] - open_sky[0]).max() < 1e-5
    facing = (n * v).sum(1) > 0.3
    assert np.abs(free[1] - open_sky[1])[facing].max() < 1e-4
    assert not dark[0].any() and not dark[1].any()


EDGES = {
    "grazing view": lambda n, v, c: (n, v - (v * n).sum(1, keepdims=True) * n, c),
    "view from behind": lambda n, v, c: (n, -v, c),
    "degenerate normal": lambda n, v, c: (0 * n, v, c),
    "DC only": lambda n, v, c: (n, v, c * np.eye(9, 1)),
    "no light": lambda n, v, c: (n, v, 0 * c),
    "all negative": lambda n, v, c: (n, v, -c),
    "view against the light": lambda n, v, c: (n, 0 * v - sh.SHLighting(c).dominant_direction(), c),
    "normal across the light": lambda n, v, c: (np.cross(n, sh.SHLighting(c).dominant_direction()), v, c),
    "view along the normal": lambda n, v, c: (n, n, c),
}


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("exponent", [1.0, 1e4])
@pytest.mark.parametrize("model", MODELS)
def test_values_and_gradients_are_finite_at_the_edges(variant: str, model: str, exponent: float, edge: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from mifit.appearance import kernels, models

    n, v, c = EDGES[edge](*scene())
    normal, view = (mi.Vector3f(x.T.astype(np.float32)) for x in (n, v))
    coefficients = [mi.Color3f(*map(float, row)) for row in c]
    m = mi.Float(exponent)
    dr.make_opaque(coefficients, m)
    inputs = [normal, view, m, *coefficients]
    dr.enable_grad(inputs)
    traced = [0.5 * t for t in kernels.diffuse_transfer(normal, 3)]
    chosen = models.get(model)
    lobe = kernels.prepare_exponent(m, 3, chosen.normalized)
    diffuse, specular = chosen.shade(normal, view, lobe, coefficients, traced)
    assert np.isfinite(np.array(diffuse)).all() and np.isfinite(np.array(specular)).all()
    dr.backward(dr.sum(diffuse + specular, axis=None))
    for value in inputs:
        assert np.isfinite(np.array(dr.grad(value))).all()
    if edge == "no light":
        assert not np.array(diffuse).any() and not np.array(specular).any()


def test_bad_input_is_named(variant: str) -> None:
    n, v, c = scene(4)
    white, gloss = np.ones((4, 3)), np.ones(4)
    with pytest.raises(InputError, match="found 'phong', expected one of paper"):
        shade_points(n, v, white, gloss, c, 0.0, 5.0, "phong")
    with pytest.raises(InputError, match=r"view: found shape \(3, 3\), expected \(4, 3\)"):
        shade_points(n, v[:3], white, gloss, c, 0.0, 5.0, "paper")
    with pytest.raises(InputError, match="no transfer vectors"):
        shade_points(n, v, white, gloss, c, 0.0, 5.0, "shadowed")
    with pytest.raises(InputError, match=r"exponent: found -1\.0"):
        shade_points(n, v, white, gloss, c, 0.0, -1.0, "prefiltered")
    assert shade_points(n[:0], v[:0], white[:0], gloss[:0], c, 0.0, 5.0, "paper")[0].shape == (0, 3)


def test_a_bent_normal_in_half_shade_sees_half_of_what_it_would_see_open(variant: str) -> None:
    """Where half of all light is blocked, so is half of the change that bending brings."""
    n, v, c = scene()
    c = np.abs(c) * np.eye(9, 1) * 3.0 + 0.2 * c
    bent = n + 0.3 * np.random.default_rng(4).standard_normal(n.shape)
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    look = appearance(c, 20.0, "shadowed")
    half, whole = (shade_bent(look, n, v, shadows(part * diffuse_matrix(n, 3)), bent)[0] for part in (0.5, 1.0))
    free, _ = appearance(c, 20.0, "prefiltered").shade(bent, v)
    lit = (np.abs(free) > 0.1).all(1) & (diffuse_matrix(n, 3) @ c > 0.1).all(1)
    assert lit.sum() > 100
    np.testing.assert_allclose(whole[lit], free[lit], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(half[lit], 0.5 * free[lit], rtol=1e-3, atol=1e-4)
