"""What is known of skin before any image."""

from __future__ import annotations

import numpy as np

from mifit.stages.reflectance.priors import FAINTEST, levelled

RNG = np.random.default_rng(0)
MEAN = np.array([0.45, 0.27, 0.2]) * RNG.uniform(0.8, 1.2, (50, 1))


def test_level_and_colour_are_the_mean_faces_and_contrasts_stay() -> None:
    fitted = MEAN * [0.5, 0.6, 0.4] * RNG.uniform(0.7, 1.3, (50, 3))
    found = levelled(fitted, MEAN, fitted, MEAN)
    np.testing.assert_allclose(found.mean(axis=0), MEAN.mean(axis=0))
    np.testing.assert_allclose(found / found[:1], fitted / fitted[:1])


def test_a_channel_that_was_driven_below_nothing_is_skin_again() -> None:
    """Blue under yellow light: the fitted face is nearly black, and blue is less than that."""
    contrast = 0.02 * RNG.uniform(-1.0, 1.0, (50, 1))
    fitted = np.array([0.011, 0.008, -0.046]) + contrast
    found = levelled(fitted, MEAN, fitted, MEAN)
    np.testing.assert_allclose(found.mean(axis=0), MEAN.mean(axis=0))
    assert found.min() > 0.1 * MEAN.mean(axis=0).min()
    assert np.corrcoef((found / MEAN)[:, 0], contrast[:, 0])[0, 1] > 0.5
    # Just above the bound nothing but the level changes, and nothing jumps there.
    near = MEAN * (FAINTEST + 1e-6), MEAN * (FAINTEST - 1e-6)
    above, below = (levelled(f, MEAN, f, MEAN) for f in near)
    np.testing.assert_allclose(above, below, rtol=1e-4)
