"""What is wrong with a calibration under which a face can't be fitted: each common mistake is undone and tried.

A face of the model's size that the landmarks place well under one of them, and badly under the calibration as it is,
names the mistake.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mifit.core.diagnostics import Diagnostic
from mifit.morphable import MorphableModel
from mifit.stages.geometry.initial import pose_candidates, reprojection, triangulate
from mifit.stages.geometry.landmarks import LandmarkView

BETTER = 0.4
"""Part of the reprojection error that a correction must leave at most."""
SCATTER_OF_WIDTH = 0.015
"""Deviation of landmarks from a fit, as part of the image's width, at which the calibration is questioned."""
GOOD_OF_WIDTH = 0.06
"""Reprojection error of the mean face that counts as explained, as part of the image's width."""
ALIKE = 1.2
"""Reprojection errors, as multiples of the least one, of mistakes that can't be told apart: all of them are named."""
LARGEST_DELAY = 5
"""Timesteps that a camera may lag behind the others."""
FEWEST_IN_STEP = 3
"""Timesteps that must remain to judge a delay."""
NOTICED_PIXELS = 1.5
"""Distance of landmarks from where views agree below which cameras are in step."""

Matrix = NDArray[np.float64]


def _location_as_translation(pose: Matrix) -> Matrix:
    """The file has [R | location] in place of [R | translation]."""
    out = pose.copy()
    out[:3, 3] = -pose[:3, :3] @ pose[:3, 3]
    return out


def _translation_as_location(pose: Matrix) -> Matrix:
    """The file has the translation in place of the location."""
    out = pose.copy()
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def _inverted(pose: Matrix) -> Matrix:
    """The file has the inverse matrix."""
    return np.asarray(np.linalg.inv(pose), dtype=np.float64)


def _scaled(factor: float) -> Callable[[Matrix], Matrix]:
    def change(pose: Matrix) -> Matrix:
        out = pose.copy()
        out[:3, 3] *= factor
        return out

    return change


MISTAKES: dict[str, Callable[[Matrix], Matrix]] = {
    "the locations of the cameras are given where their translations belong (t = -R C)": _location_as_translation,
    "the translations of the cameras are given where their locations belong (C = -R' t)": _translation_as_location,
    "world-to-camera matrices are given where camera-to-world ones belong, or the reverse": _inverted,
    "the cameras' y and z axes are flipped (OpenCV axes for OpenGL ones, or the reverse)": lambda pose: (
        np.diag([1.0, -1.0, -1.0, 1.0]) @ pose
    ),
    **{
        f"lengths are in the wrong unit: the face fits when they are {text}": _scaled(factor)
        for factor, text in (
            (1000.0, "multiplied by 1000"),
            (100.0, "multiplied by 100"),
            (10.0, "multiplied by 10"),
            (0.1, "divided by 10"),
            (0.01, "divided by 100"),
            (0.001, "divided by 1000"),
        )
    },
}
"""What may be wrong, and what turns the world-to-camera matrix (4, 4) into the right one."""


def calibration_warnings(
    views: Sequence[LandmarkView], model: MorphableModel, scale: float, noise: float
) -> list[Diagnostic]:
    """What is probably wrong with the cameras of a fit by landmarks that scatter by ``noise`` pixels about it."""
    found = []
    width = min((view.camera.width for view in views), default=0)
    if noise > SCATTER_OF_WIDTH * width:
        mistake = calibration_fault(views, model.mean[model.landmarks].astype(np.float64), scale)
        if mistake is not None:
            found.append(Diagnostic("calibration-wrong", f"the calibration looks wrong: {mistake}", "fault"))
    late = delayed_camera(views)
    if late is not None:
        name, steps = late
        text = (
            f"camera {name} looks {abs(steps)} timesteps {'late' if steps > 0 else 'early'}: its landmarks agree with "
            "the other cameras' when moved by that; synchronise the videos"
        )
        found.append(Diagnostic("camera-delayed", text, "fault", name))
    return found


def calibration_fault(views: Sequence[LandmarkView], mean: NDArray, scale: float) -> str | None:
    """The mistake whose correction lets the landmarks of several views agree on a face.

    Parameters
    ----------
    views : sequence of LandmarkView
        Of all timesteps.
    mean : (68, 3)
        The model's mean landmarks, object space.
    scale : float
        World length of an object-space one.

    Returns
    -------
    str or None
        A clause that names it, or several that the landmarks don't tell apart; None where no correction explains the
        landmarks, or the calibration does.
    """
    steps = sorted({view.step for view in views})
    if max((sum(view.step == step for view in views) for step in steps), default=0) < 2:
        return None
    width = min(view.camera.width for view in views)
    now = _disagreement(views, steps, mean, scale, lambda pose: pose)
    found = {name: _disagreement(views, steps, mean, scale, change) for name, change in MISTAKES.items()}
    best = min(found.values())
    if best > min(BETTER * now, GOOD_OF_WIDTH * width):
        return None
    return ", or ".join(name for name, error in found.items() if error < ALIKE * best)


def _disagreement(
    views: Sequence[LandmarkView], steps: Sequence[int], mean: NDArray, scale: float, change: Callable[[Matrix], Matrix]
) -> float:
    """Pixels by which the best pose of the mean face misses the landmarks of the camera that it suits least.

    Median over landmarks and timesteps: any calibration lets one camera see the face well.
    """
    errors = []
    for step in steps:
        mine = [view for view in views if view.step == step]
        cameras = [replace(v.camera, world_to_camera=change(v.camera.world_to_camera)) for v in mine]
        pixels = [_all_landmarks(view) for view in mine]
        poses = pose_candidates(cameras, mean, pixels, scale)
        each = [
            max(reprojection([c], mean, [p], scale, pose) for c, p in zip(cameras, pixels, strict=True))
            for pose in poses
        ]
        errors.append(min(each, default=np.inf))
    return float(np.median(errors))


def delayed_camera(views: Sequence[LandmarkView]) -> tuple[str, int] | None:
    """The camera whose landmarks agree with another's when moved in time, and by how many timesteps it is late.

    Landmarks of a moving head lie on one another's epipolar lines only where both were seen at one time.
    """
    by_camera: dict[str, dict[int, LandmarkView]] = {}
    for view in views:
        by_camera.setdefault(view.camera.name, {})[view.step] = view
    for a, b in combinations(by_camera, 2):
        first, second = by_camera[a], by_camera[b]
        steps = sorted(set(first) | set(second))
        miss = {}
        for late in range(-LARGEST_DELAY, LARGEST_DELAY + 1):
            both = [(first[s], second[s + late]) for s in steps if s in first and s + late in second]
            if len(both) >= FEWEST_IN_STEP:
                miss[late] = float(np.median([_misses(*pair) for pair in both]))
        if 0 not in miss or miss[0] < NOTICED_PIXELS:
            continue
        best = min(miss, key=lambda late: miss[late])
        if miss[best] < BETTER * miss[0]:
            return b, best
    return None


def _misses(first: LandmarkView, second: LandmarkView) -> float:
    """Median pixels by which the points that two views agree on best miss their landmarks."""
    cameras, pixels = (first.camera, second.camera), (_all_landmarks(first), _all_landmarks(second))
    points = triangulate(cameras, pixels)
    seen = np.isfinite(points).all(1)
    if not seen.any():
        return np.inf
    miss = [np.linalg.norm(c.project(points[seen]) - p[seen], axis=1) for c, p in zip(cameras, pixels, strict=True)]
    return float(np.median(np.concatenate(miss)))


def _all_landmarks(view: LandmarkView) -> NDArray[np.float64]:
    """(68, 2) pixels, NaN where not seen."""
    out = np.full((68, 2), np.nan)
    out[view.index] = view.pixels
    return out


def unseen_warnings(
    blind: Collection[tuple[str, int]], cameras: Sequence[str], steps: int, unit_mm: float
) -> list[Diagnostic]:
    """What to say of cameras that show nothing of the fitted face in any of the timesteps.

    Parameters
    ----------
    blind : collection of (camera, step)
        Images that showed nothing of the face.
    cameras, steps
        The cameras fitted, and the number of timesteps.
    unit_mm : float
        The capture's unit of length in millimetres.
    """
    return [
        Diagnostic(
            "face-unseen",
            f"camera {name} shows the front of the fitted face at no timestep. If its images do show the face: is the "
            f"unit of length right (found one of {unit_mm:g} mm), is the order of the landmarks (left taken for right "
            "turns a head around), are the cameras' poses?",
            camera=name,
        )
        for name in cameras
        if all((name, step) in blind for step in range(steps))
    ]
