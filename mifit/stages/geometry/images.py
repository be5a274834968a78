"""Images as smooth functions of position: cubic B-splines over Gaussian levels, with exact gradients.

An image's pixel values are taken as the spline's coefficients. The function is then the image blurred by the cubic
B-spline (about 0.58 pixels), twice differentiable everywhere, which Gauss-Newton and finite differences both need.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

DARKEST = 1e-3  # added before the logarithm: below the read noise of 8-bit images


@dataclass(frozen=True)
class SmoothImage:
    """An image that can be looked up between pixels.

    Attributes
    ----------
    values : (H, W, C) float32
    valid : (H, W) float32
        1 where the value may be used.
    """

    values: NDArray[np.float32]
    valid: NDArray[np.float32]

    def sample(self, pixels: NDArray, gradient: bool = True) -> tuple[NDArray, NDArray | None, NDArray]:
        """Look up values at pixel coordinates.

        Parameters
        ----------
        pixels : (N, 2)
            Centre of the top-left pixel at (0.5, 0.5).

        Returns
        -------
        values : (N, C)
        gradient : (N, C, 2) or None
            Derivative by the pixel coordinate.
        inside : (N,) bool
            Whether all pixels that the spline touches exist and are valid.
        """
        h, w = self.valid.shape
        dtype = self.values.dtype
        position = np.asarray(pixels, dtype=np.float64) - 0.5
        finite = np.asarray(np.isfinite(position).all(1))
        position = np.clip(np.where(finite[:, None], position, -10.0), -10.0, max(h, w) + 10.0)
        corner = np.floor(position).astype(np.int64)
        f = position - corner
        wx, dx = _bspline(f[:, 0])
        wy, dy = _bspline(f[:, 1])
        column = corner[:, :1] + np.arange(-1, 3)
        row = corner[:, 1:] + np.arange(-1, 3)
        inside = finite & (column[:, 0] >= 0) & (column[:, 3] < w) & (row[:, 0] >= 0) & (row[:, 3] < h)
        flat = np.clip(row, 0, h - 1)[:, :, None] * w + np.clip(column, 0, w - 1)[:, None, :]
        inside &= np.take(self.valid.reshape(-1), flat).reshape(len(flat), -1).min(1) > 0.5 if len(flat) else inside
        patch = np.take(self.values.reshape(h * w, -1), flat.reshape(len(flat), 16), axis=0)  # (N, 16, C)

        def blend(a: NDArray, b: NDArray) -> NDArray:
            weights = (a[:, :, None] * b[:, None, :]).reshape(-1, 1, 16).astype(dtype)
            return (weights @ patch)[:, 0]

        values = blend(wy, wx)
        if not gradient:
            return values, None, inside
        slope = np.stack([blend(wy, dx), blend(dy, wx)], axis=-1)
        return values, slope, inside


def _bspline(f: NDArray) -> tuple[NDArray, NDArray]:
    """Weights of the four taps and their derivatives at fractions f (N,) -> (N, 4) each."""
    g = 1.0 - f
    value = np.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], axis=1) / 6.0
    slope = np.stack([-(g**2), 3 * f**2 - 4 * f, -3 * g**2 + 4 * g, f**2], axis=1) / 2.0
    return value, slope


def blur(values: NDArray, valid: NDArray, sigma: float) -> NDArray:
    """Gaussian blur that ignores invalid pixels; 0 where no valid pixel is near."""
    weight = valid.astype(np.float32)
    weighted = values * (weight if values.ndim == 2 else weight[..., None])
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    out = cv2.GaussianBlur(weighted, (0, 0), sigma)
    return out / np.maximum(total if values.ndim == 2 else total[..., None], 1e-4)


def level(image: NDArray, valid: NDArray, sigma: float) -> SmoothImage:
    """Image blurred by ``sigma`` pixels; invalid pixels ignored."""
    values = blur(image, valid, sigma) if sigma > 0 else image
    return SmoothImage(np.ascontiguousarray(values, np.float32), valid.astype(np.float32))


def texture_level(image: NDArray, valid: NDArray, sigma: float, window: float) -> SmoothImage:
    """Logarithm of an image between two scales: what is painted on the skin rather than how it is lit.

    In the logarithm albedo and shading add; the difference of a fine and a wide blur keeps moles, brows, lips and
    pores, and drops smooth shading, ambient level and exposure.

    Parameters
    ----------
    sigma, window : float
        Fine and wide blur in pixels.
    """
    # Blurs reach four deviations far, and what lies outside the valid pixels is never read.
    part = box(valid, int(np.ceil(4.0 * window)) + 1)
    shown = valid[part]
    log = np.log(np.maximum(image[part], 0.0) + DARKEST).astype(np.float32)
    fine = blur(log, shown, sigma) if sigma > 0 else log
    values = np.zeros(image.shape, np.float32)
    values[part] = fine - blur(log, shown, window)
    return SmoothImage(values, valid.astype(np.float32))


def box(mask: NDArray[np.bool_], margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns around the pixels of a mask (H, W), with a margin; all of them around an empty mask."""
    ends = []
    for axis, size in enumerate(mask.shape):
        inside = np.flatnonzero(mask.any(axis=1 - axis))
        ends.append(
            slice(max(inside[0] - margin, 0), min(inside[-1] + margin + 1, size)) if len(inside) else slice(size)
        )
    return ends[0], ends[1]
