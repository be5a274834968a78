"""One camera's look at a calibration board: the frames that serve, and lens and focal length from them alone.

Frames are chosen (sharp, different from each other) and the camera is calibrated by itself (Zhang, "A Flexible New
Technique for Camera Calibration", 2000, as OpenCV implements it with radial and tangential distortion).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.sources import Source
from mifit.errors import InputError
from mifit.extras.boards import Board, BoardPoints, edge_width, grey_image
from mifit.progress import Progress

ALIKE = "like other frames"
CONTRADICTS = "contradicts the others: error {:.2f} pixels, {:.2f} is the limit"


@dataclass(frozen=True)
class BoardSettings:
    """Numbers of a calibration from a board."""

    most_searched: int = 300  # frames of a video in which the board is looked for, spread evenly
    most_used: int = 40  # frames that a camera is calibrated from
    least_frames: int = 6  # that a camera needs
    least_shared: int = 3  # that a pair of cameras needs
    least_part: float = 0.4  # of the board's points, below which it is only partly seen
    most_blur: float = 4.0  # pixels: wider edges are blurred,
    blur_factor: float = 1.6  # as are those this many times as wide as in a camera's sharper frames
    # Frames whose error is this many times the median are left out: from so many pixels on for a camera alone, and for
    # what other cameras show (a tilted board that is found a little off still helps more than it harms).
    outlier: float = 3.0
    least_outlier: float = 0.3
    out_of_step: float = 0.5
    cells: int = 6  # across and down, in which coverage is counted
    most_focal_deviation: float = 0.03  # relative; refused beyond
    most_error: float = 2.0  # pixels; refused beyond
    weak_coverage: float = 0.4  # part of covered cells; warned of below
    weak_focal: float = 0.005  # relative deviation of the focal length; warned of above
    # Deviations beforehand of a lens: principal point from the image's middle, in longer sides; fy / fx from 1; k1, k2,
    # k3 and p1, p2 from 0.
    centre: float = 0.03
    aspect: float = 0.01
    radial: float = 0.5
    tangential: float = 0.003
    least_noise: float = 0.05  # pixels: deviation of a board's points from where they are found, at the least


SETTINGS = BoardSettings()


@dataclass(frozen=True)
class Watched:
    """One camera's look at the board: ``used`` frames, ``errors``, the root-mean-square reprojection error of each in
    pixels, and frames ``left_out``, with the reason.
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
        cells = SETTINGS.cells
        covered = np.zeros((cells, cells), dtype=bool)
        for found in self.used.values():
            cell = np.clip((found.pixels / self.size * cells).astype(int), 0, cells - 1)
            covered[cell[:, 1], cell[:, 0]] = True
        return float(covered.mean())


def look(
    source: Source, board: Board, done: int, total: int, progress: Progress
) -> tuple[dict[int, tuple[BoardPoints, float]], dict[int, str]]:
    """Boards found and their blur by frame, and frames without one that can be used, with the reason."""
    every = -(-source.length // SETTINGS.most_searched)
    found: dict[int, tuple[BoardPoints, float]] = {}
    left_out: dict[int, str] = {}
    for k, (_, content) in enumerate(source.files(range(0, source.length, every))):
        progress("Looking for the board", done + k, total)
        i = k * every
        grey = grey_image(content, f"{source.name}: frame {i}")
        seen = board.find(grey)
        wanted = max(6, round(SETTINGS.least_part * len(board.points)))
        if len(seen) >= wanted:
            found[i] = seen, edge_width(grey, seen)
        elif len(board.find(np.ascontiguousarray(grey[:, ::-1]))) >= wanted:
            left_out[i] = "mirrored: the board is read in the mirrored image only; turn off the camera's mirror mode"
        elif len(seen):
            left_out[i] = f"partly seen: {len(seen)} of {len(board.points)} points, expected at least {wanted}"
        else:
            left_out[i] = "no board found: out of the image, blurred, too small or too dark"
    return found, left_out


def calibrate_one(
    source: Source, board: Board, found: dict[int, tuple[BoardPoints, float]], left_out: dict[int, str]
) -> Watched:
    """Intrinsics of one camera from its best frames."""
    if found:
        sharp = float(np.percentile([width for _, width in found.values()], 25))
        for i, (_, width) in list(found.items()):
            if width > max(min(SETTINGS.most_blur, SETTINGS.blur_factor * sharp), 2.0):
                left_out[i] = f"blurred: edges {width:.1f} pixels wide, {sharp:.1f} in sharp frames"
                del found[i]
    used = {i: seen for i, (seen, _) in found.items()}
    chosen = _varied(used, source.size)
    spare = {i: ALIKE for i in used if i not in chosen}
    while True:
        if len(chosen) < SETTINGS.least_frames:
            raise InputError(_too_few(source, board, len(chosen), left_out))
        matrix, distortion, deviation, errors = _solve({i: used[i] for i in chosen}, board, source.size)
        limit = max(SETTINGS.outlier * float(np.median(list(errors.values()))), SETTINGS.least_outlier)
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
    if seen.error > SETTINGS.most_error or focal > SETTINGS.most_focal_deviation:
        raise InputError(
            f"{source.name}: found an error of {seen.error:.2f} pixels, a focal length known to {100 * focal:.1f} %, "
            f"expected at most {SETTINGS.most_error:g} pixels and {100 * SETTINGS.most_focal_deviation:g} %; hold the "
            "board at different angles and distances, up to the image's corners, and check --board against the printed "
            "one"
        )
    return seen


def _too_few(source: Source, board: Board, count: int, left_out: dict[int, str]) -> str:
    reasons = Counter(text.split(":")[0] for text in left_out.values())
    told = ", ".join(f"{n} {reason}" for reason, n in reasons.most_common())
    return (
        f"{source.name}: found {count} frames that can be used of {count + len(left_out)} ({told or 'none else'}), "
        f"expected at least {SETTINGS.least_frames} with the whole board, sharp, not mirrored; looked for "
        f"{board.describe()}"
    )


def _varied(found: dict[int, BoardPoints], size: tuple[int, int]) -> list[int]:
    """At most ``most_used`` frames in which the board's place, size and tilt differ most, the fullest first."""
    keys = sorted(found)
    if len(keys) <= SETTINGS.most_used:
        return keys
    features = np.array([_feature(found[i], size) for i in keys])
    features /= features.std(axis=0) + 1e-9
    chosen = [int(np.argmax([len(found[i]) for i in keys]))]
    nearest = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < SETTINGS.most_used:
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
