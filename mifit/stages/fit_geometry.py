"""Stage 1: fit the morphable model to all views and timesteps (paper, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.config import GeometryConfig
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.core.process import one_blas_thread
from mifit.errors import ConvergenceError, InputError
from mifit.morphable import MorphableModel
from mifit.optim import Solution
from mifit.progress import Progress, silent
from mifit.stages.geometry.appearance import fit_appearance, gather
from mifit.stages.geometry.displaced import displaced
from mifit.stages.geometry.landmarks import LandmarkView
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.refine import Reference, priors_of, refine_by_rendering, refine_by_texture, texture_reference
from mifit.stages.geometry.start import FEWEST_LANDMARKS, State, fit_landmarks, initial_state, landmark_views
from mifit.stages.geometry.summary import Journal, pack
from mifit.stages.geometry.visibility import Visibility, spread_points, unseen_warnings

__all__ = ["fit_geometry", "fit_pose_expression", "texture_reference"]


@checked
@one_blas_thread()
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
        ``report.details`` holds the phases and the standard deviations of pose and shape, from the curvature at
        the solution.

    Raises
    ------
    InputError
        No camera or timestep, or a timestep with fewer than six visible landmarks.
    ConvergenceError
        No usable fit.

    Notes
    -----
    Gauge: the scale is ``model.unit_mm / capture.unit_mm``, and estimated around that only when
    ``config.scale_deviation`` is above 0, so that distance is; the albedo's level is the model's mean's, so the
    lighting's is estimated; ambient is held towards 0 against the constant harmonic.
    """
    cameras, timesteps = tuple(cameras), tuple(timesteps)
    if not cameras or not timesteps:
        raise InputError("fit_geometry: found no camera or no timestep, expected at least one of each")
    journal = Journal("fit geometry", 2 + config.rounds, progress)
    layout = Layout(len(timesteps), model.n_identity, model.n_expression, log_scale=int(config.scale_deviation > 0.0))
    config = replace(config, landmark_noise=_landmark_noise(capture, cameras, timesteps, config))
    views = landmark_views(capture, model, cameras, timesteps, config.landmark_noise)
    state = initial_state(model, views, len(timesteps), layout, model.unit_mm / capture.unit_mm)
    start = fit_landmarks(model, views, state, config.landmark_noise, priors_of(config))
    journal.phase("landmarks", _usable(start.solution, "landmarks"))
    config = replace(config, landmark_noise=start.noise)
    used = views if config.as_written else start.views  # the paper's landmarks are fixed vertices
    return _refine_and_pack(capture, model, cameras, timesteps, config, seed, journal, start.state, used, None, None)


def fit_pose_expression(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    timestep: int,
    config: GeometryConfig,
    seed: int = 0,
    progress: Progress = silent,
    reference: Reference | None = None,
) -> GeometryEstimate:
    """Fit pose and expression of one further timestep; identity, albedo and lighting stay those of ``geometry``.

    Starts from the last timestep of ``geometry`` or from the landmarks, whichever reprojects better. With too few
    landmarks the former alone is used, with a warning.

    Parameters
    ----------
    geometry : GeometryEstimate
        Initial fit, or that of the timestep before.
    reference : Reference, optional
        Texture of the surface from timesteps already fitted (`texture_reference`): the new images are compared with
        it as well as with one another. Its surface points are used.
    capture, model, cameras, timestep, config, seed, progress
        As in `fit_geometry`.

    Returns
    -------
    GeometryEstimate
        With this one timestep.

    Raises
    ------
    InputError
        No camera.
    ConvergenceError
        No usable fit.
    """
    cameras = tuple(cameras)
    if not cameras:
        raise InputError("fit_pose_expression: found no camera, expected at least one")
    journal = Journal("track geometry", 2 + config.rounds, progress)
    baked = bake_identity(displaced(model, geometry), geometry.identity)
    warm = _state_of(geometry, geometry.timesteps[-1])
    config = replace(config, landmark_noise=_landmark_noise(capture, cameras, (timestep,), config))
    views = landmark_views(capture, baked, cameras, (timestep,), config.landmark_noise, fewest=0)
    if sum(len(view.index) for view in views) >= FEWEST_LANDMARKS:
        state = initial_state(baked, views, 1, warm.layout, geometry.scale, warm)
        start = fit_landmarks(baked, views, state, config.landmark_noise, priors_of(config))
        journal.phase("landmarks", _usable(start.solution, "landmarks"))
        state, views, config = start.state, start.views, replace(config, landmark_noise=start.noise)
    else:
        state = warm
        text = f"timestep {timestep}: too few landmarks; started from timestep {geometry.timesteps[-1]} alone"
        journal.warn(Diagnostic("few-landmarks", text))
    found = _refine_and_pack(
        capture, baked, cameras, (timestep,), config, seed, journal, state, views, reference, geometry
    )
    return replace(found, displacement=geometry.displacement, photometry=geometry.photometry)


def _landmark_noise(
    capture: Capture, cameras: Sequence[str], timesteps: Sequence[int], config: GeometryConfig
) -> float:
    """The least noise of landmarks in pixels: the setting, or what the detector's errors amount to if that is more."""
    return max(config.landmark_noise, *(capture.frame(c, t).deviation for c in cameras for t in timesteps))


def bake_identity(model: MorphableModel, identity: NDArray) -> MorphableModel:
    """The model with one identity as its mean and no identity modes."""
    return replace(model, mean=model.shape(identity), identity=np.zeros((model.n_vertices, 3, 0), dtype=np.float32))


def _state_of(geometry: GeometryEstimate, timestep: int) -> State:
    """Pose and expression of one fitted timestep, identity baked."""
    k = geometry.index(timestep)
    layout = Layout(1, 0, len(geometry.expression[k]))
    x = np.zeros(layout.size)
    x[layout.at("expression")] = geometry.expression[k]
    x[layout.at("translation")] = geometry.translation[k]
    return State(layout, Frames(geometry.rotation[k : k + 1], geometry.scale), x)


def _usable(solution: Solution, what: str) -> Solution:
    """The solution, or ConvergenceError when it can't be used."""
    if not solution.usable or not np.isfinite(solution.value).all():
        raise ConvergenceError(
            f"fit geometry: the fit of {what} ended as '{solution.outcome.value}' after {solution.iterations} "
            "iterations; check the landmarks and the calibration of the cameras"
        )
    return solution


def _refine_and_pack(
    capture: Capture,
    model: MorphableModel,
    cameras: tuple[str, ...],
    timesteps: tuple[int, ...],
    config: GeometryConfig,
    seed: int,
    journal: Journal,
    state: State,
    views: tuple[LandmarkView, ...],
    reference: Reference | None,
    fixed: GeometryEstimate | None,
) -> GeometryEstimate:
    """Photometric rounds, then albedo and lighting unless ``fixed`` has them."""
    visibility = Visibility(capture, model, cameras, timesteps)
    if config.objective == "paper" and fixed is None:
        appearance = _appearance(model, state, visibility, config, seed)
        for number in range(config.rounds):
            state, solution, appearance = refine_by_rendering(
                model, state, appearance, views, visibility, config, seed + number
            )
            journal.phase("rendering", _usable(solution, "images"))
    else:
        if reference is not None:
            points = reference.points(model)
        else:
            points = spread_points(model, config.surface_points, seed)
        for _ in range(config.rounds):
            state, solution = refine_by_texture(model, state, views, visibility, points, config, reference)
            journal.phase("texture", _usable(solution, "images"))
    if config.objective == "paper" and config.as_written and fixed is None:
        coefficients = appearance
    elif fixed is not None:
        coefficients = np.concatenate([fixed.albedo, fixed.shading.ravel(), [fixed.ambient]])
    else:
        coefficients = _appearance(model, state, visibility, config, seed, journal)
    for message in visibility.warnings:
        journal.warn(message)
    for message in unseen_warnings(visibility.blind, cameras, len(timesteps), capture.unit_mm):
        journal.warn(message)
    return pack(
        model,
        state,
        coefficients,
        timesteps,
        visibility.world(state),
        journal,
        views,
        config.landmark_noise,
        fixed,
    )


def _appearance(
    model: MorphableModel,
    state: State,
    visibility: Visibility,
    config: GeometryConfig,
    seed: int,
    journal: Journal | None = None,
) -> NDArray[np.float64]:
    """Albedo coefficients, shading and ambient for a held geometry."""
    pixels = visibility.pixels(state, config.pixels, 1.0, seed, anew=False)
    problem = gather(model, visibility.world(state), pixels, config.robust_colour, config.albedo_prior)
    solution = _usable(fit_appearance(problem, config.max_iterations), "albedo and lighting")
    if journal is not None:
        journal.phase("albedo and lighting", solution, geometric=False)
    return solution.value
