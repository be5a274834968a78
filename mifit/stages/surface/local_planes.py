"""Planes that touch the measured surface: offsets along the normals and how they slope, in windows of texels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import normalize
from mifit.core.uv import TexelMap
from mifit.stages.surface.outline import Borders
from mifit.stages.surface.sweep import Found, Posed

WINDOW = 15
"""Side of the windows that share a plane, texels."""
SLOPE = 0.2
"""Standard deviation of the measured surface's slope against the surface that was swept."""
OUTLIERS = 2.5
"""Residual, in deviations, where an offset counts as an outlier of its plane."""
ROUNDS = 3
"""Reweightings."""


@dataclass(frozen=True)
class MeasuredPlanes:
    """Planes at N measured points of one timestep.

    Attributes
    ----------
    position, normal : (N, 3)
        World space.
    precision : (N,)
        Inverse variance of the distance from a plane; neighbours' errors are alike, which it allows for.
    outside : float
        Distance at which a plane counts as outside the model's span.
    """

    position: NDArray
    normal: NDArray
    precision: NDArray
    outside: float

    def thinned(self, most: int, rng: np.random.Generator) -> MeasuredPlanes:
        """At most so many of them, which count for all."""
        count = len(self.precision)
        if count <= most:
            return self
        some = np.sort(rng.choice(count, most, replace=False))
        precision = self.precision[some] * (count / most)
        return MeasuredPlanes(self.position[some], self.normal[some], precision, self.outside)


def touching_planes(texels: TexelMap, posed: Posed, found: Found, outside: float) -> MeasuredPlanes:
    """Planes through what a sweep found.

    Offsets are regressed on the surface around each texel, weighted by their precision and robustly, with a prior of
    no slope: where few are measured the plane is as steep as the surface that was swept.

    Parameters
    ----------
    texels : TexelMap
    posed : Posed
        Texels as they were swept, at one timestep.
    found : Found
    outside : float
        Distance at which a plane counts as outside the model's span.
    """
    row, column = (axis.astype(np.float64) for axis in np.divmod(texels.index, texels.size))
    along = posed.position.astype(np.float64).T
    _, by_column, by_row = (part.T for part in _regress(texels, row, column, np.ones(len(row)), along, 5, (1e-6, 1e-6)))
    aa, bb, ab = (by_column**2).sum(1), (by_row**2).sum(1), (by_column * by_row).sum(1)
    tiny = 1e-12 * max(float(aa.mean()), 1e-30)
    ridge = (SLOPE**-2 / np.maximum(aa, tiny), SLOPE**-2 / np.maximum(bb, tiny))
    used = found.precision > 0
    base = np.where(used, found.precision, 0.0)
    offset = np.where(used, found.offset, 0.0)
    weight, scale = base, 0.0
    height = slope_column = slope_row = np.zeros_like(offset)
    for _ in range(ROUNDS):
        height, slope_column, slope_row = _regress(texels, row, column, weight, offset, WINDOW, ridge)
        residual = offset - height
        if not scale:
            scale = OUTLIERS * 1.4826 * float(np.median(np.abs(residual[used]))) if used.any() else 1.0
        weight = base / (1.0 + (residual / max(scale, 1e-30)) ** 2) ** 2
    determinant = np.maximum(aa * bb - ab * ab, tiny**2)
    first = (bb * slope_column - ab * slope_row) / determinant
    second = (aa * slope_row - ab * slope_column) / determinant
    normal = normalize(posed.normal - first[:, None] * by_column - second[:, None] * by_row)
    position = posed.position + height[:, None] * posed.normal
    return MeasuredPlanes(position[used], normal[used], weight[used], outside)


def passing_planes(borders: Borders, outside: float) -> MeasuredPlanes:
    """Planes of the lines of sight that pass the head where the image has its outline; ``outside`` as of the others."""
    position = borders.position + borders.offset[:, None] * borders.normal
    return MeasuredPlanes(position, borders.normal, borders.precision, outside)


def _regress(
    texels: TexelMap,
    row: NDArray,
    column: NDArray,
    weight: NDArray,
    value: NDArray,
    window: int,
    ridge: tuple[NDArray | float, NDArray | float],
) -> tuple[NDArray, NDArray, NDArray]:
    """Weighted straight lines through values (..., N) in windows: centre, slopes along columns and along rows."""
    x, y = column - column.mean(), row - row.mean()

    def summed(product: NDArray) -> NDArray:
        return window**2 * texels.from_map(cv2.blur(texels.to_map(product), (window, window)))

    def mean(product: NDArray) -> NDArray:
        flat = [summed(weight * one) for one in product.reshape(-1, product.shape[-1])]
        return np.reshape(flat, product.shape) / total

    total = summed(weight) + 1e-12 * max(float(weight.max()), 1e-30)
    mx, my, mv = mean(x), mean(y), mean(value)
    xx = total * np.maximum(mean(x * x) - mx * mx, 0.0) + ridge[0]
    yy = total * np.maximum(mean(y * y) - my * my, 0.0) + ridge[1]
    xy = total * (mean(x * y) - mx * my)
    xv, yv = total * (mean(x * value) - mx * mv), total * (mean(y * value) - my * mv)
    determinant = np.maximum(xx * yy - xy * xy, 1e-30)
    by_x, by_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    return mv + by_x * (x - mx) + by_y * (y - my), by_x, by_y
