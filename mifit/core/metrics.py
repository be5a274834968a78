"""Image error measures over a region of pixels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mifit.errors import InputError


def rmse(image: NDArray, reference: NDArray, mask: NDArray | None = None) -> float:
    """Root-mean-square difference over the pixels of a region and all channels.

    Parameters
    ----------
    image, reference : (H, W, C) or (H, W)
        Same shape, any real type; the result is in their units.
    mask : (H, W) bool, optional
        Region; the whole image by default.

    Raises
    ------
    InputError
        Shapes differ, or the region is empty.
    """
    return math.sqrt(mean_squared_error(image, reference, mask))


def psnr(image: NDArray, reference: NDArray, mask: NDArray | None = None, peak: float = 255.0) -> float:
    """Peak signal-to-noise ratio in dB, ``20 log10(peak / rmse)``; infinite for equal images."""
    return psnr_from_rmse(rmse(image, reference, mask), peak)


def psnr_from_rmse(error: float, peak: float = 255.0) -> float:
    """Peak signal-to-noise ratio in dB of a root-mean-square error."""
    return math.inf if error == 0 else 20.0 * math.log10(peak / error)


def mean_squared_error(image: NDArray, reference: NDArray, mask: NDArray | None = None) -> float:
    """Mean squared difference over a region; parameters and errors as for `rmse`."""
    a, b, mask = checked_pair(image, reference, mask)
    difference = a[mask] - b[mask]
    return float(np.mean(difference * difference))


def ssim(image: NDArray, reference: NDArray, mask: NDArray | None = None, peak: float = 255.0) -> float:
    """Structural similarity (Wang et al. 2004), averaged over a region and the channels; 1 for equal images.

    Gaussian window of 1.5 pixels cut at 5 pixels (11 x 11), K1 = 0.01, K2 = 0.03. The window of a pixel at the
    region's border reaches outside the region, as is usual.

    Parameters
    ----------
    image, reference, mask
        As for `rmse`.
    peak : float
        Largest value that a pixel can take.
    """
    a, b, mask = checked_pair(image, reference, mask)
    if a.ndim == 2:
        a, b = a[..., None], b[..., None]

    def blur(x: NDArray) -> NDArray:
        return gaussian_filter(x, (1.5, 1.5, 0.0), truncate=5.0 / 1.5, mode="reflect")

    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    score = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(score[mask].mean())


def checked_pair(image: NDArray, reference: NDArray, mask: NDArray | None) -> tuple[NDArray, NDArray, NDArray]:
    """Both images as float64 and the region as a boolean array, after checks of shape."""
    a, b = np.asarray(image, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape or a.ndim not in (2, 3):
        raise InputError(f"image metric: found shapes {a.shape} and {b.shape}, expected two equal images")
    region = np.ones(a.shape[:2], dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
    if region.shape != a.shape[:2]:
        raise InputError(f"image metric: found a mask of shape {region.shape}, expected {a.shape[:2]}")
    if not region.any():
        raise InputError("image metric: the region is empty, expected at least one pixel")
    return a, b, region
