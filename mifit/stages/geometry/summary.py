"""Keeps the record of a fit and packs its result."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, Report
from mifit.morphable import MorphableModel
from mifit.optim import Outcome, Solution
from mifit.progress import Progress
from mifit.stages.geometry.landmarks import LandmarkTerm, LandmarkView
from mifit.stages.geometry.start import State, coordinate_deviation

FARTHEST_IDENTITY = 8.0  # standard deviations; heads beyond a model's span reach six, wrong cameras ten
SCATTER_OF_FACE, LEAST_SCATTER = 0.005, 1.1
"""Deviation of a landmark between images of one head, as a part of the face's width and at least in pixels; what
exceeds it is bias. Good detectors scatter by 0.3 per cent and about a pixel, and are off by one to four per cent."""
SCATTER_OF_WIDTH = 0.015  # deviation of landmarks from the fit, as part of the image's width, that deserves a warning


class Journal:
    """What happened, phase by phase; reports progress as phases end."""

    def __init__(self, label: str, total: int, progress: Progress) -> None:
        self.began = time.perf_counter()
        self.phases: list[dict] = []
        self.energies: dict[str, list[float]] = {}
        self.warnings: list[Diagnostic] = []
        self.last: Solution | None = None
        self._label, self._total, self._progress = label, total, progress
        progress(label, 0, total)

    def warn(self, message: Diagnostic) -> None:
        """Note something that a person should know."""
        if message not in self.warnings:
            self.warnings.append(message)

    def phase(self, name: str, solution: Solution, geometric: bool = True) -> None:
        """Enter the end of a phase; ``geometric`` if it moved shape and pose."""
        self.phases.append(
            {
                "name": name,
                "outcome": solution.outcome.value,
                "iterations": solution.iterations,
                "evaluations": solution.evaluations,
                "rejected": solution.rejected,
                "seconds": solution.seconds,
                "energies": {term: [float(e) for e in values] for term, values in solution.energies.items()},
            }
        )
        if solution.outcome is Outcome.MAX_ITERATIONS:
            text = f"the fit of {name} was stopped after {solution.iterations} iterations before it converged"
            self.warn(Diagnostic("not-converged", text, "note"))
        if geometric:
            self.last = solution
            self._extend(solution.energies)
        self._progress(self._label, min(len(self.phases), self._total), self._total)

    def _extend(self, energies: dict[str, list[float]]) -> None:
        """Continue the histories; a term that a phase doesn't have contributes 0 to its objective."""
        before = max((len(values) for values in self.energies.values()), default=0)
        added = len(next(iter(energies.values())))
        for name in {**self.energies, **energies}:
            self.energies.setdefault(name, [0.0] * before).extend(energies.get(name, [0.0] * added))


def pack(
    model: MorphableModel,
    state: State,
    appearance: NDArray,
    timesteps: tuple[int, ...],
    world: NDArray,
    journal: Journal,
    views: tuple[LandmarkView, ...],
    noise: float,
    fixed: GeometryEstimate | None,
) -> GeometryEstimate:
    """Turn a state into the stage's result.

    Parameters
    ----------
    appearance : (Ka + 28,)
        Albedo coefficients, shading, ambient.
    world : (T, V, 3)
    noise : float
        Standard deviation of a landmark coordinate that the fit used, pixels.
    fixed : GeometryEstimate, optional
        Where identity and albedo come from when they weren't fitted.
    """
    layout, x = state.layout, state.x
    poses = [state.frames.pose(layout, x, k) for k in range(len(timesteps))]
    albedo, shading, ambient = np.split(appearance, [model.n_albedo, model.n_albedo + 27])
    expression = np.stack([x[layout.at("expression", k)] for k in range(len(timesteps))])
    details = {
        "phases": journal.phases,
        "landmark_rms_pixels": _landmark_rms(state, views),
    }
    if journal.last is not None and journal.last.system is not None:
        details["standard_deviations"] = _deviations(state, journal.last)
    width = min((view.camera.width for view in views), default=np.inf)
    scatter = coordinate_deviation(state, views) if views else 0.0
    if scatter > SCATTER_OF_WIDTH * width:
        text = f"landmarks scatter by {scatter:.1f} pixels about the fitted face: check detector and calibration"
        journal.warn(Diagnostic("landmarks-scatter", text))
    identity = x[layout.at("identity")].copy() if fixed is None else fixed.identity
    if len(identity) and np.abs(identity).max() > FARTHEST_IDENTITY:
        text = (
            f"an identity coefficient is {np.abs(identity).max():.1f} standard deviations from the mean: the model "
            "may not span this face, or the calibration is off"
        )
        journal.warn(Diagnostic("identity-far", text))
    return GeometryEstimate(
        timesteps=timesteps,
        identity=identity,
        albedo=albedo.copy(),
        expression=expression,
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
        scale=poses[0].scale,
        vertices=world.astype(np.float32),
        vertex_albedo=model.albedo(albedo) if fixed is None else fixed.vertex_albedo,
        shading=shading.reshape(9, 3).copy(),
        ambient=float(ambient[0]),
        report=Report(
            journal.last.outcome.value if journal.last is not None else Outcome.MAX_ITERATIONS.value,
            journal.energies,
            time.perf_counter() - journal.began,
            tuple(journal.warnings),
            details,
        ),
        landmark_noise=noise,
        face_width=_face_width(model, world, views),
    )


def _face_width(model: MorphableModel, world: NDArray, views: tuple[LandmarkView, ...]) -> float:
    """Mean width of the face in the images, pixels, as a view from the front would have it; 0 without views."""
    found = []
    for view in views:
        ends = world[view.step][model.landmarks[[0, 16]]].astype(np.float64)
        depth = float(np.linalg.norm(ends.mean(axis=0) - view.camera.position))
        found.append(float(np.linalg.norm(ends[1] - ends[0])) * np.sqrt(view.camera.fx * view.camera.fy) / depth)
    return float(np.mean(found)) if found else 0.0


def _landmark_rms(state: State, views: tuple[LandmarkView, ...]) -> dict[str, float]:
    """Root-mean-square landmark distance in pixels per camera."""
    term = LandmarkTerm(views, np.inf)
    squares: dict[str, list[NDArray]] = {}
    for view in views:
        distance = term.distances(view, state.layout, state.frames, state.x)
        squares.setdefault(view.camera.name, []).append((distance**2).sum(1))
    return {name: float(np.sqrt(np.mean(np.concatenate(values)))) for name, values in squares.items()}


def _deviations(state: State, solution: Solution) -> dict[str, list]:
    """Standard deviations of pose and shape from the inverse curvature; None where the data leave them open."""
    assert solution.system is not None
    layout = state.layout
    variance = solution.system.covariance_diagonal()
    deviation = np.sqrt(np.maximum(variance, 0.0))

    def listed(values: NDArray) -> list:
        return [float(v) if np.isfinite(v) else None for v in values]

    steps = range(layout.timesteps)
    return {
        "identity": listed(deviation[layout.at("identity")]),
        "expression": [listed(deviation[layout.at("expression", k)]) for k in steps],
        "rotation_degrees": [listed(np.degrees(deviation[layout.at("rotation", k)])) for k in steps],
        "translation": [listed(deviation[layout.at("translation", k)]) for k in steps],
    }


def scatter_pixels(geometry: GeometryEstimate) -> float:
    """Deviation of a landmark coordinate that a good detector has between images of this face, pixels."""
    return max(LEAST_SCATTER, SCATTER_OF_FACE * geometry.face_width)


def landmarks_are_biased(geometry: GeometryEstimate) -> bool:
    """Whether the landmarks lie farther from the fit than a good detector scatters."""
    return geometry.landmark_noise > scatter_pixels(geometry)
