"""The Dr.Jit shading, in float32, against the plain float64 forms: values, and gradients by differences."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.appearance import kernels, models
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import PaperModel, PrintedModel
from mifit.core import sh
from tests import reference
from tests.shaded import diffuse_matrix, light_columns, shade_points

LOBES = [Lobe(5.0), Lobe(60.0, 8.0), Lobe(1000.0, 8.0), Lobe(1000.0), Lobe(20.0, None, False)]


def directions(count=400, seed=0):
    """Unit normals and views on their side."""
    n, v = np.random.default_rng(seed).normal(size=(2, count, 3))
    n, v = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (n, v))
    return n, v * np.sign((n * v).sum(1))[:, None]


def smooth_light(order, seed=1):
    return np.random.default_rng(seed).normal(size=(order**2, 3)) / (1 + sh.bands(order)[:, None])


def shaded(n, v, radiance, lobe, model, transfer=None):
    white = np.ones((len(n), 3))
    return shade_points(
        n, v, white, white[:, 0], radiance, 0.0, lobe.exponent, model, transfer, lobe.normalized, lobe.fresnel
    )


@pytest.mark.parametrize("order", [4, 10])
@pytest.mark.parametrize("lobe", LOBES, ids=str)
def test_prefiltered(variant, order, lobe):
    n, v = directions()
    radiance = smooth_light(order)
    expected = reference.prefiltered_light(n, v, radiance, lobe)
    found = shaded(n, v, radiance, lobe, "prefiltered")
    assert np.abs(found[0] - expected[0]).max() < 1e-5 * np.abs(expected[0]).max()
    assert np.abs(found[1] - expected[1]).max() < 3e-5 * np.abs(expected[1]).max()


@pytest.mark.parametrize("lobe", LOBES[:3], ids=str)
def test_shadowed(variant, lobe):
    n, v = directions()
    radiance = smooth_light(4)
    rng = np.random.default_rng(3)
    transfer = diffuse_matrix(n, 4) * rng.uniform(0.2, 1.0, (len(n), 1)).astype(np.float32)
    expected = reference.shadowed_light(n, v, radiance, lobe, transfer)
    found = shaded(n, v, radiance, lobe, "shadowed", transfer)
    assert np.abs(found[0] - expected[0]).max() < 1e-5 * np.abs(expected[0]).max()
    assert np.abs(found[1] - expected[1]).max() < 2e-4 * np.abs(expected[1]).max()


@pytest.mark.parametrize("exponent", [1.0, 5.0, 1000.0])
@pytest.mark.parametrize(("model", "guard"), [("paper", PaperModel.guard), ("printed", PrintedModel.guard)])
def test_paper(variant, model, guard, exponent):
    n, v = directions()
    # Grey: Mitsuba's luminance has one more digit than ours, which turns the dominant direction of coloured light.
    radiance = np.repeat(np.random.default_rng(2).normal(size=(9, 1)), 3, axis=1)
    radiance[0] = 4.0
    expected = reference.paper_light(n, v, radiance, exponent, guard)
    found = shaded(n, v, radiance, Lobe(exponent, None, False), model)
    assert np.abs(found[0] - expected[0]).max() < 1e-5 * np.abs(expected[0]).max()
    # Near the terminator single precision knows the cosine itself to a few parts in 1e7 only.
    clear = n @ sh.SHLighting(radiance).dominant_direction() > 0.02
    assert clear.sum() > 100
    assert np.abs(found[1] - expected[1])[clear].max() < 2e-4 * np.abs(expected[1][clear]).max()


@pytest.mark.parametrize("lobe", LOBES[:3], ids=str)
def test_compact_light(variant, lobe):
    n, v = directions()
    light = DistantLight(sh.SHLighting(smooth_light(3)).dominant_direction(), 0.1, np.ones(3))
    bits = np.random.default_rng(4).integers(0, 1 << 16, len(n)).astype(np.uint32)
    visible = (bits[:, None] >> np.arange(16)) & 1
    expected = reference.compact_light(n, v, light.samples(), visible, lobe)
    found = light_columns(n, v, bits, light, lobe.exponent, lobe.fresnel)
    np.testing.assert_allclose(found[0], expected[0], atol=1e-6)
    np.testing.assert_allclose(found[1], expected[1], atol=3e-4 * expected[1].max())


@pytest.mark.parametrize(
    ("name", "plain"),
    [
        ("paper", lambda n, v, c, m: reference.paper_light(n, v, c, m, PaperModel.guard)),
        (
            "prefiltered",
            lambda n, v, c, m: reference.prefiltered_light(n, v, c, Lobe(m)),
        ),
    ],
)
def test_gradients_by_lighting_and_exponent_are_those_of_the_plain_form(variant, name, plain):
    import drjit as dr
    import mitsuba as mi

    n, v = directions(200, seed=5)
    facing = (n * v).sum(1) > 0.3
    n, v = n[facing], v[facing]
    radiance = np.repeat(np.random.default_rng(2).normal(size=(9, 1)), 3, axis=1)
    radiance[0], exponent = 4.0, 12.0
    weights = np.random.default_rng(6).uniform(0.5, 1.5, (2, len(n), 3))

    def energy(c, m):
        return sum((w * part).sum() for w, part in zip(weights, plain(n, v, c, m), strict=True))

    model = models.get(name)
    coefficients = [mi.Color3f(*map(float, row)) for row in radiance]
    m = mi.Float(exponent)
    dr.make_opaque(coefficients, m)
    dr.enable_grad(coefficients, m)
    normal, view = (mi.Vector3f(x.T.astype(np.float32)) for x in (n, v))
    lobe = kernels.prepare_exponent(m, 3, model.normalized)
    found = model.shade(normal, view, lobe, coefficients)
    parts = [mi.Color3f(w.T.astype(np.float32)) * part for w, part in zip(weights, found, strict=True)]
    dr.backward(dr.sum(parts[0] + parts[1], axis=None))
    by_light = np.array([np.array(dr.grad(c)).ravel() for c in coefficients])
    scale = float(np.abs(by_light).max())
    for k in range(9):
        step = np.zeros((9, 3))
        step[k] = 1e-5  # all channels: the lighting stays grey
        slope = (energy(radiance + step, exponent) - energy(radiance - step, exponent)) / 2e-5
        assert by_light[k].sum() == pytest.approx(slope, abs=5e-4 * scale)
    slope = (energy(radiance, exponent + 1e-4) - energy(radiance, exponent - 1e-4)) / 2e-4
    assert float(np.array(dr.grad(m))[0]) == pytest.approx(slope, rel=2e-3)


def test_illumination_turns_and_scales():
    rng = np.random.default_rng(0)
    first, second = (DistantLight(d / np.linalg.norm(d), 0.02, rng.random(3)) for d in rng.normal(size=(2, 3)))
    lit = Illumination(rng.normal(size=(9, 3)), (first, second), 0.1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    directions_ = sh.quadrature(6)[0]
    turned = lit.rotated(turn)
    np.testing.assert_allclose(
        sh.SHLighting(turned.radiance).evaluate(directions_ @ turn.T), sh.SHLighting(lit.radiance).evaluate(directions_)
    )
    np.testing.assert_allclose(turned.lights[1].direction, turn @ second.direction)
    np.testing.assert_allclose(lit.scaled(2.0).unknowns, 2.0 * lit.unknowns)
    assert lit.scaled(2.0).ambient == 0.2
    again = lit.with_unknowns(lit.unknowns)
    np.testing.assert_array_equal(again.unknowns, lit.unknowns)
    extra = lit.smooth().coefficients - lit.radiance
    np.testing.assert_allclose(extra, first.coefficients(3) + second.coefficients(3))
