"""Files of 68 iBUG landmarks: JSON, in the project's pixels, the centre of the first one at (0.5, 0.5)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import read_text, write_text
from mifit.core.limits import MAX_LANDMARK_NOISE, MAX_SETTINGS_BYTES
from mifit.errors import InputError

COUNT = 68
MIN_VISIBLE = 6
"""Fewer visible landmarks than this give no pose of a head."""
MIN_EXTENT = 4.0
"""Pixels that the landmarks of a face span at least."""


@dataclass(frozen=True)
class Landmarks:
    """68 iBUG points in one image.

    ``points`` (68, 2) are pixel coordinates, finite also where they aren't ``visible`` (68,), to be trusted.
    ``deviation`` is the standard deviation of a coordinate that the detector's errors amount to, in pixels, were they
    independent; 0 where it isn't known.
    """

    points: NDArray[np.float64]
    visible: NDArray[np.bool_]
    deviation: float = 0.0


def read_landmarks(path: str | Path) -> Landmarks:
    """Read ``{"points": [[x, y], ...], "visible": [...], "deviation": 0}``, or a bare list of points.

    A point without finite coordinates is invisible. InputError for a missing or malformed file, or another number of
    points than 68.
    """
    path = Path(path)
    try:
        points, visible, deviation = _read(path)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        brief = (str(error) or type(error).__name__).splitlines()[0][:200]
        raise InputError(f"{path}: not a readable landmark file, expected JSON: {brief}") from None
    if points.shape != (COUNT, 2):
        raise InputError(
            f"{path}: found {len(points)} landmarks of shape {points.shape}, expected 68 points (iBUG-68) of x and y"
        )
    if visible.shape != (COUNT,):
        raise InputError(f"{path}: found {visible.size} visibility flags, expected {COUNT}")
    if not 0 <= deviation <= MAX_LANDMARK_NOISE:
        most = f"{MAX_LANDMARK_NOISE:g}"
        raise InputError(f"{path}: deviation: found {deviation}, expected a number of pixels from 0 to {most}")
    finite = np.asarray(np.isfinite(points).all(axis=1), dtype=bool)
    _check_spread(path, points[visible & finite])
    return Landmarks(np.where(finite[:, None], points, 0.0), visible & finite, deviation)


def _check_spread(path: Path, points: NDArray[np.float64]) -> None:
    """Refuse points that are no face: a detector that failed puts all of them into one place."""
    extent = float(np.ptp(points, axis=0).max()) if len(points) >= MIN_VISIBLE else MIN_EXTENT
    if extent < MIN_EXTENT:
        raise InputError(
            f"{path}: found all {len(points)} visible landmarks within {extent:.2g} pixels, expected the points of a "
            f"face, at least {MIN_EXTENT:g} across; mark them invisible or run mifit landmarks"
        )


def write_landmarks(path: str | Path, landmarks: Landmarks) -> None:
    """Write the JSON form, whole or not at all."""
    text = json.dumps(
        {
            "convention": "ibug68",
            "points": np.round(landmarks.points, 3).tolist(),
            "visible": [bool(v) for v in landmarks.visible],
            "deviation": round(float(landmarks.deviation), 2),
        }
    )
    write_text(path, text + "\n")


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
    data = json.loads(read_text(path, MAX_SETTINGS_BYTES, "landmark file"))
    if isinstance(data, list):
        data = {"points": data}
    if not isinstance(data, dict) or "points" not in data:
        raise InputError(f"{path}: found no key 'points', expected a list of 68 [x, y] pairs under it")
    convention = data.get("convention", "ibug68")
    if convention != "ibug68":
        raise InputError(f"{path}: convention: found {convention!r}, expected 'ibug68'")
    points = np.array([[np.nan, np.nan] if p is None else p for p in data["points"]], dtype=np.float64)
    flags = data.get("visible")
    visible = np.ones(len(points), dtype=bool) if flags is None else np.array(flags, dtype=bool)
    return points, visible, float(data.get("deviation", 0.0))
