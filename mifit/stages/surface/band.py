"""Images as matching sees them: the logarithm between two scales, highlights and shadows' edges held in check."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.image import box
from mifit.core.process import blocks
from mifit.sampling.visibility import DARKEST

WINDOW = 3.0
"""Wide blur of the band, pixels of the level."""
LARGEST = 0.3
"""Contrast in the logarithm above which a feature stops growing: highlights, hair, the edges of cast shadows."""


@dataclass(frozen=True)
class FeatureImage:
    """One image at one level of the pyramid.

    Attributes
    ----------
    camera : Camera
        Of the full image.
    factor : float
        Pixels of the level per pixel of the image, at most 1.
    values : (h, w, 3) float32
        Feature, 1 where it is measured, and the logarithm between features and shading: how bright it is there.
    """

    camera: Camera
    factor: float
    values: NDArray[np.float32]

    def sample(self, points: NDArray, way: NDArray, offsets: NDArray) -> NDArray[np.float32]:
        """(K, N, 3) feature, validity and brightness at world points (N, 3) moved by K offsets along their ways (N, 3).

        0 outside the image. The straight lines are projected once.
        """
        camera, factor = self.camera, self.factor
        start, slope = camera.to_camera(np.asarray(points, np.float64)), way.astype(np.float64) @ camera.rotation.T
        # Single precision places a point to a ten thousandth of a pixel, in half the time.
        x, y, z = (start * (camera.fx * factor, camera.fy * factor, 1.0)).T.astype(np.float32)
        dx, dy, dz = (slope * (camera.fx * factor, camera.fy * factor, 1.0)).T.astype(np.float32)
        middle = np.float32(camera.cx * factor - 0.5), np.float32(camera.cy * factor - 0.5)
        steps = np.asarray(offsets, np.float32)[:, None]
        out = np.empty((len(steps), len(start), self.values.shape[-1]), np.float32)
        for part in blocks(len(start), 256):
            depth = z[part] + steps * dz[part]
            behind = depth <= 1e-12
            if behind.any():
                depth[behind] = np.nan
            pixels = np.empty((*depth.shape, 2), np.float32)
            np.divide(x[part] + steps * dx[part], depth, out=pixels[..., 0])
            np.divide(y[part] + steps * dy[part], depth, out=pixels[..., 1])
            pixels += middle
            if behind.any():
                pixels[behind] = -10.0
            out[:, part] = _remapped(self.values, pixels)
        return out


def feature_image(camera: Camera, image: NDArray, valid: NDArray[np.bool_], factor: float) -> FeatureImage:
    """Band-passed logarithm of a linear image (H, W, 3) at a level of the pyramid.

    ``valid`` leaves out what isn't the surface: the band never mixes the face with what lies behind it.
    """
    size = (max(round(camera.width * factor), 8), max(round(camera.height * factor), 8))
    weight = valid.astype(np.float32)
    luminance = np.where(valid, image @ np.array([0.3, 0.5, 0.2], np.float32), np.float32(0))
    if factor < 1.0:
        weight = np.asarray(cv2.resize(weight, size, interpolation=cv2.INTER_AREA), np.float32)
        sharp = np.asarray(cv2.resize(luminance, size, interpolation=cv2.INTER_AREA), np.float32)
        luminance = sharp / np.maximum(weight, 1e-3)
    usable = (weight > 0.9).astype(np.float32)
    # Blurs reach four deviations far; nothing is read where nothing is usable.
    part = box(usable > 0, int(np.ceil(4.0 * WINDOW)) + 1)
    shown = usable[part]
    log = np.log(np.maximum(luminance[part], 0.0) + DARKEST) * shown
    wide, fine = (
        cv2.GaussianBlur(log, (0, 0), s) / np.maximum(cv2.GaussianBlur(shown, (0, 0), s), 1e-3) for s in (WINDOW, 0.6)
    )
    band = LARGEST * np.tanh((fine - wide) / LARGEST)
    values = np.zeros((*usable.shape, 3), np.float32)
    values[part] = np.stack([band * shown, shown, wide * shown], axis=-1)
    return FeatureImage(camera, factor, values)


def look_up(values: NDArray, pixels: NDArray, columns: int = 4096) -> NDArray[np.float32]:
    """Bilinear look-up at integer-centred (N, 2) positions; OpenCV wants them as an image of limited width."""
    count = len(pixels)
    padded = np.full((-(-max(count, 1) // columns) * columns, 2), -10.0, np.float32)
    padded[:count] = pixels
    grid = padded.reshape(-1, columns, 2)
    return _remapped(values, grid).reshape(-1, values.shape[-1])[:count]


def _remapped(values: NDArray, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same at (rows, columns, 2) positions, of not more columns than OpenCV takes."""
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    return cv2.remap(values, pixels, None, cv2.INTER_LINEAR, **border)  # type: ignore[call-overload]
