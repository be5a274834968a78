"""Stage 1: fit the morphable model to all views and timesteps (paper, section 4)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mifit.capture import Capture
from mifit.config import GeometryConfig
from mifit.core.estimate import GeometryEstimate, Report
from mifit.errors import ConvergenceError, InputError
from mifit.morphable import MorphableModel
from mifit.progress import Progress, silent
from mifit.solve import Outcome, Solution, minimize
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.landmarks import LandmarkTerm, LandmarkView
from mifit.stages.geometry.parameters import Layout
from mifit.stages.geometry.rendering import AMBIENT_PRIOR, WHITE, RenderingProblem
from mifit.stages.geometry.start import (
    OUTLIER_PIXELS,
    State,
    bounds,
    fit_landmarks,
    initial_state,
    landmark_views,
)
from mifit.stages.geometry.visibility import Visibility, spread_points


def fit_geometry(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    config: GeometryConfig,
    seed: int = 0,
    progress: Progress = silent,
) -> GeometryEstimate:
    """Fit identity, albedo, expression, pose, lighting and ambient to the images of a face.

    Parameters
    ----------
    capture : Capture
        Images with landmarks and calibrated (or estimated) cameras.
    model : MorphableModel
    cameras : sequence of str
        One view, two or more; no other camera is read.
    timesteps : sequence of int
        Fitted jointly: identity, albedo and lighting are shared, expression and pose are each timestep's own.
    config : GeometryConfig
    seed : int
        Seed of the choice of surface points and pixels.
    progress : Progress

    Returns
    -------
    GeometryEstimate
        ``report.details`` holds standard deviations of pose and shape, from the curvature at the solution.

    Raises
    ------
    InputError
        No camera or timestep, or a timestep with fewer than six visible landmarks.
    ConvergenceError
        No usable fit.

    Notes
    -----
    Gauge: the scale is ``model.unit_mm / capture.unit_mm`` and isn't estimated, so distance is; the albedo's level
    is the model's mean's, so the lighting's is estimated; ambient is held towards 0 against the constant harmonic.
    """
    began = time.perf_counter()
    cameras, timesteps = tuple(cameras), tuple(timesteps)
    if not cameras or not timesteps:
        raise InputError("fit_geometry: found no camera or no timestep, expected at least one of each")
    steps = 3 + config.texture_rounds
    progress("fit geometry", 0, steps)
    layout = Layout(len(timesteps), model.identity.shape[2], model.expression.shape[2])
    views = landmark_views(capture, model, cameras, timesteps, config.landmark_noise)
    state = initial_state(model, views, len(timesteps), layout, model.unit_mm / capture.unit_mm)
    state, solution, views = fit_landmarks(model, views, state, config.landmark_noise)
    _check(solution, "landmarks")
    energies = {name: list(values) for name, values in solution.energies.items()}
    progress("fit geometry", 1, steps)

    visibility = Visibility(capture, model, cameras, timesteps)
    points = spread_points(model, config.surface_points, seed)
    for number in range(config.texture_rounds):
        state, solution = _refine_by_texture(model, state, views, visibility, points, config)
        _check(solution, "texture")
        progress("fit geometry", 2 + number, steps)
        _append(energies, solution)

    appearance, lit = _fit_appearance(model, state, views, visibility, config, seed)
    _check(appearance, "albedo and lighting")
    _append(energies, appearance)
    progress("fit geometry", steps, steps)
    return _estimate(model, lit, timesteps, visibility, solution, energies, time.perf_counter() - began)


def _check(solution: Solution, what: str) -> None:
    """Raise ConvergenceError unless the solution can be used."""
    if not solution.usable or not np.isfinite(solution.value).all():
        raise ConvergenceError(
            f"fit geometry: the fit of {what} ended as '{solution.outcome.value}' after {solution.iterations} "
            "iterations; check the landmarks and the calibration of the cameras"
        )


def _append(energies: dict[str, list[float]], solution: Solution) -> None:
    """Continue the history; a term that a phase doesn't have is NaN-free: it keeps its last value."""
    length = max((len(values) for values in energies.values()), default=0)
    added = len(next(iter(solution.energies.values())))
    for name in set(energies) | set(solution.energies):
        before = energies.setdefault(name, [0.0] * length)
        before.extend(solution.energies.get(name, [before[-1]] * added))


def _refine_by_texture(
    model: MorphableModel,
    state: State,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    points: object,
    config: GeometryConfig,
) -> tuple[State, Solution]:
    """One outer step: visibility, noise level, then Levenberg-Marquardt on texture, landmarks and priors."""
    state = state.recentred()
    layout = state.layout
    seen = visibility.textures(state, points, config.texture_sigma, config.texture_window)
    term = LandmarkTerm(views, OUTLIER_PIXELS * config.landmark_noise)
    problem = ConsistencyProblem(
        layout, state.frames, config.surface_points, seen, 1.0, 3.0, config.texture_weight, term, 1.0, 1.0
    )
    problem = replace(problem, noise=problem.spread(state.x))
    low, high = bounds(layout, model.expression_bounds)
    solution = minimize(
        problem, state.x, lower=low, upper=high, max_iterations=config.max_iterations, energy_tolerance=1e-4
    )
    return replace(state, x=solution.value), solution


def _fit_appearance(
    model: MorphableModel,
    state: State,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    config: GeometryConfig,
    seed: int,
) -> tuple[Solution, State]:
    """Albedo coefficients, lighting and ambient with the geometry held: the paper's term, robust."""
    layout = replace(state.layout, albedo=model.albedo_modes.shape[2], shading=27, ambient=1)
    lit = state.with_layout(layout).recentred()
    lit.x[layout.at("shading").start : layout.at("shading").start + 3] = 1.0
    pixels = visibility.pixels(lit, config.pixels, 1.0, seed)
    priors = {"albedo": config.albedo_prior, "ambient": WHITE**2 * AMBIENT_PRIOR, "shading": 1e-3}
    problem = RenderingProblem(
        model, layout, lit.frames, pixels, LandmarkTerm(views, 1.0), config.robust_colour, priors, geometry=False
    )
    low, high = np.where(np.arange(layout.size) < layout.shared_size, -np.inf, lit.x), None
    high = np.where(np.arange(layout.size) < layout.shared_size, np.inf, lit.x)
    at = layout.at("identity")
    low[at], high[at] = lit.x[at], lit.x[at]
    solution = minimize(
        problem, lit.x, lower=low, upper=high, max_iterations=config.max_iterations, energy_tolerance=1e-4
    )
    return solution, replace(lit, x=solution.value)


def _estimate(
    model: MorphableModel,
    state: State,
    timesteps: tuple[int, ...],
    visibility: Visibility,
    solution: Solution,
    energies: dict[str, list[float]],
    seconds: float,
) -> GeometryEstimate:
    """Pack the result."""
    layout, x = state.layout, state.x
    poses = [state.frames.pose(layout, x, k) for k in range(len(timesteps))]
    warnings = []
    if solution.outcome is Outcome.MAX_ITERATIONS:
        warnings.append(f"stopped after {solution.iterations} iterations before converging")
    modes = model.albedo_modes
    albedo = model.mean_albedo + (
        modes.reshape(-1, modes.shape[2]) @ x[layout.at("albedo")].astype(modes.dtype)
    ).reshape(-1, 3)
    return GeometryEstimate(
        timesteps=timesteps,
        identity=x[layout.at("identity")].copy(),
        albedo=x[layout.at("albedo")].copy(),
        expression=np.stack([x[layout.at("expression", k)] for k in range(len(timesteps))]),
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
        scale=poses[0].scale,
        vertices=visibility.world(state).astype(np.float32),
        vertex_albedo=albedo.astype(np.float32),
        shading=x[layout.at("shading")].reshape(9, 3).copy(),
        ambient=float(x[layout.at("ambient")][0]),
        report=Report(solution.outcome.value, energies, seconds, tuple(warnings)),
    )
