"""How far images determine a texel's specular albedo."""

from types import SimpleNamespace

import numpy as np
import pytest

from mifit.core.uv import TexelMap
from mifit.stages.reflectance.albedo_priors import SPECULAR_SPREAD
from mifit.stages.reflectance.als import residual_sizes, specular_observability
from mifit.stages.reflectance.maps import TexelSystems

SIZE, EXPECTED, NOISE = 128, 0.03, 0.01


@pytest.fixture
def texels():
    """A map of which every texel belongs to the face."""
    count = SIZE * SIZE
    return TexelMap(SIZE, np.arange(count), np.zeros(count, np.int64), np.tile([1.0, 0.0, 0.0], (count, 1)))


def blocks(specular_light):
    """Blocks of texels that two views see, the second without a highlight."""
    light = np.stack([np.asarray(specular_light, np.float32), np.zeros(len(specular_light), np.float32)], axis=1)
    light = np.repeat(light[..., None], 3, axis=2)
    ones = np.ones_like(light)
    return TexelSystems.accumulate(0.3 * ones, ones, ones, light, np.zeros((0, 2), np.int64), 0.0)


def share_of_images(texels, specular_light, size=NOISE):
    sums = 6.0 * np.broadcast_to(np.asarray(size, np.float32), len(specular_light))
    sizes = np.stack([sums, np.full(len(sums), 6.0)], axis=1).astype(np.float32)
    return specular_observability(texels, blocks(specular_light), sizes, NOISE, EXPECTED)


def test_it_is_as_large_as_the_deviation_says(texels):
    """The share is that of least squares with a prior, by the albedo's deviation without it."""
    light = np.full(SIZE * SIZE, 0.8)
    # Two views with one albedo per channel: the highlight's contrast is 0.8 / sqrt(2), in three channels.
    alone = NOISE / (0.8 / np.sqrt(2) * np.sqrt(3))
    expected = 1.0 / (1.0 + (alone / (SPECULAR_SPREAD * EXPECTED)) ** 2)
    np.testing.assert_allclose(share_of_images(texels, light), expected, rtol=1e-4)


def test_what_no_lobe_lights_is_not_observed(texels):
    light = np.where(np.arange(SIZE * SIZE) % SIZE < SIZE // 2, 0.0, 2.0)
    share = share_of_images(texels, light)
    assert share[light == 0].max() == 0.0 and share[light > 0].min() > 0.5


def test_the_same_highlight_in_both_views_determines_nothing(texels):
    ones = np.ones((SIZE * SIZE, 2, 3), np.float32)
    systems = TexelSystems.accumulate(0.3 * ones, ones, ones, 2.0 * ones, np.zeros((0, 2), np.int64), 0.0)
    sizes = np.tile(np.float32((6.0 * NOISE, 6.0)), (len(ones), 1))
    found = specular_observability(texels, systems, sizes, NOISE, EXPECTED)
    assert found.max() < 1e-3


def test_residuals_nearby_lower_it_and_those_far_away_do_not(texels):
    size = np.full((SIZE, SIZE), NOISE)
    size[60:64, 60:64] = 0.5
    share = share_of_images(texels, np.full(SIZE * SIZE, 0.8), size.ravel()).reshape(SIZE, SIZE)
    usual = share[0, 0]
    assert share[61, 61] < 0.02 * usual and share[61, 64] < 0.2 * usual
    np.testing.assert_allclose(share[:58], usual, rtol=1e-4)


def test_residuals_smaller_than_the_usual_make_nothing_surer(texels):
    light = np.full(SIZE * SIZE, 0.8)
    np.testing.assert_allclose(share_of_images(texels, light, 0.1 * NOISE), share_of_images(texels, light), rtol=1e-5)


def test_the_deviation_is_that_of_weight_one_however_much_lies_in_the_dark():
    rng = np.random.default_rng(0)
    weight = np.where(rng.random((4000, 2, 3)) < 0.8, 10.0, 0.5).astype(np.float32)
    residual = rng.normal(0.0, 0.02 / np.sqrt(weight)).astype(np.float32)
    weight[:800] = 0.0
    residual[:800] = 9.0  # of what isn't measured
    usual, sizes = residual_sizes(SimpleNamespace(spread=lambda values: values), weight, residual)
    assert abs(usual / 0.02 - 1) < 0.03
    assert (sizes[:800] == 0).all() and (sizes[800:, 1] == 6).all()
    assert abs(sizes[800:, 0].mean() / 6 / 0.02 - 1) < 0.03
