"""What the benchmarks measure with: costs, growth, and their plots."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.record import exponent, measured
from benchmarks.speed import draw, markdown


@pytest.mark.parametrize("power", [0.5, 1.0, 1.5])
def test_exponents_of_powers_are_found(power):
    sizes = np.array([10.0, 40.0, 90.0])
    assert exponent(sizes, 3.0 * sizes**power) == pytest.approx(power)


def test_one_size_has_no_exponent():
    assert exponent([5, 5], [1.0, 2.0]) is None
    assert exponent([5, 6], [1.0, 0.0]) is None


def test_costs_tell_memory_and_kernels(variant):
    import drjit as dr
    import mitsuba as mi

    with measured() as small:
        pass
    with measured() as large:
        block = np.ones(40 << 17)  # 40 MB
        x = mi.Float(block[:1000].astype(np.float32))
        dr.eval(dr.sin(x) * 1.2345)
    assert small.kernels == [] and small.seconds < large.seconds
    assert len([k for k in large.kernels if k["size"] == 1000]) == 1
    assert large.peak_mb == 0.0 or large.peak_mb > small.peak_mb + 30
    assert 0 <= large.compile_seconds <= large.seconds + 1e-3


def test_growth_and_errors_are_drawn_and_tabled(tmp_path):
    cost = {"processor_seconds": 3.0, "steady_seconds": 2.0, "peak_mb": 100.0}
    rows = [{"timesteps": n, **cost, "steps": {"surface": 1.0 * n}} for n in (1, 2)]
    texels = [{"texels": n, **cost, "steps": {"surface": 1.0}} for n in (64, 256)]
    error = [{"number": n, "mesh_mm": 1.0 / n, **cost} for n in (1, 4)]
    figures = {
        "growth": {"timesteps": {"rows": rows, "exponent": 0.5}, "texels": {"rows": texels, "exponent": 0.0}},
        "error": {"surface": error, "reflectance": [{"number": 1, "third_db": 30.0, **cost}]},
        "first": {"first": cost, "second": cost},
    }
    assert [path.name for path in draw(figures, tmp_path)] == ["speed_growth.svg", "speed_error.svg"]
    assert all("<svg" in path.read_text() for path in tmp_path.iterdir())
    text = markdown(figures)
    assert "Processor time grows with timesteps to the power of 0.50, texels to the power of 0.00." in text
    assert "The first fit of a process takes 3.0 cpu s, the second 3.0" in text
