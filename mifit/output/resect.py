"""A camera that was not fitted, placed from its landmarks against the fitted head.

Held-out views of an uncalibrated capture have no camera: here their landmarks alone give one, so the view's own
colours have no part in it. The fitted head's landmarks are taken as they are, so an error of the fit is an error of
the camera as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.capture.resection import landmark_weights, resect_camera
from mifit.core.camera import Camera
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Result

LEAST_VISIBLE = 6


@dataclass(frozen=True)
class Resection:
    """A camera and how well it explains the landmarks.

    Attributes
    ----------
    camera : Camera
    landmark_pixels : float
        Root mean square distance of the landmarks other than the jaw's to the fitted head's, pixels.
    """

    camera: Camera
    landmark_pixels: float


def needs_resection(result: Result, capture: Capture, name: str) -> bool:
    """Whether a camera of the capture is neither calibrated nor fitted."""
    if capture.calibrated or name not in capture.views:
        return False
    return name not in {c.name for c in result.cameras} | set(capture.estimated)


def resect(result: Result, capture: Capture, name: str) -> Resection:
    """Place one camera of an uncalibrated capture.

    Pose, and the focal length where the capture has none, minimise the robust distances between the landmarks of
    all fitted timesteps and those of the fitted head; the principal point is the capture's, or the image's middle.

    Raises
    ------
    InputError
        The camera has too few visible landmarks at every fitted timestep.
    """
    view = capture.views[name]
    same = all((c.width, c.height) == (view.width, view.height) for c in result.cameras)
    scale = 1.0 if same else max(view.width, view.height) / max(max(c.width, c.height) for c in result.cameras)
    expected = float(np.median([c.fx for c in result.cameras])) * scale
    return Resection(*resect_camera(view, *_pairs(result, capture, name), expected, same))


def _pairs(result: Result, capture: Capture, name: str) -> tuple[NDArray, NDArray, NDArray]:
    """World points of the fitted head, their pixels and their weights, over all fitted timesteps of the capture."""
    points, pixels, weights = [], [], []
    for i, timestep in enumerate(result.timesteps):
        marks = capture.landmarks(name, timestep) if timestep in capture.timesteps else None
        if marks is None or marks.visible.sum() < LEAST_VISIBLE:
            continue
        points.append(result.geometry.vertices[i][result.model.landmarks][marks.visible].astype(np.float64))
        pixels.append(marks.points[marks.visible])
        weights.append(landmark_weights(np.flatnonzero(marks.visible)))
    if not points:
        raise InputError(
            f"camera {name!r}: not calibrated, and no fitted timestep has {LEAST_VISIBLE} visible landmarks in it to "
            "place it by; run mifit landmarks, or calibrate the capture"
        )
    return np.concatenate(points), np.concatenate(pixels), np.concatenate(weights)
