"""A moment that was not fitted: the fitted head where its landmarks are.

A head that turns before one camera has held-out moments rather than held-out cameras. Light stays with the camera as
the head turns, so that such a moment asks of light and skin what a held-out camera can't: how they look from another
side of the light. Landmarks alone place the head, so that the moment's own colours have no part in it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mifit.capture.resection import JAW, NOISE, landmark_weights
from mifit.core.camera import Camera
from mifit.core.estimate import NormalsEstimate
from mifit.errors import InputError
from mifit.output.resect import LEAST_VISIBLE

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result.record import R


class _Marks(NamedTuple):
    """Landmarks of one camera: which of the 68, where in the image, and one over their deviation in pixels."""

    camera: Camera
    which: NDArray[np.intp]
    pixels: NDArray[np.float64]
    weight: NDArray[np.float64]


def pose_head(result: R, capture: Capture, timestep: int) -> tuple[R, float]:
    """Place the fitted head at a timestep that has no geometry.

    Each fitted timestep's head is moved rigidly to the landmarks that the fitted cameras have of the wanted one; the
    one that comes nearest is taken, with its expression and its normals.

    Parameters
    ----------
    result : Result
    capture : Capture
        Only landmarks of the result's cameras at ``timestep`` are read.
    timestep : int

    Returns
    -------
    result : Result
        With this timestep alone, without refined mesh and residual, which belong to the fitted ones.
    landmark_pixels : float
        Root mean square distance of the landmarks other than the jaw's to the head's, pixels.

    Raises
    ------
    InputError
        The capture lacks the timestep, or no fitted camera has six visible landmarks of it.
    """
    if timestep not in capture.timesteps:
        raise InputError(f"timestep {timestep} is not in the capture; it has {', '.join(map(str, capture.timesteps))}")
    marks = [_marks(capture, camera, timestep) for camera in result.cameras]
    marks = [found for found in marks if len(found.which) >= LEAST_VISIBLE]
    if not marks:
        raise InputError(
            f"timestep {timestep} was not fitted, and no fitted camera has {LEAST_VISIBLE} visible landmarks of it to "
            "place the head by; run mifit landmarks, or mifit track"
        )
    found = [_fit(result, i, marks) for i in range(len(result.timesteps))]
    nearest = int(np.argmin([cost for cost, _, _ in found]))
    _, (turn, shift), off = found[nearest]
    one = result.geometry.at((result.timesteps[nearest],))
    head = (one.vertices[0] - one.translation[0]) @ one.rotation[0]
    placed = replace(
        one,
        timesteps=(timestep,),
        rotation=turn[None],
        translation=shift[None],
        vertices=(head @ turn.T + shift)[None].astype(np.float32),
    )
    normal = result.refined_normal(result.timesteps[nearest])
    normals = None
    if result.normals is not None and normal is not None:
        normals = NormalsEstimate((timestep,), normal[None], result.normals.report)
    return replace(result, geometry=placed, normals=normals, mesh=None, residual=None), off


def _marks(capture: Capture, camera: Camera, timestep: int) -> _Marks:
    """The visible landmarks of one camera at a timestep."""
    marks = capture.landmarks(camera.name, timestep)
    if marks is None:
        return _Marks(camera, np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0))
    index = np.flatnonzero(marks.visible)
    weight = landmark_weights(index) / (NOISE * max(camera.width, camera.height))
    return _Marks(camera, index, marks.points[index], weight)


def _fit(result: R, i: int, marks: list[_Marks]) -> tuple[float, tuple[NDArray, NDArray], float]:
    """Robust cost, rotation and translation, and pixels of the i-th timestep's head at the landmarks."""
    geometry = result.geometry
    rotation, translation = geometry.rotation[i], geometry.translation[i]
    points = ((geometry.vertices[i] - translation) @ rotation)[result.model.landmarks].astype(np.float64)

    def errors(x: NDArray, part: _Marks) -> NDArray:
        """(N, 2) pixels by which the head's landmarks miss those of one camera."""
        moved = points[part.which] @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:]
        return np.asarray(part.camera.project(moved) - part.pixels)

    def residuals(x: NDArray) -> NDArray:
        return np.concatenate([(errors(x, part) * part.weight[:, None]).ravel() for part in marks])

    start = np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), translation])
    solution = least_squares(residuals, start, loss="soft_l1", x_scale="jac", max_nfev=200)
    inner = np.concatenate([errors(solution.x, part)[part.which >= JAW] for part in marks])
    pixels = float(np.sqrt(np.mean(np.sum(inner**2, axis=1)))) if len(inner) else float("inf")
    turn = Rotation.from_rotvec(solution.x[:3]).as_matrix()
    return float(solution.cost), (turn, solution.x[3:]), pixels
