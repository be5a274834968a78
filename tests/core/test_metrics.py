"""Image metrics against values worked out by hand and against their defining properties."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mifit.core.metrics import median_deviation, psnr, rmse, ssim
from mifit.errors import InputError


def test_rmse_and_psnr_of_a_known_difference():
    a = np.zeros((4, 5, 3))
    b = np.full((4, 5, 3), 5.0)
    assert rmse(a, b) == 5.0
    assert psnr(a, b) == pytest.approx(20 * math.log10(51))
    assert psnr(a, a) == math.inf


def test_mask_excludes_pixels():
    a, b = np.zeros((4, 4, 3)), np.zeros((4, 4, 3))
    b[0, 0] = 100
    b[1, 1] = 3
    mask = np.ones((4, 4), dtype=bool)
    mask[0, 0] = False
    assert rmse(a, b, mask) == pytest.approx(3 / math.sqrt(15))


def test_integers_do_not_wrap():
    a, b = np.full((2, 2, 3), 10, np.uint8), np.full((2, 2, 3), 20, np.uint8)
    assert rmse(a, b) == 10.0


def test_ssim_orders_distortions_and_matches_the_formula_for_constants():
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 255, (64, 64, 3))
    assert ssim(image, image) == pytest.approx(1.0)
    mild, strong = (image + rng.normal(0, s, image.shape) for s in (5, 50))
    assert 1 > ssim(mild, image) > ssim(strong, image) > 0
    # Two constant images: only the luminance term remains.
    c1 = (0.01 * 255) ** 2
    expected = (2 * 100 * 120 + c1) / (100**2 + 120**2 + c1)
    assert ssim(np.full((32, 32), 100.0), np.full((32, 32), 120.0)) == pytest.approx(expected, rel=1e-9)


def test_ssim_of_a_pattern_against_grey_is_its_second_constant_over_the_variance():
    rows, columns = np.indices((64, 64))
    image = 100.0 + 10.0 * np.where((rows + columns) % 2, 1.0, -1.0)
    c2 = (0.03 * 255) ** 2
    inner = np.zeros((64, 64), bool)
    inner[16:48, 16:48] = True
    assert ssim(image, np.full((64, 64), 100.0), inner) == pytest.approx(c2 / (10.0**2 + c2), rel=1e-3)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="expected two equal images"):
        rmse(np.zeros((2, 2, 3)), np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match="region is empty"):
        rmse(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2), bool))
    with pytest.raises(InputError, match="mask of shape"):
        psnr(np.zeros((2, 2)), np.zeros((2, 2)), np.ones((3, 2), bool))


def test_outliers_do_not_move_the_deviation_of_residuals():
    residuals = 2.0 * np.random.default_rng(0).normal(size=20_000)
    residuals[:1000] = 1e6
    assert median_deviation(residuals) == pytest.approx(2.0, rel=0.1)
    assert median_deviation(np.zeros(0)) == 0.0
