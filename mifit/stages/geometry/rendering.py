"""The paper's photo-consistency term: I_ren = I_a + C_d * sum_k l_k phi_k(n) against the images, pixel by pixel.

Units are the paper's: colours times 255. Each facial pixel of an image is tied to the surface point that the G-buffer
found under it; as the parameters move, the point moves over the image and the residual follows it,

    r = 255 (I_a + C_d(p) * sum_k l_k phi_k(n(p)) - I(Pi(p))),

so that the Jacobian has the image's gradient through the projection, the shading's gradient through the normal, and
the normal's dependence on the one-ring of vertices around each corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross
from mifit.core.sh import basis_gradient
from mifit.morphable import MorphableModel
from mifit.solve import geman_mcclure
from mifit.solve.systems import ArrowSystem
from mifit.stages.geometry.images import SmoothImage
from mifit.stages.geometry.landmarks import LandmarkTerm
from mifit.stages.geometry.normal import NormalEquations, prior_energy
from mifit.stages.geometry.parameters import Frames, Layout, Pose, cross_matrix
from mifit.stages.geometry.points import Projection, project

WHITE = 255.0
AMBIENT_PRIOR = 1e-2  # of the squared ambient term in 0..1: fixes the gauge against the constant harmonic


@dataclass(frozen=True)
class PixelView:
    """Facial pixels of one image.

    Attributes
    ----------
    step : int
    camera : Camera
    image : SmoothImage
        Linear colours.
    face : (n,) int, weights : (n, 3)
        Surface point under each pixel.
    """

    step: int
    camera: Camera
    image: SmoothImage
    face: NDArray
    weights: NDArray


class Surface:
    """The model's surface at one timestep in object space, with unnormalised vertex normals."""

    def __init__(self, model: MorphableModel, identity: NDArray, expression: NDArray) -> None:
        size = 3 * len(model.mean)
        dtype = model.mean.dtype
        flat = model.mean.reshape(-1) + model.identity.reshape(size, -1) @ identity.astype(dtype)
        flat = flat + model.expression.reshape(size, -1) @ expression.astype(dtype)
        self.faces, self.dtype = model.faces, dtype
        self.vertices = flat.reshape(-1, 3).astype(np.float64)
        cross = face_cross(self.vertices, model.faces)
        self.normal_sum = np.stack(
            [
                np.bincount(model.faces.ravel(), np.repeat(cross[:, axis], 3), minlength=len(self.vertices))
                for axis in range(3)
            ],
            axis=1,
        )

    def normal_sum_derivative(self, touched: NDArray[np.bool_]) -> sp.csr_matrix:
        """(3V, 3V) d normal_sum / d vertices; only the rows of touched vertices (V,) are complete."""
        faces = self.faces[touched[self.faces].any(axis=1)]
        a, b, c = (self.vertices[faces[:, i]] for i in range(3))
        # cross(b - a, c - a): its derivative by one corner is the cross matrix of the opposite edge
        blocks = np.stack(
            [cross_matrix(c - b), cross_matrix(a - c), cross_matrix(b - a)], axis=2
        )  # (F, row, corner, 3)
        blocks = blocks.astype(np.float32) if self.dtype == np.float32 else blocks
        n, size = len(faces), self.vertices.size
        columns = np.broadcast_to((3 * faces[:, :, None] + np.arange(3)).reshape(n, 1, 9), (n, 3, 9))
        by_vertex = sp.csr_matrix((blocks.ravel(), columns.ravel(), np.arange(0, 27 * n + 1, 9)), shape=(3 * n, size))
        # sums face normals around each vertex, axis by axis
        rows = (3 * faces[:, :, None] + np.arange(3)).ravel()
        entries = np.broadcast_to((3 * np.arange(n)[:, None] + np.arange(3))[:, None], (n, 3, 3)).ravel()
        around = sp.csr_matrix((np.ones(len(rows), blocks.dtype), (rows, entries)), shape=(size, 3 * n))
        return around @ by_vertex


@dataclass(frozen=True)
class Observation:
    """One view at one parameter value: residuals and what their derivatives are made of."""

    residual: NDArray  # (n, 3), 0..255
    ok: NDArray  # (n,) bool
    slope: NDArray | None
    projection: Projection
    normal: NDArray  # (n, 3) world
    albedo: NDArray
    shade: NDArray
    basis: NDArray  # (n, 9)
    basis_slope: NDArray  # (n, 9, 3)
    unit: NDArray  # (n, 3) object-space normal
    length: NDArray  # (n,) length of the interpolated normal


@dataclass(frozen=True)
class RenderingProblem:
    """The paper's objective, E_con + w_l E_lan + w_r E_reg.

    Attributes
    ----------
    views : tuple of PixelView
    robust : float
        Residual (0..255, over the three channels) where Geman and McClure's penalty turns; infinite for plain
        least squares.
    priors : dict of str to float
        Weight of the squared coefficients per group.
    """

    model: MorphableModel
    layout: Layout
    frames: Frames
    views: tuple[PixelView, ...]
    landmarks: LandmarkTerm
    robust: float
    priors: dict[str, float]

    def _vertex_albedo(self, x: NDArray) -> NDArray:
        modes = self.model.albedo_modes
        flat = modes.reshape(-1, modes.shape[2]) @ x[self.layout.at("albedo")].astype(modes.dtype)
        return self.model.mean_albedo + flat.reshape(-1, 3)

    def _observe(self, view: PixelView, surface: Surface, albedo: NDArray, x: NDArray, gradient: bool) -> Observation:
        pose: Pose = self.frames.pose(self.layout, x, view.step)
        corners = self.model.faces[view.face]
        w = view.weights.astype(np.float64)
        points = np.einsum("nk,nkc->nc", w, surface.vertices[corners])
        sums = surface.normal_sum[corners]
        vertex_length = np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-30)
        q = np.einsum("nk,nkc->nc", w, sums / vertex_length)
        length = np.maximum(np.linalg.norm(q, axis=1), 1e-30)
        unit = q / length[:, None]
        normal = unit @ pose.rotation.T
        projection = project(view.camera, pose, points, gradient)
        values, slope, inside = view.image.sample(projection.pixels, gradient)
        basis, basis_slope = basis_gradient(normal, 3)
        shade = basis @ x[self.layout.at("shading")].reshape(9, 3)
        colour = np.einsum("nk,nkc->nc", w, albedo[corners])
        residual = WHITE * (x[self.layout.at("ambient")] + colour * shade - values)
        return Observation(
            residual,
            inside & (projection.depth > 0),
            slope,
            projection,
            normal,
            colour,
            shade,
            basis,
            basis_slope,
            unit,
            length,
        )

    def _loss(self, observation: Observation) -> tuple[float, NDArray]:
        """Mean robust square over the view's pixels, and each pixel's weight in it."""
        squared = (observation.residual**2).sum(1)
        rho, weight = geman_mcclure(squared, self.robust)
        count = max(int(observation.ok.sum()), 1)
        return float(rho[observation.ok].sum()) / count, np.where(observation.ok, weight, 0.0) / count

    def _touched(self, step: int) -> NDArray[np.bool_]:
        """(V,) vertices at a corner of some pixel's face at one timestep."""
        touched = np.zeros(len(self.model.mean), dtype=bool)
        for view in self.views:
            if view.step == step:
                touched[self.model.faces[view.face]] = True
        return touched

    def _surfaces(self, x: NDArray) -> list[Surface]:
        at = self.layout.at
        return [Surface(self.model, x[at("identity")], x[at("expression", k)]) for k in range(self.layout.timesteps)]

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        surfaces, albedo = self._surfaces(x), self._vertex_albedo(x)
        data = sum(
            self._loss(self._observe(view, surfaces[view.step], albedo, x, gradient=False))[0] for view in self.views
        )
        prior = prior_energy(self.layout, x, self.priors)
        landmarks = self.landmarks.energy(self.layout, self.frames, x)
        return {"photo": float(data), "landmarks": landmarks, "prior": prior}

    def linearize(self, x: NDArray) -> ArrowSystem:
        """Normal equations at x."""
        surfaces, albedo = self._surfaces(x), self._vertex_albedo(x)
        equations = NormalEquations(self.layout)
        derivatives: dict[int, sp.csr_matrix] = {}
        for view in self.views:
            surface = surfaces[view.step]
            if view.step not in derivatives:
                derivatives[view.step] = surface.normal_sum_derivative(self._touched(view.step))
            observation = self._observe(view, surface, albedo, x, gradient=True)
            _, weight = self._loss(observation)
            shared, local = self._columns(view, surface, observation, x, derivatives[view.step])
            equations.add(view.step, shared, local, observation.residual.reshape(-1), np.repeat(weight, 3))
        self.landmarks.accumulate(equations, self.layout, self.frames, x)
        equations.add_priors(x, self.priors)
        return equations.system()

    def _columns(
        self, view: PixelView, surface: Surface, o: Observation, x: NDArray, derivative: sp.csr_matrix
    ) -> tuple[NDArray, NDArray]:
        """Jacobian rows (3n, shared), (3n, local) of the residuals, pixel by pixel, channel by channel."""
        layout, model = self.layout, self.model
        dtype = model.mean.dtype
        n = len(view.face)
        size = 3 * len(model.mean)
        shared = np.zeros((3 * n, layout.shared_size), dtype=dtype)
        local = np.zeros((3 * n, layout.local_size), dtype=dtype)
        corners = model.faces[view.face]
        w = view.weights.astype(np.float64)

        if layout.albedo:
            data = WHITE * o.shade[:, :, None] * w[:, None, :]  # (n, channel, corner)
            columns = 3 * corners[:, None, :] + np.arange(3)[:, None]
            pick = sp.csr_matrix(
                (data.astype(dtype).ravel(), columns.ravel(), np.arange(0, 9 * n + 1, 3)), shape=(3 * n, size)
            )
            shared[:, layout.at("albedo")] = pick @ model.albedo_modes.reshape(size, -1)
        by_shading = np.zeros((n, 3, 9, 3), dtype=dtype)
        for c in range(3):
            by_shading[:, c, :, c] = WHITE * o.albedo[:, c, None] * o.basis
        shared[:, layout.at("shading")] = by_shading.reshape(3 * n, 27)
        shared[:, layout.at("ambient")] = WHITE
        by_pixel, by_normal, through_position, through_normal = self.by_vertex(view, surface, o, x)
        rows = through_position + through_normal @ derivative
        shared[:, layout.at("identity")] = rows @ model.identity.reshape(size, -1)
        local[:, : layout.expression] = rows @ model.expression.reshape(size, -1)
        by_pose = by_pixel @ o.projection.by_pose
        # a rotation d w turns the normal by d w x n
        pose = self.frames.pose(layout, x, view.step)
        by_pose[:, :, :3] -= by_normal @ cross_matrix(o.normal) @ pose.left_jacobian
        local[:, layout.expression :] = by_pose.reshape(3 * n, 6)
        if layout.log_scale:
            by_scale = np.einsum("nci,ni->nc", by_pixel, o.projection.by_log_scale)
            shared[:, layout.at("log_scale").start] = by_scale.ravel()
        return shared, local

    def by_vertex(
        self, view: PixelView, surface: Surface, o: Observation, x: NDArray
    ) -> tuple[NDArray, NDArray, sp.csr_matrix, sp.csr_matrix]:
        """Sparse derivatives of the residuals by what lies at the three corners of each pixel's face.

        Returns
        -------
        by_pixel (n, 3, 2), by_normal (n, 3, 3) : by the projected position and by the world-space normal
        through_position, through_normal : (3n, 3V)
            By the corners' object-space positions, and by their unnormalised normals.
        """
        layout, model = self.layout, self.model
        dtype = model.mean.dtype
        n = len(view.face)
        corners = model.faces[view.face]
        w = view.weights.astype(np.float64)
        pose = self.frames.pose(layout, x, view.step)
        assert o.slope is not None
        by_pixel = -WHITE * o.slope.astype(np.float64)
        by_object = by_pixel @ o.projection.by_object
        # shading through the world normal, each channel its own lighting
        lighting = np.einsum("nkd,kc->ncd", o.basis_slope, x[layout.at("shading")].reshape(9, 3))
        by_normal = WHITE * o.albedo[:, :, None] * lighting
        tangent = np.eye(3) - o.unit[:, :, None] * o.unit[:, None, :]
        by_interpolated = (by_normal @ pose.rotation) @ tangent / o.length[:, None, None]
        sums = surface.normal_sum[corners]
        length = np.maximum(np.linalg.norm(sums, axis=2, keepdims=True), 1e-30)
        unit = sums / length
        at_corner = (np.eye(3) - unit[..., :, None] * unit[..., None, :]) / length[..., None]  # (n, corner, 3, 3)
        by_sum = np.matmul(by_interpolated[:, None], w[:, :, None, None] * at_corner).transpose(0, 2, 1, 3)
        by_position = by_object[:, :, None, :] * w[:, None, :, None]
        columns = np.broadcast_to((3 * corners[:, :, None] + np.arange(3))[:, None], by_position.shape).ravel()
        pointer = np.arange(0, 27 * n + 1, 9)
        shape = (3 * n, 3 * len(model.mean))
        return (
            by_pixel,
            by_normal,
            sp.csr_matrix((by_position.astype(dtype).ravel(), columns, pointer), shape=shape),
            sp.csr_matrix((by_sum.astype(dtype).ravel(), columns, pointer), shape=shape),
        )
