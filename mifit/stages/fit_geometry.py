"""Stage 1: fit the morphable model to all views and timesteps (paper, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.capture.landmark_files import MIN_VISIBLE
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
from mifit.stages.geometry.images import blind_warnings, facial_pixels
from mifit.stages.geometry.landmarks import (
    LandmarkFit,
    LandmarkView,
    State,
    fit_landmarks,
    initial_state,
    landmark_views,
    priors_of,
    world_vertices,
)
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.place_head import place_head
from mifit.stages.geometry.rendering import refine_by_rendering
from mifit.stages.geometry.summary import Journal, pack
from mifit.stages.geometry.surfaces import displaced

__all__ = ["fit_geometry", "fit_pose_expression"]


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
    """Identity, albedo, expression, pose, lighting and ambient of a face model, fitted to images.

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
        Its report's details hold the phases.

    Raises
    ------
    InputError
        No camera or timestep, or a timestep with fewer than six visible landmarks off the jaw.
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
    journal = Journal("fit geometry", 1 + (config.rounds if config.objective == "paper" else 1), progress)
    layout = Layout(len(timesteps), model.n_identity, model.n_expression, log_scale=int(config.scale_deviation > 0.0))
    config = replace(config, landmark_noise=_landmark_noise(capture, cameras, timesteps, config))
    views = landmark_views(capture, model, cameras, timesteps, config.landmark_noise)

    def by_landmarks(some: tuple[LandmarkView, ...]) -> LandmarkFit:
        state = initial_state(model, some, len(timesteps), layout, model.unit_mm / capture.unit_mm)
        return fit_landmarks(model, some, state, config.landmark_noise, priors_of(config))

    start, left_out = place_head(capture, model, cameras, timesteps[0], by_landmarks(views), by_landmarks, progress)
    journal.phase("landmarks", _usable(start.solution, "landmarks"))
    for name in left_out:
        text = f"camera {name}: its landmarks contradict what all views show; they are left out"
        journal.warn(Diagnostic("landmarks-left-out", text, camera=name))
    state, world = start.state, world_vertices(model, start.state)
    seen = capture, model, cameras, timesteps
    pixels = facial_pixels(*seen, world, config.pixels, seed)
    problem = gather(model, world, pixels, config.robust_colour)
    lit = _usable(fit_appearance(problem, config.max_iterations), "albedo and lighting")
    appearance = lit.value
    if config.objective == "paper":
        for number in range(config.rounds):
            pixels = facial_pixels(*seen, world_vertices(model, state), config.pixels, seed + number)
            # The paper's landmarks are fixed vertices.
            state, solution, appearance = refine_by_rendering(model, state, appearance, views, pixels, config)
            journal.phase("rendering", _usable(solution, "images"))
    else:
        journal.phase("albedo and lighting", lit, geometric=False)
    for message in blind_warnings(pixels, cameras, timesteps, capture.unit_mm):
        journal.warn(message)
    return pack(model, state, appearance, timesteps, journal, start.views, start.noise)


def fit_pose_expression(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    timestep: int,
    config: GeometryConfig,
) -> GeometryEstimate:
    """Fit pose and expression of one further timestep to its landmarks; all else stays that of ``geometry``.

    Starts from the last timestep of ``geometry`` or from the landmarks, whichever reprojects better. With too few
    landmarks it is the last timestep again, with a warning.

    Parameters
    ----------
    geometry : GeometryEstimate
        Initial fit, or that of the timestep before.
    capture, model, cameras, timestep, config
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
    journal = Journal("track geometry", 1, silent)
    baked = bake_identity(displaced(model, geometry), geometry.identity)
    state = _state_of(geometry, geometry.timesteps[-1])
    noise = _landmark_noise(capture, cameras, (timestep,), config)
    views = landmark_views(capture, baked, cameras, (timestep,), noise, fewest=0)
    if sum(len(view.index) for view in views) >= MIN_VISIBLE:
        state = initial_state(baked, views, 1, state.layout, geometry.scale, state)
        start = fit_landmarks(baked, views, state, noise, priors_of(config))
        journal.phase("landmarks", _usable(start.solution, "landmarks"))
        state, views, noise = start.state, start.views, start.noise
    else:
        text = f"timestep {timestep}: too few landmarks; started from timestep {geometry.timesteps[-1]} alone"
        journal.warn(Diagnostic("few-landmarks", text))
    appearance = np.concatenate([geometry.albedo, geometry.shading.ravel(), [geometry.ambient]])
    found = pack(baked, state, appearance, (timestep,), journal, views, noise)
    return replace(
        found,
        identity=geometry.identity,
        vertex_albedo=geometry.vertex_albedo,
        displacement=geometry.displacement,
        photometry=geometry.photometry,
    )


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
