"""Bundle adjustment of cameras and of the poses of a flat board that they watched, over all points of all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mifit.extras.board_camera import SETTINGS, Watched
from mifit.extras.boards import Board

LENS, POSE = 9, 6
"""Unknowns of a lens (fx, fy, cx, cy, k1, k2, p1, p2, k3) and of a pose (rotation vector, translation)."""


def adjust(
    watched: Sequence[Watched], poses: Sequence[NDArray[np.float64]], board: Board
) -> tuple[list[Watched], list[NDArray[np.float64]]]:
    """Refine lenses, camera poses and board poses together (Triggs et al., "Bundle Adjustment", 2000).

    Lenses have a prior, whose weight is that of one coordinate with the points' noise: where the board was seen all
    over the image it says nothing, and where not it keeps distortion from bending what no point has shown.

    Parameters
    ----------
    watched : sequence of Watched
        A start, and the points that cameras see.
    poses : sequence of (4, 4)
        World to camera, OpenCV axes, millimetres; the first camera's frame is the world's.
    board : Board

    Returns
    -------
    watched : list of Watched
        With lenses, deviations of the focal lengths from the residuals, and errors of the frames.
    poses : list of (4, 4)
    """
    every = [error for one in watched for error in one.errors.values()]
    noise = max(float(np.median(every)) / np.sqrt(2.0), SETTINGS.least_noise)
    count, points = len(watched), board.points
    frames = sorted({i for one in watched for i in one.used})
    blocks = [(c, frames.index(i), found) for c, one in enumerate(watched) for i, found in one.used.items()]
    ends = np.cumsum([2 * len(found) for _, _, found in blocks])
    rows = [slice(end - 2 * len(found), end) for end, (_, _, found) in zip(ends, blocks, strict=True)]
    lenses = [np.concatenate([w.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], w.distortion]) for w in watched]
    boards = np.zeros((len(frames), POSE))
    for c, f, found in blocks:
        if not boards[f].any():
            _, turn, shift = cv2.solvePnP(points[found.ids], found.pixels - 0.5, watched[c].matrix, lenses[c][4:])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            boards[f] = _vector(np.linalg.inv(poses[c]) @ pose)
    first = LENS * count - POSE  # where the first camera's pose would stand, which doesn't move
    start = np.concatenate([*lenses, *(_vector(p) for p in poses[1:]), boards.ravel()])
    scale = np.concatenate(
        [np.tile([1e3] * 4 + [1, 1, 0.1, 0.1, 1], count), np.tile([1, 1, 1, 1e3, 1e3, 1e3], count - 1 + len(frames))]
    )

    def residuals(x: NDArray) -> NDArray:
        return system(x)[0]

    def system(x: NDArray) -> tuple[NDArray, NDArray]:
        """Residuals and their derivatives by the scaled unknowns."""
        x = x * scale
        out = np.zeros(ends[-1] + (LENS - 1) * count)
        slopes = np.zeros((len(out), len(x)))
        for row, (c, f, found) in zip(rows, blocks, strict=True):
            at, board = first + POSE * c, first + POSE * (count + f)
            camera = x[at : at + POSE] if c else np.zeros(POSE)
            # d(turn, shift) by the board's pose and by the camera's
            turn, shift, *parts = cv2.composeRT(x[board : board + 3], x[board + 3 : board + 6], camera[:3], camera[3:])
            by_board, by_camera = (np.block([[parts[k], parts[k + 1]], [parts[k + 4], parts[k + 5]]]) for k in (0, 2))
            lens = x[LENS * c : LENS * (c + 1)]
            pixels, by = cv2.projectPoints(points[found.ids], turn, shift, _intrinsics(lens), lens[4:])
            out[row] = (pixels.reshape(-1, 2) - (found.pixels - 0.5)).ravel()
            slopes[row, LENS * c : LENS * (c + 1)] = by[:, 6 : 6 + LENS]
            slopes[row, board : board + POSE] = by[:, :6] @ by_board
            if c:
                slopes[row, at : at + POSE] = by[:, :6] @ by_camera
        for c, one in enumerate(watched):
            row, columns = (
                slice(ends[-1] + (LENS - 1) * c, ends[-1] + (LENS - 1) * (c + 1)),
                slice(LENS * c, LENS * (c + 1)),
            )
            value, slope = _unlikely(x[columns], one.size)
            out[row], slopes[row, columns] = noise * value, noise * slope
        return out, slopes * scale

    solution = least_squares(
        residuals, start / scale, jac=lambda x: system(x)[1], method="lm", xtol=1e-12, ftol=1e-12, max_nfev=60
    )
    found_x = solution.x * scale
    free = max(len(solution.fun) - len(solution.x), 1)
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * (solution.fun @ solution.fun) / free
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale
    errors: list[dict[int, float]] = [{} for _ in watched]
    for row, (c, f, found) in zip(rows, blocks, strict=True):
        errors[c][frames[f]] = float(np.sqrt(np.sum(solution.fun[row] ** 2) / len(found)))
    adjusted = []
    for c, one in enumerate(watched):
        lens = found_x[LENS * c : LENS * (c + 1)]
        adjusted.append(
            replace(
                one,
                matrix=_intrinsics(lens),
                distortion=tuple(lens[4:].tolist()),
                focal_deviation=float(deviations[LENS * c : LENS * c + 2].max() / lens[0]),
                errors=errors[c],
            )
        )
    moved = found_x[LENS * count : LENS * count + POSE * (count - 1)].reshape(-1, POSE)
    return adjusted, [np.eye(4), *(_matrix(v) for v in moved)]


def _intrinsics(lens: NDArray) -> NDArray[np.float64]:
    fx, fy, cx, cy = lens[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _unlikely(lens: NDArray, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(LENS - 1,) how far a lens lies from a plain one, in deviations, and (LENS - 1, LENS) its derivative."""
    fx, fy, cx, cy = lens[:4]
    off = np.array([cx - 0.5 * (size[0] - 1), cy - 0.5 * (size[1] - 1)]) / (SETTINGS.centre * max(size))
    bends = np.array([SETTINGS.radial, SETTINGS.radial, SETTINGS.tangential, SETTINGS.tangential, SETTINGS.radial])
    slope = np.zeros((LENS - 1, LENS))
    slope[[0, 1], [2, 3]] = 1.0 / (SETTINGS.centre * max(size))
    slope[2, :2] = np.array([-fy / fx**2, 1.0 / fx]) / SETTINGS.aspect
    slope[3:, 4:] = np.diag(1.0 / bends)
    return np.concatenate([off, [(fy / fx - 1.0) / SETTINGS.aspect], lens[4:] / bends]), slope


def _vector(pose: NDArray) -> NDArray[np.float64]:
    return np.concatenate([cv2.Rodrigues(np.ascontiguousarray(pose[:3, :3]))[0].ravel(), pose[:3, 3]])


def _matrix(vector: NDArray) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.ascontiguousarray(vector[:3]))[0], vector[3:]
    return pose
