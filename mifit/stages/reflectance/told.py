"""How much images tell of each texel's specular albedo, against what is expected of it beforehand.

The normal equations say how sharply the residuals ask for a specular albedo once the diffuse ones follow it. That is
worth something beside residuals of a known size. In deep shade and at borders of what is modelled residuals come from
the model instead of from noise, and neighbours share them; so their size is that of the surroundings.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.uv import TexelMap
from mifit.stages.reflectance.lighting_equations import specular_pull
from mifit.stages.reflectance.maps import TexelSystems

SURROUNDINGS = 1 / 128
"""Half the side of the square of texels over which residuals are averaged, relative to the map."""


def whitened(weight: NDArray, clipped: NDArray, residual: NDArray) -> NDArray[np.float32]:
    """(N, J, 3) sizes of residuals as if their weight were 1, negative where nothing is measured.

    Those of more weight are the smaller for it. Beside a sum of weighted squares these say how much a prior of known
    spread is worth; the plain residuals don't: where most of a head lies in the dark, theirs are those of the dark.
    """
    measured = (weight > 0) & ~clipped[..., None]
    return np.where(measured, np.abs(residual) * np.sqrt(weight), np.float32(-1.0)).astype(np.float32)


def robust_deviation(sizes: NDArray) -> float:
    """Robust standard deviation of residuals (N, J, 3), negative where there are none."""
    values = sizes[sizes >= 0]
    return 1.4826 * float(np.median(values[:: max(1, len(values) // 200_000)])) if len(values) else 0.0


def deviations(sizes: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Per texel the standard deviation that the mean size of its residuals tells, and their number."""
    count = (sizes >= 0).sum((1, 2)).astype(np.float32)
    return np.float32(np.sqrt(np.pi / 2)) * np.maximum(sizes, 0).sum((1, 2)) / np.maximum(count, 1), count


def find_told(
    texels: TexelMap, systems: TexelSystems, errors: NDArray, counts: NDArray, expected: float, deviation: float
) -> NDArray[np.float32]:
    """(N,) share of each texel's own images in what is best believed of its specular albedo.

    0 where they tell nothing of it beside the diffuse one, 1 where they tell all.

    Parameters
    ----------
    texels : TexelMap
    systems : TexelSystems
    errors, counts : (N,)
        Deviation of each texel's residuals at weight 1, and how many they are.
    expected : float
        Specular albedo expected beforehand.
    deviation : float
        Of residuals at weight 1 everywhere: surroundings count as no better than that.
    """
    side = 2 * max(1, round(SURROUNDINGS * texels.size)) + 1
    sums = texels.to_map(np.stack([errors * counts, counts], axis=1).astype(np.float32))
    sums = cv2.boxFilter(sums, cv2.CV_32F, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT)
    around = texels.from_map(sums)
    size = np.maximum(around[:, 0] / np.maximum(around[:, 1], 1e-12), deviation)
    information = systems.specular_information
    share = information / np.maximum(information + specular_pull(expected, 1.0) * size**2, 1e-20)
    return share.astype(np.float32)
