"""How much images tell of a texel's specular albedo."""

import numpy as np
import pytest

from mifit.core.uv import TexelMap
from mifit.stages.reflectance.lighting_equations import SPECULAR_SPREAD
from mifit.stages.reflectance.maps import TexelSystems
from mifit.stages.reflectance.told import deviations, find_told, robust_deviation, whitened

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


def told(texels, specular_light, size=NOISE):
    errors = np.broadcast_to(np.asarray(size, np.float32), len(specular_light))
    return find_told(texels, blocks(specular_light), errors, np.full(len(errors), 6.0), EXPECTED, NOISE)


def test_a_texel_tells_as_much_as_its_deviation_says(texels):
    """The share is that of least squares with a prior, by the albedo's deviation without it."""
    light = np.full(SIZE * SIZE, 0.8)
    # Two views with one albedo per channel: the highlight's contrast is 0.8 / sqrt(2), in three channels.
    alone = NOISE / (0.8 / np.sqrt(2) * np.sqrt(3))
    expected = 1.0 / (1.0 + (alone / (SPECULAR_SPREAD * EXPECTED)) ** 2)
    np.testing.assert_allclose(told(texels, light), expected, rtol=1e-4)


def test_what_no_lobe_lights_tells_nothing(texels):
    light = np.where(np.arange(SIZE * SIZE) % SIZE < SIZE // 2, 0.0, 2.0)
    share = told(texels, light)
    assert share[light == 0].max() == 0.0 and share[light > 0].min() > 0.5


def test_the_same_highlight_in_both_views_tells_nothing(texels):
    ones = np.ones((SIZE * SIZE, 2, 3), np.float32)
    systems = TexelSystems.accumulate(0.3 * ones, ones, ones, 2.0 * ones, np.zeros((0, 2), np.int64), 0.0)
    found = find_told(texels, systems, np.full(len(ones), NOISE), np.full(len(ones), 6.0), EXPECTED, NOISE)
    assert found.max() < 1e-3


def test_residuals_nearby_lower_it_and_those_far_away_do_not(texels):
    size = np.full((SIZE, SIZE), NOISE)
    size[60:64, 60:64] = 0.5
    share = told(texels, np.full(SIZE * SIZE, 0.8), size.ravel()).reshape(SIZE, SIZE)
    usual = share[0, 0]
    assert share[61, 61] < 0.02 * usual and share[61, 64] < 0.2 * usual
    np.testing.assert_allclose(share[:58], usual, rtol=1e-4)


def test_residuals_smaller_than_the_usual_make_nothing_surer(texels):
    light = np.full(SIZE * SIZE, 0.8)
    np.testing.assert_allclose(told(texels, light, 0.1 * NOISE), told(texels, light), rtol=1e-5)


def test_the_deviation_is_that_of_weight_one_however_much_lies_in_the_dark():
    rng = np.random.default_rng(0)
    weight = np.where(rng.random((4000, 2, 3)) < 0.8, 10.0, 0.5).astype(np.float32)
    residual = rng.normal(0.0, 0.02 / np.sqrt(weight)).astype(np.float32)
    weight[:400], clipped = 0.0, np.zeros((4000, 2), bool)
    clipped[400:800] = True
    residual[:800] = 9.0  # of what isn't measured
    sizes = whitened(weight, clipped, residual)
    assert abs(robust_deviation(sizes) / 0.02 - 1) < 0.03
    each, count = deviations(sizes)
    assert (count[:800] == 0).all() and (each[:800] == 0).all() and (count[800:] == 6).all()
    assert abs(each[800:].mean() / 0.02 - 1) < 0.03
