"""Lens distortion: OpenCV's model, in this project's pixel convention (first centre at 0.5, 0.5)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)


def opencv_matrix(camera: Camera) -> NDArray[np.float64]:
    """(3, 3) intrinsic matrix with OpenCV's integer pixel centres."""
    matrix = camera.matrix
    matrix[:2, 2] -= 0.5
    return matrix


def undistort_points(camera: Camera, pixels: NDArray) -> NDArray[np.float64]:
    """Pixel coordinates (N, 2) in the image as stored -> in the undistorted image of the same intrinsics."""
    pixels = np.asarray(pixels, dtype=np.float64)
    if not any(camera.distortion) or len(pixels) == 0:
        return pixels.copy()
    matrix = opencv_matrix(camera)
    found = cv2.undistortPoints(
        (pixels - 0.5).reshape(-1, 1, 2), matrix, np.array(camera.distortion), P=matrix, criteria=_CRITERIA
    )
    return np.asarray(found.reshape(-1, 2) + 0.5, dtype=np.float64)


@dataclass(frozen=True)
class Undistortion:
    """Look-up of an undistorted image in the stored one.

    ``x`` and ``y`` (H, W) are the integer-centred source column and row of every pixel; ``valid`` (H, W) are pixels
    whose source lies inside the stored image and where the distortion model is one to one.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    valid: NDArray[np.bool_]

    def apply(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Undistort an image (H, W) or (H, W, C), bilinear; 0 outside the stored image."""
        moved = cv2.remap(image, self.x, self.y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(moved, dtype=np.float32)


@lru_cache(maxsize=4)
def undistortion(camera: Camera) -> Undistortion:
    """The look-up for a camera, kept for the last few; the undistorted image keeps size and intrinsics."""
    matrix, size = opencv_matrix(camera), (camera.width, camera.height)
    x, y = cv2.initUndistortRectifyMap(matrix, np.array(camera.distortion), np.eye(3), matrix, size, cv2.CV_32FC1)
    inside = (x >= 0) & (x <= camera.width - 1) & (y >= 0) & (y <= camera.height - 1)
    return Undistortion(np.asarray(x, np.float32), np.asarray(y, np.float32), inside & _one_to_one(camera, x, y))


def _one_to_one(camera: Camera, x: NDArray, y: NDArray) -> NDArray[np.bool_]:
    """Where the polynomial has not folded over: the part around the axis with a positive Jacobian."""
    (xy, xx), (yy, yx) = np.gradient(x), np.gradient(y)
    positive = (xx * yy - xy * yx > 0).astype(np.uint8)
    _, labels = cv2.connectedComponents(positive, connectivity=4)
    row = int(np.clip(camera.cy - 0.5, 0, camera.height - 1))
    column = int(np.clip(camera.cx - 0.5, 0, camera.width - 1))
    return np.asarray((labels == labels[row, column]) & (positive > 0))
