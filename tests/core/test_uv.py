"""Maps: which point a texel shows, and look-ups that agree with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mifit.core.uv import TexelMap, bilinear, rasterize_uv, sample_map

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("size", [1, 2, 7, 64])
def test_a_full_chart_covers_every_texel_once(size):
    texels = rasterize_uv(SQUARE, HALVES, size)
    assert_array_equal(texels.index, np.arange(size * size))
    assert texels.mask.all()


def test_texel_centres_follow_the_stated_convention():
    size = 8
    texels = rasterize_uv(SQUARE, HALVES, size)
    uv = np.einsum("nk,nkc->nc", texels.weights, SQUARE[HALVES[texels.face]])
    row, column = np.divmod(texels.index, size)
    assert_allclose(uv[:, 0], (column + 0.5) / size, atol=1e-6)
    assert_allclose(uv[:, 1], 1 - (row + 0.5) / size, atol=1e-6)  # row 0 at v = 1


def test_barycentric_weights_are_a_partition_of_unity():
    rng = np.random.default_rng(1)
    texels = rasterize_uv(rng.random((30, 2)), rng.integers(0, 30, (20, 3)), 32)
    assert_allclose(texels.weights.sum(1), 1, atol=1e-5)
    assert texels.weights.min() > -1e-5


def test_winding_does_not_matter():
    a, b = rasterize_uv(SQUARE, HALVES, 16), rasterize_uv(SQUARE, HALVES[:, ::-1], 16)
    assert_array_equal(a.index, b.index)
    assert_allclose(a.weights, b.weights[:, ::-1], atol=1e-6)


def test_mask_selects_faces_and_keeps_their_numbers():
    texels = rasterize_uv(SQUARE, HALVES, 16, np.array([False, True]))
    assert set(texels.face) == {1}
    assert len(texels.index) == pytest.approx(128, abs=16)


def test_degenerate_and_outside_faces_cover_nothing():
    uv = np.array([[0.2, 0.2], [0.2, 0.2], [0.8, 0.8], [2.0, 2.0], [3.0, 2.0], [2.0, 3.0]])
    texels = rasterize_uv(uv, np.array([[0, 1, 2], [3, 4, 5]]), 32)
    assert len(texels.index) == 0
    assert not texels.mask.any()


def test_faces_that_reach_outside_are_clipped():
    texels = rasterize_uv(4 * SQUARE - 1.5, HALVES, 8)
    assert len(texels.index) == 64


def test_round_trip_of_values():
    texels = rasterize_uv(SQUARE * 0.5, HALVES, 16)
    values = np.random.default_rng(2).random((len(texels.index), 3)).astype(np.float32)
    image = texels.to_map(values, fill=-1.0)
    assert image.dtype == np.float32
    assert_array_equal(texels.from_map(image), values)
    assert_array_equal(image[~texels.mask], -1.0)
    flat = texels.to_map(values[:, 0])
    assert flat.shape == (16, 16)


def test_sampling_at_texel_centres_returns_the_texels():
    image = np.random.default_rng(3).random((9, 9, 2)).astype(np.float32)
    row, column = np.divmod(np.arange(81), 9)
    uv = np.stack([(column + 0.5) / 9, 1 - (row + 0.5) / 9], axis=1)
    assert_allclose(sample_map(image, uv), image.reshape(-1, 2), atol=1e-6)


@settings(deadline=None, max_examples=50)
@given(st.floats(-2, 3), st.floats(-2, 3))
def test_bilinear_is_exact_for_linear_images_and_clamped_outside(x, y):
    row, column = np.mgrid[0:5, 0:7].astype(np.float64)
    image = 2.0 * column - 3.0 * row + 1.0
    px, py = 3 * x, 2 * y
    expected = 2.0 * np.clip(px, 0, 6) - 3.0 * np.clip(py, 0, 4) + 1.0
    assert_allclose(bilinear(image, np.array([px]), np.array([py])), [expected], atol=1e-9)


def test_bilinear_of_a_single_pixel():
    assert_allclose(bilinear(np.full((1, 1), 4.0), np.array([0.3]), np.array([0.0])), [4.0])


def test_the_map_is_a_plain_record():
    texels = TexelMap(2, np.array([0, 3]), np.zeros(2, np.int32), np.zeros((2, 3), np.float32))
    assert_array_equal(texels.mask, [[True, False], [False, True]])


def test_an_equal_map_is_found_once_and_cannot_be_written_to():
    first = rasterize_uv(SQUARE, HALVES, 12)
    assert rasterize_uv(SQUARE.copy(), HALVES.copy(), 12) is first
    assert rasterize_uv(SQUARE, HALVES, 12, np.array([True, False])) is not first
    assert rasterize_uv(0.5 * SQUARE, HALVES, 12) is not first
    with pytest.raises(ValueError, match="read-only"):
        first.weights[0] = 0.0
