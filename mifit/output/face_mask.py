"""What of an input image shows the face: the fitted model's coverage, less what is clipped or hidden by something.

Hair, glasses or a hand are found as pixels that the fit leaves unexplained. Its robust weights keep an occluder in one
image out of albedo and lighting, which the other images agree on, so there the render stays that of the skin and the
photograph departs from it. A pixel counts as unexplained when it departs by many times the spread of the others, over
an area: single pixels are noise, edges or a mesh that is a little off.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.output.evaluate import face_area

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Result

DEPARTURE = 6.0
"""Robust standard deviations of the residual from which a pixel is unexplained."""
LEAST = 0.15
"""Departure at the least, as a part of the brighter one of photograph and render."""
DARKEST = 0.02
"""Linear colour below which parts of it mean nothing."""
BLUR = 0.003
"""Standard deviation of the blur against noise, as a part of the face's size in pixels."""
SMALLEST = 0.002
"""Part of the face area that an occluder covers at the least."""


@dataclass(frozen=True)
class FaceMask:
    """Pixels of one image, each (H, W) bool.

    Attributes
    ----------
    area : The face area of the fitted model, eroded by 2 pixels, where the image is valid.
    clipped : Those of it at the sensor's limit: no measurement.
    unexplained : Those of it that neither lighting nor albedo of the fit explains: occluders, or what the model lacks.
    """

    area: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    unexplained: NDArray[np.bool_]

    @property
    def face(self) -> NDArray[np.bool_]:
        """(H, W) pixels that show the face and measure it."""
        return self.area & ~self.clipped & ~self.unexplained

    def part(self, which: NDArray[np.bool_]) -> float:
        """Part of the face area, 0..1."""
        return float((which & self.area).sum() / max(int(self.area.sum()), 1))


def face_mask(
    reconstruction: Result,
    capture: Capture,
    camera: str,
    timestep: int,
    render: NDArray | None = None,
) -> FaceMask:
    """Find what of an input image shows the face.

    Parameters
    ----------
    reconstruction : Result
    capture : Capture
    camera : str
        A camera of the capture; an occluder is found in an image of the fit or in any other.
    timestep : int
    render : (H, W, 4), optional
        What `Reconstruction.render` gives for this view, where it is at hand.

    Raises
    ------
    InputError
        Unknown camera or timestep.
    """
    capture = reconstruction.seen(capture)
    view, frame = capture.camera(camera), capture.frame(camera, timestep)
    if render is None:
        from mifit.output.scene import render_view

        render = render_view(reconstruction, view, timestep, reconstruction.methods[-1])
    model, i = reconstruction.model, reconstruction.index(timestep)
    area = face_area(reconstruction.geometry.vertices[i], model.faces, model.face_mask, view)
    area &= frame.valid & (render[..., 3] > 0.999)
    clipped = area & frame.clipped
    fitted = render[..., :3]
    return FaceMask(area, clipped, _unexplained(frame.image, fitted, area & ~clipped))


def _unexplained(photograph: NDArray, fitted: NDArray, measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Connected areas in which two linear images (H, W, 3) differ more than elsewhere."""
    count = int(measured.sum())
    if not count:
        return np.zeros_like(measured)
    size = np.sqrt(count)
    weight = cv2.GaussianBlur(measured.astype(np.float32), (0, 0), max(BLUR * size, 0.5))
    level = np.maximum(np.maximum(photograph, fitted), DARKEST)
    difference = np.where(measured[..., None], (photograph - fitted) / level, 0.0).astype(np.float32)
    smooth = cv2.GaussianBlur(difference, (0, 0), max(BLUR * size, 0.5)) / np.maximum(weight, 1e-6)[..., None]
    departure = np.sqrt((smooth**2).mean(axis=-1))
    limit = max(DEPARTURE * 1.4826 / 2 * float(np.median(departure[measured])), LEAST)
    found = (measured & (departure > limit)).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(round(BLUR * size), 1) + 1,) * 2)
    found = cv2.morphologyEx(cv2.morphologyEx(found, cv2.MORPH_OPEN, kernel), cv2.MORPH_CLOSE, kernel)
    _, parts, figures, _ = cv2.connectedComponentsWithStats(found)
    large = np.flatnonzero(figures[:, cv2.CC_STAT_AREA] >= SMALLEST * count)
    return np.asarray(np.isin(parts, large[large > 0]) & measured)
