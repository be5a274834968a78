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
from mifit.stages.geometry.landmarks import LandmarkView, State, contradicts, coordinate_deviation, world_vertices

FARTHEST_IDENTITY = 8.0  # standard deviations; heads beyond a model's span reach six, wrong cameras ten


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
    journal: Journal,
    views: tuple[LandmarkView, ...],
    noise: float,
) -> GeometryEstimate:
    """Turn a state into the stage's result.

    Parameters
    ----------
    appearance : (Ka + 28,)
        Albedo coefficients, shading, ambient.
    noise : float
        Standard deviation of a landmark coordinate that the fit used, pixels.
    """
    layout, x, poses = state.layout, state.x, state.poses
    albedo, shading, ambient = np.split(appearance, [model.n_albedo, model.n_albedo + 27])
    expression = np.stack([x[layout.at("expression", k)] for k in range(len(timesteps))])
    if contradicts(state, views):
        scatter = coordinate_deviation(state, views)
        text = f"landmarks scatter by {scatter:.1f} pixels about the fitted face: check detector and calibration"
        journal.warn(Diagnostic("landmarks-scatter", text))
    identity = x[layout.at("identity")].copy()
    if len(identity) and np.abs(identity).max() > FARTHEST_IDENTITY:
        far = f"an identity coefficient is {np.abs(identity).max():.1f} standard deviations from the mean"
        text = f"{far}: the model may not span this face, or the calibration is off"
        journal.warn(Diagnostic("identity-far", text))
    return GeometryEstimate(
        timesteps=timesteps,
        identity=identity,
        albedo=albedo.copy(),
        expression=expression,
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
        scale=poses[0].scale,
        vertices=world_vertices(model, state).astype(np.float32),
        vertex_albedo=model.albedo(albedo),
        shading=shading.reshape(9, 3).copy(),
        ambient=float(ambient[0]),
        report=Report(
            journal.last.outcome.value if journal.last is not None else Outcome.MAX_ITERATIONS.value,
            journal.energies,
            time.perf_counter() - journal.began,
            tuple(journal.warnings),
            {"phases": journal.phases},
        ),
        landmark_noise=noise,
    )
