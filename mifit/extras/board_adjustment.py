"""Bundle adjustment of cameras and of the poses of a flat board that they watched, over all points of all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mifit.extras.boards import BoardPoints

LENS, POSE = 9, 6
"""Unknowns of a lens (fx, fy, cx, cy, k1, k2, p1, p2, k3) and of a pose (rotation vector, translation)."""
PRIORS = 8
"""Residuals of a lens's prior."""
_STEP = 1e-6
CENTRE, ASPECT = 0.03, 0.01
"""Deviations beforehand of the principal point from the image's middle, in longer sides, and of fy / fx from 1."""
RADIAL, TANGENTIAL = 0.5, 0.003
"""Of k1, k2, k3 and of p1, p2 from 0: what a board in the middle of the image doesn't tell stays near a plain lens."""
LEAST_NOISE = 0.05
"""Deviation of a board's points from where they are found, pixels, at the least."""


@dataclass(frozen=True)
class Adjusted:
    """Cameras after the adjustment, OpenCV's pixel centres and axes, millimetres, the first camera's frame as world.

    Attributes
    ----------
    matrices : list of (3, 3)
    distortions : list of 5 float
    poses : list of (4, 4)
        World to camera.
    focal_deviations : list of float
        Standard deviations of the focal lengths in pixels, from the residuals.
    errors : list of dict of int to float
        Per camera and frame: root-mean-square distance in pixels.
    """

    matrices: list[NDArray[np.float64]]
    distortions: list[tuple[float, ...]]
    poses: list[NDArray[np.float64]]
    focal_deviations: list[float]
    errors: list[dict[int, float]]


def adjust(
    points: NDArray[np.float64],
    seen: Sequence[dict[int, BoardPoints]],
    matrices: Sequence[NDArray[np.float64]],
    distortions: Sequence[tuple[float, ...]],
    poses: Sequence[NDArray[np.float64]],
    sizes: Sequence[tuple[int, int]],
    noise: float,
) -> Adjusted:
    """Refine lenses, camera poses and board poses together (Triggs et al., "Bundle Adjustment", 2000).

    Lenses have a prior, whose weight is that of one coordinate with the noise: where the board was seen all over the
    image it says nothing, and where not it keeps distortion from bending what no point has shown.

    Parameters
    ----------
    points : (P, 3)
        Board points by their ids, millimetres.
    seen : one dict of frame to BoardPoints per camera
    matrices, distortions, poses
        Start, see `Adjusted`.
    sizes : sequence of (int, int)
        Width and height of the images.
    noise : float
        Deviation of the points found, pixels.
    """
    count = len(seen)
    frames = sorted({i for used in seen for i in used})
    blocks = [(c, frames.index(i), found) for c, used in enumerate(seen) for i, found in used.items()]
    lenses = [np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *d]) for m, d in zip(matrices, distortions, strict=True)]
    boards = np.zeros((len(frames), POSE))
    for c, f, found in blocks:
        if not boards[f].any():
            _, turn, shift = cv2.solvePnP(points[found.ids], found.pixels - 0.5, matrices[c], np.array(distortions[c]))
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            boards[f] = _vector(np.linalg.inv(poses[c]) @ pose)
    start = np.concatenate([*lenses, *(_vector(p) for p in poses[1:]), boards.ravel()])
    scale = np.concatenate(
        [
            np.tile([1e3, 1e3, 1e3, 1e3, 1, 1, 0.1, 0.1, 1], count),
            np.tile([1, 1, 1, 1e3, 1e3, 1e3], count - 1 + len(frames)),
        ]
    )

    def unpack(x: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        x = x * scale
        lens = x[: LENS * count].reshape(count, LENS)
        rest = x[LENS * count :].reshape(-1, POSE)
        return lens, np.concatenate([np.zeros((1, POSE)), rest[: count - 1]]), rest[count - 1 :]

    def residuals(x: NDArray) -> NDArray:
        lens, camera, board = unpack(x)
        out = []
        for c, f, found in blocks:
            turn, shift, *_ = cv2.composeRT(board[f, :3], board[f, 3:], camera[c, :3], camera[c, 3:])
            fx, fy, cx, cy = lens[c, :4]
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            pixels, _ = cv2.projectPoints(points[found.ids], turn, shift, matrix, lens[c, 4:])
            out.append((pixels.reshape(-1, 2) - (found.pixels - 0.5)).ravel())
        return np.concatenate([*out, *(noise * _unlikely(one, size) for one, size in zip(lens, sizes, strict=True))])

    ends = np.cumsum([2 * len(found) for _, _, found in blocks])
    rows = [slice(end - 2 * len(found), end) for end, (_, _, found) in zip(ends, blocks, strict=True)]
    lens_rows = [slice(ends[-1] + PRIORS * c, ends[-1] + PRIORS * (c + 1)) for c in range(count)]

    def jacobian(x: NDArray) -> NDArray:
        """Differences; one unknown of every camera, or of every board, at a time: a block depends on one of each."""
        out = np.zeros((lens_rows[-1].stop, len(x)))
        groups = [([LENS * c + j for c in range(count)], 0) for j in range(LENS)]
        first = LENS * count
        groups += [([-1, *(first + POSE * c + j for c in range(count - 1))], 0) for j in range(POSE)]
        first += POSE * (count - 1)
        groups += [([first + POSE * f + j for f in range(len(frames))], 1) for j in range(POSE)]
        for columns, which in groups:
            moved = [np.array(x), np.array(x)]
            used = [k for k in columns if k >= 0]
            moved[0][used] += _STEP
            moved[1][used] -= _STEP
            change = (residuals(moved[0]) - residuals(moved[1])) / (2 * _STEP)
            for row, block in zip(rows, blocks, strict=True):
                column = columns[block[:2][which]]  # camera or board
                if column >= 0:
                    out[row, column] = change[row]
            if columns[0] < LENS:
                for row, column in zip(lens_rows, columns, strict=True):
                    out[row, column] = change[row]
        return out

    solution = least_squares(residuals, start / scale, jac=jacobian, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=60)
    lens, camera, _ = unpack(solution.x)
    free = max(len(solution.fun) - len(solution.x), 1)
    covariance = np.linalg.pinv(solution.jac.T @ solution.jac) * (solution.fun @ solution.fun) / free
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale
    errors: list[dict[int, float]] = [{} for _ in seen]
    for row, (c, f, found) in zip(rows, blocks, strict=True):
        errors[c][frames[f]] = float(np.sqrt(np.sum(solution.fun[row] ** 2) / len(found)))
    return Adjusted(
        [np.array([[v[0], 0, v[2]], [0, v[1], v[3]], [0, 0, 1.0]]) for v in lens],
        [tuple(v[4:].tolist()) for v in lens],
        [_matrix(v) for v in camera],
        [float(deviations[LENS * c : LENS * c + 2].max()) for c in range(count)],
        errors,
    )


def _unlikely(lens: NDArray, size: tuple[int, int]) -> NDArray[np.float64]:
    """(PRIORS,) how far a lens lies from a plain one, in deviations."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    off = np.array([cx - 0.5 * (size[0] - 1), cy - 0.5 * (size[1] - 1)]) / (CENTRE * max(size))
    bent = np.array([k1, k2, k3]) / RADIAL, np.array([p1, p2]) / TANGENTIAL
    return np.concatenate([off, [(fy / fx - 1.0) / ASPECT], *bent])


def _vector(pose: NDArray) -> NDArray[np.float64]:
    return np.concatenate([cv2.Rodrigues(np.ascontiguousarray(pose[:3, :3]))[0].ravel(), pose[:3, 3]])


def _matrix(vector: NDArray) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(np.ascontiguousarray(vector[:3]))[0], vector[3:]
    return pose
