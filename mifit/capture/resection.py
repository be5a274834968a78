"""One camera from points of known places and their pixels: a pose, and the focal length where it isn't known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mifit.capture.transforms import View
from mifit.core.camera import Camera
from mifit.errors import InputError

JAW = 17
"""The first landmarks lie on the jaw's outline, which slides over the head as it turns: they count less."""
NOISE = 0.004
"""Standard deviation of a landmark as a part of the image's longer side."""


def landmark_weights(indices: NDArray) -> NDArray[np.float64]:
    """Weights of landmarks of these numbers: less for the jaw's."""
    return np.where(indices < JAW, 0.3, 1.0)


def resect_camera(
    view: View, points: NDArray, pixels: NDArray, weights: NDArray, focal: float, same: bool
) -> tuple[Camera, float]:
    """The camera that sees points where they are, and its root-mean-square error in pixels at weight 1.

    Parameters
    ----------
    view : View
        Its intrinsics are kept where it has any; else the principal point is the image's middle and pixels are square.
    points : (N, 3), pixels : (N, 2), weights : (N,)
        World space; undistorted pixels; weights of their distances.
    focal : float
        Expected focal length in pixels, where the view has none: to 2 % if ``same``, else to half of it.
    same : bool
        Whether its images have the size of those that ``focal`` is from.

    Raises
    ------
    InputError
        No pose explains the points.
    """
    fx, fy, cx, cy = view.intrinsics or (focal, focal, view.width / 2, view.height / 2)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    found, turn, shift = cv2.solvePnP(points, pixels, matrix, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        raise InputError(f"camera {view.name!r}: no place explains its landmarks; check their order (iBUG-68)")
    noise = NOISE * max(view.width, view.height)

    def zoom(x: NDArray) -> float:
        return float(np.exp(x[6])) if view.intrinsics is None else 1.0

    def off(x: NDArray) -> NDArray:
        p = points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        return np.asarray(zoom(x) * np.array((fx, fy)) * p[:, :2] / np.maximum(p[:, 2:], 1e-6) + (cx, cy) - pixels)

    def residuals(x: NDArray) -> NDArray:
        return np.append((off(x) * (weights / noise)[:, None]).ravel(), x[6] / (0.02, 0.5)[not same])

    start = np.concatenate([turn.ravel(), shift.ravel(), [0.0]])
    x = least_squares(residuals, start, loss="soft_l1", x_scale="jac", max_nfev=200).x
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
    error = float(np.sqrt(np.mean(np.sum(off(x)[weights == 1.0] ** 2, axis=1))))
    return Camera(view.name, view.width, view.height, zoom(x) * fx, zoom(x) * fy, cx, cy, pose), error
