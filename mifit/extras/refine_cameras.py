"""Poses and focal lengths of calibrated cameras by dense matches between them, the calibration as a prior.

Views of one timestep are matched through the fitted mesh, whose errors don't matter: what is adjusted are the images'
own correspondences, every timestep's points free in space. So two views tell what their epipolar lines tell: how one
is rolled, looks up and magnifies beside the other. What shifts matches along the lines alone, such as a turn that makes
the views converge nearer, can't be told from depth: there the calibration stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.core.process import one_blas_thread
from mifit.core.uv import rasterize_uv
from mifit.extras.bundle import AdjustedBundle, Bundle, Freedom, Sightings, adjust_bundle
from mifit.extras.calibrate_densely import MOST_TIMESTEPS
from mifit.extras.tracks import Tracks, focal_of, follow_points, image_scale, sightings_of, unwrap_image
from mifit.progress import Progress, silent
from mifit.stages.geometry.parameters import cross_matrix
from mifit.stages.surface.views import texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


@dataclass(frozen=True)
class CalibrationLimits:
    """What a calibration may be off by, and what matches must show of it.

    Lengths are for images whose longer side has `MATCH_SIDE` pixels or fewer.

    Attributes
    ----------
    focal, turn_degrees, shift : float
        Deviations of the prior: of a focal length, relative; of an orientation about each axis; of a position along
        each axis, as a part of its distance to the head.
    shared_error : float
        Smooth error that all matches share, pixels: whatever their number, together they weigh as one of this
        deviation.
    fewest : int
        Matches, as many used as left out, below which nothing is adjusted.
    residual : float
        Of matches left out, pixels, beyond which it isn't poses and focal lengths that are off, or not alone.
    better : float
        Part of the residual of matches left out that an adjustment must leave at most to be kept.
    farthest : float
        Deviations of the prior beyond which a calibration isn't adjusted: it is another one.
    """

    focal: float = 0.005
    turn_degrees: float = 0.5
    shift: float = 0.005
    shared_error: float = 0.1
    fewest: int = 200
    residual: float = 0.5
    better: float = 0.95
    farthest: float = 3.0


LIMITS = CalibrationLimits()


@dataclass(frozen=True)
class RefinedCameras:
    """A calibration that matches have judged.

    Attributes
    ----------
    cameras : tuple of Camera
        With other poses and focal lengths; empty where the calibration stays.
    finding : str
        In a line: how far it is off, or why it stays.
    doubtful : bool
        Whether the calibration stays although matches don't agree with it, or too few of them were found.
    figures : dict
        Residuals, movements and counts, as far as they were found.
    """

    cameras: tuple[Camera, ...]
    finding: str
    doubtful: bool
    figures: dict[str, Any]


@dataclass(frozen=True)
class _Matches:
    """Points seen by two cameras or more at one timestep."""

    seen: Sightings
    points: NDArray[np.float64]  # (N, 3) on the fitted mesh, world
    block: NDArray[np.int64]  # (N,) row plus column of the square of 32 texels that each lies in, as on a chessboard

    def some(self, chosen: NDArray[np.bool_]) -> _Matches:
        """Those of chosen points (N,)."""
        kept = chosen[self.seen.point]
        number = np.cumsum(chosen) - 1
        seen = replace(
            self.seen,
            pixels=self.seen.pixels[kept],
            point=number[self.seen.point[kept]],
            camera=self.seen.camera[kept],
            timestep=self.seen.timestep[kept],
        )
        return _Matches(seen, self.points[chosen], self.block[chosen])


@one_blas_thread()
def refine_cameras(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    progress: Progress = silent,
) -> RefinedCameras:
    """Adjust the calibration of two or more cameras to dense matches.

    Parameters
    ----------
    capture : Capture
        Calibrated.
    model : MorphableModel
    geometry : GeometryEstimate
        A fit with the calibration as it is; views are matched through its meshes.
    cameras : sequence of str
        No other camera's images are read.
    progress : Progress

    Returns
    -------
    RefinedCameras
        No cameras where the calibration stays: it can't be adjusted, the adjustment disagrees with it by more than
        ``farthest`` deviations or didn't settle, or matches that were left out don't agree better.

    Notes
    -----
    The prior is Gaussian, see `CalibrationLimits`. All cameras move: of rigs that explain matches alike the one that
    differs least from the calibration is taken, so that the world frame, and with it cameras that weren't fitted, stay
    valid.
    """
    if not capture.calibrated:
        return _kept("the capture is uncalibrated: its cameras are estimates already", {})
    if len(cameras) < 2:
        return _kept("one camera has nothing to be matched with", {})
    views = [capture.camera(name) for name in cameras]
    scale = image_scale(views)
    matches = _match(capture, model, geometry, views, progress)
    used = matches.block % 2 == 0
    counts = {"matches": int(used.sum()), "matches_left_out": int((~used).sum())}
    if min(counts.values()) < LIMITS.fewest:
        found = f"{len(used)} points of the face are matched between them"
        return _kept(f"{found}, expected at least {2 * LIMITS.fewest}; more timesteps help", counts)
    taken, left = matches.some(used), matches.some(~used)
    centre = geometry.vertices[:, np.unique(model.faces[model.face_mask])].reshape(-1, 3).mean(axis=0)
    poses = np.array([view.world_to_camera for view in views])
    focal = np.array([focal_of(view) for view in views])
    precision = calibration_precision(poses, np.array([np.linalg.norm(view.position - centre) for view in views]))
    together = used.sum() * (LIMITS.shared_error * scale / taken.seen.deviation) ** 2
    calibrated = Bundle(focal, poses, np.eye(4)[None], taken.points, np.zeros((1, 0)))
    before = _triangulated(taken, calibrated)
    adjusted = adjust_bundle(before.bundle, taken.seen, Freedom.of_prior(together * precision))
    rig = adjusted.bundle
    moved = [_moved(view, float(f), pose) for view, f, pose in zip(views, rig.focal, rig.cameras, strict=True)]
    judged = [_triangulated(left, one).residual for one in (calibrated, rig)]
    deviations = np.abs(np.linalg.cholesky(precision).T @ adjusted.moved)
    details = {
        **counts,
        "residual_pixels": [before.residual, _triangulated(taken, rig).residual],
        "residual_left_out_pixels": judged,
        "deviations": deviations.tolist(),
        "moved": {a.name: _movement(a, b, centre, capture.unit_mm) for a, b in zip(views, moved, strict=True)},
    }
    farthest = float(np.linalg.norm(deviations))
    before_after = f"{judged[0]:.2f} pixels off with it, {judged[1]:.2f} with adjusted cameras"
    if not adjusted.settled:
        return _kept("the adjustment to dense matches hasn't settled", details)
    if farthest > LIMITS.farthest:
        found = f"dense matches are off by {farthest:.1f} of the deviations that a calibration is taken to have"
        return _kept(f"{found}, expected at most {LIMITS.farthest:g}; calibrate the cameras anew", details)
    if judged[1] > LIMITS.residual * scale:
        found = f"dense matches are {before_after}, expected at most {LIMITS.residual * scale:.2g}"
        return _kept(f"{found}; the cameras may be out of step, or their lenses distort otherwise", details)
    if (
        judged[1] > LIMITS.better * judged[0]
        or judged[0] ** 2 - judged[1] ** 2 < (0.5 * LIMITS.shared_error * scale) ** 2
    ):
        return _kept(f"matches that were left out are {before_after}", details, doubtful=False)
    away = ", in ".join(f"{name} by {way['at_head_mm']:.1f}" for name, way in details["moved"].items())
    finding = f"the calibration is off: dense matches are {before_after}, which shift the head in {away} mm"
    return RefinedCameras(tuple(moved), finding, False, details)


def _triangulated(matches: _Matches, rig: Bundle) -> AdjustedBundle:
    """Points where cameras that stay see them best; none of them an outlier, so that two views share a residual."""
    seen = replace(matches.seen, deviation=10.0 * matches.seen.deviation)
    return adjust_bundle(replace(rig, points=matches.points), seen, Freedom.none(len(rig.cameras)))


def _kept(why: str, figures: dict[str, Any], doubtful: bool = True) -> RefinedCameras:
    """The calibration as it is, and why."""
    return RefinedCameras((), f"the cameras stay as they were calibrated: {why}", doubtful, figures)


def _match(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    views: Sequence[Camera],
    progress: Progress,
) -> _Matches:
    """Points of the face that several views show at a timestep."""
    steps = np.unique(np.linspace(0, len(geometry.timesteps) - 1, MOST_TIMESTEPS).round().astype(int))
    centre = geometry.vertices[0].mean(axis=0)
    length = min(float(np.linalg.norm(centre - view.position)) / focal_of(view) for view in views)
    size = texture_size(model, geometry.vertices[0].astype(np.float64), length, 1024)
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    block, points, found, count = [], [], [], 0
    for done, k in enumerate(steps):
        progress("match views", done, len(steps))
        vertices = geometry.vertices[k].astype(np.float64)
        frames = [(capture.frame(view.name, geometry.timesteps[k]), view) for view in views]
        tracks = follow_points([unwrap_image(*frame, vertices, model.faces, texels) for frame in frames], 2, 10000)
        at = np.searchsorted(texels.index, tracks.texel)
        row, column = np.divmod(tracks.texel, size)
        block.append(row // 32 + column // 32)
        points.append(interpolate(vertices, model.faces, texels.face[at], texels.weights[at]))
        found.append(replace(tracks, point=tracks.point + count))
        count += len(tracks.texel)
    progress("match views", len(steps), len(steps))
    columns = (np.concatenate([getattr(one, name) for one in found]) for name in ("texel", "point", "image", "pixels"))
    every = Tracks(*columns)
    seen = sightings_of(every, views, every.image, np.zeros_like(every.image))
    return _Matches(seen, np.concatenate(points).astype(np.float64), np.concatenate(block))


def _moved(view: Camera, focal: float, pose: NDArray) -> Camera:
    """A camera at another pose, with another focal length and pixels as they were."""
    factor = focal / focal_of(view)
    return replace(view, fx=view.fx * factor, fy=view.fy * factor, world_to_camera=pose)


def _movement(before: Camera, after: Camera, centre: NDArray, unit_mm: float) -> dict[str, float]:
    """How far a camera has moved, and what it shows of the head."""
    turn = after.rotation @ before.rotation.T
    degrees = math.degrees(math.acos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    distance = float(np.linalg.norm(before.position - centre))
    return {
        "degrees": degrees,
        "focal_percent": 100.0 * (after.fx / before.fx - 1.0),
        "position_mm": float(np.linalg.norm(after.position - before.position)) * unit_mm,
        "at_head_mm": float(np.linalg.norm(after.project(centre) - before.project(centre)))
        * distance
        / focal_of(before)
        * unit_mm,
    }


def calibration_precision(poses: NDArray, distances: NDArray) -> NDArray[np.float64]:
    """(7 C, 7 C) inverse covariance of what C cameras may be off by, in the order of `Freedom`.

    Parameters
    ----------
    poses : (C, 4, 4)
        World to camera, as calibrated.
    distances : (C,)
        From the cameras to the head.
    """
    found = [LIMITS.focal**-2.0 * np.eye(len(poses))]
    for shift, distance in zip(poses[:, :3, 3], distances, strict=True):
        # A camera that turns about its centre shifts its pose: the centre moves by -(shift + translation x turn).
        moved = np.eye(6)
        moved[3:, :3] = cross_matrix(shift)
        deviation = np.repeat([np.radians(LIMITS.turn_degrees), LIMITS.shift * distance], 3)
        found.append(moved.T @ np.diag(deviation**-2.0) @ moved)
    return np.asarray(block_diag(*found))
