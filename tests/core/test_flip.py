"""FLIP against values of the authors' own program and against its defining properties."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.core.metrics import flip, flip_map
from mifit.errors import InputError


def picture():
    """A smooth coloured image with one hard-edged box, in whole codes."""
    y, x = np.mgrid[0:60, 0:80]
    codes = np.stack([128 + 100 * np.sin(x / 5) * np.cos(y / 9), 40 + 2.5 * x, 220 - 3 * y], axis=-1)
    codes[20:30, 30:50] = (200, 30, 60)
    return np.clip(np.round(codes), 0, 255)


def with_a_white_pixel(image):
    changed = image.copy()
    changed[40, 40] = 255
    return changed


@pytest.mark.parametrize(
    ("change", "expected"),  # means of flip-evaluator 1.7 (single precision) with its defaults
    [
        (lambda x: np.roll(x, 1, axis=1), 0.1763446),
        (lambda x: np.round(0.9 * x), 0.3227195),
        (lambda x: np.clip(x + np.array([10, -5, 20]), 0, 255), 0.2897796),
        (with_a_white_pixel, 0.0012486),
        (lambda x: 255 - x, 0.9271062),
    ],
)
def test_means_are_those_of_the_authors_program(change, expected):
    assert flip(change(picture()), picture()) == pytest.approx(expected, rel=3e-5, abs=1e-6)


def test_zero_for_equal_images_symmetric_and_within_one():
    image = picture()
    other = np.random.default_rng(0).permuted(image, axis=1)
    assert flip(image, image) == 0
    assert flip(image, other) == pytest.approx(flip(other, image), rel=1e-12)
    worst = flip_map(np.tile([0.0, 1.0, 0.0], (40, 40, 1)), np.tile([0.0, 0.0, 1.0], (40, 40, 1)))
    assert worst == pytest.approx(1.0)  # green against blue is the largest difference of colours


def test_error_grows_with_the_difference():
    noise = np.random.default_rng(1).normal(size=picture().shape)
    errors = [flip(picture() + s * noise, picture()) for s in (1, 3, 10, 30)]
    assert 0 < errors[0] and np.all(np.diff(errors) > 0) and errors[-1] < 1
    shades = [flip(np.full((20, 20, 3), 100 + d), np.full((20, 20, 3), 100)) for d in (1, 5, 25, 125)]
    assert 0 < shades[0] and np.all(np.diff(shades) > 0)


def test_fine_noise_vanishes_when_it_is_seen_from_far_away():
    checks = 128.0 + 40.0 * (-1.0) ** np.indices((60, 60)).sum(axis=0)
    flat = np.full((60, 60), 128.0)
    near, far = (flip(checks, flat, pixels_per_degree=p) for p in (20.0, 200.0))
    assert far < 0.5 * near


def test_only_the_region_counts_though_its_surroundings_are_seen():
    image, other = picture(), with_a_white_pixel(picture())
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:15, :15] = True
    assert flip(other, image, mask) == 0
    mask[38:45, 37:44] = True
    assert flip(other, image, mask) == pytest.approx(flip_map(other / 255, image / 255)[mask].mean(), rel=1e-12)


def test_grey_images_and_bad_input():
    grey = picture()[..., 0]
    assert flip(grey, grey + 9) == pytest.approx(flip(*(np.repeat(x[..., None], 3, -1) for x in (grey, grey + 9))))
    with pytest.raises(InputError, match="expected two equal images"):
        flip(grey, picture())
    with pytest.raises(InputError, match="region is empty"):
        flip(grey, grey, np.zeros(grey.shape, dtype=bool))
