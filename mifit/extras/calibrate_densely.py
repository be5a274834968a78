"""Focal lengths and poses of an uncalibrated capture from dense matches, after landmarks have given a start.

What a detector takes for a landmark differs from the model's by a bias, and a face model explains perspective by shape.
Points that are matched between the images themselves know of neither: several views of a head that turns determine
focal lengths as they do in structure from motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera
from mifit.core.files import Document
from mifit.core.process import one_blas_thread
from mifit.extras.bundle import AdjustedBundle, Bundle, Freedom, Sightings, adjust_bundle
from mifit.extras.calibrate_heads import FOCAL_PRIOR, HeadCalibration, calibrate_heads
from mifit.extras.tracks import FEWEST_IMAGES, focal_of, follow_head, points_of, sightings_of
from mifit.morphable import MorphableModel
from mifit.progress import Progress, silent
from mifit.stages.surface.sweep import FEWEST

MOST_TIMESTEPS = 6
"""Timesteps that are matched, spread evenly over more: cameras keep still, and each has its expression to find."""
LARGEST_DEVIATION = 0.02
"""Relative deviation of a focal length beyond which matches don't decide it; real errors are larger."""


@dataclass(frozen=True)
class DenseCalibration:
    """A capture with estimated cameras, those that the landmarks gave where matches don't decide.

    ``note`` is what a person should know, in a line. Where matches decided, ``deviation`` is the standard deviation of
    the focal length relative to it, from the normal equations, and ``residual`` the median distance of matches from the
    adjusted points, pixels.
    """

    capture: Capture
    note: str
    deviation: float | None = None
    residual: float | None = None


@one_blas_thread()
def calibrate_capture(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    progress: Progress = silent,
) -> DenseCalibration:
    """An uncalibrated capture with cameras from landmarks and the model's, then from dense matches.

    Unknown focal lengths, and the poses with them, are found by bundle adjustment of the matches. No other camera's
    images are read. Lengths are scaled so that the head is as large as the model's that landmarks gave.

    One focal length serves all cameras without one whose images have the same longer side; principal points of such
    cameras are in the middle and pixels are square. Two images don't determine a focal length: both look at the head,
    and then it is a family of solutions. Images of one camera leave expressions and perspective apart too badly.
    """
    unit = model.unit_mm / capture.unit_mm
    mean, identity = model.mean[model.landmarks], model.identity[model.landmarks][..., :30]
    start = calibrate_heads(capture, unit * mean, unit * identity, cameras, timesteps)
    capture = start.capture
    unknown = np.array([capture.views[name].intrinsics is None for name in cameras])
    if not unknown.any():
        return DenseCalibration(capture, "focal lengths are the capture's own")
    some = np.unique(np.linspace(0, len(timesteps) - 1, min(len(timesteps), MOST_TIMESTEPS)).round().astype(int))
    start, timesteps = replace(start, heads=start.heads[some]), [timesteps[k] for k in some]
    images = len(cameras) * len(timesteps)
    if len(cameras) < 2:
        return _left(start, cameras, "one camera can't tell expressions from perspective, expected two")
    if images < FEWEST_IMAGES:
        return _left(start, cameras, f"{images} images can't tell more, expected {FEWEST_IMAGES}")
    neutral = model.mean + model.identity[..., : len(start.shape)].astype(np.float64) @ start.shape
    vertices = unit * neutral  # of the head that landmarks gave, head's frame
    world = [vertices @ pose[:3, :3].T + pose[:3, 3] for pose in OPENGL_FROM_OPENCV @ start.heads]
    views = [capture.camera(name) for name in cameras]
    tracks, texels = follow_head(capture, model, views, timesteps, world, progress)
    if len(tracks.texel) < FEWEST:
        count = f"{len(tracks.texel)} points are found in {FEWEST_IMAGES} or more images"
        return _left(start, cameras, f"{count}, expected {FEWEST}; add timesteps where the head turns")
    seen = sightings_of(tracks, views)
    points, modes = points_of(tracks, texels, model, vertices)
    adjusted, focals = _adjust(start, views, unknown, seen, points, modes * unit)
    deviation = float(adjusted.deviations[:focals].max())
    if deviation > LARGEST_DEVIATION:
        found = f"matches give it to {_percent(deviation)} only"
        return _left(start, cameras, f"{found}, expected {_percent(LARGEST_DEVIATION)}; add timesteps where it turns")
    if adjusted.residual > 4.0 * seen.deviation:  # not the tracks of one head
        found = f"matches are {adjusted.residual:.1f} pixels from those of a moving head"
        return _left(start, cameras, f"{found}; views may be out of step")
    return _calibration(start, views, points, adjusted, deviation)


def _left(start: HeadCalibration, cameras: Sequence[str], why: str) -> DenseCalibration:
    """The landmarks' cameras, and why."""
    focal = start.capture.camera(cameras[0]).fx
    note = f"focal length {focal:.0f} pixels is from landmarks, which may be off by a third: {why}"
    return DenseCalibration(start.capture, note)


def _percent(deviation: float) -> str:
    return f"{100 * deviation:.1f} %" if math.isfinite(deviation) else "no precision"


def _adjust(
    start: HeadCalibration,
    views: Sequence[Camera],
    unknown: NDArray[np.bool_],
    seen: Sightings,
    points: NDArray,
    modes: NDArray,
) -> tuple[AdjustedBundle, int]:
    """The bundle adjusted from points (N, 3) and expression modes (N, 3, K) on the landmarks' head, and free focals."""
    side = np.array([max(view.width, view.height) for view in views], dtype=np.float64)
    numbers = np.full(len(views), -1)
    sides, numbers[unknown] = np.unique(side[unknown], return_inverse=True)
    focal = np.array([focal_of(view) for view in views])
    for g in range(len(sides)):
        focal[numbers == g] = focal[numbers == g].mean()
    bundle = Bundle(
        focal,
        np.array([view.world_to_camera @ OPENGL_FROM_OPENCV for view in views]),  # the first is the world's frame
        start.heads,
        points,
        np.zeros((len(start.heads), modes.shape[2])),
    )
    freedom = Freedom.of_focals(numbers, focal, FOCAL_PRIOR[0] * sides, FOCAL_PRIOR[1])
    return adjust_bundle(bundle, seen, freedom, modes), len(sides)


def _calibration(
    start: HeadCalibration, views: Sequence[Camera], first: NDArray, adjusted: AdjustedBundle, deviation: float
) -> DenseCalibration:
    bundle = adjusted.bundle
    # images alone leave the scale open; medians, as a few points may have gone anywhere
    sizes = [np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1)) for p in (first, bundle.points)]
    found = []
    for view, focal, pose in zip(views, bundle.focal, bundle.cameras, strict=True):
        scaled = pose.copy()
        scaled[:3, 3] *= sizes[0] / sizes[1]
        lens: Document = {} if start.capture.views[view.name].intrinsics else {"fx": float(focal), "fy": float(focal)}
        found.append(replace(view, **lens, world_to_camera=scaled @ OPENGL_FROM_OPENCV))
    free = [k for k, view in enumerate(views) if start.capture.views[view.name].intrinsics is None]
    lengths = ", ".join(dict.fromkeys(f"{bundle.focal[k]:.0f}" for k in free))
    before = ", ".join(dict.fromkeys(f"{views[k].fx:.0f}" for k in free))
    note = (
        f"focal length {lengths} pixels (+- {_percent(deviation)}) is from {len(first)} dense matches, "
        f"residual {adjusted.residual:.2f} pixels; landmarks gave {before}"
    )
    if not adjusted.settled:
        note += "; the adjustment hasn't settled"
    return DenseCalibration(start.capture.with_estimate(found), note, deviation, adjusted.residual)
