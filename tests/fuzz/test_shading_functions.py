"""Shading of finite input is finite, in value and in gradient, at every angle, exponent and lighting."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mifit.appearance import kernels, models
from mifit.appearance.arrays import aligned, on_device
from mifit.config import SHADINGS
from tests.fuzz.conftest import bounded

AXES = np.array([[0, 0, 1], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]], dtype=np.float64)
TINY = 1e-7
NEAR = np.array([[TINY, 0, 1], [1, 0, TINY], [1, 0, -TINY], [1, 1, 0], [1, -1, TINY], [-TINY, 1, -1]])
DRAWN = 4


def unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-12, vectors / np.maximum(length, 1e-12), AXES[:1])


directions = st.lists(
    st.tuples(*[st.floats(-1, 1, width=32, allow_subnormal=False)] * 3), min_size=DRAWN, max_size=DRAWN
)
values = st.one_of(st.sampled_from([0.0, 1.0, -1.0, 1e-30, 1e6, -1e6, 1e-6]), st.floats(-10, 10, width=32))


def check_gradients(inputs: list[Any]) -> None:
    """All of them are finite; one kernel computes them."""
    import drjit as dr

    gradients = [dr.grad(value) for value in inputs]
    dr.eval(gradients)
    for gradient in gradients:
        assert np.isfinite(np.array(gradient)).all()


@pytest.mark.slow
@bounded(24, deadline=None)  # the first of a kind compiles its kernels
@given(
    model=st.sampled_from(SHADINGS[1:]),
    order=st.sampled_from([1, 3]),
    exponent=st.sampled_from([1.0, 1.5, 5.0, 200.0, 1e4]),
    fresnel=st.sampled_from([None, 0.0, 8.0]),
    drawn=directions,
    lighting=st.lists(values, min_size=12, max_size=12),
    seed=st.integers(0, 2**16),
)
def test_shade(
    variant: str,
    model: str,
    order: int,
    exponent: float,
    fresnel: float | None,
    drawn: list[tuple[float, float, float]],
    lighting: list[float],
    seed: int,
) -> None:
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(seed)
    pool = np.concatenate([AXES, unit(NEAR), unit(np.array(drawn))])
    i, j = np.divmod(np.arange(len(pool) ** 2), len(pool))
    n, v = (on_device(mi.Vector3f, pool[k]) for k in (i, j))
    numbers = rng.choice(np.array(lighting), (order * order, 3)).astype(np.float32)
    coefficients = [on_device(mi.Color3f, np.tile(row, (len(i), 1))) for row in numbers]
    m = mi.Float(aligned(np.full(len(i), exponent)))  # as wide as the rest: sums would be a kernel each
    traced: list[Any] | None = None
    if model == "shadowed":
        traced = [mi.Float(aligned(rng.choice([0.0, 0.3, -0.1], len(i)))) for _ in range(order * order)]
    inputs = [n, v, m, *coefficients, *(traced or [])]
    dr.enable_grad(inputs)
    chosen = models.get(model)
    rise = None if fresnel is None or not chosen.normalized else dr.opaque(mi.Float, fresnel)
    lobe = kernels.prepare_exponent(m, order, chosen.normalized, rise)
    diffuse, specular = chosen.shade(n, v, lobe, coefficients, traced)
    dr.eval(diffuse, specular)
    for part in (diffuse, specular):
        assert np.isfinite(np.array(part)).all()
    dr.backward(dr.sum(diffuse + specular, axis=None))
    check_gradients(inputs)


@bounded(20, deadline=None)
@given(
    order=st.sampled_from([1, 3]),
    lighting=st.lists(values, min_size=12, max_size=12),
    seed=st.integers(0, 2**16),
)
def test_dominant_direction(variant: str, order: int, lighting: list[float], seed: int) -> None:
    import drjit as dr
    import mitsuba as mi

    numbers = np.random.default_rng(seed).choice(np.array(lighting), (order * order, 3)).astype(np.float32)
    coefficients = [mi.Color3f(*(dr.opaque(mi.Float, float(x)) for x in row)) for row in numbers]
    dr.enable_grad(coefficients)
    d = kernels.dominant_direction(coefficients)
    assert abs(np.linalg.norm(np.array(d)) - 1) < 1e-3
    if order > 1:  # with one band the direction depends on nothing
        dr.backward(d.x + 2.0 * d.y + 3.0 * d.z)
    check_gradients(coefficients)
