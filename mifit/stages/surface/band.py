"""Images as the search for the surface reads them: the logarithm, and a band of it in which large contrasts end."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.image import box
from mifit.sampling.visibility import DARKEST

FINE, WINDOW = 0.6, 4.0
"""Blurs whose difference is the band, pixels of the level; the second chosen on all development heads."""
SHEEN = 0.9
"""Part of the least channel that all levels but the finest leave out. Highlights have much of it and move over skin,
which has little; at the finest level noise would remain. Chosen on all development heads."""
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
        Feature, 1 where it is measured, and the logarithm of which the feature is a band.
    """

    camera: Camera
    factor: float
    values: NDArray[np.float32]

    def place(self, points: NDArray) -> NDArray[np.float32]:
        """(N, 2) integer-centred pixels of the level that show world points (N, 3); far outside it behind the camera.

        Single precision places a point to a ten thousandth of a pixel.
        """
        camera, factor = self.camera, self.factor
        scaled = camera.to_camera(np.asarray(points, np.float64)) * (camera.fx * factor, camera.fy * factor, 1.0)
        x, y, z = scaled.T.astype(np.float32)
        z = np.where(z > 1e-12, z, np.float32(np.nan))
        pixels = np.stack([x / z, y / z], axis=1)
        pixels += (camera.cx * factor - 0.5, camera.cy * factor - 0.5)
        return np.nan_to_num(pixels, copy=False, nan=-10.0)

    def sample(self, points: NDArray) -> NDArray[np.float32]:
        """(N, 3) values at world points (N, 3), 0 outside the image."""
        return look_up(self.values, self.place(points))


def feature_image(camera: Camera, image: NDArray, valid: NDArray[np.bool_], factor: float) -> FeatureImage:
    """Band-passed logarithm of a linear image (H, W, 3) at a level of the pyramid; coarse ones leave sheen out.

    ``valid`` leaves out what isn't the surface: the band never mixes the face with what lies behind it.
    """
    size = (max(round(camera.width * factor), 8), max(round(camera.height * factor), 8))
    weight = valid.astype(np.float32)
    layer = np.where(valid, image @ np.array([0.3, 0.5, 0.2], np.float32), np.float32(0))
    if factor < 1.0:
        layer -= np.float32(SHEEN) * np.where(valid, image.min(axis=-1), np.float32(0))
        small = (cv2.resize(x, size, interpolation=cv2.INTER_AREA) for x in (weight, layer))
        weight, layer = (np.asarray(x, np.float32) for x in small)
        layer = layer / np.maximum(weight, np.float32(1e-3))
    usable = weight > 0.9
    # Blurs reach four deviations far; nothing is read where nothing is usable.
    part = box(usable, int(np.ceil(4.0 * WINDOW)) + 1)
    shown = usable[part]
    log = np.log(np.maximum(layer[part], 0.0) + DARKEST) * shown
    band = _blurred(log, shown, FINE) - _blurred(log, shown, WINDOW)
    values = np.zeros((*usable.shape, 3), np.float32)
    values[part] = np.stack([LARGEST * np.tanh(band / LARGEST), shown, log], axis=-1)
    return FeatureImage(camera, factor, values)


def _blurred(log: NDArray, shown: NDArray[np.bool_], deviation: float) -> NDArray[np.float32]:
    """Mean around each pixel of what is shown; 0 elsewhere."""
    mask = shown.astype(np.float32)
    weight = np.maximum(cv2.GaussianBlur(mask, (0, 0), deviation), 1e-3)
    return np.asarray(mask * cv2.GaussianBlur(log * mask, (0, 0), deviation) / weight, np.float32)


def look_up(values: NDArray, pixels: NDArray, columns: int = 4096) -> NDArray[np.float32]:
    """Bilinear look-up at integer-centred (N, 2) positions; OpenCV wants them as an image of limited width."""
    count = len(pixels)
    padded = np.full((-(-max(count, 1) // columns) * columns, 2), -10.0, np.float32)
    padded[:count] = pixels
    grid, border = padded.reshape(-1, columns, 2), {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 0}
    found = cv2.remap(values, grid, None, cv2.INTER_LINEAR, **border)  # type: ignore[call-overload]
    return np.asarray(found).reshape(-1, values.shape[-1])[:count]
