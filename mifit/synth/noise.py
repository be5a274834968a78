"""Smooth random functions of space, without seams where a UV map has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

_SIDE = 48


def smooth_noise(points: NDArray, wavelength: float, rng: np.random.Generator, octaves: int = 1) -> NDArray[np.float32]:
    """Noise with mean 0 and standard deviation about 1 at points (N, 3).

    Parameters
    ----------
    points : (N, 3)
    wavelength : float
        Feature size of the first octave, in the points' unit; every further octave halves size and amplitude.
    rng : numpy Generator
    octaves : int
    """
    total = np.zeros(len(points), dtype=np.float32)
    for octave in range(octaves):
        grid = rng.standard_normal((_SIDE,) * 3).astype(np.float32)
        at = np.asarray(points, dtype=np.float32).T * np.float32(2.0**octave * 2.0 / wavelength)
        total += map_coordinates(grid, at, order=1, mode="grid-wrap") * np.float32(1.8 * 0.5**octave)
    return total
