"""One compact light, such as the sun or a bare lamp, beside lighting that is smooth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.sh import basis

RAYS = 16
"""Directions that stand for the light's disc."""


@dataclass(frozen=True)
class KeyLight:
    """A distant disc of even radiance.

    Attributes
    ----------
    direction : (3,) float64
        Unit vector towards its centre, world axes.
    radius : float
        Angular radius in radians; 0 for a point.
    irradiance : (3,) float64
        Irradiance of a surface that faces it, linear Rec. 709: a white Lambertian point reflects 1 / pi of it.
    """

    direction: NDArray[np.float64]
    radius: float
    irradiance: NDArray[np.float64]

    def samples(self, count: int = RAYS) -> NDArray[np.float64]:
        """(count, 3) directions that cover the disc evenly."""
        return disc(self.direction, self.radius, count)

    def coefficients(self, order: int) -> NDArray[np.float64]:
        """(B*B, 3) SH coefficients of its radiance: what B bands can show of it."""
        return np.outer(basis(self.samples(), order).mean(0), self.irradiance)


def disc(direction: ArrayLike, radius: float, count: int = RAYS) -> NDArray[np.float64]:
    """Directions (count, 3) that cover a disc of an angular radius evenly, on a sunflower's pattern."""
    centre = np.asarray(direction, dtype=np.float64)
    frame = np.linalg.svd(centre[None])[2]  # the centre up to its sign, and two directions across
    i = np.arange(count) + 0.5
    # Even in solid angle: the cap between centre and angle a has the area 2 pi (1 - cos a).
    cosine = 1.0 - (1.0 - math.cos(radius)) * i / count
    angle = i * math.pi * (3.0 - math.sqrt(5.0))
    across = np.cos(angle)[:, None] * frame[1] + np.sin(angle)[:, None] * frame[2]
    return cosine[:, None] * centre + np.sqrt(np.maximum(1.0 - cosine**2, 0.0))[:, None] * across
