"""Smooth shading as evidence of shape: what the texture term drops, once stage 2 knows the light.

Every surface point has a diffuse albedo of its own, eliminated exactly, so that paint pulls on nothing. What is left
says how radiance changes as the head turns and from view to view, and so where normals point:

    E = sum over points i of min over A_i of sum over images v of w_iv |g_v(n_iv) + A_i d_v(n_iv) - I_iv|^2

with d the radiance of a white diffuse surface and g everything else (highlights, ambient). Normals are those of the
model's mesh; colours are read where the points project at the start and stay, as moves are fractions of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.core.bend import tangent_plane
from mifit.core.mesh import normalize
from mifit.morphable import MorphableModel
from mifit.solve.systems import DenseSystem
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.normal import NormalEquations
from mifit.stages.geometry.parameters import Frames, Layout, cross_matrix
from mifit.stages.geometry.rendering import Surface

DIFFERENCE = 0.01
"""Radians by which normals are tilted to differentiate the shading, which has no feature as fine as that."""

Shade = Callable[[NDArray, int], tuple[NDArray, NDArray]]
"""World normals (N, 3), number of the image -> radiance (N, 3) of white diffuse points, and everything else (N, 3)."""


@dataclass(frozen=True)
class ShadingTerm:
    """The energy above.

    Attributes
    ----------
    face : (N,) int, weights : (N, 3)
        Surface points.
    step : (J,) int
        Timestep of each image, as a position.
    colour, precision : (N, J, 3)
        Colours, and the weights of their squared residuals; 0 where not observed.
    shade : Shade
    """

    model: MorphableModel
    layout: Layout
    frames: Frames
    face: NDArray
    weights: NDArray
    step: NDArray
    colour: NDArray
    precision: NDArray
    shade: Shade

    def energy(self, x: NDArray) -> float:
        """The energy at x."""
        normals = [self._points(x, k)[0] for k in range(self.layout.timesteps)]
        return float((self.precision * self.residual(normals)[0] ** 2).sum())

    def residual(self, normals: list[NDArray]) -> tuple[NDArray, NDArray, NDArray]:
        """Residuals (N, J, 3), diffuse radiances (N, J, 3) and eliminated albedos (N, 3), of normals per timestep."""
        body, rest = np.empty_like(self.colour), np.empty_like(self.colour)
        for j, k in enumerate(self.step):
            body[:, j], rest[:, j] = self.shade(normals[k], j)
        weighted = self.precision * body
        squares = np.maximum((weighted * body).sum(1), 1e-12)
        albedo = (weighted * (self.colour - rest)).sum(1) / squares
        return rest + albedo[:, None] * body - self.colour, body, albedo

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations with the albedos eliminated."""
        layout, n = self.layout, len(self.face)
        points = [self._points(x, k) for k in range(layout.timesteps)]
        residual, body, albedo = self.residual([normals for normals, _ in points])
        tangents = [tangent_plane(normals) for normals, _ in points]
        slopes = [self._slopes(x, k, points[k][1], tangents[k]) for k in range(layout.timesteps)]
        equations = NormalEquations(layout)
        squares = np.maximum((self.precision * body**2).sum(1), 1e-12)
        pooled = np.zeros((n, 3, layout.size), dtype=np.float32)
        for j, k in enumerate(self.step):
            by_tangent = np.empty((n, 3, 2), dtype=np.float32)
            for a in range(2):
                tilt = DIFFERENCE * tangents[k][:, a]
                up, down = (self.shade(normalize(points[k][0] + s * tilt), j) for s in (1, -1))
                by_tangent[..., a] = (albedo * (up[0] - down[0]) + up[1] - down[1]) / (2 * DIFFERENCE)
            rows = np.matmul(by_tangent, slopes[k])  # (N, 3, Ki + Ke + 6)
            shared = np.zeros((n, 3, layout.shared_size), dtype=np.float32)
            shared[..., layout.at("identity")] = rows[..., : layout.identity]
            local = rows[..., layout.identity :]
            weight = self.precision[:, j].astype(np.float32)
            equations.add(
                k, shared.reshape(3 * n, -1), local.reshape(3 * n, -1), residual[:, j].ravel(), weight.ravel()
            )
            factor = (weight * body[:, j]).astype(np.float32)[..., None]
            pooled[..., : layout.shared_size] += factor * shared
            pooled[..., layout.local(k)] += factor * local
        pooled /= np.sqrt(squares).astype(np.float32)[..., None]
        flat = pooled.reshape(3 * n, -1)
        system = equations.system()
        return DenseSystem(system.dense() - flat.T @ flat, system.gradient)

    def _points(self, x: NDArray, step: int) -> tuple[NDArray, Surface]:
        """World normals (N, 3) of the points at one timestep, and the surface that they are on."""
        surface = Surface(self.model, x[self.layout.at("identity")], x[self.layout.at("expression", step)])
        normal, _ = surface.normals(self.face, self.weights)
        return normal @ self.frames.pose(self.layout, x, step).rotation.T, surface

    def _slopes(self, x: NDArray, step: int, surface: Surface, tangents: NDArray) -> NDArray[np.float32]:
        """(N, 2, Ki + Ke + 6) derivative of the normals along two tangents by the unknowns of a timestep."""
        pose = self.frames.pose(self.layout, x, step)
        slopes = surface.normal_modes(self.face, self.weights)
        shape = (tangents @ pose.rotation).astype(slopes.dtype) @ slopes
        normals = np.cross(tangents[:, 0], tangents[:, 1])
        # a rotation d w turns the normal by d w x n
        turn = -tangents @ cross_matrix(normals) @ pose.left_jacobian
        return np.concatenate([shape, turn, np.zeros_like(turn)], axis=2).astype(np.float32)


@dataclass(frozen=True)
class ShadedTextureProblem:
    """Texture, landmarks and priors of stage 1, and shading, in one sum of squares."""

    texture: ConsistencyProblem
    shading: ShadingTerm

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        return {**self.texture.energies(x), "shading": self.shading.energy(x)}

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        a, b = self.texture.linearize(x), self.shading.linearize(x)
        return DenseSystem(a.hessian + b.hessian, a.gradient + b.gradient)
