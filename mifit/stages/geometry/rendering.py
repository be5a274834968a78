"""The paper's objective as written: I_ren = I_a + C_d * sum_k l_k phi_k(n) against the images, pixel by pixel.

Units are the paper's: colours times 255. Each facial pixel of an image is tied to the surface point that the G-buffer
found under it; as the parameters move, the point moves over the image and the residual follows it,

    r = 255 (I_a + C_d(p) * sum_k l_k phi_k(n(p)) - I(Pi(p))),

so that the Jacobian has the image's gradient through the projection, the shading's gradient through the normal, and
the normal's dependence on the one-ring of vertices around each corner.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.config import GeometryConfig
from mifit.core.mesh import face_cross
from mifit.core.sh import basis_gradient
from mifit.morphable import MorphableModel
from mifit.optim import DenseSystem, Solution, minimize
from mifit.stages.geometry.images import PixelView
from mifit.stages.geometry.landmarks import LandmarkTerm, LandmarkView, State, bounds, priors_of
from mifit.stages.geometry.parameters import Frames, Layout, NormalEquations, Pose, cross_matrix, prior_energy
from mifit.stages.geometry.points import PointBasis, Projection, corner_matrix, project

WHITE = 255.0
"""Colours of 0..1 in the paper's units."""


class Surface:
    """The model's surface at one timestep in object space, with its vertex normals before and after normalising."""

    def __init__(self, model: MorphableModel, identity: NDArray, expression: NDArray) -> None:
        self.model = model
        every = PointBasis.at_vertices(model, slice(None))
        self.vertices = every.evaluate(identity, expression).astype(np.float64)
        cross, corners = face_cross(self.vertices, model.faces), model.faces.ravel()
        sums = [np.bincount(corners, np.repeat(each, 3), minlength=len(self.vertices)) for each in cross.T]
        normal_sum = np.stack(sums, axis=1)
        self.length = np.maximum(np.linalg.norm(normal_sum, axis=1), 1e-30)
        self.unit = normal_sum / self.length[:, None]

    def normals(self, face: NDArray, weights: NDArray) -> tuple[NDArray, NDArray]:
        """Unit normals (N, 3) at points given by face and barycentric weights, and the length (N,) before normalising.

        They are mixed from the vertices' unit normals.
        """
        mixed = np.einsum("nk,nkc->nc", weights, self.unit[self.model.faces[face]])
        length = np.maximum(np.linalg.norm(mixed, axis=1), 1e-30)
        return mixed / length[:, None], length

    def normal_modes(self, face: NDArray, weights: NDArray) -> NDArray:
        """(N, 3, Ki + Ke) derivative of `normals` by the coefficients."""
        model, dtype, n = self.model, self.model.mean.dtype, len(face)
        touched, corners = np.unique(model.faces[face], return_inverse=True)
        corners = corners.reshape(n, 3)
        unit, length = self.normals(face, weights)
        at_vertex = self.unit[touched][corners]
        by_unit = (weights / self.length[touched][corners])[..., None, None] * (
            np.eye(3) - at_vertex[..., :, None] * at_vertex[..., None, :]
        )
        tangent = (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / length[:, None, None]
        by_sum = np.matmul(tangent[:, None], by_unit).transpose(0, 2, 1, 3).astype(dtype)
        columns = np.broadcast_to((3 * corners[:, :, None] + np.arange(3))[:, None], by_sum.shape)
        through = sp.csr_matrix(
            (by_sum.ravel(), columns.ravel(), np.arange(0, 27 * n + 1, 9)), shape=(3 * n, 3 * len(touched))
        )
        modes = through @ self._normal_sum_modes(touched)
        return modes.reshape(n, 3, modes.shape[-1])

    def _normal_sum_modes(self, vertices: NDArray) -> NDArray:
        """(3N, Ki + Ke) derivative of the summed face normals around some vertices (N,) by the coefficients."""
        model, dtype = self.model, self.model.mean.dtype
        row = np.full(len(model.mean), -1)
        row[vertices] = np.arange(len(vertices))
        faces = model.faces[(row[model.faces] >= 0).any(axis=1)]
        n = len(faces)
        a, b, c = (self.vertices[faces[:, i]].astype(dtype) for i in range(3))
        # cross(b - a, c - a): its derivative by one corner is the cross matrix of the opposite edge
        opposite = np.stack([c - b, a - c, b - a], axis=1)  # (F, corner, 3)
        x, y, z = (opposite[..., k] for k in range(3))
        entries = np.stack([-z, y, z, -x, -y, x], axis=-1).reshape(n, 3, 3, 2).transpose(0, 2, 1, 3)
        columns = 3 * faces[:, None, :, None] + np.array([[1, 2], [0, 2], [0, 1]])[:, None]  # (F, row, corner, 2)
        by_vertex = sp.csr_matrix(
            (entries.ravel(), columns.ravel(), np.arange(0, 18 * n + 1, 6)), shape=(3 * n, 3 * len(model.mean))
        )
        wanted, which = row[faces].ravel(), np.repeat(np.arange(n), 3)
        around = sp.csr_matrix(
            (np.ones((wanted >= 0).sum(), dtype), (wanted[wanted >= 0], which[wanted >= 0])), shape=(len(vertices), n)
        )
        parts = []
        for modes, k in ((m, m.shape[-1]) for m in (model.identity, model.expression)):
            by_modes = by_vertex @ modes.reshape(3 * len(modes), k)
            parts.append((around @ by_modes.reshape(n, 3 * k)).reshape(3 * len(vertices), k))
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True)
class Observation:
    """One view at one parameter value: residuals and what their derivatives are made of."""

    surface: Surface
    residual: NDArray  # (n, 3), 0..255
    weight: NDArray  # (n,) of its square: all alike, 0 where the image has no value
    slope: NDArray  # (n, 3, 2) of the image, by pixels
    projection: Projection
    normal: NDArray  # (n, 3) world
    albedo: NDArray
    shade: NDArray
    basis: NDArray  # (n, 9)
    basis_slope: NDArray  # (n, 9, 3)


@dataclass(frozen=True)
class PixelRows:
    """What the coefficients do to the points under one view's pixels, as long as those stay.

    Attributes
    ----------
    position : (n, 3, Ki + Ke)
        Derivative of the object-space points.
    albedo : (n, 3), albedo_modes : (n, 3, Ka)
    """

    position: NDArray
    albedo: NDArray
    albedo_modes: NDArray


@dataclass(frozen=True)
class RenderingProblem:
    """The paper's objective, E_con + w_l E_lan + w_r E_reg.

    Attributes
    ----------
    views : tuple of PixelView
    priors : dict of str to float
        Weight of the squared coefficients per group.
    """

    model: MorphableModel
    layout: Layout
    frames: Frames
    views: tuple[PixelView, ...]
    landmarks: LandmarkTerm
    priors: dict[str, float]

    @cached_property
    def _rows(self) -> list[PixelRows]:
        """Of each view."""
        model, out = self.model, []
        for view in self.views:
            n = len(view.face)
            mix = corner_matrix(model.faces, view.face, view.weights, len(model.mean))
            ordered = mix.sorted_indices()
            parts = [ordered @ modes.reshape(len(modes), -1) for modes in (model.identity, model.expression)]
            position = np.concatenate([part.reshape(n, 3, -1) for part in parts], axis=2)
            modes = mix @ model.albedo_modes.reshape(len(model.mean), -1)
            out.append(PixelRows(position, mix @ model.mean_albedo, modes.reshape(n, 3, modes.shape[-1] // 3)))
        return out

    @cached_property
    def _last(self) -> dict[bytes, list[Observation]]:
        """The views at the x last asked for: a step that is accepted is linearised where it has been judged."""
        return {}

    def _observations(self, x: NDArray) -> list[Observation]:
        """Of each view."""
        key = x.tobytes()
        if key not in self._last:
            at = self.layout.at
            steps = range(self.layout.timesteps)
            surfaces = [Surface(self.model, x[at("identity")], x[at("expression", k)]) for k in steps]
            self._last.clear()
            self._last[key] = [
                self._observe(view, rows, surfaces[view.step], x)
                for view, rows in zip(self.views, self._rows, strict=True)
            ]
        return self._last[key]

    def _observe(self, view: PixelView, rows: PixelRows, surface: Surface, x: NDArray) -> Observation:
        """One view."""
        pose: Pose = self.frames.pose(self.layout, x, view.step)
        w = view.weights.astype(np.float64)
        points = np.einsum("nk,nkc->nc", w, surface.vertices[self.model.faces[view.face]])
        normal = surface.normals(view.face, w)[0] @ pose.rotation.T
        projection = project(view.camera, pose, points)
        values, slope, inside = view.image.sample(projection.pixels)
        harmonics, basis_slope = basis_gradient(normal, 3)
        shade = harmonics @ x[self.layout.at("shading")].reshape(9, 3)
        modes = rows.albedo_modes
        colour = rows.albedo + modes @ x[self.layout.at("albedo")].astype(modes.dtype)
        residual = WHITE * (x[self.layout.at("ambient")] + colour * shade - values)
        ok = inside & (projection.depth > 0)
        weight = ok / max(int(ok.sum()), 1)
        return Observation(surface, residual, weight, slope, projection, normal, colour, shade, harmonics, basis_slope)

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term; that of the images is each view's mean over its pixels."""
        data = sum((o.weight * (o.residual**2).sum(1)).sum() for o in self._observations(x))
        prior = prior_energy(self.layout, x, self.priors)
        landmarks = self.landmarks.energy(self.layout, self.frames, x)
        return {"photo": float(data), "landmarks": landmarks, "prior": prior}

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        equations = NormalEquations(self.layout)
        for view, rows, observation in zip(self.views, self._rows, self._observations(x), strict=True):
            equations.add(view.step, self._weighted_rows(view, rows, observation, x))
        self.landmarks.accumulate(equations, self.layout, self.frames, x)
        equations.add_priors(x, self.priors)
        return equations.system()

    def _weighted_rows(self, view: PixelView, rows: PixelRows, o: Observation, x: NDArray) -> NDArray:
        """Jacobian and residuals, pixel by pixel, channel by channel, as `NormalEquations.add` takes them."""
        layout = self.layout
        dtype = rows.position.dtype
        n, shared = len(view.face), layout.shared_size
        root = np.sqrt(o.weight)[:, None, None]
        pose = self.frames.pose(layout, x, view.step)
        by_pixel = -WHITE * root * o.slope.astype(np.float64)
        # shading through the world normal, each channel its own lighting
        lighting = np.einsum("nkd,kc->ncd", o.basis_slope, x[layout.at("shading")].reshape(9, 3))
        by_normal = WHITE * root * o.albedo[:, :, None] * lighting

        out = np.zeros((n, 3, shared + layout.local_size + 1), dtype=dtype)
        by_position = (by_pixel @ o.projection.by_object).astype(dtype)
        by_shape = by_position @ rows.position
        slopes = o.surface.normal_modes(view.face, view.weights.astype(np.float64))
        by_shape += (by_normal @ pose.rotation).astype(dtype) @ slopes
        out[:, :, layout.at("identity")] = by_shape[:, :, : layout.identity]
        out[:, :, shared : shared + layout.expression] = by_shape[:, :, layout.identity :]
        by_albedo = (WHITE * root[:, 0] * o.shade).astype(dtype)
        out[:, :, layout.at("albedo")] = by_albedo[:, :, None] * rows.albedo_modes
        first = layout.at("shading").start
        for c in range(3):
            out[:, c, first + c : first + 27 : 3] = WHITE * root[:, 0] * o.albedo[:, c, None] * o.basis
        out[:, :, layout.at("ambient")] = WHITE * root
        if layout.log_scale:
            out[:, :, layout.at("log_scale").start] = np.einsum("nci,ni->nc", by_pixel, o.projection.by_log_scale)
        by_pose = by_pixel @ o.projection.by_pose
        # a rotation d w turns the normal by d w x n
        by_pose[:, :, :3] -= by_normal @ cross_matrix(o.normal) @ pose.left_jacobian
        out[:, :, shared + layout.expression : -1] = by_pose
        out[:, :, -1] = root[:, 0] * o.residual
        return out.reshape(3 * n, out.shape[2])


def refine_by_rendering(
    model: MorphableModel,
    state: State,
    appearance: NDArray,
    views: tuple[LandmarkView, ...],
    pixels: tuple[PixelView, ...],
    config: GeometryConfig,
) -> tuple[State, Solution, NDArray]:
    """One outer step of the paper's objective, all unknowns together.

    Parameters
    ----------
    appearance : (Ka + 28,)
        Albedo coefficients, shading and ambient to start from.
    pixels : tuple of PixelView
        Those of the images, as the surface at ``state`` covers them.

    Returns
    -------
    state (geometry alone), solution, appearance
    """
    problem, start = paper_problem(model, state, appearance, views, pixels, config)
    low, high = bounds(problem.layout, model.expression_bounds)
    solution = minimize(
        problem, start, lower=low, upper=high, max_iterations=config.max_iterations, energy_tolerance=1e-4
    )
    full = State(problem.layout, problem.frames, solution.value)
    at = problem.layout.at
    appearance = np.concatenate([solution.value[at(name)] for name in ("albedo", "shading", "ambient")])
    return full.with_layout(state.layout), solution, appearance


def paper_problem(
    model: MorphableModel,
    state: State,
    appearance: NDArray,
    views: tuple[LandmarkView, ...],
    pixels: tuple[PixelView, ...],
    config: GeometryConfig,
) -> tuple[RenderingProblem, NDArray]:
    """The paper's objective, and the flat vector to start from; parameters as in `refine_by_rendering`."""
    layout = replace(state.layout, albedo=model.n_albedo, shading=27, ambient=1)
    full = state.with_layout(layout).recentred()
    x = full.x
    albedo, shading, ambient = np.split(appearance, [model.n_albedo, model.n_albedo + 27])
    x[layout.at("albedo")], x[layout.at("shading")], x[layout.at("ambient")] = albedo, shading, ambient
    # w_l / |F_view| per view
    weighted = tuple(replace(view, weight=config.landmark_weight / max(len(view.index), 1)) for view in views)
    priors = {name: config.prior_weight for name in ("identity", "albedo", "expression")}
    if layout.log_scale:
        priors["log_scale"] = priors_of(config)["log_scale"]
    return RenderingProblem(model, layout, full.frames, pixels, LandmarkTerm(weighted, np.inf), priors), x
