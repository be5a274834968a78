"""``calibrate_boards``: intrinsics, distortion and relative poses of cameras that watched a calibration board.

Each camera is calibrated by itself (`board_camera`), then the cameras' relative poses over frames that several of them
see, and in the end everything together (`adjust`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mifit.capture.sources import Source
from mifit.capture.stereo import write_stereo
from mifit.capture.transforms import UNITS_MM, Shot, View, write_transforms
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera, rigid
from mifit.core.files import Document, file_name, write_json
from mifit.errors import InputError
from mifit.extras.board_camera import ALIKE, CONTRADICTS, SETTINGS, Watched, calibrate_one, look
from mifit.extras.boards import Board, grey_image
from mifit.progress import Progress, silent

LENS, POSE = 9, 6
"""Unknowns of a lens (fx, fy, cx, cy, k1, k2, p1, p2, k3) and of a pose (rotation vector, translation)."""

RECOGNISED = 40
"""Points of a board that tell the dictionary of its markers: other dictionaries give a few."""


@dataclass(frozen=True)
class BoardCalibration:
    """Cameras from a board: `cameras` in the unit asked for, the first one's frame (OpenGL axes) as world."""

    cameras: tuple[Camera, ...]
    watched: tuple[Watched, ...]
    pair_errors: dict[str, float]
    warnings: tuple[str, ...]
    board: Board

    def summary(self) -> str:
        """What was looked for and found, in a few lines."""
        lines = [f"Looked for {self.board.describe()}"]
        for camera, seen in zip(self.cameras, self.watched, strict=True):
            k = ", ".join(f"{value:.4f}" for value in seen.distortion)
            lines.append(
                f"{seen.name}: fx {camera.fx:.2f}, fy {camera.fy:.2f} (+- {100 * seen.focal_deviation:.2f} %), cx "
                f"{camera.cx:.2f}, cy {camera.cy:.2f}, distortion {k}; error {seen.error:.3f} pixels in "
                f"{len(seen.used)} frames, {100 * seen.coverage:.0f} % of the image covered"
            )
            bad = [f"  frame {i} left out: {reason}" for i, reason in seen.left_out.items() if reason != ALIKE]
            lines += [*bad[:12], *([f"  and {len(bad) - 12} more, all in calibration.json"] if len(bad) > 12 else [])]
        lines += [f"{pair}: error {error:.3f} pixels" for pair, error in self.pair_errors.items()]
        return "\n".join([*lines, *(f"warning: {text}" for text in self.warnings)])


def calibrate_boards(
    sources: Sequence[Source], board: Board, units: str = "cm", progress: Progress = silent
) -> BoardCalibration:
    """Calibrate cameras that watched one board at the same time.

    ``sources`` are a video or folder of images per camera, in step; with a single camera only its intrinsics are found.
    ``units`` is the unit of length of the poses. InputError where the board is seen sharply in too few frames (the
    message says why the others don't count), cameras don't see it together, or the solution is too uncertain.
    """
    if len({file_name(source.name) for source in sources}) != len(sources):
        raise InputError("found cameras of one name, expected different names of videos or folders")
    board = recognise(board, sources[0])
    total = sum(min(source.length, SETTINGS.most_searched) for source in sources)
    watched, done = [], 0
    for source in sources:
        found, left_out = look(source, board, done, total, progress)
        done += min(source.length, SETTINGS.most_searched)
        watched.append(calibrate_one(source, board, found, left_out))
    progress("Looking for the board", total, total)
    relative, pair_errors = _relative_poses(watched, board)
    watched, relative = _together(watched, relative, board)
    scale = 1.0 / UNITS_MM[units]
    cameras = []
    for seen, pose in zip(watched, relative, strict=True):
        pose[:3, 3] *= scale
        (fx, _, cx), (_, fy, cy) = seen.matrix[0], seen.matrix[1]
        cameras.append(
            Camera(seen.name, *seen.size, fx, fy, cx + 0.5, cy + 0.5, pose @ OPENGL_FROM_OPENCV, seen.distortion)
        )
    return BoardCalibration(tuple(cameras), tuple(watched), pair_errors, _warnings(watched), board)


def recognise(board: Board, source: Source) -> Board:
    """The board with the dictionary whose markers a camera's images show most of, where it was not named.

    A dozen images are looked at, or as many as show `RECOGNISED` points of one of the dictionaries.
    """
    if board.named:
        return board
    boards = [board, *board.of_other_dictionaries()]
    points = np.zeros(len(boards), int)
    for _, content in source.files(range(0, source.length, max(source.length // 12, 1))):
        grey = grey_image(content, source.name)
        points += [len(one.find(grey)) for one in boards]
        if points.max() >= RECOGNISED:
            break
    return boards[int(points.argmax())]


def write_calibration(calibration: BoardCalibration, folder: str | Path, units: str) -> None:
    """Write what `calibrate_boards` found.

    ``transforms.json`` holds all cameras for ``mifit import --transforms``; ``stereo.yml`` two of them in OpenCV's
    layout; ``calibration.json`` the error of every frame and why others were left out.
    """
    folder = Path(folder)
    document = {
        "units": units,
        "cameras": {
            seen.name: {
                "error_pixels": seen.error,
                "focal_deviation": seen.focal_deviation,
                "coverage": seen.coverage,
                "frames": {str(i): round(error, 4) for i, error in sorted(seen.errors.items())},
                "left_out": {str(i): reason for i, reason in sorted(seen.left_out.items())},
            }
            for seen in calibration.watched
        },
        "pairs": calibration.pair_errors,
        "warnings": list(calibration.warnings),
    }
    write_json(folder / "calibration.json", document)
    if len(calibration.cameras) == 2:
        write_stereo(folder / "stereo.yml", *calibration.cameras)
    shots = [Shot(c.name, 0, folder / "images" / file_name(c.name) / "0000.png") for c in calibration.cameras]
    write_transforms(folder / "transforms.json", map(View.of, calibration.cameras), shots, units)


def _relative_poses(watched: Sequence[Watched], board: Board) -> tuple[list[NDArray[np.float64]], dict[str, float]]:
    """World-to-camera matrices (OpenCV axes, millimetres), the first the identity, and each pair's error in pixels."""
    poses: dict[int, NDArray[np.float64]] = {0: np.eye(4)}
    errors: dict[str, float] = {}
    while len(poses) < len(watched):
        options = [
            (len(_shared(watched[a], watched[b])), a, b) for a in poses for b in range(len(watched)) if b not in poses
        ]
        count, a, b = max(options)
        if count < SETTINGS.least_shared:
            raise InputError(
                f"{watched[b].name}: sees the board together with {watched[a].name} in {count} frames, expected "
                f"at least {SETTINGS.least_shared}; show it to both at once, and check that the videos are synchronised"
            )
        turn, shift, error = _pair(watched[a], watched[b], board)
        poses[b] = rigid(turn, shift) @ poses[a]
        errors[f"{watched[a].name}, {watched[b].name}"] = error
        if error > SETTINGS.most_error:
            raise InputError(
                f"{watched[b].name}: the board seen with {watched[a].name} gives an error of {error:.2f} pixels, "
                f"expected at most {SETTINGS.most_error:g}; the videos aren't synchronous, a camera moved, or one is "
                "mirrored"
            )
    return [poses[i] for i in range(len(watched))], errors


def _together(
    watched: Sequence[Watched], poses: Sequence[NDArray[np.float64]], board: Board
) -> tuple[list[Watched], list[NDArray[np.float64]]]:
    """All lenses and poses at once, without the frames in which cameras contradict one another."""
    while True:
        watched, poses = adjust(watched, poses, board)
        kept = [_consistent(seen) for seen in watched]
        shared = [len(_shared(a, b)) for k, b in enumerate(kept) for a in kept[:k]]
        few = (
            any(len(seen.used) < SETTINGS.least_frames for seen in kept)
            or min(shared, default=SETTINGS.least_shared) < SETTINGS.least_shared
        )
        if few or all(len(a.used) == len(b.used) for a, b in zip(kept, watched, strict=True)):
            return watched, poses
        watched = kept


def _consistent(seen: Watched) -> Watched:
    """One camera's frames without those whose error stands out."""
    limit = max(SETTINGS.outlier * float(np.median(list(seen.errors.values()))), SETTINGS.out_of_step)
    bad = {i: error for i, error in seen.errors.items() if error > limit}
    reasons = {i: CONTRADICTS.format(error, limit) for i, error in bad.items()}
    used = {i: found for i, found in seen.used.items() if i not in bad}
    errors = {i: error for i, error in seen.errors.items() if i not in bad}
    return dataclasses.replace(seen, used=used, errors=errors, left_out={**seen.left_out, **reasons})


def _shared(a: Watched, b: Watched) -> dict[int, NDArray[np.int64]]:
    """Points that two cameras see at the same time, by frame."""
    both = {i: np.intersect1d(a.used[i].ids, b.used[i].ids) for i in a.used if i in b.used}
    return {i: ids for i, ids in both.items() if len(ids) >= 6}


def _pair(a: Watched, b: Watched, board: Board) -> tuple[NDArray, NDArray, float]:
    """Rotation and translation (mm) from one camera's frame to another's, intrinsics fixed."""
    shared = _shared(a, b)
    objects = [board.points[ids].astype(np.float32) for ids in shared.values()]
    images = [
        [(w.used[i].pixels[np.searchsorted(w.used[i].ids, ids)] - 0.5).astype(np.float32) for i, ids in shared.items()]
        for w in (a, b)
    ]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-9)
    error, *_, turn, shift, _, _ = cv2.stereoCalibrate(
        objects, images[0], images[1], a.matrix, np.array(a.distortion), b.matrix, np.array(b.distortion), a.size,
        flags=cv2.CALIB_FIX_INTRINSIC, criteria=criteria,
    )  # fmt: skip
    return turn, shift.ravel(), float(error)


def _warnings(watched: Sequence[Watched]) -> tuple[str, ...]:
    found = []
    for seen in watched:
        if seen.coverage < SETTINGS.weak_coverage:
            found.append(
                f"{seen.name}: the board covers {100 * seen.coverage:.0f} % of the image, so distortion elsewhere is a "
                "guess; show it near the edges and corners too"
            )
        if seen.focal_deviation > SETTINGS.weak_focal:
            found.append(
                f"{seen.name}: the focal length is known to {100 * seen.focal_deviation:.1f} % only; tilt the board"
            )
    return tuple(found)


def adjust(
    watched: Sequence[Watched], poses: Sequence[NDArray[np.float64]], board: Board
) -> tuple[list[Watched], list[NDArray[np.float64]]]:
    """Refine lenses, camera poses and board poses together (Triggs et al., "Bundle Adjustment", 2000).

    ``poses`` (4, 4) are world to camera, OpenCV axes, millimetres; the first camera's frame is the world's. The cameras
    returned have lenses, deviations of the focal lengths from the residuals, and errors of the frames.

    Lenses have a prior, whose weight is that of one coordinate with the points' noise: where the board was seen all
    over the image it says nothing, and where not it keeps distortion from bending what no point has shown.
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
            boards[f] = _vector(np.linalg.inv(poses[c]) @ rigid(cv2.Rodrigues(turn)[0], shift.ravel()))
    first = LENS * count - POSE  # where the first camera's pose would stand, which doesn't move
    start = np.concatenate([*lenses, *(_vector(p) for p in poses[1:]), boards.ravel()])
    scale = np.concatenate(
        [np.tile([1e3] * 4 + [1, 1, 0.1, 0.1, 1], count), np.tile([1, 1, 1, 1e3, 1e3, 1e3], count - 1 + len(frames))]
    )

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
            prior = ends[-1] + (LENS - 1) * c
            row, columns = slice(prior, prior + LENS - 1), slice(LENS * c, LENS * (c + 1))
            value, slope = _unlikely(x[columns], one.size)
            out[row], slopes[row, columns] = noise * value, noise * slope
        return out, slopes * scale

    value, slope = (lambda x: system(x)[0]), (lambda x: system(x)[1])
    solution = least_squares(value, start / scale, jac=slope, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=60)
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
        matrix, distortion = _intrinsics(lens), tuple(lens[4:].tolist())
        deviation = float(deviations[LENS * c : LENS * c + 2].max() / lens[0])
        new: Document = {"matrix": matrix, "distortion": distortion, "focal_deviation": deviation, "errors": errors[c]}
        adjusted.append(dataclasses.replace(one, **new))
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
    return rigid(cv2.Rodrigues(np.ascontiguousarray(vector[:3]))[0], vector[3:])
