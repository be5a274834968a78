"""The fit by landmarks: detected points of all images, a pose per timestep, then identity and expression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.optim import Solution, minimize
from mifit.stages.geometry.initial import pose_candidates, reprojection
from mifit.stages.geometry.landmarks import LandmarkProblem, LandmarkTerm, LandmarkView, slide_contour
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.points import PointBasis

FEWEST_LANDMARKS = 6
FEW_IDENTITY_MODES = 20
FARTHEST_PIXEL = 10.0  # in image sizes
OUTLIER_PIXELS = 4.0  # in units of the landmark noise: where Geman and McClure's penalty turns


@dataclass(frozen=True)
class State:
    """A point in the space of unknowns: what a flat vector means and its value."""

    layout: Layout
    frames: Frames
    x: NDArray

    def recentred(self) -> State:
        """The same state with the rotation vectors at zero, where their derivatives are simplest."""
        x = self.x.copy()
        rotation = np.stack([self.frames.pose(self.layout, x, k).rotation for k in range(self.layout.timesteps)])
        for k in range(self.layout.timesteps):
            x[self.layout.at("rotation", k)] = 0.0
        return State(self.layout, Frames(rotation, self.frames.scale), x)

    def with_layout(self, layout: Layout) -> State:
        """The same state under another choice of groups; new groups start at zero."""
        x = np.zeros(layout.size)
        for name in ("identity", "albedo", "shading", "ambient", "log_scale"):
            old, new = self.layout.at(name), layout.at(name)
            if getattr(self.layout, name) == getattr(layout, name):
                x[new] = self.x[old]
        for k in range(layout.timesteps):
            x[layout.local(k)] = self.x[self.layout.local(k)]
        return State(layout, self.frames, x)


def bounds(layout: Layout, expression_bounds: NDArray) -> tuple[NDArray, NDArray]:
    """Lower and upper bounds of the flat vector: only expressions have any."""
    low, high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    for k in range(layout.timesteps):
        low[layout.at("expression", k)] = expression_bounds[:, 0]
        high[layout.at("expression", k)] = expression_bounds[:, 1]
    return low, high


def landmark_views(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    noise: float,
    fewest: int = FEWEST_LANDMARKS,
) -> tuple[LandmarkView, ...]:
    """Visible landmarks of all images; raises InputError for a timestep with fewer than ``fewest`` in total."""
    views = []
    for step, timestep in enumerate(timesteps):
        counts = {}
        for name in cameras:
            frame = capture.frame(name, timestep)
            if frame.landmarks is None:
                counts[name] = 0
                continue
            pixels = np.asarray(frame.landmarks, dtype=np.float64)
            # far outside the image is no detection but an error of whatever wrote the file
            near = (np.abs(pixels) < FARTHEST_PIXEL * max(frame.image.shape)).all(1)
            index = np.flatnonzero(frame.visible & near)
            counts[name] = len(index)
            if len(index):
                vertices = model.landmarks[index]
                basis = PointBasis.at_vertices(model, vertices)
                views.append(
                    LandmarkView(step, capture.camera(name), index, vertices, pixels[index], 1.0 / noise**2, basis)
                )
        if sum(counts.values()) < fewest:
            found = ", ".join(f"{n} in camera {name}" for name, n in counts.items())
            raise InputError(
                f"timestep {timestep}: found {sum(counts.values())} visible landmarks ({found}), expected at "
                f"least {fewest} in total; detect them with `mifit landmarks` or leave the timestep out"
            )
    return tuple(views)


def initial_state(
    model: MorphableModel,
    views: Sequence[LandmarkView],
    timesteps: int,
    layout: Layout,
    scale: float,
    warm: State | None = None,
) -> State:
    """Mean face at the pose per timestep that reprojects best among all candidates, ``warm`` one of them."""
    mean = model.mean[model.landmarks].astype(np.float64)
    x = np.zeros(layout.size) if warm is None else warm.x.copy()
    rotation = np.tile(np.eye(3), (timesteps, 1, 1))
    for step in range(timesteps):
        mine = [v for v in views if v.step == step]
        cameras: list[Camera] = [v.camera for v in mine]
        pixels = []
        for view in mine:
            full = np.full((68, 2), np.nan)
            full[view.index] = view.pixels
            pixels.append(full)
        candidates = pose_candidates(cameras, mean, pixels, scale)
        if not candidates:  # landmarks too thinly spread for any closed form: in front of the camera, facing it
            camera = cameras[0]
            distance = 500.0 * scale
            candidates = [
                (camera.rotation.T @ np.diag([1.0, -1.0, -1.0]), camera.position + distance * camera.rotation[2])
            ]
        if warm is not None:
            pose = warm.frames.pose(warm.layout, warm.x, step)
            candidates.append((pose.rotation, pose.translation))
        error = [reprojection(cameras, mean, pixels, scale, pose) for pose in candidates]
        best = candidates[int(np.argmin(error))]
        rotation[step] = best[0]
        x[layout.at("translation", step)] = best[1]
    return State(layout, Frames(rotation, scale), x)


@dataclass(frozen=True)
class LandmarkFit:
    """Result of the fit by landmarks.

    Attributes
    ----------
    state : State
    solution : Solution
        Of the last run.
    views : tuple of LandmarkView
        With slid contour points and weights by the noise found.
    noise : float
        Standard deviation of a landmark's coordinate in pixels: what was assumed, or what the residuals show if
        that is more. Detectors and models disagree about where a landmark lies by more than the detector's scatter.
    """

    state: State
    solution: Solution
    views: tuple[LandmarkView, ...]
    noise: float


def fit_landmarks(
    model: MorphableModel,
    views: tuple[LandmarkView, ...],
    state: State,
    noise: float,
    priors: dict[str, float],
) -> LandmarkFit:
    """Levenberg-Marquardt on landmarks and prior: pose alone, then few modes, then all, then all once more.

    Before the last two runs the contour slides; before the last one the noise is raised to what the residuals show.
    """
    layout = state.layout
    low, high = bounds(layout, model.expression_bounds)
    held = np.zeros(layout.size, dtype=bool)
    solution: Solution | None = None
    # a wide outlier scale first: the mean face is far from every landmark
    runs = ((0, False, 10.0), (FEW_IDENTITY_MODES, True, 3.0), (None, True, 1.0), (None, True, 1.0))
    for number, (modes, expression, widening) in enumerate(runs):
        state = state.recentred()
        held[:] = False
        if modes is not None:
            held[layout.at("identity")][modes:] = True
        if not expression:
            for k in range(layout.timesteps):
                held[layout.at("expression", k)] = True
        low_now, high_now = np.where(held, state.x, low), np.where(held, state.x, high)
        if solution is not None and modes is None:
            vertices = object_vertices(model, state)
            poses = [state.frames.pose(layout, state.x, k) for k in range(layout.timesteps)]
            views = slide_contour(model, views, vertices, poses)
        if number == 3:
            noise = max(noise, coordinate_deviation(state, views))
            views = tuple(replace(view, weight=noise**-2) for view in views)
        term = LandmarkTerm(views, OUTLIER_PIXELS * noise * widening)
        problem = LandmarkProblem(layout, state.frames, term, priors)
        solution = minimize(
            problem,
            state.x,
            lower=low_now,
            upper=high_now,
            max_iterations=30,
            energy_tolerance=1e-5,
        )
        state = replace(state, x=solution.value)
    assert solution is not None
    return LandmarkFit(state, solution, views, noise)


def coordinate_deviation(state: State, views: tuple[LandmarkView, ...]) -> float:
    """Robust standard deviation of a landmark coordinate's residual, pixels."""
    term = LandmarkTerm(views, np.inf)
    residual = [term.distances(view, state.layout, state.frames, state.x).ravel() for view in views]
    return 1.4826 * float(np.median(np.abs(np.concatenate(residual))))


def object_vertices(model: MorphableModel, state: State) -> NDArray:
    """(T, V, 3) vertices in object space."""
    layout, x = state.layout, state.x
    size = len(model.mean)
    neutral = model.mean.reshape(-1) + model.identity.reshape(3 * size, -1) @ x[layout.at("identity")].astype(
        np.float32
    )
    flat = model.expression.reshape(3 * size, -1)
    return np.stack(
        [
            (neutral + flat @ x[layout.at("expression", k)].astype(np.float32)).reshape(size, 3)
            for k in range(layout.timesteps)
        ]
    )
