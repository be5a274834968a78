"""``calibrate_boards``: intrinsics, distortion and relative poses of cameras that watched a calibration board.

Frames are chosen (sharp, different from each other), each camera is calibrated by itself (Zhang, "A Flexible New
Technique for Camera Calibration", 2000, as OpenCV implements it with radial and tangential distortion), then the
cameras' relative poses over frames that several of them see, and in the end everything together.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.board_adjustment import LEAST_NOISE, adjust
from mifit.capture.boards import Board, BoardPoints, edge_width
from mifit.capture.sources import Source, check_synchronous
from mifit.capture.stereo import write_stereo
from mifit.capture.transforms import UNITS_MM, Shot, View, write_transforms
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera
from mifit.core.files import file_name, write_bytes, write_text
from mifit.core.image import decode_image, encode_png, to_8_bit
from mifit.errors import InputError
from mifit.progress import Progress, silent

MAX_LOOKED_AT = 300
"""Frames of a video in which the board is looked for, spread evenly."""
MAX_USED = 40
"""Frames that a camera is calibrated from; more add time and little else."""
LEAST_FRAMES = 6
LEAST_SHARED = 3
LEAST_PART = 0.4
"""Part of the board's points below which it is only partly seen."""
MAX_BLUR, BLUR_FACTOR = 4.0, 1.6
"""Edges wider than this many pixels, or than this many times those of a camera's sharper frames, are blurred."""
OUTLIER, LEAST_OUTLIER = 3.0, 0.3
"""Frames whose error is this many times the median, and at least so many pixels, are left out."""
OUT_OF_STEP = 0.5
"""Error in pixels, at the least, of frames that are left out for what other cameras show: a tilted board that is found
a little off still tells more than it harms."""
CONTRADICTS = "contradicts the others: error {:.2f} pixels, {:.2f} is the limit"
GRID = 6
"""Cells across and down of the picture of coverage."""
WEAK_COVERAGE, WEAK_FOCAL, BAD_FOCAL, BAD_ERROR = 0.4, 0.005, 0.03, 2.0
"""Warn below this part of covered cells and above this relative deviation of the focal length; refuse beyond the last
two, a relative deviation and an error in pixels."""


@dataclass(frozen=True)
class Watched:
    """One camera's look at the board.

    Attributes
    ----------
    used : dict of int to BoardPoints
        Frames that the calibration uses.
    errors : dict of int to float
        Root-mean-square reprojection error of each, pixels.
    left_out : dict of int to str
        Frames that it doesn't, and why.
    """

    name: str
    size: tuple[int, int]
    matrix: NDArray[np.float64] = field(repr=False)
    distortion: tuple[float, ...]
    focal_deviation: float
    used: dict[int, BoardPoints] = field(repr=False)
    errors: dict[int, float] = field(repr=False)
    left_out: dict[int, str] = field(repr=False)

    @property
    def error(self) -> float:
        """Root-mean-square reprojection error over all frames, pixels."""
        return float(np.sqrt(np.mean(np.square(list(self.errors.values())))))

    @property
    def coverage(self) -> float:
        """Part of the cells of a grid over the image in which the board was seen."""
        return float(_cells(self).mean())


@dataclass(frozen=True)
class BoardCalibration:
    """Cameras from a board: `cameras` in the unit asked for, the first one's frame (OpenGL axes) as world."""

    cameras: tuple[Camera, ...]
    watched: tuple[Watched, ...]
    pair_errors: dict[str, float]
    warnings: tuple[str, ...]

    def summary(self) -> str:
        """What was found, in a few lines."""
        lines = []
        for camera, seen in zip(self.cameras, self.watched, strict=True):
            k = ", ".join(f"{value:.4f}" for value in seen.distortion)
            lines.append(
                f"{seen.name}: fx {camera.fx:.2f}, fy {camera.fy:.2f} (+- {100 * seen.focal_deviation:.2f} %), cx "
                f"{camera.cx:.2f}, cy {camera.cy:.2f}, distortion {k}; error {seen.error:.3f} pixels in "
                f"{len(seen.used)} frames, {100 * seen.coverage:.0f} % of the image covered"
            )
            lines += [f"  frame {i} left out: {reason}" for i, reason in list(seen.left_out.items())[:12]]
            if len(seen.left_out) > 12:
                lines.append(f"  and {len(seen.left_out) - 12} more, all in calibration.json")
        lines += [f"{pair}: error {error:.3f} pixels" for pair, error in self.pair_errors.items()]
        return "\n".join([*lines, *(f"warning: {text}" for text in self.warnings)])


def calibrate_boards(
    sources: Sequence[Source], board: Board, units: str = "cm", progress: Progress = silent
) -> BoardCalibration:
    """Calibrate cameras that watched one board at the same time.

    Parameters
    ----------
    sources : sequence of Source
        One synchronised video or folder of images per camera; with a single camera only its intrinsics are found.
    board : Board
    units : str
        Unit of length of the poses.
    progress : Progress

    Raises
    ------
    InputError
        The board is seen sharply in too few frames (the message says why the others don't count), cameras don't see it
        together, or the solution is too uncertain to be used.
    """
    check_synchronous(sources)
    if len({file_name(source.name) for source in sources}) != len(sources):
        raise InputError("found cameras of one name, expected different names of videos or folders")
    if len(sources) > 1 and board.turns_into_itself:
        raise InputError(
            f"--board: a chessboard of {board.columns} x {board.rows} squares looks the same after a half turn, so two "
            "cameras can't agree on its corners; use an even and an odd number of squares, or a ChArUco board"
        )
    total = sum(min(source.length, MAX_LOOKED_AT) for source in sources)
    watched, done = [], 0
    for source in sources:
        found, left_out = _look(source, board, done, total, progress)
        done += min(source.length, MAX_LOOKED_AT)
        watched.append(_calibrate_one(source, board, found, left_out))
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
    return BoardCalibration(tuple(cameras), tuple(watched), pair_errors, _warnings(watched))


def write_calibration(calibration: BoardCalibration, folder: str | Path, units: str) -> None:
    """Write what `calibrate_boards` found.

    ``transforms.json`` holds all cameras for ``mifit import --transforms``; ``stereo.yml`` two of them in OpenCV's
    layout; ``calibration.json`` the error of every frame and why others were left out; ``coverage_CAMERA.png`` where in
    the image the board was seen.
    """
    folder = Path(folder)
    for seen in calibration.watched:
        write_bytes(folder / f"coverage_{file_name(seen.name)}.png", encode_png(coverage_picture(seen)))
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
    write_text(folder / "calibration.json", json.dumps(document, indent=1) + "\n")
    if len(calibration.cameras) == 2:
        write_stereo(folder / "stereo.yml", *calibration.cameras)
    shots = [Shot(c.name, 0, folder / "images" / file_name(c.name) / "0000.png") for c in calibration.cameras]
    write_transforms(folder / "transforms.json", map(View.of, calibration.cameras), shots, units)


def coverage_picture(seen: Watched) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB: cells where the board was seen, its points, and frames' errors ten times enlarged as circles."""
    width, height = seen.size
    picture = np.full((height, width, 3), 40, dtype=np.uint8)
    for (row, column), covered in np.ndenumerate(_cells(seen)):
        low, high = (
            (column * width // GRID, row * height // GRID),
            ((column + 1) * width // GRID, (row + 1) * height // GRID),
        )
        cv2.rectangle(picture, low, high, (60, 100, 60) if covered else (90, 50, 50), -1)
        cv2.rectangle(picture, low, high, (30, 30, 30), 1)
    for i, found in seen.used.items():
        radius = max(1, round(10 * seen.errors[i]))
        for x, y in np.round(found.pixels - 0.5).astype(int):
            cv2.circle(picture, (int(x), int(y)), radius, (230, 230, 120), 1, cv2.LINE_AA)
    return picture


def _cells(seen: Watched) -> NDArray[np.bool_]:
    covered = np.zeros((GRID, GRID), dtype=bool)
    for found in seen.used.values():
        cell = np.clip((found.pixels / seen.size * GRID).astype(int), 0, GRID - 1)
        covered[cell[:, 1], cell[:, 0]] = True
    return covered


def _look(
    source: Source, board: Board, done: int, total: int, progress: Progress
) -> tuple[dict[int, tuple[BoardPoints, float]], dict[int, str]]:
    """Boards found and their blur by frame, and frames without one that can be used, with the reason."""
    every = -(-source.length // MAX_LOOKED_AT)
    found: dict[int, tuple[BoardPoints, float]] = {}
    left_out: dict[int, str] = {}
    for k, (_, content) in enumerate(source.files(0, every)):
        progress("Looking for the board", done + k, total)
        i = k * every
        codes = to_8_bit(decode_image(content, f"{source.name}: frame {i}").pixels)
        grey = np.asarray(cv2.cvtColor(codes, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        seen = board.find(grey)
        wanted = max(6, round(LEAST_PART * len(board.points)))
        if len(seen) >= wanted:
            found[i] = seen, edge_width(grey, seen)
        elif board.kind != "chessboard" and len(board.find(np.ascontiguousarray(grey[:, ::-1]))) >= wanted:
            left_out[i] = "mirrored: the board is read in the mirrored image only; turn off the camera's mirror mode"
        elif len(seen):
            left_out[i] = f"partly seen: {len(seen)} of {len(board.points)} points, expected at least {wanted}"
        else:
            left_out[i] = "no board found: out of the image, blurred, too small or too dark"
    return found, left_out


def _calibrate_one(
    source: Source, board: Board, found: dict[int, tuple[BoardPoints, float]], left_out: dict[int, str]
) -> Watched:
    """Intrinsics of one camera from its best frames."""
    if found:
        sharp = float(np.percentile([width for _, width in found.values()], 25))
        for i, (_, width) in list(found.items()):
            if width > max(min(MAX_BLUR, BLUR_FACTOR * sharp), 2.0):
                left_out[i] = f"blurred: edges {width:.1f} pixels wide, {sharp:.1f} in sharp frames"
                del found[i]
    used = {i: seen for i, (seen, _) in found.items()}
    chosen = _varied(used, source.size)
    spare = {i: "like other frames" for i in used if i not in chosen}
    while True:
        if len(chosen) < LEAST_FRAMES:
            raise InputError(_too_few(source, len(chosen), left_out))
        matrix, distortion, deviation, errors = _solve({i: used[i] for i in chosen}, board, source.size)
        limit = max(OUTLIER * float(np.median(list(errors.values()))), LEAST_OUTLIER)
        bad = [i for i, error in errors.items() if error > limit]
        if not bad:
            break
        for i in bad:
            left_out[i] = CONTRADICTS.format(errors[i], limit)
        chosen = [i for i in chosen if i not in bad]
    focal = deviation / float(matrix[0, 0])
    seen = Watched(
        source.name, source.size, matrix, distortion, focal, {i: used[i] for i in chosen}, errors, {**left_out, **spare}
    )
    if seen.error > BAD_ERROR or focal > BAD_FOCAL:
        raise InputError(
            f"{source.name}: found an error of {seen.error:.2f} pixels, a focal length known to {100 * focal:.1f} %, "
            f"expected at most {BAD_ERROR:g} pixels and {100 * BAD_FOCAL:g} %; hold the board at different angles and "
            "distances, up to the image's corners, and check --board against the printed one"
        )
    return seen


def _too_few(source: Source, count: int, left_out: dict[int, str]) -> str:
    reasons: dict[str, int] = {}
    for text in left_out.values():
        reasons[text.split(":")[0]] = reasons.get(text.split(":")[0], 0) + 1
    told = ", ".join(f"{n} {reason}" for reason, n in sorted(reasons.items(), key=lambda item: -item[1]))
    return (
        f"{source.name}: found {count} frames that can be used of {count + len(left_out)} ({told or 'none else'}), "
        f"expected at least {LEAST_FRAMES} with the whole board, sharp, not mirrored; check --board too"
    )


def _varied(found: dict[int, BoardPoints], size: tuple[int, int]) -> list[int]:
    """At most `MAX_USED` frames in which the board's place, size and tilt differ most, the first at the most points."""
    keys = sorted(found)
    if len(keys) <= MAX_USED:
        return keys
    features = np.array([_feature(found[i], size) for i in keys])
    features /= features.std(axis=0) + 1e-9
    chosen = [int(np.argmax([len(found[i]) for i in keys]))]
    nearest = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < MAX_USED:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return sorted(keys[k] for k in chosen)


def _feature(found: BoardPoints, size: tuple[int, int]) -> NDArray[np.float64]:
    """Place, size and shape of the board in the image."""
    centre = found.pixels.mean(axis=0)
    spread = np.linalg.svd(found.pixels - centre, full_matrices=False)
    axes = spread.S / np.sqrt(len(found))
    angle = np.arctan2(*spread.Vh[0][::-1])
    return np.array([*centre / max(size), *np.log(np.maximum(axes, 1e-3)), np.cos(2 * angle), np.sin(2 * angle)])


def _solve(
    used: dict[int, BoardPoints], board: Board, size: tuple[int, int]
) -> tuple[NDArray[np.float64], tuple[float, ...], float, dict[int, float]]:
    """Matrix (OpenCV's pixel centres), distortion, deviation of the focal length in pixels, error of each frame."""
    objects = [board.points[f.ids].astype(np.float32) for f in used.values()]
    images = [(f.pixels - 0.5).astype(np.float32) for f in used.values()]
    try:
        _, matrix, distortion, _, _, deviations, _, errors = cv2.calibrateCameraExtended(
            objects,
            images,
            size,
            None,
            None,  # type: ignore[call-overload]  # the stubs know no start of None
        )
    except cv2.error as error:
        raise InputError(f"the board's views allow no calibration ({' '.join(str(error).split())[-100:]})") from None
    found = dict(zip(used, map(float, np.ravel(errors)), strict=True))
    deviation = float(np.max(np.ravel(deviations)[:2]))
    if not (np.isfinite(matrix).all() and np.isfinite(deviation)):
        raise InputError("the board's views allow no calibration: all of them are alike; tilt and move the board")
    return np.asarray(matrix, dtype=np.float64), tuple(map(float, np.ravel(distortion)[:5])), deviation, found


def _relative_poses(watched: Sequence[Watched], board: Board) -> tuple[list[NDArray[np.float64]], dict[str, float]]:
    """World-to-camera matrices (OpenCV axes, millimetres), the first the identity, and each pair's error in pixels."""
    poses: dict[int, NDArray[np.float64]] = {0: np.eye(4)}
    errors: dict[str, float] = {}
    while len(poses) < len(watched):
        options = [
            (len(_shared(watched[a], watched[b])), a, b) for a in poses for b in range(len(watched)) if b not in poses
        ]
        count, a, b = max(options)
        if count < LEAST_SHARED:
            raise InputError(
                f"{watched[b].name}: sees the board together with {watched[a].name} in {count} frames, expected "
                f"at least {LEAST_SHARED}; show it to both at once, and check that the videos are synchronised"
            )
        turn, shift, error = _pair(watched[a], watched[b], board)
        between = np.eye(4)
        between[:3, :3], between[:3, 3] = turn, shift
        poses[b] = between @ poses[a]
        errors[f"{watched[a].name}, {watched[b].name}"] = error
        if error > BAD_ERROR:
            raise InputError(
                f"{watched[b].name}: the board seen with {watched[a].name} gives an error of {error:.2f} pixels, "
                f"expected at most {BAD_ERROR:g}; the videos aren't synchronous, a camera moved, or one is mirrored"
            )
    return [poses[i] for i in range(len(watched))], errors


def _together(
    watched: Sequence[Watched], poses: Sequence[NDArray[np.float64]], board: Board
) -> tuple[list[Watched], list[NDArray[np.float64]]]:
    """All lenses and poses at once, without the frames in which cameras contradict one another.

    A board that moves while the cameras aren't quite in step fits each camera by itself.
    """
    watched = list(watched)
    while True:
        every = np.array([error for seen in watched for error in seen.errors.values()])
        found = adjust(
            board.points,
            [seen.used for seen in watched],
            [seen.matrix for seen in watched],
            [seen.distortion for seen in watched],
            poses,
            [seen.size for seen in watched],
            max(float(np.median(every)) / np.sqrt(2.0), LEAST_NOISE),
        )
        poses = found.poses
        watched = [
            dataclasses.replace(
                seen,
                matrix=found.matrices[c],
                distortion=found.distortions[c],
                focal_deviation=found.focal_deviations[c] / float(found.matrices[c][0, 0]),
                errors=found.errors[c],
            )
            for c, seen in enumerate(watched)
        ]
        kept = [_consistent(seen) for seen in watched]
        shared = [len(_shared(a, b)) for k, b in enumerate(kept) for a in kept[:k]]
        few = any(len(seen.used) < LEAST_FRAMES for seen in kept) or min(shared, default=LEAST_SHARED) < LEAST_SHARED
        if few or all(len(a.used) == len(b.used) for a, b in zip(kept, watched, strict=True)):
            return watched, poses
        watched = kept


def _consistent(seen: Watched) -> Watched:
    """One camera's frames without those whose error stands out."""
    limit = max(OUTLIER * float(np.median(list(seen.errors.values()))), OUT_OF_STEP)
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
        if seen.coverage < WEAK_COVERAGE:
            found.append(
                f"{seen.name}: the board covers {100 * seen.coverage:.0f} % of the image, so distortion elsewhere is a "
                "guess; show it near the edges and corners too"
            )
        if seen.focal_deviation > WEAK_FOCAL:
            found.append(
                f"{seen.name}: the focal length is known to {100 * seen.focal_deviation:.1f} % only; tilt the board"
            )
    return tuple(found)
