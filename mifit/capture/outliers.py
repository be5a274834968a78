"""Landmarks that contradict others: far from their neighbours in time, or off their epipolar line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.metrics import NORMAL


def temporal_outliers(points: NDArray) -> NDArray[np.bool_]:
    """Landmarks that jump: far from where the frames before and after put them.

    The neighbours are moved onto each frame by the similarity that fits best, so head motion doesn't count. Expressions
    and a detector's noise stay below the smallest jump that counts, 0.05 of the face's width. ``points`` (T, 68, 2) are
    landmarks over time, NaN where there are none; (T, 68) outliers are returned, none of fewer than three frames.
    """
    count = len(points)
    residual = np.full(points.shape[:2], np.nan)
    for t in range(count):
        around = (t - 1, t + 1) if 0 < t < count - 1 else (1, 2) if t == 0 else (t - 1, t - 2)
        if count < 3 or not np.isfinite(points[[t, *around]]).all():
            continue
        # the nearer of two neighbours, so that a jump counts in its own frame only
        residual[t] = np.min([np.linalg.norm(_align(points[s], points[t]) - points[t], axis=1) for s in around], axis=0)
    return _beyond(residual, 0.05 * _widths(points))


def epipolar_outliers(first: NDArray, second: NDArray, cameras: tuple[Camera, Camera]) -> NDArray[np.bool_]:
    """(T, 68) landmarks of two views that can't be the same point of space.

    Their distance to the other's epipolar line is too large in either view: 0.02 of the face's width at the least.
    ``first`` and ``second`` (T, 68, 2) are undistorted landmarks of the two cameras; NaN where there are none.
    """
    matrix = fundamental_matrix(*cameras)
    distance = np.abs([line_distances(matrix, first, second), line_distances(matrix.T, second, first)]).max(axis=0)
    return _beyond(distance, 0.02 * np.fmax(_widths(first), _widths(second)))


def fundamental_matrix(first: Camera, second: Camera) -> NDArray[np.float64]:
    """(3, 3) matrix F with ``x2' F x1 = 0`` for the pixels of one point in two undistorted views."""
    relative = second.world_to_camera @ np.linalg.inv(first.world_to_camera)
    x, y, z = relative[:3, 3]
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.linalg.inv(second.matrix).T @ cross @ relative[:3, :3] @ np.linalg.inv(first.matrix))


def line_distances(matrix: NDArray, first: NDArray, second: NDArray) -> NDArray[np.float64]:
    """(T, N) signed distances of a view's pixels (T, N, 2) from the lines of another view's by `fundamental_matrix`."""
    line = np.concatenate([first, np.ones((*first.shape[:2], 1))], axis=2) @ matrix.T
    length = np.maximum(np.linalg.norm(line[..., :2], axis=2), 1e-12)
    return ((line[..., :2] * second).sum(-1) + line[..., 2]) / length


def _widths(points: NDArray) -> NDArray[np.float64]:
    """(T, 1) width of the face: the longer side of the landmarks' box."""
    return np.asarray(np.ptp(points, axis=1).max(axis=1, keepdims=True), dtype=np.float64)


def _beyond(residual: NDArray, floor: NDArray) -> NDArray[np.bool_]:
    """Above the floor and 4.5 robust standard deviations of all landmarks of a camera."""
    seen = residual[np.isfinite(residual)]
    if not len(seen):
        return np.zeros(residual.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        return np.asarray(residual > np.fmax(floor, 4.5 * NORMAL * np.median(seen)))


def _align(source: NDArray, target: NDArray) -> NDArray[np.float64]:
    """Move points by the similarity that takes them closest to others, outliers weighted down."""
    z, w = source[:, 0] + 1j * source[:, 1], target[:, 0] + 1j * target[:, 1]
    system = np.stack([z, np.ones_like(z)], axis=1)
    weight = np.ones(len(z))
    for _ in range(5):
        scaled = np.sqrt(weight)[:, None]
        a, b = np.linalg.lstsq(system * scaled, w * scaled[:, 0], rcond=None)[0]
        distance = np.abs(a * z + b - w)
        weight = 1.0 / np.maximum(distance, np.median(distance) + 1e-9)
    moved = a * z + b
    return np.stack([moved.real, moved.imag], axis=1)
