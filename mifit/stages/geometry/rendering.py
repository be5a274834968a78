"""The paper's photo-consistency term: I_ren = I_a + C_d * sum_k l_k phi_k(n) against the images, pixel by pixel.

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

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross
from mifit.core.sh import basis_gradient
from mifit.morphable import MorphableModel
from mifit.optim import geman_mcclure
from mifit.optim.systems import ArrowSystem
from mifit.stages.geometry.images import SmoothImage
from mifit.stages.geometry.landmarks import LandmarkTerm
from mifit.stages.geometry.normal import NormalEquations, prior_energy
from mifit.stages.geometry.parameters import Frames, Layout, Pose, cross_matrix
from mifit.stages.geometry.points import PointBasis, Projection, corner_matrix, project

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


@dataclass(frozen=True)
class Patch:
    """The part of a model that decides positions and normals on some of its faces.

    Attributes
    ----------
    mean, identity, expression, faces
        As of the model, of these vertices and the faces around the wanted ones' corners alone.
    """

    mean: NDArray
    identity: NDArray
    expression: NDArray
    faces: NDArray

    @classmethod
    def around(cls, model: MorphableModel, face: NDArray) -> tuple[Patch, NDArray]:
        """Around faces (n,) of a model, and their numbers (n,) in the patch."""
        corner = np.zeros(len(model.mean), bool)
        corner[model.faces[face]] = True
        kept = np.flatnonzero(corner[model.faces].any(axis=1))
        vertices, faces = np.unique(model.faces[kept], return_inverse=True)
        patch = cls(model.mean[vertices], model.identity[vertices], model.expression[vertices], faces.reshape(-1, 3))
        return patch, np.searchsorted(kept, face)


class Surface:
    """The model's surface at one timestep in object space, with its vertex normals before and after normalising."""

    def __init__(self, model: MorphableModel | Patch, identity: NDArray, expression: NDArray) -> None:
        size = 3 * len(model.mean)
        dtype = model.mean.dtype
        flat = model.mean.reshape(-1) + model.identity.reshape(size, len(identity)) @ identity.astype(dtype)
        flat = flat + model.expression.reshape(size, len(expression)) @ expression.astype(dtype)
        self.model = model
        self.vertices = flat.reshape(-1, 3).astype(np.float64)
        cross = face_cross(self.vertices, model.faces)
        normal_sum = np.stack(
            [
                np.bincount(model.faces.ravel(), np.repeat(cross[:, axis], 3), minlength=len(self.vertices))
                for axis in range(3)
            ],
            axis=1,
        )
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

    residual: NDArray  # (n, 3), 0..255
    ok: NDArray  # (n,) bool
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
    robust : float
        Residual (0..255, over the three channels) where Geman and McClure's penalty turns; infinite for plain
        least squares.
    priors : dict of str to float
        Weight of the squared coefficients per group.
    slopes : tuple of (n, 3, Ki + Ke), optional
        Derivatives of the normals under each view's pixels by the coefficients, held; by default found anew in every
        linearisation.
    """

    model: MorphableModel
    layout: Layout
    frames: Frames
    views: tuple[PixelView, ...]
    landmarks: LandmarkTerm
    robust: float
    priors: dict[str, float]
    slopes: tuple[NDArray, ...] | None = None

    @cached_property
    def _rows(self) -> list[PixelRows]:
        """Of each view."""
        model, out = self.model, []
        for view in self.views:
            n = len(view.face)
            points = PointBasis.on_faces(model, view.face, view.weights)
            position = np.concatenate([points.identity, points.expression], axis=1)
            position = position.reshape(n, 3, position.shape[-1])
            mix = corner_matrix(model.faces, view.face, view.weights, len(model.mean))
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
            surfaces = self._surfaces(x)
            self._last.clear()
            self._last[key] = [
                self._observe(view, rows, surfaces[view.step], face, x)
                for view, rows, face in zip(self.views, self._rows, self._patches[1], strict=True)
            ]
        return self._last[key]

    def _observe(self, view: PixelView, rows: PixelRows, surface: Surface, face: NDArray, x: NDArray) -> Observation:
        """One view; ``face`` are its pixels' faces on the surface's patch."""
        pose: Pose = self.frames.pose(self.layout, x, view.step)
        w = view.weights.astype(np.float64)
        points = np.einsum("nk,nkc->nc", w, surface.vertices[surface.model.faces[face]])
        normal = surface.normals(face, w)[0] @ pose.rotation.T
        projection = project(view.camera, pose, points)
        values, slope, inside = view.image.sample(projection.pixels)
        assert slope is not None
        harmonics, basis_slope = basis_gradient(normal, 3)
        shade = harmonics @ x[self.layout.at("shading")].reshape(9, 3)
        modes = rows.albedo_modes
        colour = rows.albedo + modes @ x[self.layout.at("albedo")].astype(modes.dtype)
        residual = WHITE * (x[self.layout.at("ambient")] + colour * shade - values)
        ok = inside & (projection.depth > 0)
        return Observation(residual, ok, slope, projection, normal, colour, shade, harmonics, basis_slope)

    def _loss(self, observation: Observation) -> tuple[float, NDArray]:
        """Mean robust square over the view's pixels, and each pixel's weight in it."""
        squared = (observation.residual**2).sum(1)
        rho, weight = geman_mcclure(squared, self.robust)
        count = max(int(observation.ok.sum()), 1)
        return float(rho[observation.ok].sum()) / count, np.where(observation.ok, weight, 0.0) / count

    @cached_property
    def _patches(self) -> tuple[list[Patch], list[NDArray]]:
        """What the pixels of each timestep are on, and the numbers of their faces there, per view."""
        patches, faces = [], [np.zeros(0, np.intp)] * len(self.views)
        for step in range(self.layout.timesteps):
            own = [i for i, view in enumerate(self.views) if view.step == step]
            together = np.concatenate([np.zeros(0, np.intp), *(self.views[i].face for i in own)])
            patch, numbers = Patch.around(self.model, together)
            patches.append(patch)
            ends = np.cumsum([len(self.views[i].face) for i in own])[:-1]
            for i, part in zip(own, np.split(numbers, ends), strict=False):
                faces[i] = part
        return patches, faces

    def _surfaces(self, x: NDArray) -> list[Surface]:
        at = self.layout.at
        patches = self._patches[0]
        return [Surface(patch, x[at("identity")], x[at("expression", k)]) for k, patch in enumerate(patches)]

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        data = sum(self._loss(observation)[0] for observation in self._observations(x))
        prior = prior_energy(self.layout, x, self.priors)
        landmarks = self.landmarks.energy(self.layout, self.frames, x)
        return {"photo": float(data), "landmarks": landmarks, "prior": prior}

    def holding_slopes(self, x: NDArray) -> RenderingProblem:
        """The problem with the normals' derivatives by the coefficients held as they are at x.

        They are the dearest part of a linearisation, and change by as much as the surface bends. Energies stay exact.
        """
        surfaces = self._surfaces(x)
        slopes = [
            surfaces[view.step].normal_modes(face, view.weights.astype(np.float64))
            for view, face in zip(self.views, self._patches[1], strict=True)
        ]
        return replace(self, slopes=tuple(slopes))

    def linearize(self, x: NDArray) -> ArrowSystem:
        """Normal equations at x."""
        equations = NormalEquations(self.layout)
        slopes = self.slopes if self.slopes is not None else self.holding_slopes(x).slopes
        assert slopes is not None
        observed = self._observations(x)
        for view, rows, by_shape, observation in zip(self.views, self._rows, slopes, observed, strict=True):
            equations.add_weighted(view.step, self._weighted_rows(view, rows, by_shape, observation, x))
        self.landmarks.accumulate(equations, self.layout, self.frames, x)
        equations.add_priors(x, self.priors)
        return equations.system()

    def _weighted_rows(self, view: PixelView, rows: PixelRows, slopes: NDArray, o: Observation, x: NDArray) -> NDArray:
        """Jacobian and residuals by the root of their weights, as `NormalEquations.add_weighted` takes them.

        Pixel by pixel, channel by channel; ``slopes`` are the derivatives of the normals by the coefficients.
        """
        layout = self.layout
        dtype = rows.position.dtype
        n, shared = len(view.face), layout.shared_size
        root = np.sqrt(self._loss(o)[1])[:, None, None]
        pose = self.frames.pose(layout, x, view.step)
        by_pixel = -WHITE * root * o.slope.astype(np.float64)
        # shading through the world normal, each channel its own lighting
        lighting = np.einsum("nkd,kc->ncd", o.basis_slope, x[layout.at("shading")].reshape(9, 3))
        by_normal = WHITE * root * o.albedo[:, :, None] * lighting

        out = np.zeros((n, 3, shared + layout.local_size + 1), dtype=dtype)
        by_position = (by_pixel @ o.projection.by_object).astype(dtype)
        by_shape = by_position @ rows.position
        by_shape += (by_normal @ pose.rotation).astype(dtype) @ slopes
        out[:, :, layout.at("identity")] = by_shape[:, :, : layout.identity]
        out[:, :, shared : shared + layout.expression] = by_shape[:, :, layout.identity :]
        if layout.albedo:
            out[:, :, layout.at("albedo")] = (WHITE * root[:, 0] * o.shade).astype(dtype)[
                :, :, None
            ] * rows.albedo_modes
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
