from __future__ import annotations

import numpy as np
import pytest

from benchmarks.mapped import MapSampler
from mifit.core.uv import sample_map


@pytest.fixture(scope="module")
def uv() -> np.ndarray:
    inside = np.random.default_rng(0).random((5000, 2))
    return np.concatenate([inside, [[0, 0], [1, 1], [0, 1], [1, 0], [-0.1, 0.5], [0.5, 1.2]]])


@pytest.mark.parametrize("size", [2, 17])
def test_values_are_those_of_the_plain_look_up(variant: str, uv: np.ndarray, size: int) -> None:
    import mitsuba as mi

    sampler = MapSampler(uv, size)
    maps = np.random.default_rng(1).random((3, size, size)).astype(np.float32)
    values = sampler([mi.Float(m.ravel()) for m in maps])
    for value, m in zip(values, maps, strict=True):
        assert np.abs(np.array(value) - sample_map(m, uv)[sampler.order]).max() < 1e-5


@pytest.mark.parametrize("size", [2, 17])
def test_the_gradient_is_that_of_the_scattered_one(variant: str, uv: np.ndarray, size: int) -> None:
    import drjit as dr
    import mitsuba as mi

    sampler = MapSampler(uv, size)
    rng = np.random.default_rng(1)
    weights = [mi.Float(rng.normal(size=len(uv)).astype(np.float32)) for _ in range(2)]
    results = []
    for look_up in (sampler, sampler.look_up):
        maps = [mi.Float(rng.random(size * size).astype(np.float32)) for _ in range(2)]
        dr.enable_grad(maps)
        values = look_up(maps)
        dr.backward(dr.sum(values[0] * weights[0] + values[1] * weights[1]))
        results.append([np.array(dr.grad(m)) for m in maps])
    assert np.abs(np.array(results[0]) - np.array(results[1])).max() < 1e-3
    assert np.abs(results[0]).max() > 1.0


def test_the_forward_derivative(variant: str, uv: np.ndarray) -> None:
    import drjit as dr
    import mitsuba as mi

    sampler = MapSampler(uv, 8)
    m, tangent = (mi.Float(np.random.default_rng(s).random(64).astype(np.float32)) for s in (0, 1))
    dr.enable_grad(m)
    dr.set_grad(m, tangent)
    (value,) = sampler([m])
    assert np.allclose(np.array(dr.forward_to(value)), np.array(sampler.look_up([tangent])[0]), atol=1e-5)
