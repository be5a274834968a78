"""Images compared over regions of a face: which pixels count, and errors that any program's images can be given.

Regions follow the landmarks of the photograph alone, so that they are the same for every program:

- ``face``: the hull of the 68 landmarks, a few pixels smaller;
- ``skin``: the face without eyes and inner mouth;
- ``relit``: the face without a wider surrounding of both, where relit views are compared.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.image import box, linear_to_srgb, srgb_to_linear
from mifit.core.metrics import flip, psnr_from_rmse, ssim
from mifit.core.sh import LUMINANCE
from mifit.errors import InputError
from mifit.morphable.topology import BROWS, EYES_AND_MOUTH

Region = NDArray[np.bool_]


def face_region(landmarks: NDArray, camera: Camera, shrink: int = 4) -> Region:
    """(H, W) hull of 68 landmarks (68, 2), eroded by ``shrink`` pixels."""
    side = 2 * shrink + 1
    return cv2.erode(_hull(landmarks, camera), np.ones((side, side), np.uint8)) > 0


def skin_region(landmarks: NDArray, camera: Camera) -> Region:
    """(H, W) face without eyes and inner mouth."""
    holes = _openings(landmarks, camera, 1.6, 1.2)
    side = 2 * int(0.012 * np.ptp(landmarks[:, 0])) + 1
    return face_region(landmarks, camera) & (cv2.dilate(holes, np.ones((side, side), np.uint8)) == 0)


def relit_region(landmarks: NDArray, camera: Camera) -> Region:
    """(H, W) face without a wider surrounding of eyes and mouth."""
    return face_region(landmarks, camera) & (_openings(landmarks, camera, 2.0, 2.0) == 0)


def pass_region(landmarks: NDArray, camera: Camera) -> Region:
    """(H, W) as `relit_region`, without brows and further from the hull: bare skin, for diffuse and specular images."""
    hair = np.zeros((camera.height, camera.width), np.uint8)
    for brow in BROWS:
        width = max(int(0.05 * np.ptp(landmarks[:, 0])), 1)  # half of a brow's height
        cv2.polylines(hair, [landmarks[list(brow)].astype(np.int32)], False, 1, width)
    inner = face_region(landmarks, camera, 7)
    return inner & (_openings(landmarks, camera, 2.0, 2.0) == 0) & (hair == 0)


def _hull(points: NDArray, camera: Camera) -> NDArray[np.uint8]:
    area = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(area, cv2.convexHull(points.astype(np.float32)).astype(np.int32), 1)
    return area


def _openings(landmarks: NDArray, camera: Camera, eyes: float, mouth: float) -> NDArray[np.uint8]:
    """Hulls of eyes and inner mouth, grown about their middles by factors."""
    area = np.zeros((camera.height, camera.width), np.uint8)
    for marks, factor in zip(EYES_AND_MOUTH, (eyes, eyes, mouth), strict=True):
        points = landmarks[list(marks)]
        area |= _hull(points.mean(0) + factor * (points - points.mean(0)), camera)
    return area


class Errors:
    """Errors of some images of one method against photographs, pooled over the pixels of their regions."""

    def __init__(self) -> None:
        self.pixels = 0
        self._sums = np.zeros(4)

    def add(self, image: NDArray[np.uint8], photograph: NDArray[np.uint8], region: Region) -> dict[str, float]:
        """Add a region of 8-bit sRGB images (H, W, 3); returns its own `figures`, none of an empty region."""
        count = int(region.sum())
        if not count:
            return {}
        a, b = image[region].astype(np.float64), photograph[region].astype(np.float64)
        means = ((a - b) ** 2).mean(), (matched_difference(a, b) ** 2).mean()
        near = box(region, 48)  # wider than any window of a measure
        pair = image[near], photograph[near], region[near]
        sums = count * np.array([*means, ssim(*pair), flip(*pair)])
        self._sums += sums
        self.pixels += count
        return _figures(sums, count)

    def figures(self) -> dict[str, float]:
        """PSNR (dB), PSNR after one factor per channel and image, RMSE (0..255), SSIM, FLIP and number of pixels."""
        return _figures(self._sums, self.pixels)


def _figures(sums: NDArray, pixels: int) -> dict[str, float]:
    squared, matched, likeness, flipped = map(float, sums / max(pixels, 1))
    rmse = math.sqrt(squared)
    psnr, psnr_matched = psnr_from_rmse(rmse), psnr_from_rmse(math.sqrt(matched))
    figures = {"psnr": psnr, "psnr_matched": psnr_matched, "rmse": rmse, "ssim": likeness, "flip": flipped}
    return {**figures, "pixels": pixels}


def matched_difference(codes: NDArray, photograph: NDArray) -> NDArray[np.float64]:
    """(N, 3) difference of sRGB codes 0..255 once each channel's light is scaled to fit best.

    A camera that no program reads may be exposed or balanced differently.
    """
    a, b = (srgb_to_linear(x / 255.0) for x in (codes, photograph))
    return np.asarray(255.0 * linear_to_srgb(np.clip(_channel_scale(a, b) * a, 0.0, 1.0)) - photograph)


def scaled_psnr(image: NDArray, truth: NDArray, region: Region) -> float:
    """PSNR (dB) of the sRGB codes of linear images over a region, after the least-squares factor of each channel."""
    a, b = image[region].astype(np.float64), truth[region].astype(np.float64)
    codes = [255.0 * linear_to_srgb(np.clip(x, 0.0, 1.0)) for x in (_channel_scale(a, b) * a, b)]
    return psnr_from_rmse(float(np.sqrt(np.mean((codes[0] - codes[1]) ** 2))))


def _channel_scale(a: NDArray, b: NDArray) -> NDArray:
    return (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)


def separation(
    diffuse: NDArray, specular: NDArray, true_diffuse: NDArray, true_specular: NDArray, region: Region
) -> dict[str, float]:
    """How well diffuse and specular reflection are separated in one view, over skin (`pass_region`).

    Images (H, W, 3) are linear radiance, the true ones in the photograph's exposure. ``correlation``: of the specular
    images' luminance (Pearson); ``error``: RMS error of it after the best factor, over its RMS; both again
    ``_smooth``, after a blur of 3 pixels; ``error_flat``: that of an even specular image; ``share``, ``share_truth``:
    mean specular over mean of both; ``diffuse_psnr``: PSNR in dB of the diffuse image after one factor per channel;
    ``diffuse_psnr_unseparated``: that of the whole true image.
    """
    if not region.any():
        raise InputError("separation: the region is empty, expected skin in the view")
    weights = np.asarray(LUMINANCE, np.float64)

    def blurred(image: NDArray) -> NDArray:
        return cv2.GaussianBlur(image.astype(np.float32), (0, 0), 3.0)

    def likeness(found: NDArray, true: NDArray) -> tuple[float, float]:
        a, b = found[region] @ weights, true[region] @ weights
        factor = float(a @ b) / max(float(a @ a), 1e-12)
        flat = np.ptp(a) == 0 or np.ptp(b) == 0
        error = np.sqrt(((factor * a - b) ** 2).mean() / max(float((b**2).mean()), 1e-20))
        return 0.0 if flat else float(np.corrcoef(a, b)[0, 1]), float(error)

    def share(part: NDArray, rest: NDArray) -> float:
        both = float(((part + rest)[region] @ weights).mean())
        return float((part[region] @ weights).mean() / max(both, 1e-12))

    specular, true_specular = np.asarray(specular, np.float64), np.asarray(true_specular, np.float64)
    raw, smooth = likeness(specular, true_specular), likeness(blurred(specular), blurred(true_specular))
    return {
        "correlation": raw[0],
        "error": raw[1],
        "correlation_smooth": smooth[0],
        "error_smooth": smooth[1],
        "error_flat": likeness(np.ones_like(true_specular), true_specular)[1],
        "share": share(specular, np.asarray(diffuse, np.float64)),
        "share_truth": share(true_specular, np.asarray(true_diffuse, np.float64)),
        "diffuse_psnr": scaled_psnr(diffuse, true_diffuse, region),
        "diffuse_psnr_unseparated": scaled_psnr(true_diffuse + true_specular, true_diffuse, region),
    }
