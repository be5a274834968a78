"""Image error measures over a region of pixels, RMSE, PSNR, SSIM and FLIP, and the deviation of residuals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter

from mifit.core.image import box, srgb_to_linear
from mifit.errors import InputError

Image = NDArray
Mask = NDArray[np.bool_] | None
NORMAL = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute value."""
SURE = 4.0
"""Standard deviations beyond which a difference is surely no noise: 6 in 100,000 of a normal distribution."""
INDEPENDENT = 0.1
"""Part of the measurements of neighbouring points that count as measured on their own: their errors are alike."""


def median_deviation(residuals: NDArray) -> float:
    """Standard deviation by the median of absolute residuals, which outliers don't move; 0 of none."""
    return NORMAL * float(np.median(np.abs(residuals))) if residuals.size else 0.0


def rmse(image: Image, reference: Image, mask: Mask = None) -> float:
    """Root-mean-square difference of equal images over a region's pixels and all channels, in their units.

    InputError where shapes differ, or the region is empty.
    """
    a, b, mask = _checked(image, reference, mask)
    return math.sqrt(float(np.mean((a[mask] - b[mask]) ** 2)))


def psnr(image: Image, reference: Image, mask: Mask = None, peak: float = 255.0) -> float:
    """Peak signal-to-noise ratio in dB, ``20 log10(peak / rmse)``; infinite for equal images."""
    return psnr_from_rmse(rmse(image, reference, mask), peak)


def psnr_from_rmse(error: float, peak: float = 255.0) -> float:
    """Peak signal-to-noise ratio in dB of a root-mean-square error."""
    return math.inf if error == 0 else 20.0 * math.log10(peak / error)


def ssim(image: Image, reference: Image, mask: Mask = None, peak: float = 255.0) -> float:
    """Structural similarity (Wang et al. 2004), averaged over a region and the channels; 1 for equal images.

    Gaussian window of 1.5 pixels cut at 5 pixels (11 x 11), K1 = 0.01, K2 = 0.03. The window of a pixel at the region's
    border reaches outside the region, as is usual. ``peak`` is the largest value that a pixel can take.
    """
    a, b, mask = _checked(image, reference, mask)
    a, b = (np.atleast_3d(x) for x in (a, b))

    def blur(x: NDArray) -> NDArray:
        return gaussian_filter(x, (1.5, 1.5, 0.0), truncate=5.0 / 1.5, mode="reflect")

    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    score = ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(score[mask].mean())


def _checked(image: Image, reference: Image, mask: Mask) -> tuple[NDArray, NDArray, NDArray[np.bool_]]:
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


def flip(
    image: Image,
    reference: Image,
    mask: Mask = None,
    peak: float = 255.0,
    pixels_per_degree: float = 3840 * math.pi / 180,
) -> float:
    """Mean FLIP error (Andersson et al. 2020) over a region: 0 for equal images, at most 1.

    Colours are blurred by the eye's contrast sensitivity and compared where they are perceptually even; edges and
    points are compared beside them. The constants are the paper's. Images are sRGB codes, 0..peak. A pixel's error
    depends on its neighbours, also on those outside the region. ``pixels_per_degree`` of the field of view are by
    default those of a screen of 3840 pixels seen from its own width.
    """
    a, b, region = _checked(image, reference, mask)
    margin = len(_support(_widest(pixels_per_degree))) // 2  # no filter reaches further
    near = box(region, margin)
    return float(flip_map(a[near] / peak, b[near] / peak, pixels_per_degree)[region[near]].mean())


def flip_map(image: Image, reference: Image, pixels_per_degree: float = 3840 * math.pi / 180) -> NDArray[np.float64]:
    """(H, W) FLIP error of every pixel, 0..1, of two sRGB images with values 0..1; see `flip`."""
    a, b = (_opponent(x) for x in (image, reference))
    return _colour_error(a, b, pixels_per_degree) ** (1.0 - _feature_error(a[..., 0], b[..., 0], pixels_per_degree))


# Contrast sensitivity of the channels Y, Cx, Cz as sums of Gaussians in degrees: a sqrt(pi / b) exp(-pi^2 x^2 / b).
_SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
_XYZ = np.array(  # of linear Rec. 709
    [
        [0.4123907992659595, 0.357584339383878, 0.1804807884018343],
        [0.2126390058715103, 0.715168678767756, 0.0721923153607337],
        [0.0193308187155918, 0.119194779794626, 0.9505321522496607],
    ]
)
_XYZ /= _XYZ.sum(axis=1, keepdims=True)  # 1, 1, 1 for white


def _opponent(srgb: NDArray) -> NDArray[np.float64]:
    """SRGB 0..1 -> YCxCz, linear opponent colours."""
    rgb = srgb if srgb.ndim == 3 else np.repeat(srgb[..., None], 3, axis=-1)
    x, y, z = np.moveaxis(srgb_to_linear(np.clip(rgb, 0.0, 1.0)) @ _XYZ.T, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _blurred(opponent: NDArray, pixels_per_degree: float) -> NDArray[np.float64]:
    """YCxCz after the eye's contrast sensitivity -> linear RGB within the display's range."""
    x = _support(_widest(pixels_per_degree)) / pixels_per_degree
    out = np.zeros_like(opponent)
    for c, channel in enumerate(_SENSITIVITY):
        total = 0.0
        for a, b in channel:
            kernel, weight = np.exp(-((math.pi * x) ** 2) / b), a * math.sqrt(math.pi / b)
            out[..., c] += weight * _separable(opponent[..., c], kernel, kernel)
            total += weight * kernel.sum() ** 2
        out[..., c] /= total
    y = (out[..., 0] + 16.0) / 116.0
    xyz = np.stack([y + out[..., 1] / 500.0, y, y - out[..., 2] / 200.0], axis=-1)
    return np.clip(xyz @ np.linalg.inv(_XYZ).T, 0.0, 1.0)


def _hunt_lab(linear: NDArray) -> NDArray[np.float64]:
    """Linear RGB -> CIELAB whose colourfulness grows with lightness, as the eye's does (Hunt)."""
    t, d = linear @ _XYZ.T, 6.0 / 29.0
    fx, fy, fz = np.moveaxis(np.where(t > d**3, np.cbrt(t), t / (3.0 * d**2) + 4.0 / 29.0), -1, 0)
    lightness = 116.0 * fy - 16.0
    return np.stack([lightness, 5.0 * lightness * (fx - fy), 2.0 * lightness * (fy - fz)], axis=-1)


def _colour_error(a: NDArray, b: NDArray, pixels_per_degree: float) -> NDArray[np.float64]:
    """HyAB distance in powers of 0.7; up to 0.4 of the largest, green against blue, it fills errors up to 0.95."""

    def distance(one: NDArray, other: NDArray) -> NDArray:
        d = _hunt_lab(one) - _hunt_lab(other)
        return (np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2])) ** 0.7

    found = distance(*(_blurred(x, pixels_per_degree) for x in (a, b)))
    largest = float(distance(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])))
    return np.interp(found, (0.0, 0.4 * largest, largest), (0.0, 0.95, 1.0))


def _feature_error(a: NDArray, b: NDArray, pixels_per_degree: float) -> NDArray[np.float64]:
    """Difference in edges and points of lightness, 0.082 degrees wide."""
    sigma = 0.5 * 0.082 * pixels_per_degree
    x = _support(3.0 * sigma)
    blur = np.exp(-(x**2) / (2.0 * sigma**2))
    smooth, difference = blur / blur.sum(), np.zeros(a.shape)
    for profile in (-x * blur, (x**2 / sigma**2 - 1.0) * blur):
        balanced = np.where(profile > 0, profile / profile[profile > 0].sum(), -profile / profile[profile < 0].sum())
        one, other = (
            np.hypot(_separable(y, smooth, balanced), _separable(y, balanced, smooth))
            for y in ((image + 16.0) / 116.0 for image in (a, b))
        )
        difference = np.maximum(difference, np.abs(one - other))
    return np.clip(difference / math.sqrt(2.0), 0.0, 1.0) ** 0.5


def _widest(pixels_per_degree: float) -> float:
    """Pixels that the widest Gaussian of the contrast sensitivity reaches."""
    return 3.0 * math.sqrt(max(b for c in _SENSITIVITY for _, b in c) / (2.0 * math.pi**2)) * pixels_per_degree


def _support(radius: float) -> NDArray[np.float64]:
    """Pixel offsets of a kernel that reaches ``radius`` pixels."""
    r = math.ceil(radius)
    return np.arange(-r, r + 1, dtype=np.float64)


def _separable(image: NDArray, rows: NDArray, columns: NDArray) -> NDArray[np.float64]:
    return correlate1d(correlate1d(image, rows, axis=0, mode="nearest"), columns, axis=1, mode="nearest")
