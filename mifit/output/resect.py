"""A camera that was not fitted, placed from its landmarks against the fitted head.

Held-out views of an uncalibrated capture have no camera: here their landmarks alone give one, so the view's own
colours have no part in it. The fitted head's landmarks are taken as they are, so an error of the fit is an error of
the camera as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mifit.core.camera import Camera
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Result

LEAST_VISIBLE = 6
JAW = 17
JAW_WEIGHT = 0.3
"""The first 17 iBUG points slide along the jaw's outline as the view turns."""
FOCAL_DEVIATION = {True: 0.02, False: 0.5}
"""Of the log of the focal length about the fitted cameras': images of the same size suggest the same lens."""
NOISE = 0.004
"""Standard deviation of a landmark as a part of the image's longer side."""


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
    points, pixels, weights = _pairs(result, capture, name)
    side = max(view.width, view.height)
    fitted = [c.fx for c in result.cameras]
    same = all((c.width, c.height) == (view.width, view.height) for c in result.cameras)
    scale = 1.0 if same else side / max(max(c.width, c.height) for c in result.cameras)
    expected = float(np.median(fitted)) * scale
    if view.intrinsics is None:
        fx, fy, cx, cy = expected, expected, view.width / 2, view.height / 2
    else:
        fx, fy, cx, cy = view.intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    found, turn, shift = cv2.solvePnP(points, pixels, matrix, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        raise InputError(f"camera {name!r}: no pose of the fitted head explains its landmarks; check their order")

    def project(x: NDArray) -> NDArray:
        p = points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        focal = np.exp(x[6]) if view.intrinsics is None else 1.0
        return focal * np.array((fx, fy)) * p[:, :2] / np.maximum(p[:, 2:], 1e-3) + (cx, cy)

    def residuals(x: NDArray) -> NDArray:
        error = (project(x) - pixels) * (weights / (NOISE * side))[:, None]
        return np.append(error.ravel(), x[6] / FOCAL_DEVIATION[same])

    start = np.concatenate([turn.ravel(), shift.ravel(), [0.0]])
    solution = least_squares(residuals, start, loss="soft_l1", x_scale="jac", max_nfev=200).x
    focal = float(np.exp(solution[6])) if view.intrinsics is None else 1.0
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(solution[:3]).as_matrix(), solution[3:6]
    camera = Camera(name, view.width, view.height, focal * fx, focal * fy, cx, cy, pose)
    inner = weights == 1.0
    error = np.linalg.norm((project(solution) - pixels)[inner], axis=1)
    return Resection(camera, float(np.sqrt(np.mean(error**2))))


def _pairs(result: Result, capture: Capture, name: str) -> tuple[NDArray, NDArray, NDArray]:
    """World points of the fitted head, their pixels and their weights, over all fitted timesteps of the capture."""
    points, pixels, weights = [], [], []
    for i, timestep in enumerate(result.timesteps):
        marks = capture.landmarks(name, timestep) if timestep in capture.timesteps else None
        if marks is None or marks.visible.sum() < LEAST_VISIBLE:
            continue
        points.append(result.geometry.vertices[i][result.model.landmarks][marks.visible].astype(np.float64))
        pixels.append(marks.points[marks.visible])
        weights.append(np.where(np.arange(68) < JAW, JAW_WEIGHT, 1.0)[marks.visible])
    if not points:
        raise InputError(
            f"camera {name!r}: not calibrated, and no fitted timestep has {LEAST_VISIBLE} visible landmarks in it to "
            "place it by; run mifit landmarks, or calibrate the capture"
        )
    return np.concatenate(points), np.concatenate(pixels), np.concatenate(weights)
