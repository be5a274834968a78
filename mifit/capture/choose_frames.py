"""Which frames of a long video tell most about a face: different poses, sharp, eyes open, views that agree.

Pose comes from the landmarks alone, so that no model is fitted before the choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.capture import Capture
from mifit.capture.outliers import fundamental_matrix, line_distances
from mifit.core.calls import checked, whole
from mifit.errors import InputError

RIGID = (27, 28, 29, 30, 33, 36, 39, 42, 45)
"""Landmarks that expressions move least: the ridge and base of the nose, the corners of the eyes."""
EYES = ((37, 41, 38, 40, 36, 39), (43, 47, 44, 46, 42, 45))
"""Upper and lower lids, twice, and the corners of both eyes."""


@dataclass(frozen=True)
class FrameChoice:
    """Frames that were chosen, ascending, and ``why``, with those ``left_out`` that could not be, and the reason."""

    timesteps: tuple[int, ...]
    why: dict[int, str]
    left_out: dict[int, str] = field(default_factory=dict)

    def document(self) -> dict:
        """JSON values for a report."""
        return {
            "why": {str(t): text for t, text in self.why.items()},
            "left_out": {str(t): text for t, text in self.left_out.items()},
        }


@checked
def choose_frames(
    capture: Capture,
    cameras: Sequence[str],
    count: int,
    timesteps: Sequence[int] | None = None,
    beside: Sequence[int] = (),
) -> FrameChoice:
    """The timesteps of a capture that show most of a face.

    Frames without landmarks are left out, and those that are blurred (half of the median sharpness), show closed eyes
    (0.6 of the median opening) or whose views disagree (landmarks off the epipolar lines by 3 times the median distance
    and more than a pixel). Of the others the first is the one nearest to the middle of all poses, and each next one the
    farthest from those before it.

    Parameters
    ----------
    capture : Capture
        With landmarks.
    cameras : sequence of str
        No other camera is read.
    count : int
        How many; fewer come back where there aren't as many.
    timesteps : sequence of int, optional
        Those to choose from; default: all.
    beside : sequence of int
        Timesteps that are taken already: those that are chosen lie far from them too, and are others.

    Raises
    ------
    InputError
        No camera, or no timestep with landmarks.
    """
    if not cameras:
        raise InputError("choose_frames: found no camera, expected at least one")
    whole(count, 1, "count")
    steps = np.array(sorted({*(capture.timesteps if timesteps is None else timesteps), *beside}))
    points = np.stack([_landmarks(capture, name, steps) for name in cameras])  # (C, T, 68, 2)
    known = np.isfinite(points).all((2, 3))
    if not known.any():
        raise InputError(f"{capture.path}: no timestep has landmarks to choose by; run mifit landmarks first")
    left_out: dict[int, str] = {int(t): "no landmarks" for t in steps[~known.any(0)]}
    sharp = np.array([_sharpness(capture, cameras, int(t), points[:, i]) for i, t in enumerate(steps)])
    opening = _eye_opening(points)
    apart = _disagreement(capture, cameras, points)
    for i, t in enumerate(int(t) for t in steps):
        if t in left_out or t in beside:
            continue
        if sharp[i] < 0.5 * np.nanmedian(sharp):
            left_out[t] = f"blurred: {sharp[i] / np.nanmedian(sharp):.0%} of the usual sharpness"
        elif opening[i] < 0.6 * np.nanmedian(opening):
            left_out[t] = f"eyes closed: {opening[i] / np.nanmedian(opening):.0%} of the usual opening"
        elif apart[i] > max(3.0 * float(np.nanmedian(apart)), 1.0):
            left_out[t] = f"views disagree: landmarks {apart[i]:.1f} pixels off the other view's lines"
    good = np.array([i for i, t in enumerate(steps) if int(t) not in left_out])
    if not len(good):  # better the worst frames than none
        good = np.flatnonzero(known.any(0))
    poses = _poses(points[:, good])
    taken = [k for k, i in enumerate(good) if steps[i] in beside]
    chosen, why = _spread(poses, sharp[good] / np.nanmedian(sharp), count, taken)
    found = {int(steps[good[k]]): text for k, text in zip(chosen, why, strict=True)}
    return FrameChoice(tuple(sorted(found)), dict(sorted(found.items())), left_out)


def _landmarks(capture: Capture, camera: str, steps: NDArray) -> NDArray[np.float64]:
    """(T, 68, 2) undistorted landmarks; NaN where there are none."""
    out = np.full((len(steps), 68, 2), np.nan)
    for i, t in enumerate(steps):
        found = capture.landmarks(camera, int(t))
        if found is not None:
            out[i] = found.points
    return out


def _sharpness(capture: Capture, cameras: Sequence[str], timestep: int, points: NDArray) -> float:
    """Least over the cameras of the share of fine detail in the face's contrast, 128 pixels across; NaN without one."""
    found = []
    for name, p in zip(cameras, points, strict=True):
        if not np.isfinite(p).all():
            continue
        image = capture.frame(name, timestep).image.mean(-1)
        low, high = np.floor(p.min(0)).astype(int), np.ceil(p.max(0)).astype(int)
        low, high = np.maximum(low, 0), np.minimum(high, (image.shape[1], image.shape[0]))
        if (high - low).min() < 8:
            continue
        crop = np.sqrt(np.maximum(image[low[1] : high[1], low[0] : high[0]], 0.0)).astype(np.float32)
        scale = 128 / max(crop.shape)
        if scale < 1.0:
            crop = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        fine = crop - cv2.GaussianBlur(crop, (0, 0), 1.5)
        found.append(float(fine.std() / max(float(crop.std()), 1e-6)))
    return min(found) if found else float("nan")


def _eye_opening(points: NDArray) -> NDArray[np.float64]:
    """(T,) height over width of the more open eye, mean of the cameras."""
    ratios = []
    for a, b, c, d, left, right in EYES:
        height = np.linalg.norm(points[:, :, a] - points[:, :, b], axis=-1)
        height = height + np.linalg.norm(points[:, :, c] - points[:, :, d], axis=-1)
        ratios.append(height / np.maximum(np.linalg.norm(points[:, :, left] - points[:, :, right], axis=-1), 1e-6))
    with np.errstate(all="ignore"):
        return np.asarray(np.ma.masked_invalid(np.maximum(*ratios)).mean(0).filled(np.nan), dtype=np.float64)


def _disagreement(capture: Capture, cameras: Sequence[str], points: NDArray) -> NDArray[np.float64]:
    """(T,) largest over the views of the median distance of landmarks from the first view's lines; 0 where unknown."""
    found = np.zeros(points.shape[1])
    if not capture.calibrated:
        return found
    for k in range(1, len(cameras)):
        matrix = fundamental_matrix(capture.camera(cameras[0]), capture.camera(cameras[k]))
        distance = line_distances(matrix, points[0], points[k])
        distance -= np.nan_to_num(np.nanmedian(distance, axis=0)) if np.isfinite(distance).any() else 0.0
        for i, row in enumerate(np.abs(distance)):
            if np.isfinite(row).any():
                found[i] = max(found[i], float(np.nanmedian(row)))
    return found


def _poses(points: NDArray) -> NDArray[np.float64]:
    """(T, C * 2 * K) places of the landmarks that expressions move least, in widths of the face: they tell its turn."""
    rigid = points[:, :, list(RIGID)]
    size = np.nanmedian(np.linalg.norm(points[:, :, 36] - points[:, :, 45], axis=-1), axis=1)
    rigid = (rigid - rigid.mean(axis=2, keepdims=True)) / size[:, None, None, None]
    flat = rigid.transpose(1, 0, 2, 3).reshape(points.shape[1], -1)
    return np.where(np.isfinite(flat), flat, np.nanmedian(flat, axis=0))


def _spread(poses: NDArray, sharpness: NDArray, count: int, taken: Sequence[int] = ()) -> tuple[list[int], list[str]]:
    """Rows that lie far from one another and from those taken, sharper ones preferred, and the reason for each."""
    middle = np.median(poses, axis=0)
    away = np.linalg.norm(poses - middle, axis=1)
    good = np.clip(np.nan_to_num(sharpness, nan=1.0), 0.5, 1.0)
    chosen: list[int] = []
    why: list[str] = []
    if not taken and count > 0:
        chosen, why = [int(np.argmin(away / good))], ["nearest to the middle of all poses"]
    known = [*taken, *chosen]
    nearest = np.linalg.norm(poses[:, None] - poses[known], axis=2).min(axis=1)
    while len(chosen) < min(count, len(poses) - len(taken)):
        pick = int(np.argmax(np.where(np.isin(np.arange(len(poses)), [*taken, *chosen]), -1.0, nearest * good)))
        why.append(f"farthest in pose from those before, {nearest[pick]:.2f} widths between the eyes")
        chosen.append(pick)
        nearest = np.minimum(nearest, np.linalg.norm(poses - poses[pick], axis=1))
    return chosen, why
