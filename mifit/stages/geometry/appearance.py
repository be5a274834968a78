"""Albedo coefficients, lighting and ambient of the paper's shading while the geometry is held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.sh import basis
from mifit.morphable import MorphableModel
from mifit.optim import DenseSystem, Solution, geman_mcclure, minimize
from mifit.sampling.visibility import DARKEST
from mifit.stages.geometry.images import PixelView
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.geometry.rendering import WHITE

AMBIENT_PRIOR = 1e-2  # of the squared ambient term in 0..1: fixes the gauge against the constant harmonic
SHADING_PRIOR = 1e-4  # of the squared coefficients, 0..255: decides only what the visible normals leave open
# The squared relative change of the face's mean albedo, per channel, counts like a residual, 0..255: images show the
# product of albedo and light alone, but beside a prior of the modes darker skin in brighter light makes all contrasts
# cheap, and in light far from white they fall to nothing. As a prior alone, skin's spread of luminance is too weak.


@dataclass(frozen=True)
class AppearanceProblem:
    """Mean robust square of 255 (I_a + (C + A x) * sum_k l_k phi_k - I) over each view's pixels, plus priors.

    The unknowns are albedo coefficients (Ka), shading (9, 3) and ambient, in this order. All else is constant, so
    the rows are gathered once.

    Attributes
    ----------
    mean : (n, 3), modes : (n, 3, Ka) float32
        Albedo of the pixels' surface points.
    harmonics : (n, 9) float32
        Of their normals in world space.
    observed : (n, 3) float32
        Linear colours.
    weight : (n,)
        1 / (number of the view's pixels).
    robust : float
        Residual in 0..255 where the penalty turns.
    level : (3, Ka)
        Change of the face's mean albedo by each mode, relative to that of the model's mean face.
    """

    mean: NDArray
    modes: NDArray
    harmonics: NDArray
    observed: NDArray
    weight: NDArray
    robust: float
    level: NDArray

    @property
    def albedo_size(self) -> int:
        """Number of albedo modes."""
        return self.modes.shape[2]

    def start(self) -> NDArray[np.float64]:
        """Mean albedo under the lighting that fits best, channel by channel (linear least squares)."""
        x = np.zeros(self.albedo_size + 28)
        shading = np.zeros((9, 3))
        for c in range(3):
            rows = self.harmonics.astype(np.float64) * (self.mean[:, c] * np.sqrt(self.weight))[:, None]
            normal = rows.T @ rows
            normal[np.diag_indices(9)] += 1e-6 * np.trace(normal) + 1e-12
            shading[:, c] = np.linalg.solve(normal, rows.T @ (self.observed[:, c] * np.sqrt(self.weight)))
        x[self.albedo_size : -1] = shading.ravel()
        return x

    def _residual(self, x: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        a = self.albedo_size
        # OpenBLAS raises the flag for finite values now and then (seen in one run of hundreds, as in NumPy's issue
        # 24067); values that aren't finite the solver sees in the energies.
        with np.errstate(invalid="ignore"):
            albedo = self.mean + self.modes @ x[:a].astype(np.float32)
        shade = self.harmonics @ x[a:-1].reshape(9, 3).astype(np.float32)
        return WHITE * (np.float32(x[-1]) + albedo * shade - self.observed), albedo, shade

    def _priors(self) -> NDArray[np.float64]:
        return np.repeat([1.0, SHADING_PRIOR, AMBIENT_PRIOR * WHITE**2], [self.albedo_size, 27, 1])

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        squared = (self._residual(x)[0].astype(np.float64) ** 2).sum(1)
        data = float((self.weight * geman_mcclure(squared, self.robust)[0]).sum())
        change = self.level @ x[: self.albedo_size]
        level = WHITE**2 * float(change @ change)
        return {"photo": data, "prior": float(self._priors() @ (x * x)) + level}

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations at x."""
        residual, albedo, shade = self._residual(x)
        weight = self.weight * geman_mcclure((residual.astype(np.float64) ** 2).sum(1), self.robust)[1]
        n, a = len(residual), self.albedo_size
        rows = np.zeros((n, 3, a + 29), dtype=np.float32)
        rows[:, :, :a] = shade[:, :, None] * self.modes
        for c in range(3):
            rows[:, c, a + c : a + 27 : 3] = albedo[:, c, None] * self.harmonics
        rows[:, :, -2] = 1.0
        rows *= WHITE
        rows[:, :, -1] = residual
        rows *= np.sqrt(weight).astype(np.float32)[:, None, None]
        flat = rows.reshape(3 * n, a + 29)
        normal = (flat.T @ flat).astype(np.float64)
        prior = np.diag(self._priors())
        prior[:a, :a] += WHITE**2 * self.level.T @ self.level
        return DenseSystem(normal[:-1, :-1] + prior, normal[:-1, -1] + prior @ x)


def gather(model: MorphableModel, world: NDArray, views: Sequence[PixelView], robust: float) -> AppearanceProblem:
    """Collect the pixels of all views; ``world`` (T, V, 3) is the held geometry."""
    flat = model.albedo_modes.reshape(len(model.mean), -1)
    normals = [vertex_normals(vertices, model.faces) for vertices in world]
    empty = [np.zeros((0, *shape), np.float32) for shape in ((3,), (3, model.n_albedo), (9,), (3,))]
    parts = [(*empty, np.zeros(0))]
    for view in views:
        corner = corner_matrix(model.faces, view.face, view.weights, len(model.mean))
        normal = normalize(interpolate(normals[view.step], model.faces, view.face, view.weights))
        position = interpolate(world[view.step], model.faces, view.face, view.weights)
        colour, _, inside = view.image.sample(view.camera.project(position))
        modes = (corner @ flat).reshape(len(view.face), 3, -1)
        rows = corner @ model.mean_albedo, modes, basis(normal, 3).astype(np.float32), colour
        parts.append((*(each[inside] for each in rows), np.full(inside.sum(), 1.0 / max(inside.sum(), 1))))
    face = np.unique(model.faces[model.face_mask])
    level = np.maximum(model.mean_albedo[face].mean(axis=0, dtype=np.float64), DARKEST)
    change = model.albedo_modes[face].mean(axis=0, dtype=np.float64) / level[:, None]
    mean, shifts, harmonics, observed, weight = (np.concatenate(each) for each in zip(*parts, strict=True))
    return AppearanceProblem(mean, shifts, harmonics, observed, weight, robust, change)


def fit_appearance(problem: AppearanceProblem, max_iterations: int) -> Solution:
    """Minimise from the problem's own start."""
    return minimize(problem, problem.start(), max_iterations=max_iterations, energy_tolerance=1e-4)
