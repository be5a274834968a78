"""A calibrated rig that may move a little: a Gaussian about its calibration, whatever the rig does as a whole.

A camera's movement is the logarithm of its focal length's change and six numbers, a rotation vector and a shift, by
which its world-to-camera pose changes: R' = exp(turn) R, t' = t + shift, camera axes. Matches between the cameras don't
tell movements of all of them together: of those the smallest is taken.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from mifit.stages.geometry.parameters import cross_matrix

FOCAL_DEVIATION = 0.005
"""Of a focal length, relative."""
TURN_DEGREES = 0.5
"""Deviation of a camera's orientation about each axis."""
SHIFT_DEVIATION = 0.005
"""Of a camera's position along each axis, as a part of its distance to the head."""
ROUNDS = 3
"""Linear steps that find the smallest movement of a rig; one nearly does."""


def pose_precisions(poses: NDArray, distances: NDArray) -> NDArray[np.float64]:
    """(C, 6, 6) inverse covariances of the turns and shifts of cameras.

    Parameters
    ----------
    poses : (C, 4, 4)
        World to camera, as calibrated.
    distances : (C,)
        From the cameras to the head.
    """
    found = []
    for shift, distance in zip(poses[:, :3, 3], distances, strict=True):
        # A camera that turns about its centre shifts its pose: the centre moves by -(shift + translation x turn).
        moved = np.eye(6)
        moved[3:, :3] = cross_matrix(shift)
        deviation = np.repeat([np.radians(TURN_DEGREES), SHIFT_DEVIATION * distance], 3)
        found.append(moved.T @ np.diag(deviation**-2.0) @ moved)
    return np.array(found)


def rig_precision(poses: NDArray, precisions: NDArray) -> NDArray[np.float64]:
    """Inverse covariance of C focal lengths and the poses of all cameras but the first, (7 C - 6,) squared.

    Poses are relative to the first camera's: what all cameras do together costs nothing.
    """
    whole, together, inverse = _together(poses, precisions)
    relative = (whole - whole @ together @ inverse @ together.T @ whole)[6:, 6:]
    return np.asarray(block_diag(np.eye(len(poses)) * FOCAL_DEVIATION**-2.0, relative))


def settled_rig(start: NDArray, moved: NDArray, precisions: NDArray) -> NDArray[np.float64]:
    """Poses (C, 4, 4) of a rig that has moved, brought back as a whole to where they differ least from its start."""
    whole, together, inverse = _together(start, precisions)
    poses = moved
    for _ in range(ROUNDS):
        back = -inverse @ together.T @ whole @ movements(start, poses).ravel()
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(back[:3]).as_matrix(), back[3:]
        poses = poses @ step
    return poses


def movements(start: NDArray, moved: NDArray) -> NDArray[np.float64]:
    """(C, 6) turns and shifts from one rig's poses to another's."""
    turns = Rotation.from_matrix(moved[:, :3, :3] @ start[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([turns, moved[:, :3, 3] - start[:, :3, 3]], axis=1)


def told_ways(information: NDArray, precision: NDArray, least: float) -> NDArray[np.float64]:
    """(P, R) ways of moving that the matches tell.

    Parameters
    ----------
    information : (P, P)
        Mean square by which a movement changes what matches show, pixels, after points have followed it.
    precision : (P, P)
        Inverse covariance of the prior.
    least : float
        Pixels by which a movement of one of the prior's deviations must change matches.
    """
    factor = np.linalg.inv(np.linalg.cholesky(precision))
    squared, ways = np.linalg.eigh(factor @ information @ factor.T)
    return np.asarray(factor.T @ ways[:, squared > least**2])


def _together(poses: NDArray, precisions: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Inverse covariance of all poses, what turns and shifts of the whole rig do to them, and what that costs."""
    whole = block_diag(*precisions)
    together = np.concatenate([block_diag(rotation, rotation) for rotation in poses[:, :3, :3]])
    return whole, together, np.linalg.inv(together.T @ whole @ together)
