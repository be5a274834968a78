"""What the benchmarks measure with: costs, growth, the held-out view, and their plots."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.measure import exponent, measured
from benchmarks.speed_plots import draw, markdown
from benchmarks.third_view import Error, ThirdView, pooled_psnr
from mifit.core.image import srgb_to_linear
from mifit.output.evaluate import evaluate
from tests.output.conftest import ball_camera, ball_result
from tests.output.test_render_evaluate import FakeCapture


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


def test_the_held_out_view_has_evaluates_error(variant):
    ball, camera = ball_result(), ball_camera("third", 25.0)

    def image(camera, timestep):
        values = np.random.default_rng(timestep).integers(40, 200, (camera.height, camera.width, 3))
        return srgb_to_linear(values.astype(np.uint8))

    capture = FakeCapture((camera,), image)
    expected = evaluate(ball, capture, "third", region="model")
    view = ThirdView(capture, region="model", oversampling=2)
    for method in ("diffuse", "full"):
        errors = view.errors(ball, method=method)
        assert sum(e.pixels for e in errors.values()) == expected["region_pixels"]
        assert pooled_psnr(errors.values()) == pytest.approx(expected["methods"][method]["psnr"], abs=1e-9)


def test_errors_are_pooled_over_pixels():
    assert pooled_psnr([Error(255.0**2, 1), Error(0.0, 99)]) == pytest.approx(20.0)


def test_growth_is_drawn_and_tabled(tmp_path):
    cost = {"seconds": 1.0, "steady_seconds": 0.9, "compile_seconds": 0.1, "peak_mb": 100.0}
    rows = [{"pixels": n, "processor_seconds": 1e-3 * n, **cost} for n in (100, 400)]
    figures = {"growth": {"shading over pixels": {"rows": rows, "exponent": 0.0, "processor_exponent": 1.0}}}
    (path,) = draw(figures, tmp_path)
    assert "shading over pixels: 1.00" in path.read_text()
    assert "| shading over pixels | 100 to 400 | 0.00 | 1.00 | 0.90 | 100 |" in markdown(figures)
