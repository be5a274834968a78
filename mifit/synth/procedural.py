"""What needs no file: a studio of soft lights, and smooth noise on a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from mifit.core.sh import latlong_directions


def studio_environment(seed: int = 0) -> NDArray[np.float32]:
    """Lat-long radiance of a studio, (128, 256, 3), linear; axes as in `core.sh`.

    A gradient from warm floor to cool ceiling, a large key softbox on one side in front, a dimmer fill on the
    other, and a rim light behind; places and colours vary with the seed.
    """
    rng = np.random.default_rng([seed, 7])
    direction = latlong_directions(128, 256)
    up = 0.5 + 0.5 * direction[..., 1:2]
    image = 0.10 * ((1 - up) * np.array([1.1, 0.95, 0.8]) + up * np.array([0.8, 0.95, 1.15]))
    side = rng.choice([-1.0, 1.0])
    boxes = (  # azimuth from the nose, elevation, half-width, half-height (degrees), radiance
        (side * rng.uniform(30, 50), rng.uniform(20, 40), 17.0, 22.0, rng.uniform(5.0, 7.0)),
        (-side * rng.uniform(45, 70), rng.uniform(0, 20), 20.0, 26.0, rng.uniform(1.2, 2.0)),
        (side * rng.uniform(130, 160), rng.uniform(15, 35), 12.0, 20.0, rng.uniform(2.5, 4.0)),
    )
    for azimuth, elevation, half_width, half_height, radiance in boxes:
        tint = np.array([1.0, 0.97, 0.93]) ** rng.uniform(-1.0, 2.0)
        image += radiance * tint * _softbox(direction, azimuth, elevation, half_width, half_height)[..., None]
    return image.astype(np.float32)


def _softbox(
    direction: NDArray, azimuth: float, elevation: float, half_width: float, half_height: float
) -> NDArray[np.float64]:
    """0..1 coverage of directions by a rectangular light; angles in degrees, azimuth 0 is +z, 90 is +x."""
    a, e = np.radians(azimuth), np.radians(elevation)
    forward = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    depth = direction @ forward
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.abs(direction @ right) / depth / np.tan(np.radians(half_width))
        y = np.abs(direction @ np.cross(forward, right)) / depth / np.tan(np.radians(half_height))
    edge = np.clip((1.0 - np.maximum(x, y)) / 0.1, 0.0, 1.0)
    return np.where(depth > 0, edge, 0.0)


def smooth_noise(points: NDArray, wavelength: float, rng: np.random.Generator, octaves: int = 1) -> NDArray[np.float32]:
    """Noise with mean 0 and standard deviation about 1 at points (N, 3).

    ``wavelength`` is the feature size of the first octave, in the points' unit; every further octave halves size and
    amplitude.
    """
    total = np.zeros(len(points), dtype=np.float32)
    for octave in range(octaves):
        grid = rng.standard_normal((48,) * 3).astype(np.float32)
        at = np.asarray(points, dtype=np.float32).T * np.float32(2.0**octave * 2.0 / wavelength)
        total += map_coordinates(grid, at, order=1, mode="grid-wrap") * np.float32(1.8 * 0.5**octave)
    return total
