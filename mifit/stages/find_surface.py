"""Stage 1b: the surface beyond the model's span, where the images of all views and timesteps together ask for it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import SurfaceConfig
from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import normalize
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.progress import Progress, silent
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.surface.displace import Plate, solve_displacement
from mifit.stages.surface.sweep import sweep
from mifit.stages.surface.views import Resolution, pose_texels, texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

STEP_PIXELS = 0.7
"""Parallax between neighbouring offsets of a sweep, pixels of the level."""
WINDOW = 11
"""Side of the windows that are compared, texels; a texel is about a pixel of the level."""
COARSEST = 3
"""Times that the images are halved at most."""
LARGEST_MAP = 1024
HALF_LAYERS = 6
"""Offsets to either side in a level's first sweep."""
ROBUST_STEPS = 0.7
"""Distance from the fitted surface, in steps of the sweep, where an offset counts as an outlier."""
FORGET_MM = 150.0
"""Wavelength above which displacements fall back to the model where nothing is measured."""
CONTACT_MM = 1.5
"""Gap below which opposed parts of the surface, such as closed lips, move together."""
THIN = 2
START, STIFFEST = 20.0, 5000.0
"""Stiffness at the start, and the largest."""
NARROWEST = 0.03
"""Least parallax; below it, about 2 degrees between the views, depth isn't measured."""


def find_surface(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: SurfaceConfig | None = None,
    progress: Progress = silent,
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

    Returns
    -------
    GeometryEstimate
        With ``displacement``, one for all timesteps, and the vertices that follow it. With fewer than two views, or
        views from nearly one place, ``geometry`` with a warning.

    Notes
    -----
    Coarse to fine: at every level the texels of the current surface are moved along their normals to where the views
    agree best (`surface.sweep`), and the mesh follows by sparse least squares (`surface.displace`).
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
    neutral = model.shape(geometry.identity).astype(np.float64)
    plate = Plate.of(neutral, model.faces, FORGET_MM / model.unit_mm, CONTACT_MM / model.unit_mm)
    scene = SurfaceScene(world[0], model.faces)
    displacement = np.zeros_like(neutral)
    stiffness = START
    levels = sweeps(resolution, config, capture.unit_mm)
    matched = 0.0
    for number, (level, half) in enumerate(levels):
        progress("find surface", number, len(levels))
        pixel = resolution.pixel * 2.0**level
        texels = rasterize_uv(
            model.uv, model.faces_uv, texture_size(model, world[0], pixel, LARGEST_MAP), model.face_mask
        )
        posed = []
        for vertices, timestep in zip(world, geometry.timesteps, strict=True):
            scene.update(vertices)
            posed.append(pose_texels(capture, scene, vertices, model.faces, texels, cameras, timestep, 0.5**level))
        step = STEP_PIXELS * pixel / resolution.parallax
        found = sweep(texels, posed, step * np.arange(-half, half + 1), WINDOW, pairs)
        matched = float((found.precision > 0).mean())
        objects = [p.normal @ rotation for p, rotation in zip(posed, geometry.rotation, strict=True)]
        some = thinned(texels)
        solved = solve_displacement(
            plate,
            corner_matrix(model.faces, texels.face[some], texels.weights[some], len(neutral)),
            normalize(np.mean(objects, axis=0))[some],
            found.offset[some] / geometry.scale,
            found.precision[some] * (THIN * geometry.scale) ** 2,
            displacement,
            stiffness,
            ROBUST_STEPS * step / geometry.scale,
        )
        displacement = solved.displacement
        stiffness = solved.likely_stiffness(config.stiffness, STIFFEST)
        world = geometry.vertices + geometry.scale * displacement @ geometry.rotation.transpose(0, 2, 1)
    progress("find surface", len(levels), len(levels))
    seconds = time.perf_counter() - began
    moved = np.linalg.norm(displacement, axis=1)[np.unique(model.faces[model.face_mask])] * model.unit_mm
    phase = {
        "name": "surface",
        "outcome": "converged",
        "levels": [level for level, _ in levels],
        "matched": matched,
        "stiffness": stiffness,
        "displacement_mm": float(np.sqrt(np.mean(moved**2))),
        "seconds": seconds,
    }
    return replace(
        geometry,
        vertices=world.astype(np.float32),
        displacement=displacement.astype(np.float32),
        report=_extended(geometry.report, seconds, phase),
    )


def thinned(texels: TexelMap) -> NDArray[np.intp]:
    """Every `THIN`-th texel along rows and columns: windows overlap, so that nothing is lost."""
    row, column = np.divmod(texels.index, texels.size)
    return np.flatnonzero((row % THIN == 0) & (column % THIN == 0))


def sweeps(resolution: Resolution, config: SurfaceConfig, unit_mm: float) -> list[tuple[int, int]]:
    """Level and half the number of offsets of each sweep: as coarse as the reach needs, then finer.

    A level is the number of times that the images are halved.
    """
    finest = config.finest
    step_mm = STEP_PIXELS * resolution.pixel / resolution.parallax * unit_mm
    first = finest
    while first < max(COARSEST, finest) and HALF_LAYERS * step_mm * 2**first < config.reach:
        first += 1
    return [(first, HALF_LAYERS), *((level, 4) for level in range(first, finest - 1, -1))]


def _unchanged(geometry: GeometryEstimate, warning: str, began: float) -> GeometryEstimate:
    """The input with a warning."""
    report = _extended(geometry.report, time.perf_counter() - began, {"name": "surface", "outcome": "left out"})
    return replace(geometry, report=replace(report, warnings=(*report.warnings, warning)))


def _extended(report: Report, seconds: float, phase: dict) -> Report:
    """A report with one more phase."""
    details = {**report.details, "phases": [*report.details.get("phases", []), phase]}
    return replace(report, seconds=report.seconds + seconds, details=details)
