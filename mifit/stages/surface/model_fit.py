"""The model once more, where landmarks are biased: identity, expressions and poses by what the images show.

Landmarks name points but misplace them, each the same way in every image. Three things correct them, in one sum of
squares: colours, which the model's albedo under a smooth lighting explains (shading tells a nose that points elsewhere,
which no view may see well enough to match); texture consistency between views and timesteps; and planes that touch the
surface where a sweep of the current one found it, along which the model slides freely. Landmarks count as one biased
measurement each. The model alone moves, and every round sweeps it anew: nothing stands between what is measured and
the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.config import GeometryConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.optim import geman_mcclure, minimize
from mifit.optim.systems import DenseSystem
from mifit.stages.geometry.appearance import fit_appearance, gather
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.landmarks import LandmarkView, slide_contour
from mifit.stages.geometry.normal import NormalEquations
from mifit.stages.geometry.parameters import Frames, Layout, cross_matrix
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.refine import ENERGY_TOLERANCE, joint_state, paper_problem, texture_problem
from mifit.stages.geometry.rendering import RenderingProblem
from mifit.stages.geometry.scenes import Scenes
from mifit.stages.geometry.start import State, bounds, landmark_views, object_vertices
from mifit.stages.geometry.visibility import Visibility, spread_points
from mifit.stages.surface.local_planes import MeasuredPlanes

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

SHADING_ROUNDS, SHADING_ITERATIONS = 3, 10
"""Rounds by colours and texture, before anything is swept: they reach farthest; and iterations of each."""
PASSES, ITERATIONS = 2, 6
"""Times that the planes' counterparts are found anew after a sweep, and iterations of each."""
PIXELS, FEWEST_PIXELS = 4000, 500
"""Pixels of all images together, drawn anew in every round, and the fewest of an image."""
POINTS, TEXTURE_POINTS = 4000, 1000
"""Planes of a timestep, and points whose texture is compared."""
COUNTERPART_MAP = 256
"""Side of the map whose texels may be counterparts of planes."""
FARTHEST_MM = 6.0
"""Distance at which a plane has no counterpart on the model."""
SCATTER_OF_FACE, LEAST_SCATTER = 0.005, 1.1
"""Deviation of a landmark between images of one head, as a part of the face's width and at least in pixels; what
exceeds it is bias. Good detectors scatter by 0.3 per cent and about a pixel, and are off by one to four per cent."""
SMALLEST_COSINE = 0.7
"""Between normals of the model and of the found surface where they are compared."""
COLOUR = 1.0
"""Prior of the albedo's coefficients against the colours' mean square: an image counts as one measurement to 1 of 255,
or a hundred to 10."""
UNEXPLAINED = 100.0
"""Mean square of a pixel's residual, of 255 and over all channels, above which colours count in inverse proportion."""

Measure = Callable[[NDArray, tuple[int, int]], Sequence[Sequence[MeasuredPlanes]]]
"""Planes of each timestep, matched and at outlines, from the model's world vertices (T, V, 3) and a sweep."""


@dataclass(frozen=True)
class PlaneTerm:
    """Sum over points i of one timestep of ``weight_i * rho((n_i . (x_i - y_i))^2)``, Geman and McClure's rho.

    Attributes
    ----------
    step : int
        Position of the timestep.
    basis : PointBasis
        Of the N points.
    touched, normal : (N, 3)
        Planes, world space.
    weight : (N,)
    scale : float
        Distance at which a point counts as outside the model's span.
    """

    step: int
    basis: PointBasis
    touched: NDArray
    normal: NDArray
    weight: NDArray
    scale: float

    def _distance(self, layout: Layout, frames: Frames, x: NDArray) -> tuple[NDArray, NDArray]:
        """(N,) distances from the planes, and the points less the translation (N, 3)."""
        objects = self.basis.evaluate(x[layout.at("identity")], x[layout.at("expression", self.step)])
        pose = frames.pose(layout, x, self.step)
        moved = pose.scale * objects.astype(np.float64) @ pose.rotation.T
        return ((moved + pose.translation - self.touched) * self.normal).sum(1), moved

    def energy(self, layout: Layout, frames: Frames, x: NDArray) -> float:
        """Value of the term."""
        distance, _ = self._distance(layout, frames, x)
        return float((self.weight * geman_mcclure(distance**2, self.scale)[0]).sum())

    def accumulate(self, equations: NormalEquations, layout: Layout, frames: Frames, x: NDArray) -> None:
        """Add the linearised term to the normal equations."""
        distance, moved = self._distance(layout, frames, x)
        pose, normal = frames.pose(layout, x, self.step), self.normal
        by_object = (pose.scale * normal @ pose.rotation).astype(self.basis.mean.dtype)
        shared = np.zeros((len(normal), layout.shared_size), dtype=by_object.dtype)
        local = np.empty((len(normal), layout.local_size), dtype=by_object.dtype)
        shared[:, layout.at("identity")] = _along(by_object, self.basis.identity)
        if layout.log_scale:
            shared[:, layout.at("log_scale").start] = (moved * normal).sum(1)
        local[:, : layout.expression] = _along(by_object, self.basis.expression)
        turn = -np.einsum("ni,nij->nj", normal, cross_matrix(moved)) @ pose.left_jacobian
        local[:, layout.expression :] = np.concatenate([turn, normal], axis=1)
        weight = self.weight * geman_mcclure(distance**2, self.scale)[1]
        equations.add(self.step, shared, local, distance, weight)


def _along(direction: NDArray, modes: NDArray) -> NDArray:
    """(N, K) component of modes (3N, K) along directions (N, 3)."""
    return np.einsum("nc,nck->nk", direction, modes.reshape(len(direction), 3, -1), optimize=True)


@dataclass(frozen=True)
class JointProblem:
    """Colours, texture, landmarks, priors and the measured surface in one sum of squares.

    Attributes
    ----------
    colours : RenderingProblem
        Without landmarks; its priors are those of albedo and lighting.
    texture : ConsistencyProblem
        With landmarks and the priors of the shape, and in a layout without appearance.
    weight : float
        Factor of the colours' terms.
    planes : sequence of PlaneTerm
    """

    colours: RenderingProblem
    texture: ConsistencyProblem
    weight: float = 1.0
    planes: Sequence[PlaneTerm] = ()

    @cached_property
    def _shape(self) -> NDArray[np.intp]:
        """Where the unknowns of the texture's layout lie in that of the colours."""
        layout, steps = self.colours.layout, range(self.colours.layout.timesteps)
        parts = [layout.at("identity"), layout.at("log_scale"), *(layout.local(k) for k in steps)]
        return np.concatenate([np.arange(part.start, part.stop) for part in parts])

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        shape, layout, frames = x[self._shape], self.texture.layout, self.texture.frames
        terms, colours = self.texture.energies(shape), self.colours.energies(x)
        return {
            **terms,
            "photo": self.weight * colours["photo"],
            "prior": terms["prior"] + self.weight * colours["prior"],
            "surface": sum(plane.energy(layout, frames, shape) for plane in self.planes),
        }

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        shape, layout, frames = x[self._shape], self.texture.layout, self.texture.frames
        equations = NormalEquations(layout)
        for plane in self.planes:
            plane.accumulate(equations, layout, frames, shape)
        texture, colours, planes = self.texture.linearize(shape), self.colours.linearize(x), equations.system()
        hessian, gradient = self.weight * colours.dense(), self.weight * colours.gradient
        hessian[np.ix_(self._shape, self._shape)] += texture.hessian + planes.dense()
        gradient[self._shape] += texture.gradient + planes.gradient
        return DenseSystem(hessian, gradient)


def fit_model(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    measure: Measure,
    sweeps: Sequence[tuple[int, int]],
    config: GeometryConfig,
    seed: int = 0,
    progress: Callable[[], None] = lambda: None,
    scenes: Scenes | None = None,
) -> GeometryEstimate:
    """Identity, expressions and poses by colours and texture first, then with sweeps of the model's surface.

    Parameters
    ----------
    capture, model, cameras
        As in `fit_geometry`.
    geometry : GeometryEstimate
        Where to start; albedo, lighting and photometry stay.
    measure : callable
        Sweeps the model's surface.
    sweeps : sequence of (int, int)
        Level and half the number of offsets of each.
    config : GeometryConfig
        Its landmarks, texture and robust colours.
    seed : int
        Of the choice of points and pixels.
    progress : callable
        Called after each round.
    scenes : Scenes, optional
        Kept by who sweeps the same surfaces.

    Returns
    -------
    GeometryEstimate
        On the model's surface, without displacement; ``geometry`` where a round ends without a usable result.
    """
    steps = geometry.timesteps
    noise = geometry.landmark_noise or config.landmark_noise
    images = len(cameras) * len(steps)
    pixels = min(config.pixels, max(PIXELS // images, FEWEST_PIXELS))
    config = replace(config, as_written=False, scale_deviation=0.0, landmark_noise=noise, pixels=pixels)
    views = landmark_views(
        capture, model, cameras, steps, biased_noise(noise, images, scatter_pixels(geometry)), fewest=0
    )
    views = slid(model, geometry, views)
    visibility = Visibility(capture, model, tuple(cameras), steps, scenes)
    points = spread_points(model, min(config.surface_points, TEXTURE_POINTS), seed)
    texels = rasterize_uv(model.uv, model.faces_uv, COUNTERPART_MAP, model.face_mask)
    farthest = FARTHEST_MM * float(geometry.scale) / model.unit_mm
    rng = np.random.default_rng(seed)
    state = joint_state(model, geometry)
    seen = visibility.pixels(state, config.pixels, 1.0, seed)
    start = gather(model, visibility.world(state), seen, config.robust_colour, config.albedo_prior)
    appearance = fit_appearance(start, config.max_iterations).value
    for number, sweep in enumerate((*[None] * SHADING_ROUNDS, *sweeps)):
        measured = [] if sweep is None else measure(visibility.world(state), sweep)
        planes = [(step, part.thinned(POINTS, rng)) for step, parts in enumerate(measured) for part in parts]
        state = state.recentred()
        colours, x = paper_problem(model, state, appearance, (), visibility, config, seed + number)
        colours = replace(colours, priors={"albedo": COLOUR, "ambient": colours.priors["ambient"]}).holding_slopes(x)
        texture = texture_problem(state, views, visibility, points, config)
        # Paint that the model's albedo doesn't explain is no shading: what stays unexplained counts less.
        left = colours.energies(x)["photo"] / max(len(colours.views), 1)
        problem = JointProblem(colours, texture, min(1.0, UNEXPLAINED / max(left, 1e-30)))
        low, high = bounds(colours.layout, model.expression_bounds)
        for _ in range(PASSES if planes else 1):
            terms = _counterparts(model, texels, visibility.world(state), planes, farthest)
            solution = minimize(
                replace(problem, planes=terms),
                x,
                lower=low,
                upper=high,
                max_iterations=SHADING_ITERATIONS if sweep is None else ITERATIONS,
                energy_tolerance=ENERGY_TOLERANCE,
            )
            if not solution.usable or not np.isfinite(solution.value).all():
                return geometry
            x = solution.value
            state = State(colours.layout, colours.frames, x).with_layout(state.layout)
        appearance = np.concatenate([x[colours.layout.at(name)] for name in ("albedo", "shading", "ambient")])
        progress()
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


def _counterparts(
    model: MorphableModel,
    texels: TexelMap,
    world: NDArray,
    planes: Sequence[tuple[int, MeasuredPlanes]],
    farthest: float,
) -> list[PlaneTerm]:
    """The texels of the model nearest to planes of timesteps; planes far from all of them are left out."""
    terms = []
    for step, plane in planes:
        if not len(plane.precision):
            continue
        vertices = world[step]
        position = interpolate(vertices, model.faces, texels.face, texels.weights)
        distance, near = cKDTree(position).query(plane.position)
        corners = texels.face[near], texels.weights[near]
        normal = normalize(interpolate(vertex_normals(vertices, model.faces), model.faces, *corners))
        used = (distance < farthest) & ((normal * plane.normal).sum(1) > SMALLEST_COSINE)
        basis = PointBasis.on_faces(model, corners[0][used], corners[1][used])
        parts = plane.position[used], plane.normal[used], plane.precision[used]
        terms.append(PlaneTerm(step, basis, *parts, plane.outside))
    return terms


def scatter_pixels(geometry: GeometryEstimate) -> float:
    """Deviation of a landmark coordinate that a good detector has between images of this face, pixels."""
    return max(LEAST_SCATTER, SCATTER_OF_FACE * geometry.face_width)


def landmarks_are_biased(geometry: GeometryEstimate) -> bool:
    """Whether the landmarks lie farther from the fit than a good detector scatters."""
    return geometry.landmark_noise > scatter_pixels(geometry)


def biased_noise(deviation: float, images: int, scatter: float) -> float:
    """Deviation of a landmark coordinate under which all images count as one where they share a bias, pixels.

    What exceeds the scatter of a good detector is the same in every image of a head.
    """
    scatter = min(deviation, scatter)
    return float(np.sqrt(scatter**2 + images * (deviation**2 - scatter**2)))


def slid(
    model: MorphableModel, geometry: GeometryEstimate, views: tuple[LandmarkView, ...]
) -> tuple[LandmarkView, ...]:
    """Landmarks with their jaw points on the silhouettes of a fit."""
    state = joint_state(model, geometry)
    poses = [state.frames.pose(state.layout, state.x, k) for k in range(state.layout.timesteps)]
    return slide_contour(model, views, object_vertices(model, state), poses)
