"""The fit by landmarks: detected points of all images, a pose per timestep, then identity and expression."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.capture.landmark_files import MIN_VISIBLE
from mifit.config import GeometryConfig
from mifit.core.camera import Camera
from mifit.core.mesh import face_cross
from mifit.core.metrics import SURE, median_deviation
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.topology import INNER
from mifit.optim import DenseSystem, Solution, geman_mcclure, minimize
from mifit.stages.geometry.initial import best_pose
from mifit.stages.geometry.parameters import Frames, Layout, NormalEquations, Pose, prior_energy
from mifit.stages.geometry.points import PointBasis, Projection, project

FARTHEST_PIXEL = 10.0  # in image sizes
CONTRADICTS = 0.025
"""Deviation of landmarks from a fit, as part of their extent, that errors of detector and model don't reach: 0.002 to
0.017 on the shared captures."""


@dataclass(frozen=True)
class State:
    """A point in the space of unknowns: what a flat vector means and its value."""

    layout: Layout
    frames: Frames
    x: NDArray

    @property
    def poses(self) -> list[Pose]:
        """Of all timesteps."""
        return [self.frames.pose(self.layout, self.x, k) for k in range(self.layout.timesteps)]

    def recentred(self) -> State:
        """The same state with the rotation vectors at zero, where their derivatives are simplest."""
        x, rotation = self.x.copy(), np.stack([pose.rotation for pose in self.poses])
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


@dataclass(frozen=True)
class LandmarkView:
    """Detected points of one image.

    Attributes
    ----------
    step : int
        Position of the timestep.
    camera : Camera
    index : (n,) int
        Which of the 68 landmarks.
    vertices : (n,) int
        Model vertex that each is compared with.
    pixels : (n, 2)
    weight : float
        Factor of the squared pixel distances.
    basis : PointBasis
        Of ``vertices``.
    """

    step: int
    camera: Camera
    index: NDArray
    vertices: NDArray
    pixels: NDArray
    weight: float
    basis: PointBasis


@dataclass(frozen=True)
class LandmarkTerm:
    """Sum over images of ``weight * sum rho(|pixel distance|^2)`` with Geman and McClure's rho.

    Attributes
    ----------
    views : tuple of LandmarkView
    scale : float
        Pixel distance at which a landmark counts as an outlier.
    """

    views: tuple[LandmarkView, ...]
    scale: float

    def energy(self, layout: Layout, frames: Frames, x: NDArray) -> float:
        """Value of the term."""
        total = 0.0
        for view in self.views:
            squared = ((_project(view, layout, frames, x).pixels - view.pixels) ** 2).sum(1)
            total += view.weight * float(geman_mcclure(squared, self.scale)[0].sum())
        return total

    def accumulate(self, equations: NormalEquations, layout: Layout, frames: Frames, x: NDArray) -> None:
        """Add the linearised term to the normal equations."""
        for view in self.views:
            projection = _project(view, layout, frames, x)
            distance = projection.pixels - view.pixels
            weight = view.weight * geman_mcclure((distance**2).sum(1), self.scale)[1]
            rows = _columns(layout, view.basis, projection)
            root = np.sqrt(np.repeat(weight, 2))[:, None]
            equations.add(view.step, root * np.concatenate([*rows, distance.reshape(-1, 1)], axis=1))


def _project(view: LandmarkView, layout: Layout, frames: Frames, x: NDArray) -> Projection:
    """The view's points of the model."""
    points = view.basis.evaluate(x[layout.at("identity")], x[layout.at("expression", view.step)])
    return project(view.camera, frames.pose(layout, x, view.step), points)


def _columns(layout: Layout, basis: PointBasis, projection: Projection) -> tuple[NDArray, NDArray]:
    """(2n, shared size) and (2n, local size) derivatives of projected points, in the basis' precision."""
    n, dtype = len(projection.pixels), basis.mean.dtype
    columns = np.repeat(np.arange(3 * n).reshape(n, 1, 3), 2, axis=1).reshape(-1)
    by_object = projection.by_object.astype(dtype).reshape(-1)
    spread = sp.csr_matrix((by_object, columns, np.arange(0, 6 * n + 1, 3)), shape=(2 * n, 3 * n))
    shared = np.zeros((2 * n, layout.shared_size), dtype=dtype)
    shared[:, layout.at("identity")] = spread @ basis.identity
    if layout.log_scale:
        shared[:, layout.at("log_scale").start] = projection.by_log_scale.reshape(-1)
    by_pose = projection.by_pose.reshape(2 * n, 6)
    return shared, np.concatenate([spread @ basis.expression, by_pose], axis=1, dtype=dtype)


@dataclass(frozen=True)
class LandmarkProblem:
    """Landmarks and prior only: no image is looked at."""

    layout: Layout
    frames: Frames
    term: LandmarkTerm
    priors: dict[str, float]

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        return {
            "landmarks": self.term.energy(self.layout, self.frames, x),
            "prior": prior_energy(self.layout, x, self.priors),
        }

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        equations = NormalEquations(self.layout)
        self.term.accumulate(equations, self.layout, self.frames, x)
        equations.add_priors(x, self.priors)
        return equations.system()


def slide_contour(
    model: MorphableModel, views: tuple[LandmarkView, ...], vertices: NDArray
) -> tuple[LandmarkView, ...]:
    """Let jaw-line points whose model vertex faces away slide to the silhouette.

    A detector that calls a contour point visible while the model's own vertex is turned away has drawn it on the
    silhouette; it is then compared with the nearest silhouette vertex in the image.

    Parameters
    ----------
    vertices : (T, V, 3)
        World-space vertices per timestep.
    """
    out = []
    for view in views:
        world = vertices[view.step].astype(np.float64)
        normal = face_cross(world, model.faces)
        centre = world[model.faces].mean(1)
        front = np.einsum("ij,ij->i", normal, view.camera.position - centre) > 0
        seen = np.bincount(model.faces[front].ravel(), minlength=len(world)) > 0
        around = np.bincount(model.faces[~front].ravel(), minlength=len(world)) > 0
        in_face = np.bincount(model.faces[model.face_mask].ravel(), minlength=len(world)) > 0
        contour = np.flatnonzero(seen & around & in_face)
        own = model.landmarks[view.index]
        turned_away = (view.index < INNER[0]) & ~seen[own]
        chosen = own.copy()
        if turned_away.any() and len(contour):
            pixels = view.camera.project(world[contour])
            for k in np.flatnonzero(turned_away):
                distance = np.linalg.norm(pixels - view.pixels[k], axis=1)
                chosen[k] = contour[int(np.nanargmin(distance))]
        out.append(replace(view, vertices=chosen, basis=PointBasis.at_vertices(model, chosen)))
    return tuple(out)


def priors_of(config: GeometryConfig) -> dict[str, float]:
    """Weights of the squared unknowns where every term is in units of its noise: coefficients have deviation 1."""
    priors = {"identity": 1.0, "expression": 1.0}
    return priors if config.scale_deviation == 0.0 else {**priors, "log_scale": config.scale_deviation**-2}


def landmark_views(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    noise: float,
    fewest: int = MIN_VISIBLE,
) -> tuple[LandmarkView, ...]:
    """Visible landmarks of all images; raises InputError for a timestep with fewer than ``fewest`` within the face."""
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
            counts[name] = int((index >= INNER[0]).sum())
            if len(index):
                vertices = model.landmarks[index]
                basis = PointBasis.at_vertices(model, vertices)
                views.append(
                    LandmarkView(step, capture.camera(name), index, vertices, pixels[index], 1.0 / noise**2, basis)
                )
        if sum(counts.values()) < fewest:
            found = ", ".join(f"{n} in camera {name}" for name, n in counts.items())
            raise InputError(
                f"timestep {timestep}: found {sum(counts.values())} visible landmarks of brows, eyes, nose and mouth "
                f"({found}), expected at least {fewest}; detect them with `mifit landmarks` or leave the timestep out"
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
        cameras = [v.camera for v in mine]
        pixels = np.full((len(mine), 68, 2), np.nan)
        for full, view in zip(pixels, mine, strict=True):
            full[view.index] = view.pixels
        more = [] if warm is None else [(warm.poses[step].rotation, warm.poses[step].translation)]
        best = best_pose(cameras, mean, list(pixels), scale, 500.0 * scale, more)
        rotation[step], x[layout.at("translation", step)] = best
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
    """Levenberg-Marquardt on landmarks and prior: pose alone, then shape too, at ever narrower outliers.

    Before the last two runs the contour slides; before the last one the noise is raised to what the residuals show.
    """
    layout = state.layout
    low, high = bounds(layout, model.expression_bounds)
    held = np.zeros(layout.size, dtype=bool)
    # a wide outlier scale first: the mean face is far from every landmark
    for number, (bends, widening) in enumerate(((False, 10.0), (True, 3.0), (True, 1.0), (True, 1.0))):
        state = state.recentred()
        held[layout.at("identity")] = not bends
        for k in range(layout.timesteps):
            held[layout.at("expression", k)] = not bends
        if number >= 2:
            views = slide_contour(model, views, world_vertices(model, state))
        if number == 3:
            noise = max(noise, coordinate_deviation(state, views))
            views = tuple(replace(view, weight=noise**-2) for view in views)
        term = LandmarkTerm(views, SURE * noise * widening)
        problem = LandmarkProblem(layout, state.frames, term, priors)
        least, most = np.where(held, state.x, low), np.where(held, state.x, high)
        solution = minimize(problem, state.x, lower=least, upper=most, max_iterations=30, energy_tolerance=1e-5)
        state = replace(state, x=solution.value)
    return LandmarkFit(state, solution, views, noise)


def coordinate_deviation(state: State, views: tuple[LandmarkView, ...]) -> float:
    """Robust standard deviation of a landmark coordinate's residual, pixels."""
    residual = [_project(view, state.layout, state.frames, state.x).pixels - view.pixels for view in views]
    return median_deviation(np.concatenate(residual))


def contradicts(state: State, views: tuple[LandmarkView, ...]) -> bool:
    """Whether landmarks lie farther from a fit than any detector's or model's errors."""
    extent = [np.ptp(view.pixels, axis=0).max() for view in views]
    return bool(extent) and coordinate_deviation(state, views) > CONTRADICTS * float(np.median(extent))


def world_vertices(model: MorphableModel, state: State) -> NDArray[np.float64]:
    """(T, V, 3) vertices in world space."""
    layout, x = state.layout, state.x
    shapes = [model.shape(x[layout.at("identity")], x[layout.at("expression", k)]) for k in range(layout.timesteps)]
    return np.stack([pose.apply(shape.astype(np.float64)) for pose, shape in zip(state.poses, shapes, strict=True)])
