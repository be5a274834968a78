"""Stage 1b: the surface beyond the model's span, where the images of all views and timesteps together ask for it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from mifit.config import GeometryConfig, SurfaceConfig
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.process import one_blas_thread
from mifit.optim import Outcome
from mifit.progress import Progress, silent
from mifit.stages.eyes import behind_lids
from mifit.stages.surface.close_openings import LIDS, LIPS, close_again, close_openings
from mifit.stages.surface.coarse_to_fine import Reached, Search, sweeps
from mifit.stages.surface.model_fit import SHADING_ROUNDS, fit_model, landmarks_are_biased
from mifit.stages.surface.prediction_between_views import errors_between_views
from mifit.stages.surface.thin_walls import keep_walls
from mifit.stages.surface.views import Resolution

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

ROUNDS, RESTS = 6, 0.25
"""Rounds of the coarse levels at the most, and the movement that ends them, in parallax of a pixel."""
SETTLING = 2
"""Further sweeps at the finest level, at the most, until it has."""
FINEST_AGAIN = 2
"""Further sweeps at the finest level while the model alone moves."""
CLOSED_LAYERS = 8
"""Offsets to either side in the first sweep of lids that have been closed."""
TRIES = 2
"""Refits with other points and pixels, at the most, of a single timestep, where a refit may end in a wrong place."""
OFF_PIXELS = 1.0
"""Median distance from epipolar lines that deserves a warning."""
NARROWEST = 0.03
"""Least parallax; below it, about 2 degrees between the views, depth isn't measured."""


@checked
@one_blas_thread()
def find_surface(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: SurfaceConfig | None = None,
    progress: Progress = silent,
    geometry_config: GeometryConfig | None = None,
) -> GeometryEstimate:
    """Displace a fitted surface to where all views agree.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Result of stage 1.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : SurfaceConfig, optional
    progress : Progress
    geometry_config : GeometryConfig, optional
        Stage 1's, whose texture, landmark and prior terms go on where the model is refitted.

    Returns
    -------
    GeometryEstimate
        With ``displacement``, one for all timesteps, and the vertices that follow it. With fewer than two views, or
        views from nearly one place, ``geometry`` with a warning.

    Notes
    -----
    Coarse to fine: at every level the texels of the current surface are moved along their normals to where the views
    agree best (`surface.sweep`), and the mesh follows by sparse least squares (`surface.displace`). The coarse
    levels are swept again until the surface rests: a head far from the model's span takes several rounds. Where
    landmarks are biased, pose and expression of the timesteps follow the images too (`surface.align_timesteps`).
    """
    began = time.perf_counter()
    config = config or SurfaceConfig()
    views = [capture.camera(name) for name in cameras]
    pairs = list(combinations(range(len(views)), 2))
    world = geometry.vertices.astype(np.float64)
    if not pairs:
        return _unchanged(geometry, "one view: the surface stays in the model's span", began)
    resolution = Resolution.of(views, world[0].mean(axis=0), pairs)
    if resolution.parallax < NARROWEST:
        return _unchanged(geometry, "views from nearly one place: the surface stays in the model's span", began)
    levels = sweeps(resolution, config, capture.unit_mm)
    # Landmarks that agree with the fit say more of a face within the model's span than shading and sweeps do.
    beyond = landmarks_are_biased(geometry)
    tries = (TRIES if len(geometry.timesteps) == 1 else 1) * (config.refit and beyond)
    coarse, finest = levels[:-1], levels[-1:]
    spanned, over_lids = [*levels, *finest * FINEST_AGAIN], [(config.finest, CLOSED_LAYERS), *finest]
    total = (
        len(coarse) * ROUNDS
        + 1
        + SETTLING
        + (len(coarse) + len(spanned) + SHADING_ROUNDS) * tries
        + len(over_lids) * beyond
    )
    search = Search(capture, model, cameras, resolution, pairs, config, progress, total, beyond)
    last = search.descend(Reached.at(geometry), coarse)
    between: list[float] = []  # without and with it
    refit = False
    for seed in range(tries):
        fitted = fit_model(
            capture,
            model,
            last.geometry,
            cameras,
            # A head beyond the model's span has other outlines: they lead there, and what is matched has the last word.
            lambda world, sweep: search.planes(geometry.timesteps, world, *sweep, outlines=sweep in coarse),
            spanned,
            geometry_config or GeometryConfig(),
            seed,
            progress=search.advance,
            scenes=search.scenes,
        )
        other = search.descend(Reached.at(fitted), coarse)
        # Colours mislead where the albedo model doesn't explain them; through the truer surface views predict others.
        # What the finest sweep adds is small beside what parts the two, and dear.
        between = errors_between_views(capture, model, cameras, geometry.timesteps, [last.world, other.world])
        refit = between[1] < between[0]
        if refit:
            last = other
            break
    rounds = 1
    while coarse and rounds < ROUNDS:  # each round sees further, from where the last one has brought the surface
        before = last.world
        last, rounds = search.descend(Reached.at(last.estimate), coarse), rounds + 1
        step = np.linalg.norm(last.world - before, axis=2)[:, np.unique(model.faces[model.face_mask])]
        if float(np.sqrt(np.mean(step**2))) < RESTS * resolution.pixel / resolution.parallax:
            break
    last = search.descend(last, finest)
    again = 0
    while again < SETTLING and last.outcome is not Outcome.CONVERGED:
        last, again = search.descend(last, finest), again + 1
    openings = LIPS * config.close_lips + LIDS * config.close_lids
    found, closed = close_openings(capture, model, last.estimate, cameras, openings)
    lids = [set(closed[opening.name]["closed"]) for opening in LIDS if opening.name in closed]
    covering = beyond and any(seen == set(geometry.timesteps) for seen in lids)
    if covering:
        # Lids that have just met over the eyes lie where they fade into the skin around them: now they are measured.
        covered = Reached.at(behind_lids(model, found), last.stiffness)
        last = search.descend(covered, over_lids)
        found = close_again(model, last.estimate, closed, openings)
    search.finish()
    found, crossed = keep_walls(model, found)
    residuals = search.epipolar_residuals(found, found.vertices.astype(np.float64), config.finest)
    seconds = time.perf_counter() - began
    moved = np.linalg.norm(last.displacement, axis=1)[np.unique(model.faces[model.face_mask])] * model.unit_mm
    phase = {
        "name": "surface",
        "outcome": last.outcome.value,
        "moved_last_mm": last.moved * capture.unit_mm,
        "levels": [level for level, _ in (*coarse * rounds, *finest * (1 + again), *over_lids * covering)],
        "matched": last.matched,
        "rounds": rounds,
        "refitted": refit,
        "between_views": between,
        "stiffness": last.stiffness,
        "displacement_mm": float(np.sqrt(np.mean(moved**2))),
        "epipolar_pixels": residuals,
        "openings": closed,
        "walls_crossed": crossed,
        "seconds": seconds,
    }
    return replace(found, report=_extended(geometry.report, seconds, phase, epipolar_warnings(residuals)))


def _unchanged(geometry: GeometryEstimate, text: str, began: float) -> GeometryEstimate:
    """The input with a warning."""
    report = _extended(geometry.report, time.perf_counter() - began, {"name": "surface", "outcome": "left out"})
    warning = Diagnostic("surface-in-span", text)
    return replace(geometry, report=replace(report, warnings=(*report.warnings, warning)))


def _extended(report: Report, seconds: float, phase: dict, warnings: Sequence[Diagnostic] = ()) -> Report:
    """A report with one more phase."""
    details = {**report.details, "phases": [*report.details.get("phases", []), phase]}
    warnings = (*report.warnings, *warnings)
    return replace(report, seconds=report.seconds + seconds, details=details, warnings=warnings)


def epipolar_warnings(residuals: Mapping[str, float | None]) -> list[Diagnostic]:
    """What to say of views, such as ``"left, right"``, that show points off one another's epipolar lines."""
    return [
        Diagnostic(
            "views-disagree",
            f"cameras {names}: what they show lies {pixels:.1f} pixels off one another's epipolar lines, expected at "
            f"most {OFF_PIXELS:g}; the calibration is off, or the cameras aren't in step",
        )
        for names, pixels in residuals.items()
        if pixels is not None and pixels > OFF_PIXELS
    ]
