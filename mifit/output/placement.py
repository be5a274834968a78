"""Cameras and heads that were not fitted, placed by landmarks alone, so that a view's own colours have no part in it.

A held-out camera of an uncalibrated capture is placed against the fitted head. A moment that was not fitted has the
fitted head where its landmarks are: light stays with the camera as a head turns, so such a moment shows light and skin
from another side. An error of the fit is an error of what is placed as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mifit.capture.resection import JAW, NOISE, landmark_weights, resect_camera
from mifit.core.camera import Camera
from mifit.core.estimate import NormalsEstimate
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Reconstruction

LEAST_VISIBLE = 6
"""Landmarks by which a pose is determined with redundancy."""


class _Marks(NamedTuple):
    """Visible landmarks of one image: their numbers, pixels (N, 2) and weights (N,)."""

    which: NDArray[np.intp]
    pixels: NDArray[np.float64]
    weight: NDArray[np.float64]


def _marks(capture: Capture, camera: str, timestep: int) -> _Marks | None:
    """The landmarks of an image that has enough of them; None for another."""
    found = capture.landmarks(camera, timestep) if timestep in capture.timesteps else None
    if found is None or found.visible.sum() < LEAST_VISIBLE:
        return None
    which = np.flatnonzero(found.visible)
    return _Marks(which, found.points[which], landmark_weights(which))


def needs_resection(result: Reconstruction, capture: Capture, name: str) -> bool:
    """Whether a camera of the capture is neither calibrated nor fitted."""
    if capture.calibrated or name not in capture.views:
        return False
    return name not in {c.name for c in result.cameras} | set(capture.estimated)


def resect(result: Reconstruction, capture: Capture, name: str) -> tuple[Camera, float]:
    """A camera of an uncalibrated capture, and the RMS distance in pixels of its landmarks but the jaw's to the head's.

    Pose, and the focal length where the capture has none, minimise the robust distances between the landmarks of all
    fitted timesteps and those of the fitted head; the principal point is the capture's, or the image's middle.

    Raises
    ------
    InputError
        The camera has too few visible landmarks at every fitted timestep.
    """
    view = capture.views[name]

    def rows() -> Iterator[tuple[NDArray, NDArray, NDArray]]:
        for vertices, timestep in zip(result.geometry.vertices, result.timesteps, strict=True):
            marks = _marks(capture, name, timestep)
            if marks is not None:
                yield vertices[result.model.landmarks][marks.which].astype(np.float64), marks.pixels, marks.weight

    found = list(rows())
    if not found:
        raise InputError(
            f"camera {name!r}: not calibrated, and no fitted timestep has {LEAST_VISIBLE} visible landmarks in it to "
            "place it by; run mifit landmarks, or calibrate the capture"
        )
    same = all((c.width, c.height) == (view.width, view.height) for c in result.cameras)
    scale = 1.0 if same else max(view.width, view.height) / max(max(c.width, c.height) for c in result.cameras)
    expected = float(np.median([c.fx for c in result.cameras])) * scale
    points, pixels, weights = (np.concatenate(part) for part in zip(*found, strict=True))
    return resect_camera(view, points, pixels, weights, expected, same)


def pose_head(result: Reconstruction, capture: Capture, timestep: int) -> tuple[Reconstruction, float]:
    """The fitted head at a timestep without geometry, and the RMS distance in pixels of its landmarks but the jaw's.

    Each fitted timestep's head is moved rigidly to the landmarks that the fitted cameras have of the wanted one; the
    one that comes nearest is taken, with its expression and normals. Refined mesh and residual belong to the fitted
    ones and are left out.

    Raises
    ------
    InputError
        The capture lacks the timestep, or no fitted camera has six visible landmarks of it.
    """
    if timestep not in capture.timesteps:
        raise InputError(f"timestep {timestep} is not in the capture; it has {', '.join(map(str, capture.timesteps))}")
    marks = {camera: _marks(capture, camera.name, timestep) for camera in result.cameras}
    known = {camera: found for camera, found in marks.items() if found is not None}
    if not known:
        raise InputError(
            f"timestep {timestep} was not fitted, and no fitted camera has {LEAST_VISIBLE} visible landmarks of it to "
            "place the head by; run mifit landmarks, or mifit track"
        )
    found = [_moved(result, i, known) for i in range(len(result.timesteps))]
    nearest = int(np.argmin([cost for cost, *_ in found]))
    _, turn, shift, pixels = found[nearest]
    one = result.geometry.at((result.timesteps[nearest],))
    head = (one.vertices[0] - one.translation[0]) @ one.rotation[0]
    geometry = replace(
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
    return replace(result, geometry=geometry, normals=normals, mesh=None, residual=None), pixels


def _moved(result: Reconstruction, i: int, marks: dict[Camera, _Marks]) -> tuple[float, NDArray, NDArray, float]:
    """Robust cost, rotation, translation and RMS pixels of the i-th timestep's head at the landmarks."""
    geometry = result.geometry
    rotation, translation = geometry.rotation[i], geometry.translation[i]
    points = ((geometry.vertices[i] - translation) @ rotation)[result.model.landmarks].astype(np.float64)

    def errors(x: NDArray) -> list[NDArray]:
        """(N, 2) pixels by which the head's landmarks miss those of each camera."""
        moved = points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:]
        return [camera.project(moved[found.which]) - found.pixels for camera, found in marks.items()]

    scale = [found.weight[:, None] / (NOISE * max(c.width, c.height)) for c, found in marks.items()]
    start = np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), translation])
    solution = least_squares(
        lambda x: np.concatenate([(e * s).ravel() for e, s in zip(errors(x), scale, strict=True)]),
        start,
        loss="soft_l1",
        x_scale="jac",
        max_nfev=200,
    )
    inner = np.concatenate([e[m.which >= JAW] for e, m in zip(errors(solution.x), marks.values(), strict=True)])
    pixels = float(np.sqrt(np.mean(np.sum(inner**2, axis=1)))) if len(inner) else float("inf")
    return float(solution.cost), Rotation.from_rotvec(solution.x[:3]).as_matrix(), solution.x[3:], pixels
