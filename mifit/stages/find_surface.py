"""Stage 1b: the surface beyond the model's span, where the images of all views and timesteps together ask for it."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import GeometryConfig, SurfaceConfig
from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import normalize, vertex_normals
from mifit.core.threads import one_blas_thread
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.progress import Progress, silent
from mifit.solve import Outcome
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.geometry.scenes import Scenes
from mifit.stages.surface.close_openings import LIDS, LIPS, close_openings
from mifit.stages.surface.displace import USUAL, Plate, solve_displacement
from mifit.stages.surface.epipolar import epipolar_residual
from mifit.stages.surface.local_planes import MeasuredPlanes, touching_planes
from mifit.stages.surface.model_fit import SHADING_ROUNDS, fit_model, landmarks_are_biased
from mifit.stages.surface.outline import Borders, find_borders, joined
from mifit.stages.surface.prediction_between_views import errors_between_views
from mifit.stages.surface.sweep import Found, Posed, sweep
from mifit.stages.surface.thin_walls import keep_walls
from mifit.stages.surface.views import Resolution, pose_texels, texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

SLACK = 0.01
"""Pixels that the surface may move by before what rays meet is built anew."""
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
SETTLED = 0.25
"""Part of the last sweep's step below which the surface counts as settled."""
SETTLING = 2
"""Further sweeps at the finest level, at the most, until it has."""
THIN = 2
STIFFEST = 5000.0
"""Largest stiffness."""
FINEST_AGAIN = 2
"""Further sweeps at the finest level while the model alone moves."""
OFF_PIXELS = 1.0
"""Median distance from epipolar lines that deserves a warning."""
NARROWEST = 0.03
"""Least parallax; below it, about 2 degrees between the views, depth isn't measured."""


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
    levels = sweeps(resolution, config, capture.unit_mm)
    # Landmarks that agree with the fit say more of a face within the model's span than shading and sweeps do.
    beyond = landmarks_are_biased(geometry)
    refit = config.refit and beyond
    spanned = [*levels, *[levels[-1]] * FINEST_AGAIN] if refit else []
    coarse, finest = levels[:-1], levels[-1:]
    total = len(levels) + SETTLING + (len(coarse) + len(spanned) + SHADING_ROUNDS) * refit
    search = _Search(capture, model, cameras, resolution, pairs, config, progress, total, beyond)
    last = search.descend(geometry, coarse)
    between: list[float] = []  # without and with it
    if refit:
        fitted = fit_model(
            capture,
            model,
            geometry,
            cameras,
            lambda world, sweep: search.planes(geometry.timesteps, world, *sweep),
            spanned,
            geometry_config or GeometryConfig(),
            progress=search.advance,
            scenes=search.scenes,
        )
        other = search.descend(fitted, coarse)
        # Colours mislead where the albedo model doesn't explain them; through the truer surface views predict others.
        # What the finest sweep adds is small beside what parts the two, and dear.
        between = errors_between_views(
            capture, model, cameras, geometry.timesteps, [last.world, other.world], geometry.gains
        )
        refit = between[1] < between[0]
        geometry, last = (fitted, other) if refit else (geometry, last)
    last = search.descend(geometry, finest, last)
    again = 0
    while again < SETTLING and last.outcome is not Outcome.CONVERGED:
        last, again = search.descend(geometry, finest, last), again + 1
    search.finish()
    found = replace(geometry, vertices=last.world.astype(np.float32), displacement=last.displacement.astype(np.float32))
    openings = LIPS * config.close_lips + LIDS * config.close_lids
    found, closed = close_openings(capture, model, found, cameras, openings)
    found, crossed = keep_walls(model, found)
    residuals = search.epipolar_residuals(found, found.vertices.astype(np.float64), config.finest)
    seconds = time.perf_counter() - began
    moved = np.linalg.norm(last.displacement, axis=1)[np.unique(model.faces[model.face_mask])] * model.unit_mm
    phase = {
        "name": "surface",
        "outcome": last.outcome.value,
        "moved_last_mm": last.moved * capture.unit_mm,
        "levels": [level for level, _ in (*levels, *finest * again)],
        "matched": last.matched,
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


@dataclass(frozen=True)
class _Descent:
    """Where a run of sweeps ended."""

    displacement: NDArray[np.float64]
    world: NDArray[np.float64]
    stiffness: float
    matched: float
    moved: float
    """Root mean square of what the last sweep moved the measured texels by along their normals, world length."""
    outcome: Outcome

    @classmethod
    def before(cls, geometry: GeometryEstimate) -> _Descent:
        """Nothing displaced yet."""
        world = geometry.vertices.astype(np.float64)
        return cls(np.zeros_like(world[0]), world, USUAL, 0.0, np.inf, Outcome.MAX_ITERATIONS)


@dataclass(frozen=True)
class _Swept:
    """What one sweep saw and found.

    Attributes
    ----------
    texels : TexelMap
    posed, borders : list
        Views of the texels, and outlines of the surface in them, per timestep.
    found : Found
    step : float
        Between offsets, world length.
    """

    texels: TexelMap
    posed: list[Posed]
    borders: list[Borders]
    found: Found
    step: float


class _Search:
    """Sweeps, coarse to fine, from a fit of the model."""

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        cameras: Sequence[str],
        resolution: Resolution,
        pairs: Sequence[tuple[int, int]],
        config: SurfaceConfig,
        progress: Progress,
        total: int,
        beyond: bool,
    ) -> None:
        self._beyond = beyond
        self._capture, self._model, self._cameras, self._pairs = capture, model, cameras, pairs
        self._resolution, self._config, self._progress = resolution, config, progress
        self._done, self._total = 0, total
        self.scenes = Scenes(model.faces, np.unique(model.faces[model.face_mask]), SLACK * resolution.pixel)
        progress("find surface", 0, total)

    def finish(self) -> None:
        """All steps are done, or were not needed."""
        self._progress("find surface", self._total, self._total)

    def advance(self) -> None:
        """One more step is done."""
        self._done += 1
        self._progress("find surface", self._done, self._total)

    def _sweep(self, timesteps: Sequence[int], world: NDArray, level: int, half: int, outlined: bool) -> _Swept:
        """One sweep of a surface (T, V, 3), with its outlines if asked for."""
        model = self._model
        pixel = self._resolution.pixel * 2.0**level
        size = texture_size(model, world[0], pixel, LARGEST_MAP)
        texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
        posed, borders, factor = [], [], 0.5**level
        finer = min(2.0 * factor, 1.0)  # where the image mixes skin and background in a pixel the border is doubtful
        for vertices, timestep in zip(world, timesteps, strict=True):
            scene = self.scenes.at(timestep, vertices)
            posed.append(
                pose_texels(self._capture, scene, vertices, model.faces, texels, self._cameras, timestep, factor)
            )
            seen_by = self._cameras if outlined else ()
            borders.append(joined([find_borders(self._capture, scene, c, timestep, finer) for c in seen_by]))
        step = STEP_PIXELS * pixel / self._resolution.parallax
        found = sweep(texels, posed, step * np.arange(-half, half + 1), WINDOW, self._pairs)
        return _Swept(texels, posed, borders, found, step)

    def planes(
        self, timesteps: Sequence[int], world: NDArray, level: int, half: int
    ) -> tuple[list[MeasuredPlanes], float]:
        """Planes that touch what a sweep finds, per timestep, which share its precision, and the sweep's step."""
        swept = self._sweep(timesteps, world, level, half, outlined=False)
        shared = replace(swept.found, precision=swept.found.precision / len(swept.posed))
        return [touching_planes(swept.texels, one, shared) for one in swept.posed], swept.step

    def descend(
        self, geometry: GeometryEstimate, levels: Sequence[tuple[int, int]], last: _Descent | None = None
    ) -> _Descent:
        """Displace a fitted model's surface; levels as of `sweeps`. Goes on from ``last``."""
        model, scale = self._model, float(geometry.scale)
        neutral = model.shape(geometry.identity).astype(np.float64)
        # A head that the model spans is as symmetric as its modes make it.
        halves = model.symmetry if self._beyond else None
        plate = Plate.of(neutral, model.faces, FORGET_MM / model.unit_mm, CONTACT_MM / model.unit_mm, symmetry=halves)
        last = last or _Descent.before(geometry)
        world, displacement, stiffness = last.world, last.displacement, last.stiffness
        matched, moved, step = 0.0, 0.0, 0.0
        for level, half in levels:
            swept = self._sweep(geometry.timesteps, world, level, half, outlined=True)
            texels, found, step = swept.texels, swept.found, swept.step
            matched = float((found.precision > 0).mean())
            objects = [p.normal @ rotation for p, rotation in zip(swept.posed, geometry.rotation, strict=True)]
            some, outline = thinned(texels), joined(swept.borders)
            turned = [b.normal @ rotation for b, rotation in zip(swept.borders, geometry.rotation, strict=True)]
            face = np.concatenate([texels.face[some], outline.face])
            weights = np.concatenate([texels.weights[some], outline.weights])
            solved = solve_displacement(
                plate,
                corner_matrix(model.faces, face, weights, len(neutral)),
                np.concatenate([normalize(np.mean(objects, axis=0))[some], *turned]),
                np.concatenate([found.offset[some], outline.offset]) / scale,
                np.concatenate([found.precision[some] * THIN**2, outline.precision]) * scale**2,
                displacement,
                stiffness,
                ROBUST_STEPS * step / scale,
            )
            change = scale * solved.displacement - scale * displacement
            displacement = solved.displacement
            stiffness = solved.likely_stiffness(self._config.stiffness, STIFFEST)
            world = geometry.vertices + scale * displacement @ geometry.rotation.transpose(0, 2, 1)
            measured = np.flatnonzero(found.precision > 0)
            along = np.einsum(
                "tvc,tvc->tv", change @ geometry.rotation.transpose(0, 2, 1), _normals(world, model.faces)
            )
            seen = np.unique(model.faces[texels.face[measured]])
            moved = float(np.sqrt(np.mean(along[:, seen] ** 2))) if len(seen) else 0.0
            self.advance()
        # A sweep tells offsets to a part of its step: where the last one moved the surface by less, it has settled.
        outcome = Outcome.CONVERGED if moved < SETTLED * step else Outcome.MAX_ITERATIONS
        return _Descent(displacement, world, stiffness, matched, moved, outcome)

    def epipolar_residuals(self, geometry: GeometryEstimate, world: NDArray, level: int) -> dict[str, float | None]:
        """Median distance from one another's epipolar lines for each pair of views, pixels of the images."""
        model = self._model
        pixel = self._resolution.pixel * 2.0**level
        texels = rasterize_uv(
            model.uv, model.faces_uv, texture_size(model, world[0], pixel, LARGEST_MAP), model.face_mask
        )
        views = [self._capture.camera(name) for name in self._cameras]
        some = sorted({0, len(world) - 1})  # two timesteps tell what all would
        posed = [
            pose_texels(
                self._capture,
                self.scenes.at(geometry.timesteps[k], world[k]),
                world[k],
                model.faces,
                texels,
                self._cameras,
                geometry.timesteps[k],
                0.5**level,
            )
            for k in some
        ]
        found: dict[str, float | None] = {}
        for a, b in self._pairs:
            residual = epipolar_residual(texels, posed, views, (a, b), pixel, WINDOW)
            found[f"{self._cameras[a]}, {self._cameras[b]}"] = None if residual is None else residual * 2.0**level
        return found


def _normals(world: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(T, V, 3) unit normals of the vertices of each timestep."""
    return np.stack([vertex_normals(vertices, faces) for vertices in world])


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


def _extended(report: Report, seconds: float, phase: dict, warnings: Sequence[str] = ()) -> Report:
    """A report with one more phase."""
    details = {**report.details, "phases": [*report.details.get("phases", []), phase]}
    warnings = (*report.warnings, *warnings)
    return replace(report, seconds=report.seconds + seconds, details=details, warnings=warnings)


def epipolar_warnings(residuals: Mapping[str, float | None]) -> list[str]:
    """What to say of views, such as ``"left, right"``, that show points off one another's epipolar lines."""
    return [
        f"cameras {names}: what they show lies {pixels:.1f} pixels off one another's epipolar lines; the calibration "
        "is off, or the cameras aren't in step"
        for names, pixels in residuals.items()
        if pixels is not None and pixels > OFF_PIXELS
    ]
