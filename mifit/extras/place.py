"""Cameras of an uncalibrated capture that took no part in its calibration: placed by their landmarks, and all written.

The cameras that decide (`calibrate_heads`) give every landmark a place in space; another camera is the one that sees
them where its own landmarks are. So a held-out camera moves none of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.capture.capture import Capture
from mifit.capture.landmark_files import COUNT, MIN_VISIBLE
from mifit.capture.resection import landmark_weights, resect_camera
from mifit.capture.transforms import update_frames
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera
from mifit.errors import InputError


def landmark_places(
    capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]
) -> dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Landmarks in world space by timestep, as (indices, points (N, 3)): those that two of the cameras see."""
    found: dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]] = {}
    for timestep in timesteps:
        rows = np.zeros((COUNT, 4, 4))
        count = np.zeros(COUNT, dtype=int)
        for name in cameras:
            marks, camera = capture.landmarks(name, timestep), capture.camera(name)
            if marks is None:
                continue
            projection = camera.matrix @ camera.world_to_camera[:3]
            for axis in (0, 1):
                line = marks.points[:, axis, None] * projection[2] - projection[axis]
                line = line / np.linalg.norm(line[:, :3], axis=1, keepdims=True) * marks.visible[:, None]
                rows += line[:, :, None] * line[:, None, :]
            count += marks.visible
        seen = np.flatnonzero(count >= 2)
        if len(seen) >= MIN_VISIBLE:
            points = np.linalg.solve(rows[seen, :3, :3], -rows[seen, :3, 3:])[..., 0]
            found[timestep] = seen.astype(np.int64), np.asarray(points, dtype=np.float64)
    return found


def place_camera(
    capture: Capture,
    name: str,
    places: dict[int, tuple[NDArray[np.int64], NDArray[np.float64]]],
    focal: float,
    same: bool,
) -> tuple[Camera, float]:
    """The camera that sees landmarks of known places where its own are, and its root-mean-square error in pixels.

    Parameters
    ----------
    capture : Capture
    name : str
    places : dict
        From `landmark_places`.
    focal : float
        Expected focal length in pixels, where the capture gives none.
    same : bool
        Whether its images have the size of those that ``focal`` is from.

    Raises
    ------
    InputError
        Too few of its landmarks are visible.
    """
    points, pixels, weights = [], [], []
    for timestep, (seen, world) in places.items():
        marks = capture.landmarks(name, timestep)
        if marks is not None:
            both = marks.visible[seen]
            points.append(world[both])
            pixels.append(marks.points[seen[both]])
            weights.append(landmark_weights(seen[both]))
    if sum(map(len, points)) < MIN_VISIBLE:
        raise InputError(
            f"camera {name!r}: found fewer than {MIN_VISIBLE} landmarks that the others see too, expected enough to "
            "place it; run mifit landmarks, or leave the camera uncalibrated with --cameras"
        )
    marks_of = np.concatenate(points), np.concatenate(pixels), np.concatenate(weights)
    return resect_camera(capture.views[name], *marks_of, focal, same)


def calibrate_others(
    capture: Capture, decided: Sequence[str], timesteps: Sequence[int]
) -> dict[str, tuple[Camera, float]]:
    """All cameras of a capture whose ``decided`` ones are estimated, each with its error in pixels.

    Raises
    ------
    InputError
        A single camera has decided, which gives nothing a place; or a camera can't be placed.
    """
    places = landmark_places(capture, decided, timesteps)
    others = [name for name in capture.cameras if name not in decided]
    if others and not places:
        raise InputError(
            f"{capture.path}: {', '.join(decided)} give no landmark a place in space; expected two cameras"
        )
    sides = {name: max(capture.views[name].width, capture.views[name].height) for name in capture.cameras}
    focal = float(np.median([capture.camera(name).fx / sides[name] for name in decided]))  # in longer sides
    sizes = {(capture.views[name].width, capture.views[name].height) for name in decided}
    found: dict[str, tuple[Camera, float]] = {}
    for name in capture.cameras:
        same = (capture.views[name].width, capture.views[name].height) in sizes
        camera, error = place_camera(capture, name, places, focal * sides[name], same)
        found[name] = (capture.camera(name) if name in decided else camera), error
    return found


def write_cameras(path: str | Path, capture: Capture, cameras: Sequence[Camera]) -> None:
    """Write intrinsics and poses of some cameras into a capture's ``transforms.json``; all else in it stays."""
    by_name = {camera.name: camera for camera in cameras}
    changes: dict[tuple[str, int], dict[str, Any]] = {}
    for key in (shot for shot in capture.shots if shot[0] in by_name):
        camera = by_name[key[0]]
        inverse = np.linalg.inv(camera.world_to_camera) @ OPENGL_FROM_OPENCV
        numbers = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        changes[key] = {k: float(v) for k, v in numbers.items()} | {"transform_matrix": inverse.tolist()}
    file = Path(path) if Path(path).is_file() else Path(path) / "transforms.json"
    update_frames(file, changes)
