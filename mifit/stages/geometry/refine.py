"""Outer steps of the photometric fits: visibility and noise level anew, then one minimisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.config import GeometryConfig
from mifit.core.estimate import GeometryEstimate
from mifit.morphable import MorphableModel
from mifit.optim import Solution, minimize
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.displaced import displaced
from mifit.stages.geometry.landmarks import LandmarkTerm, LandmarkView
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.rendering import AMBIENT_PRIOR, WHITE, RenderingProblem
from mifit.stages.geometry.start import OUTLIER_PIXELS, State, bounds
from mifit.stages.geometry.visibility import SurfacePoints, Visibility, spread_points

ROBUST_DEVIATIONS = 3.0
ENERGY_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Reference:
    """Log-texture of surface points as timesteps already fitted show it.

    Attributes
    ----------
    face : (N,) int, weights : (N, 3)
        The points.
    values : (N, 3)
        Their log-texture.
    confidence : (N,)
        Sum of the views' weights behind each value; 0 where never seen.
    """

    face: NDArray
    weights: NDArray
    values: NDArray
    confidence: NDArray

    def points(self, model: MorphableModel) -> SurfacePoints:
        """The surface points with their basis in a model of the same mesh."""
        return SurfacePoints(self.face, self.weights, PointBasis.on_faces(model, self.face, self.weights))


def priors_of(config: GeometryConfig) -> dict[str, float]:
    """Weights of the squared unknowns where every term is in units of its noise: coefficients have deviation 1."""
    priors = {"identity": 1.0, "expression": 1.0}
    return priors if config.scale_deviation == 0.0 else {**priors, "log_scale": config.scale_deviation**-2}


def texture_reference(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: GeometryConfig,
    seed: int = 0,
) -> Reference:
    """Collect the log-texture of a fitted face, for `fit_pose_expression` of further timesteps.

    Parameters
    ----------
    capture, model, cameras, config, seed
        As given to `fit_geometry`.
    geometry : GeometryEstimate
        Its result.
    """
    model = displaced(model, geometry)
    state = joint_state(model, geometry)
    points = spread_points(model, config.surface_points, seed)
    visibility = Visibility(capture, model, cameras, geometry.timesteps)
    views = visibility.textures(state, points, config.texture_sigma, config.texture_window)
    problem = ConsistencyProblem(
        state.layout, state.frames, len(points.face), views, 1.0, np.inf, 1.0, LandmarkTerm((), np.inf), {}
    )
    problem = replace(problem, noise=problem.spread(state.x), robust=ROBUST_DEVIATIONS)
    values, confidence = problem.texture(state.x)
    return Reference(points.face, points.weights, values, confidence)


def joint_state(model: MorphableModel, geometry: GeometryEstimate) -> State:
    """The unknowns at a result: identity, and expression and pose of every timestep."""
    steps = len(geometry.timesteps)
    layout = Layout(steps, model.n_identity, model.n_expression)
    x = np.zeros(layout.size)
    x[layout.at("identity")] = geometry.identity
    for k in range(steps):
        x[layout.at("expression", k)] = geometry.expression[k]
        x[layout.at("translation", k)] = geometry.translation[k]
    return State(layout, Frames(geometry.rotation, geometry.scale), x)


def refine_by_texture(
    model: MorphableModel,
    state: State,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    points: SurfacePoints,
    config: GeometryConfig,
    reference: Reference | None = None,
) -> tuple[State, Solution]:
    """One outer step of the fit by consistency."""
    state = state.recentred()
    problem = texture_problem(state, views, visibility, points, config, reference)
    low, high = bounds(state.layout, model.expression_bounds)
    solution = minimize(
        problem,
        state.x,
        lower=low,
        upper=high,
        max_iterations=config.max_iterations,
        energy_tolerance=ENERGY_TOLERANCE,
    )
    return replace(state, x=solution.value), solution


def texture_problem(
    state: State,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    points: SurfacePoints,
    config: GeometryConfig,
    reference: Reference | None = None,
) -> ConsistencyProblem:
    """Consistency, landmarks and priors with visibility and noise as they are at a state."""
    problem = ConsistencyProblem(
        state.layout,
        state.frames,
        len(points.face),
        visibility.textures(state, points, config.texture_sigma, config.texture_window),
        noise=1.0,
        robust=np.inf,
        independence=config.texture_weight,
        landmarks=LandmarkTerm(views, OUTLIER_PIXELS * config.landmark_noise),
        priors=priors_of(config),
        known=None if reference is None else (reference.values, reference.confidence),
    )
    return replace(problem, noise=problem.spread(state.x), robust=ROBUST_DEVIATIONS)


def refine_by_rendering(
    model: MorphableModel,
    state: State,
    appearance: NDArray,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    config: GeometryConfig,
    seed: int,
) -> tuple[State, Solution, NDArray]:
    """One outer step of the paper's objective, all unknowns together.

    Parameters
    ----------
    appearance : (Ka + 28,)
        Albedo coefficients, shading and ambient to start from.

    Returns
    -------
    state (geometry alone), solution, appearance
    """
    problem, start = paper_problem(model, state, appearance, views, visibility, config, seed)
    layout = problem.layout
    low, high = bounds(layout, model.expression_bounds)
    solution = minimize(
        problem,
        start,
        lower=low,
        upper=high,
        max_iterations=config.max_iterations,
        energy_tolerance=ENERGY_TOLERANCE,
    )
    full = State(layout, problem.frames, solution.value)
    at = layout.at
    appearance = np.concatenate([solution.value[at(name)] for name in ("albedo", "shading", "ambient")])
    return full.with_layout(state.layout), solution, appearance


def paper_problem(
    model: MorphableModel,
    state: State,
    appearance: NDArray,
    views: tuple[LandmarkView, ...],
    visibility: Visibility,
    config: GeometryConfig,
    seed: int,
) -> tuple[RenderingProblem, NDArray]:
    """The paper's objective at the current visibility, and the flat vector to start from."""
    layout = replace(state.layout, albedo=model.n_albedo, shading=27, ambient=1)
    full = state.with_layout(layout).recentred()
    x = full.x
    albedo, shading, ambient = np.split(appearance, [model.n_albedo, model.n_albedo + 27])
    x[layout.at("albedo")], x[layout.at("shading")], x[layout.at("ambient")] = albedo, shading, ambient
    # w_l / |F_view| per view
    weighted = tuple(replace(view, weight=config.landmark_weight / max(len(view.index), 1)) for view in views)
    priors = {name: config.prior_weight for name in ("identity", "albedo", "expression")}
    if not config.as_written:
        priors["ambient"] = AMBIENT_PRIOR * WHITE**2
    if layout.log_scale:
        priors["log_scale"] = priors_of(config)["log_scale"]
    blur, robust_pixels, robust_colour = (
        config.texture_sigma,
        OUTLIER_PIXELS * config.landmark_noise,
        config.robust_colour,
    )
    if config.as_written:
        blur, robust_pixels, robust_colour = 0.0, np.inf, np.inf
    pixels = visibility.pixels(full, config.pixels, blur, seed)
    term = LandmarkTerm(weighted, robust_pixels)
    return RenderingProblem(model, layout, full.frames, pixels, term, robust_colour, priors), x
