"""Cameras of an uncalibrated capture, from landmarks and the face model's landmark positions, and written into it.

A bundle adjustment over focal lengths, camera poses, one head pose per timestep and the subject's shape, with the
model's modes as prior. World space is the first camera's frame with OpenGL axes. The result is an estimate that stage 1
may refine; `Capture.calibrated` stays False.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mifit.capture.capture import Capture
from mifit.capture.landmark_files import COUNT, MIN_VISIBLE
from mifit.capture.transforms import View, update_frames
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera, rigid
from mifit.errors import InputError

FOCAL_PRIOR = (1.8, 0.7)
"""Portrait lenses, loosely: focal length in multiples of the longer image side, and deviation of its logarithm."""
LANDMARK_NOISE = 0.004
"""Standard deviation of a landmark as a part of the image's longer side."""
WEIGHTS = np.repeat([0.3, 1.0, 0.4], [17, 31, 20])
"""Of landmarks: the jaw's lie on its outline, which slides over the head as it turns, mouths move."""


@dataclass(frozen=True)
class HeadCalibration:
    """A capture with estimated cameras, whose world is the first one's frame with OpenGL axes, and the head.

    ``heads`` (T, 4, 4) are its poses: from the model's frame to the first camera's, OpenCV axes; ``shape`` (K,) are
    identity coefficients.
    """

    capture: Capture
    heads: NDArray[np.float64]
    shape: NDArray[np.float64]


@dataclass(frozen=True)
class _Problem:
    """Landmarks of C cameras and T timesteps, and what is known of the cameras."""

    points: NDArray[np.float64]  # (C, T, 68, 2)
    weight: NDArray[np.float64]  # (C, T, 68), 0 where invisible
    mean: NDArray[np.float64]  # (68, 3)
    modes: NDArray[np.float64]  # (68, 3, K)
    centre: NDArray[np.float64]  # (C, 2) principal points
    side: NDArray[np.float64]  # (C,) longer image sides
    known: NDArray[np.float64]  # (C,) focal lengths, NaN where they are looked for
    noise: float  # standard deviation of a landmark in pixels


def calibrate_heads(
    capture: Capture,
    landmarks3d: NDArray,
    modes: NDArray | None = None,
    cameras: Sequence[str] | None = None,
    timesteps: Sequence[int] | None = None,
    noise: float = LANDMARK_NOISE,
) -> HeadCalibration:
    """Estimate the cameras of a capture that came without calibration, and the head's poses and shape.

    Intrinsics that are known stay as they are. ``landmarks3d`` (68, 3) are the model's mean landmarks in the capture's
    unit of length, ``modes`` (68, 3, K) identity modes there, premultiplied by their standard deviations. Only
    landmarks of ``cameras`` are read, all by default; ``noise`` is a landmark's standard deviation as a part of the
    image's longer side. The capture returned has the named cameras, and stays one that isn't `calibrated`.

    InputError for no landmarks, or fewer than 6 visible ones in some image.
    """
    names = tuple(cameras) if cameras is not None else capture.cameras
    steps = tuple(timesteps) if timesteps is not None else capture.timesteps
    mean = np.asarray(landmarks3d, dtype=np.float64)
    if mean.shape != (COUNT, 3):
        raise InputError(f"landmarks3d: found shape {mean.shape}, expected (68, 3)")
    problem = _gather(capture, names, steps, mean, modes, noise)
    focal, poses, heads, shape = _solve(problem)
    found = []
    for i, name in enumerate(names):
        view = capture.views[name]
        cx, cy = (float(value) for value in problem.centre[i])
        fx, fy = (focal[i], focal[i]) if view.intrinsics is None else view.intrinsics[:2]
        found.append(Camera(name, view.width, view.height, float(fx), float(fy), cx, cy, poses[i]))
    return HeadCalibration(capture.with_estimate(found), heads, shape)


def _gather(
    capture: Capture,
    names: tuple[str, ...],
    steps: tuple[int, ...],
    mean: NDArray[np.float64],
    modes: NDArray | None,
    noise: float,
) -> _Problem:
    points = np.zeros((len(names), len(steps), COUNT, 2))
    weight = np.zeros(points.shape[:3])
    for i, name in enumerate(names):
        for j, step in enumerate(steps):
            marks = capture.landmarks(name, step)
            if marks is None or marks.visible.sum() < MIN_VISIBLE:
                count = 0 if marks is None else int(marks.visible.sum())
                raise InputError(
                    f"{capture.path}: camera {name!r}, timestep {step}: found {count} visible landmarks, expected at "
                    f"least {MIN_VISIBLE} to estimate an uncalibrated camera; run mifit landmarks, or leave it out"
                )
            points[i, j], weight[i, j] = marks.points, marks.visible * WEIGHTS
    views = [capture.views[name] for name in names]
    centre = [(v.width / 2, v.height / 2) if v.intrinsics is None else v.intrinsics[2:] for v in views]
    known = [np.nan if v.intrinsics is None else math.sqrt(v.intrinsics[0] * v.intrinsics[1]) for v in views]
    for i, view in enumerate(views):  # square pixels from here on: fy is brought to the mean of both
        if view.intrinsics is not None:
            fx, fy, cx, cy = view.intrinsics
            points[i] = (points[i] - (cx, cy)) * (known[i] / fx, known[i] / fy) + (cx, cy)
    basis = np.zeros((COUNT, 3, 0)) if modes is None else np.asarray(modes, dtype=np.float64)
    side = np.array([max(v.width, v.height) for v in views], dtype=np.float64)
    return _Problem(points, weight, mean, basis, np.array(centre), side, np.array(known), noise * float(side.max()))


def _solve(problem: _Problem) -> tuple[NDArray, list[NDArray[np.float64]], NDArray, NDArray]:
    """Focal lengths (C,), world-to-camera matrices, head poses (T, 4, 4) and shape coefficients (K,)."""
    factors = np.geomspace(0.6, 8.0, 12) if np.isnan(problem.known).any() else np.ones(1)  # of the longer image side
    starts = [_start(problem, factor) for factor in factors]
    best = min(starts, key=lambda x: float(np.sum(np.sqrt(1 + _residuals(x, problem) ** 2))))
    solution = least_squares(
        _residuals, best, args=(problem,), loss="soft_l1", x_scale="jac", ftol=1e-6, xtol=1e-6, max_nfev=40
    )
    focal, cameras, heads, shape = _unpack(solution.x, problem)
    return focal, [pose @ OPENGL_FROM_OPENCV for pose in cameras], heads, shape


def _start(problem: _Problem, factor: float) -> NDArray[np.float64]:
    """Unknowns from the pose of the mean shape in every image, for one guess of the focal lengths."""
    count, steps = problem.points.shape[:2]
    free = np.isnan(problem.known)
    focal = np.where(free, factor * problem.side, problem.known)
    heads = np.zeros((count, steps, 4, 4))
    for i, j in np.ndindex(count, steps):
        matrix = np.array([[focal[i], 0, problem.centre[i, 0]], [0, focal[i], problem.centre[i, 1]], [0, 0, 1]])
        seen = problem.weight[i, j] > 0
        heads[i, j] = _pnp(problem.mean[seen], problem.points[i, j, seen], matrix)
    relative = [heads[i] @ np.linalg.inv(heads[0]) for i in range(1, count)]
    vectors = [Rotation.from_matrix(poses[:, :3, :3]).mean().as_rotvec() for poses in relative]
    vectors += list(Rotation.from_matrix(heads[0, :, :3, :3]).as_rotvec())
    shifts = [*(np.median(poses[:, :3, 3], axis=0) for poses in relative), *heads[0, :, :3, 3]]
    focals = np.full(_focals(problem), math.log(factor))
    return np.concatenate([focals, np.hstack([vectors, shifts]).ravel(), np.zeros(problem.modes.shape[2])])


def _pnp(points: NDArray, pixels: NDArray, matrix: NDArray) -> NDArray[np.float64]:
    ok, rotation, translation = cv2.solvePnP(points, pixels, matrix, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)
    if not ok:
        raise InputError("landmarks: no pose of a head explains them; check their order (iBUG-68)")
    rotation, translation = cv2.solvePnPRefineLM(points, pixels, matrix, np.zeros(4), rotation, translation)
    return rigid(cv2.Rodrigues(rotation)[0], translation.ravel())


def _focals(problem: _Problem) -> int:
    """Unknown focal lengths: one for all cameras that lack one where all images have one size."""
    unknown = int(np.isnan(problem.known).sum())
    return min(unknown, 1) if np.ptp(problem.side) == 0 else unknown


def _unpack(x: NDArray, problem: _Problem) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Variables -> focal lengths (C,), camera poses (C, 4, 4), head poses (T, 4, 4), shape coefficients (K,)."""
    count, steps = problem.points.shape[:2]
    free, n = np.isnan(problem.known), _focals(problem)
    focal = problem.known.copy()
    focal[free] = np.exp(x[:n]) * problem.side[free]
    values = x[n : n + 6 * (count - 1 + steps)].reshape(-1, 6)
    poses = rigid(Rotation.from_rotvec(values[:, :3]).as_matrix(), values[:, 3:])
    cameras = np.concatenate([np.eye(4)[None], poses[: count - 1]])
    return focal, cameras, poses[count - 1 :], x[n + values.size :]


def _residuals(x: NDArray, problem: _Problem) -> NDArray[np.float64]:
    focal, cameras, heads, shape = _unpack(x, problem)
    model = problem.mean + problem.modes @ shape
    world = np.einsum("tij,nj->tni", heads[:, :3, :3], model) + heads[:, None, :3, 3]
    p = np.einsum("cij,tnj->ctni", cameras[:, :3, :3], world) + cameras[:, None, None, :3, 3]
    depth = np.maximum(p[..., 2:], 1e-3)
    pixels = focal[:, None, None, None] * p[..., :2] / depth + problem.centre[:, None, None]
    error = (pixels - problem.points) * (np.sqrt(problem.weight)[..., None] / problem.noise)
    prior_focal = (np.log(focal / problem.side) - math.log(FOCAL_PRIOR[0])) / FOCAL_PRIOR[1]
    return np.concatenate([error.ravel(), shape, prior_focal[np.isnan(problem.known)]])


def calibrate_others(
    capture: Capture, decided: Sequence[str], timesteps: Sequence[int]
) -> dict[str, tuple[Camera, float]]:
    """All cameras of a capture whose ``decided`` ones are estimated, each with its error in pixels.

    The decided ones give every landmark a place in space; another camera is the one that sees them where its own
    landmarks are. So a held-out camera moves none of the others. InputError where a single camera has decided, which
    gives nothing a place, or a camera can't be placed.
    """
    places = _places(capture, decided, timesteps)
    if len(decided) < len(capture.cameras) and not places:
        raise InputError(
            f"{capture.path}: {', '.join(decided)} give no landmark a place in space; expected two cameras"
        )
    views = [capture.views[name] for name in decided]
    focal = float(np.median([capture.camera(v.name).fx / max(v.width, v.height) for v in views]))  # in longer sides
    sizes = {(view.width, view.height) for view in views}
    found: dict[str, tuple[Camera, float]] = {}
    for name in capture.cameras:
        points, pixels, weights = [], [], []
        for timestep, (seen, world) in places.items():
            marks = capture.landmarks(name, timestep)
            if marks is not None:
                both = marks.visible[seen]
                points.append(world[both])
                pixels.append(marks.points[seen[both]])
                weights.append(np.where(seen[both] < 17, WEIGHTS[0], 1.0))
        if sum(map(len, points)) < MIN_VISIBLE:
            raise InputError(
                f"camera {name!r}: found fewer than {MIN_VISIBLE} landmarks that the others see too, expected enough "
                "to place it; run mifit landmarks, or leave the camera uncalibrated with --cameras"
            )
        view, where, at, weight = capture.views[name], *map(np.concatenate, (points, pixels, weights))
        size = view.width, view.height
        camera, error = resect_camera(view, where, at, weight, focal * max(size), size in sizes)
        found[name] = (capture.camera(name) if name in decided else camera), error
    return found


def resect_camera(
    view: View, points: NDArray, pixels: NDArray, weights: NDArray, focal: float, same: bool
) -> tuple[Camera, float]:
    """The camera that sees points where they are, and its root-mean-square error in pixels at weight 1.

    ``points`` (N, 3) are world space, ``pixels`` (N, 2) undistorted, ``weights`` (N,) those of their distances. A view
    keeps its intrinsics. One without has square pixels, the principal point in the middle, and a focal length near
    ``focal``, pixels: to 2 % if its images have the ``same`` size as those that it is from, else to half of it.
    InputError where no pose explains the points.
    """
    fx, fy, cx, cy = view.intrinsics or (focal, focal, view.width / 2, view.height / 2)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    found, turn, shift = cv2.solvePnP(points, pixels, matrix, np.zeros(4), flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        raise InputError(f"camera {view.name!r}: no place explains its landmarks; check their order (iBUG-68)")
    noise = LANDMARK_NOISE * max(view.width, view.height)

    def zoom(x: NDArray) -> float:
        return float(np.exp(x[6])) if view.intrinsics is None else 1.0

    def off(x: NDArray) -> NDArray:
        p = points @ Rotation.from_rotvec(x[:3]).as_matrix().T + x[3:6]
        return np.asarray(zoom(x) * np.array((fx, fy)) * p[:, :2] / np.maximum(p[:, 2:], 1e-6) + (cx, cy) - pixels)

    def residuals(x: NDArray) -> NDArray:
        return np.append((off(x) * (weights / noise)[:, None]).ravel(), x[6] / (0.02, 0.5)[not same])

    start = np.concatenate([turn.ravel(), shift.ravel(), [0.0]])
    x = least_squares(residuals, start, loss="soft_l1", x_scale="jac", max_nfev=200).x
    pose = rigid(Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6])
    error = float(np.sqrt(np.mean(np.sum(off(x)[weights == 1.0] ** 2, axis=1))))
    return Camera(view.name, view.width, view.height, zoom(x) * fx, zoom(x) * fy, cx, cy, pose), error


def _places(
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


def write_cameras(path: str | Path, capture: Capture, cameras: Sequence[Camera]) -> None:
    """Write intrinsics and poses of some cameras into a capture's ``transforms.json``; all else in it stays."""
    by_name = {camera.name: camera for camera in cameras}
    changes: dict[tuple[str, int], dict[str, object]] = {}
    for key in (shot for shot in capture.shots if shot[0] in by_name):
        c = by_name[key[0]]
        numbers = {"fl_x": float(c.fx), "fl_y": float(c.fy), "cx": float(c.cx), "cy": float(c.cy)}
        changes[key] = numbers | {"transform_matrix": c.camera_to_world_opengl.tolist()}
    file = Path(path) if Path(path).is_file() else Path(path) / "transforms.json"
    update_frames(file, changes)
