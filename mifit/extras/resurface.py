"""Before a video is absorbed (`mifit.refine`), its frames mend the surface: more poses, swept once more.

What the sums of the refinement hold is tied to the surface that was looked at, so that this comes first. At most
`MOST` timesteps are swept, however long the video is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mifit import cache
from mifit.capture.choose_frames import choose_frames
from mifit.config import GeometryConfig, SurfaceConfig, from_mapping
from mifit.core.estimate import GeometryEstimate
from mifit.core.rows import Rows
from mifit.errors import ConvergenceError
from mifit.extras.sweep_again import on_surface, sweep_again
from mifit.progress import Progress, silent
from mifit.result.record import R, Result
from mifit.stages.surface.prediction_between_views import errors_between_views
from mifit.stages.track import Follower

if TYPE_CHECKING:
    from mifit.capture import Capture

MOST = 16
"""Timesteps that are swept, fitted ones included."""
JUDGE = 3
"""Of the further frames every so many are not swept, but judge."""
FEWEST = 6
"""Further frames below which the surface stays."""
DISAGREES = 2.0
"""Error between a frame's views, relative to the median of the fitted ones, above which it isn't used."""


@dataclass(frozen=True)
class _Surface:
    """What a checkpoint holds."""

    kept: bool
    displacement: NDArray
    timesteps: tuple[int, ...]
    expression: NDArray
    rotation: NDArray
    translation: NDArray
    details: dict[str, Any]


def resurfaced(
    result: R,
    capture: Capture,
    fitted: Sequence[int],
    timesteps: Sequence[int],
    seed: int = 0,
    progress: Progress = silent,
    folder: Path | None = None,
    key: str = "",
) -> R:
    """A result on the surface that chosen frames of a video show, where these speak for it.

    Parameters
    ----------
    result : Reconstruction
        With reflectance, on a surface beyond the model's span; any other comes back as it is.
    capture : Capture
        As the fit saw it.
    fitted : sequence of int
        Timesteps of the result that were fitted jointly.
    timesteps : sequence of int
        Frames to choose from. Those that the result has no geometry for are followed and not kept.
    seed, progress
        As in `mifit.refine`.
    folder, key
        Where the surface is kept, and under which key, for a run that is stopped.

    Returns
    -------
    Reconstruction
        With ``geometry`` on the new surface at all of its timesteps; maps, normals and meshes are still those of the
        old one. ``geometry.report.details["phases"]`` ends with what was found, kept or not.
    """
    names = [camera.name for camera in result.cameras]
    settings = from_mapping(SurfaceConfig, result.config.get("surface", {}), "result.json: config: surface")
    if result.geometry.displacement is None or not settings.enabled:
        return result
    found = None if folder is None else cache.load(folder, "surface", _Surface, key)
    if found is None:
        count = (MOST - len(fitted)) * JUDGE // (JUDGE - 1)
        further = _chosen(capture, names, timesteps, fitted, count)
        geometry = _followed(result, capture, fitted, further, seed, progress)
        further = [t for t in geometry.timesteps if t not in fitted]
        if len(further) < FEWEST:
            return result
        judged = further[1::JUDGE]
        swept, details = sweep_again(capture, result.model, geometry, judged, names, settings, progress)
        assert swept.displacement is not None
        parts = swept.displacement, swept.timesteps, swept.expression, swept.rotation, swept.translation
        found = _Surface(bool(details["kept"]), *parts, details)
        if folder is not None:
            cache.save(folder, "surface", found, key)
    return _on(result, found)


def _chosen(
    capture: Capture, cameras: Sequence[str], timesteps: Sequence[int], fitted: Sequence[int], count: int
) -> list[int]:
    """Further timesteps, far in pose from one another and from those that were fitted; none without landmarks."""
    further = [t for t in timesteps if t not in fitted]
    if not any(capture.landmarks(name, t) is not None for name in cameras for t in further):
        return []
    return list(choose_frames(capture, cameras, count, further, fitted).timesteps) if count > 0 else []


def _followed(
    result: Result, capture: Capture, fitted: Sequence[int], further: Sequence[int], seed: int, progress: Progress
) -> GeometryEstimate:
    """Geometry of the fitted and of further timesteps, less those whose views disagree on it."""
    names = [camera.name for camera in result.cameras]
    home, model, gains = result.geometry.at(fitted), result.model, result.geometry.gains
    follower: Follower | None = None
    found = []

    def apart(geometry: GeometryEstimate) -> float:
        given = capture, model, names, geometry.timesteps, [geometry.vertices], gains
        return errors_between_views(*given)[0]

    usual = float(np.median([apart(home.at((t,))) for t in fitted]))
    for done, timestep in enumerate(further):
        progress("follow frames", done, len(further))
        if timestep in result.timesteps:
            one = result.geometry.at((timestep,))
        else:
            if follower is None:
                follower = Follower(capture, model, home, names, GeometryConfig(), None, seed)
            try:
                one = follower.next(timestep)[0]
            except ConvergenceError:
                continue
        if apart(one) < DISAGREES * usual:
            found.append(one)
    progress("follow frames", len(further), len(further))
    parts: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in (home, *found)])
        for name in ("expression", "rotation", "translation", "vertices")
    }
    exposures = {name: (*factors, *(1.0 for _ in found)) for name, factors in home.exposures.items()}
    return replace(home, timesteps=(*fitted, *(one.timesteps[0] for one in found)), exposures=exposures, **parts)


def _on(result: R, found: _Surface) -> R:
    """The result on a surface that was kept; in any case with what its report says of it."""
    geometry, model = result.geometry, result.model
    report = geometry.report
    details = {**report.details, "phases": [*report.details.get("phases", []), found.details]}
    report = replace(report, seconds=report.seconds + found.details["seconds"], details=details)
    if not found.kept:
        return replace(result, geometry=replace(geometry, report=report))
    moved: dict[str, Any] = {
        name: np.stack(
            [
                getattr(found, name)[found.timesteps.index(t)] if t in found.timesteps else getattr(geometry, name)[k]
                for k, t in enumerate(geometry.timesteps)
            ]
        )
        for name in ("expression", "rotation", "translation")
    }
    posed = replace(geometry, report=report, **moved)
    vertices = Rows(len(posed.timesteps), posed.vertices.shape[1:], np.float32)
    for timestep in posed.timesteps:
        vertices.add(on_surface(model, posed.at((timestep,)), found.displacement).vertices[0])
    geometry = replace(posed, vertices=vertices.all, displacement=found.displacement)
    return replace(result, geometry=geometry)
