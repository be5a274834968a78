"""The `shenv` emitter."""

from __future__ import annotations

import numpy as np
import pytest

import mifit
from mifit.core import sh
from mifit.errors import InputError


@pytest.fixture(scope="module", autouse=True)
def plugins(variant: str) -> None:
    mifit.register_plugins()


def coefficients(case: str) -> np.ndarray:
    rng = np.random.default_rng(5)
    c = np.zeros((9, 3))
    c[0] = 1.0
    if case == "band 1":
        c[1:4] = [[0.3] * 3, [0.8] * 3, [0.2] * 3]
    elif case == "negative lobes":
        c = rng.normal(size=(9, 3))
    elif case == "order 8":
        c = rng.normal(size=(64, 3))
        c[0] = 3.0
    elif case == "all negative":
        c = -c
    elif case == "zero":
        c = 0 * c
    return c


TURN = '<transform name="to_world"><rotate x="0.6" y="0.8" z="0" angle="50"/></transform>'


def turn() -> np.ndarray:
    """The rotation in ``TURN``."""
    k, a = np.array([0.6, 0.8, 0.0]), np.radians(50)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross


def xml(c: np.ndarray, rotated: bool = False) -> str:
    numbers = " ".join(f"{x:.9g}" for x in c.ravel())
    return f'<string name="coefficients" value="{numbers}"/>' + (TURN if rotated else "")


def emitter(c: np.ndarray, rotated: bool = False):
    import mitsuba as mi

    return mi.load_string(f'<emitter version="3.0.0" type="shenv">{xml(c, rotated)}</emitter>')


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def seen(e, d: np.ndarray) -> np.ndarray:
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = mi.Vector3f(-d.T.astype(np.float32))
    return np.array(e.eval(si)).T


CASES = ["DC", "band 1", "negative lobes", "order 8"]


@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("case", [*CASES, "zero"])
def test_chi2(case: str, rotated: bool) -> None:
    from mitsuba.chi2 import ChiSquareTest, EmitterAdapter, SphericalDomain

    sample, pdf = EmitterAdapter("shenv", xml(coefficients(case), rotated))
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=2, sample_count=200_000, res=61, ires=16)
    assert test.run(significance_level=0.001, test_count=10), test.messages


@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_radiance_is_the_clamped_expansion(case: str, rotated: bool) -> None:
    c, d = coefficients(case), directions(300)
    light = sh.SHLighting(c).rotate(turn()) if rotated else sh.SHLighting(c)
    expected = np.maximum(light.evaluate(d), 0.0)
    assert np.abs(seen(emitter(c, rotated), d) - expected).max() < 1e-4 * np.abs(c).sum()


@pytest.mark.parametrize("case", CASES)
def test_weights_are_radiance_over_density(case: str) -> None:
    import drjit as dr
    import mitsuba as mi

    e, count = emitter(coefficients(case)), 20_000
    u = np.random.default_rng(0).random((2, count)).astype(np.float32)
    it = dr.zeros(mi.Interaction3f, count)
    it.p = mi.Point3f(1.0, 2.0, 3.0)
    ds, weight = e.sample_direction(it, mi.Point2f(u))
    assert np.allclose(np.array(ds.pdf), np.array(e.pdf_direction(it, ds)), rtol=1e-3)
    radiance = np.array(e.eval_direction(it, ds))
    assert np.allclose(np.array(weight) * np.array(ds.pdf), radiance, rtol=1e-4, atol=1e-5)
    d, w = sh.quadrature(200)
    total = (w @ np.maximum(sh.SHLighting(coefficients(case)).evaluate(d), 0)).sum()
    estimates = np.array(weight).sum(0)
    assert abs(estimates.mean() - total) < 4 * estimates.std() / np.sqrt(count) + 1e-4 * total
    assert estimates.std() < 0.75 * total  # importance sampling, not luck: uniform directions give more


def test_rays_that_leave_the_light_carry_its_power() -> None:
    import mitsuba as mi

    e, count = emitter(coefficients("band 1")), 20_000
    mi.traverse(e)["radius"] = 2.0
    e.radius = mi.Float(2.0)
    u = np.random.default_rng(0).random((5, count)).astype(np.float32)
    ray, weight = e.sample_ray(0.0, mi.Float(u[0]), mi.Point2f(u[1:3]), mi.Point2f(u[3:]))
    d, w = sh.quadrature(50)
    light = sh.SHLighting(coefficients("band 1"))
    power = np.pi * 4.0 * (w @ np.maximum(light.evaluate(d), 0))[0]
    assert np.array(weight)[0].mean() == pytest.approx(power, rel=0.02)
    origin, toward = np.array(ray.o).T, np.array(ray.d).T
    closest = np.linalg.norm(np.cross(origin, toward), axis=1)
    assert closest.max() < 2.0001 and (np.einsum("ij,ij->i", origin, toward) < 0).all()


def test_the_gradient_is_that_of_the_clamped_radiance() -> None:
    import drjit as dr
    import mitsuba as mi

    c, d = coefficients("negative lobes"), directions(400)
    e = emitter(c)
    parameters = mi.traverse(e)
    dr.enable_grad(parameters["coefficients"])
    parameters.update()
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = mi.Vector3f(-d.T.astype(np.float32))
    dr.backward(dr.sum(e.eval(si), axis=None))
    y, value = sh.basis(d, 3), sh.SHLighting(c).evaluate(d)
    assert (value < 0).any() and (value > 0).any()
    expected = y.T @ (value > 0)
    assert np.abs(np.array(dr.grad(parameters["coefficients"])) - expected).max() < 1e-3


@pytest.mark.parametrize("case", [*CASES, "zero", "all negative"])
def test_projection_is_that_of_the_clamped_radiance(case: str) -> None:
    for rotated in (False, True):
        c = coefficients(case)
        flat = np.array(emitter(c, rotated).project()).reshape(-1, 3)
        light = sh.SHLighting(c).rotate(turn()) if rotated else sh.SHLighting(c)
        d, w = sh.quadrature(150)
        exact = sh.basis(d, sh.order_of(flat)).T @ (w[:, None] * np.maximum(light.evaluate(d), 0))
        assert np.abs(flat - exact).max() < 2e-3 * max(np.abs(c).max(), 1.0)


def test_parameters_can_be_written() -> None:
    import mitsuba as mi

    e, d = emitter(coefficients("DC")), directions(20)
    parameters = mi.traverse(e)
    assert {"coefficients", "scale", "radius"} <= set(parameters.keys())
    before = seen(e, d)
    parameters["scale"] = 2.0
    parameters.update()
    assert np.allclose(seen(e, d), 2 * before)
    parameters["coefficients"] = mi.TensorXf(coefficients("band 1").astype(np.float32))
    parameters.update()
    expected = 2 * np.maximum(sh.SHLighting(coefficients("band 1")).evaluate(d), 0)
    assert np.allclose(seen(e, d), expected, atol=1e-5)
    import drjit as dr

    it = dr.zeros(mi.Interaction3f)
    ds = dr.zeros(mi.DirectionSample3f, len(d))
    ds.d = mi.Vector3f(d.T.astype(np.float32))
    density = np.array(e.pdf_direction(it, ds))
    assert np.corrcoef(density, expected @ sh.LUMINANCE)[0, 1] > 0.99  # the table was rebuilt
    parameters["radius"] = 5.0
    parameters.update()
    assert np.allclose(np.array(e.sample_direction(it, mi.Point2f(0.3, 0.6))[0].dist), 10.0)
    assert "order = 3" in str(e)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found no 'coefficients'"),
        ('<string name="coefficients" value="1 2"/>', "found 2 numbers, expected three per function"),
        ('<string name="coefficients" value="1 1 1 1 1 1"/>', "found 2 of them, expected a square number"),
        ('<string name="coefficients" value="1 b 1"/>', "could not convert string to float"),
        ('<string name="coefficients" value="1 nan 1"/>', "not finite"),
        (
            '<string name="coefficients" value="1 1 1"/><transform name="to_world"><scale value="2"/></transform>',
            "found a scale or shear",
        ),
    ],
)
def test_bad_parameters_are_named(text: str, message: str) -> None:
    scene = f'<scene version="3.0.0"><emitter type="shenv">{text}</emitter></scene>'
    import mitsuba as mi

    with pytest.raises(RuntimeError, match=message):
        mi.load_string(scene)


def test_arrays_of_a_wrong_shape_are_named() -> None:
    from mifit.render.plugins.shenv import read_coefficients

    with pytest.raises(InputError, match=r"found shape \(9, 2\), expected \(B\*B, 3\)"):
        read_coefficients(np.zeros((9, 2)))
    with pytest.raises(InputError, match="expected at most 100"):
        read_coefficients(np.zeros((121, 3)))
