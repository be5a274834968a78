"""The model once more, fitted to the found surface: identity, expressions and poses by where the surface lies.

Landmarks name points but misplace them, each the same way in every image; a surface names no points but lies where it
lies. Points of the model are compared with the planes that touch the found surface next to them, so that they slide
freely; texture consistency keeps views and timesteps in step, landmarks count as one biased measurement each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.config import GeometryConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.solve import geman_mcclure, minimize
from mifit.solve.systems import DenseSystem
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.landmarks import LandmarkView, slide_contour
from mifit.stages.geometry.normal import NormalEquations
from mifit.stages.geometry.parameters import Frames, Layout, cross_matrix
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.refine import ENERGY_TOLERANCE, joint_state, texture_problem
from mifit.stages.geometry.start import bounds, landmark_views, object_vertices
from mifit.stages.geometry.visibility import Visibility, spread_points

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

ROUNDS, ITERATIONS = 4, 6
"""Times that the planes are found anew, and iterations of each."""
POINTS = 300.0
"""Independent measurements that the found surface amounts to: errors of neighbours are alike."""
DEVIATION_MM = 0.3
"""Standard deviation of one of them."""
OUTSIDE_MM = 1.5
"""Distance from the found surface at which a point counts as outside the model's span."""
FARTHEST_MM = 8.0
"""Distance at which a point of the model has no counterpart on the found surface."""
SCATTER_PIXELS = 1.5
"""Deviation of a landmark between images of one head; what exceeds it is bias."""
SMALLEST_COSINE = 0.7
"""Between normals of the model and of the found surface where they are compared."""


@dataclass(frozen=True)
class FoundSurface:
    """Measured points of the found surface at one timestep.

    Attributes
    ----------
    position, normal : (M, 3)
        World space.
    trust : (M,)
        0..1.
    """

    position: NDArray
    normal: NDArray
    trust: NDArray

    def touching(self, points: NDArray, normals: NDArray, farthest: float) -> tuple[NDArray, NDArray, NDArray]:
        """Planes next to points (N, 3): where they touch (N, 3), their normals (N, 3), and trust (N,), 0 for none."""
        distance, row = cKDTree(self.position).query(points, distance_upper_bound=farthest)
        missing = ~np.isfinite(distance)
        row = np.where(missing, 0, row)
        aligned = (self.normal[row] * normals).sum(1) > SMALLEST_COSINE
        return self.position[row], self.normal[row], np.where(missing | ~aligned, 0.0, self.trust[row])


@dataclass(frozen=True)
class PlaneTerm:
    """Sum over timesteps t and points i of ``weight_ti * rho((n_ti . (x_ti - y_ti))^2)``, Geman and McClure's rho.

    Attributes
    ----------
    basis : PointBasis
        Of the N points.
    touched, normal : (T, N, 3)
        Planes, world space.
    weight : (T, N)
    scale : float
        Distance at which a point counts as outside the model's span.
    """

    basis: PointBasis
    touched: NDArray
    normal: NDArray
    weight: NDArray
    scale: float

    def _distance(self, layout: Layout, frames: Frames, x: NDArray, step: int) -> tuple[NDArray, NDArray]:
        """(N,) distances from the planes, and the points less the translation (N, 3)."""
        objects = self.basis.evaluate(x[layout.at("identity")], x[layout.at("expression", step)])
        pose = frames.pose(layout, x, step)
        moved = pose.scale * objects.astype(np.float64) @ pose.rotation.T
        return ((moved + pose.translation - self.touched[step]) * self.normal[step]).sum(1), moved

    def energy(self, layout: Layout, frames: Frames, x: NDArray) -> float:
        """Value of the term."""
        total = 0.0
        for step in range(layout.timesteps):
            distance, _ = self._distance(layout, frames, x, step)
            total += float((self.weight[step] * geman_mcclure(distance**2, self.scale)[0]).sum())
        return total

    def accumulate(self, equations: NormalEquations, layout: Layout, frames: Frames, x: NDArray) -> None:
        """Add the linearised term to the normal equations."""
        count = len(self.touched[0])
        for step in range(layout.timesteps):
            distance, moved = self._distance(layout, frames, x, step)
            pose, normal = frames.pose(layout, x, step), self.normal[step]
            by_object = (pose.scale * normal @ pose.rotation).astype(self.basis.mean.dtype)
            shared = np.zeros((count, layout.shared_size), dtype=by_object.dtype)
            local = np.empty((count, layout.local_size), dtype=by_object.dtype)
            shared[:, layout.at("identity")] = _along(by_object, self.basis.identity)
            if layout.log_scale:
                shared[:, layout.at("log_scale").start] = (moved * normal).sum(1)
            local[:, : layout.expression] = _along(by_object, self.basis.expression)
            turn = -np.einsum("ni,nij->nj", normal, cross_matrix(moved)) @ pose.left_jacobian
            local[:, layout.expression :] = np.concatenate([turn, normal], axis=1)
            weight = self.weight[step] * geman_mcclure(distance**2, self.scale)[1]
            equations.add(step, shared, local, distance, weight)


def _along(direction: NDArray, modes: NDArray) -> NDArray:
    """(N, K) component of modes (3N, K) along directions (N, 3)."""
    return np.einsum("nc,nck->nk", direction, modes.reshape(len(direction), 3, -1), optimize=True)


@dataclass(frozen=True)
class PlaneTextureProblem:
    """Texture, landmarks and priors of stage 1, and the found surface, in one sum of squares."""

    texture: ConsistencyProblem
    planes: PlaneTerm

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        texture = self.texture
        return {**texture.energies(x), "surface": self.planes.energy(texture.layout, texture.frames, x)}

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        texture = self.texture
        equations = NormalEquations(texture.layout)
        self.planes.accumulate(equations, texture.layout, texture.frames, x)
        a, b = texture.linearize(x), equations.system()
        return DenseSystem(a.hessian + b.dense(), a.gradient + b.gradient)


def fit_model(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    found: Sequence[FoundSurface],
    config: GeometryConfig,
    seed: int = 0,
) -> GeometryEstimate:
    """Identity, expressions and poses of a model whose surface lies on the found one, as far as its modes allow.

    Parameters
    ----------
    capture, model, cameras
        As in `fit_geometry`.
    geometry : GeometryEstimate
        Where to start; albedo, lighting and gains stay.
    found : sequence of FoundSurface
        Per timestep.
    config : GeometryConfig
    seed : int
        Of the choice of surface points.

    Returns
    -------
    GeometryEstimate
        On the model's surface, without displacement.
    """
    steps = geometry.timesteps
    unit = float(geometry.scale) / model.unit_mm  # of world length in a millimetre
    noise = float(geometry.report.details.get("landmark_noise_pixels", config.landmark_noise))
    views = landmark_views(capture, model, cameras, steps, biased_noise(noise, len(cameras) * len(steps)), fewest=0)
    views = slid(model, geometry, views)
    visibility = Visibility(capture, model, tuple(cameras), steps, geometry.gains)
    points = spread_points(model, config.surface_points, seed)
    weight = POINTS / len(points.face) / (DEVIATION_MM * unit) ** 2
    state = joint_state(model, geometry)
    low, high = bounds(state.layout, model.expression_bounds)
    for _ in range(ROUNDS):
        state = state.recentred()
        touched: list[NDArray] = []
        normals: list[NDArray] = []
        trust: list[NDArray] = []
        for vertices, surface in zip(visibility.world(state), found, strict=True):
            corners = model.faces, points.face, points.weights
            own = normalize(interpolate(vertex_normals(vertices, model.faces), *corners))
            plane = surface.touching(interpolate(vertices, *corners), own, FARTHEST_MM * unit)
            for part, value in zip((touched, normals, trust), plane, strict=True):
                part.append(value)
        planes = PlaneTerm(
            points.basis, np.stack(touched), np.stack(normals), weight * np.stack(trust), OUTSIDE_MM * unit
        )
        texture = texture_problem(state, views, visibility, points, config)
        solution = minimize(
            PlaneTextureProblem(texture, planes),
            state.x,
            lower=low,
            upper=high,
            max_iterations=ITERATIONS,
            energy_tolerance=ENERGY_TOLERANCE,
        )
        if not solution.usable or not np.isfinite(solution.value).all():
            return geometry
        state = replace(state, x=solution.value)
    layout = state.layout
    poses = [state.frames.pose(layout, state.x, k) for k in range(len(steps))]
    return replace(
        geometry,
        identity=state.x[layout.at("identity")].copy(),
        expression=np.stack([state.x[layout.at("expression", k)] for k in range(len(steps))]),
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
        vertices=visibility.world(state).astype(np.float32),
        displacement=None,
    )


def landmarks_are_biased(geometry: GeometryEstimate) -> bool:
    """Whether the landmarks lie farther from the fit than a good detector scatters."""
    return float(geometry.report.details.get("landmark_noise_pixels", 0.0)) > SCATTER_PIXELS


def biased_noise(deviation: float, images: int) -> float:
    """Deviation of a landmark coordinate under which all images count as one where they share a bias, pixels.

    What exceeds the scatter of a good detector is the same in every image of a head.
    """
    scatter = min(deviation, SCATTER_PIXELS)
    return float(np.sqrt(scatter**2 + images * (deviation**2 - scatter**2)))


def slid(
    model: MorphableModel, geometry: GeometryEstimate, views: tuple[LandmarkView, ...]
) -> tuple[LandmarkView, ...]:
    """Landmarks with their jaw points on the silhouettes of a fit."""
    state = joint_state(model, geometry)
    poses = [state.frames.pose(state.layout, state.x, k) for k in range(state.layout.timesteps)]
    return slide_contour(model, views, object_vertices(model, state), poses)
