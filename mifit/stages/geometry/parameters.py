"""The unknowns of stage 1 as one flat vector, shared by all timesteps first, and their normal equations.

Gauge. Scale against distance: the scale is fixed by the units of model and capture, or held by a prior on its
logarithm. Albedo against lighting: the model's mean albedo and its prior decide. Ambient against the constant
harmonic: a weak pull of the ambient term to zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mifit.optim import DenseSystem

SHARED = ("identity", "albedo", "shading", "ambient", "log_scale")
LOCAL = ("expression", "rotation", "translation")


@dataclass(frozen=True)
class Layout:
    """Where each group of unknowns lies; a group of size 0 is not estimated.

    Attributes
    ----------
    identity, albedo, shading, ambient, log_scale, expression : int
        Sizes; rotation and translation have three entries each per timestep.
    timesteps : int
    """

    timesteps: int
    identity: int
    expression: int
    albedo: int = 0
    shading: int = 0
    ambient: int = 0
    log_scale: int = 0
    rotation: int = 3
    translation: int = 3

    @property
    def shared_size(self) -> int:
        """Number of shared unknowns."""
        return sum(getattr(self, name) for name in SHARED)

    @property
    def local_size(self) -> int:
        """Number of unknowns of one timestep."""
        return sum(getattr(self, name) for name in LOCAL)

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.shared_size + self.timesteps * self.local_size

    def at(self, name: str, step: int = 0) -> slice:
        """Slice of a group in the flat vector; ``step`` is the position of the timestep for a local group."""
        return _slice(self, name, step)

    def local(self, step: int) -> slice:
        """Slice of all unknowns of one timestep."""
        start = self.shared_size + step * self.local_size
        return slice(start, start + self.local_size)


@lru_cache(maxsize=4096)
def _slice(layout: Layout, name: str, step: int) -> slice:
    """Asked for thousands of times in every fit."""
    names, offset = (SHARED, 0) if name in SHARED else (LOCAL, layout.shared_size + step * layout.local_size)
    offset += sum(getattr(layout, before) for before in names[: names.index(name)])
    return slice(offset, offset + getattr(layout, name))


@dataclass(frozen=True)
class Pose:
    """Object to world: ``world = scale * rotation @ object + translation``.

    ``rotation = exp([vector]) @ reference``; the derivative with respect to ``vector`` is carried along.

    Attributes
    ----------
    rotation : (3, 3), translation : (3,), scale : float
    left_jacobian : (3, 3)
        d rotation = [left_jacobian d vector] rotation.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scale: float
    left_jacobian: NDArray[np.float64]

    def apply(self, points: NDArray) -> NDArray:
        """Object points (..., 3) -> world points (..., 3)."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class Frames:
    """What a flat vector is relative to: the linearisation point of the rotations, and the scale.

    Attributes
    ----------
    rotation : (T, 3, 3)
    scale : float
    """

    rotation: NDArray[np.float64]
    scale: float

    def pose(self, layout: Layout, x: NDArray, step: int) -> Pose:
        """Pose of one timestep."""
        vector = x[layout.at("rotation", step)]
        log_scale = x[layout.at("log_scale")]
        scale = self.scale * float(np.exp(log_scale[0])) if len(log_scale) else self.scale
        return Pose(
            exponential(vector) @ self.rotation[step],
            x[layout.at("translation", step)],
            scale,
            left_jacobian(vector),
        )


def cross_matrix(v: NDArray) -> NDArray:
    """(..., 3) -> (..., 3, 3) with ``cross_matrix(v) @ w == cross(v, w)``."""
    out = np.zeros((*v.shape, 3), dtype=v.dtype)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exponential(vector: NDArray) -> NDArray[np.float64]:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    k = cross_matrix(np.asarray(vector, dtype=np.float64))
    if angle < 1e-6:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + (1.0 - np.cos(angle)) / angle**2 * k @ k


def left_jacobian(vector: NDArray) -> NDArray[np.float64]:
    """(3, 3) J with exp([v + dv]) = exp([J dv]) exp([v]) to first order."""
    angle = float(np.linalg.norm(vector))
    k = cross_matrix(np.asarray(vector, dtype=np.float64))
    if angle < 1e-4:
        return np.eye(3) + 0.5 * k + k @ k / 6.0
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k


class NormalEquations:
    """J^T J and J^T r of rows that each touch the shared unknowns and one timestep's."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.hessian, self.gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)

    def add(self, step: int, rows: NDArray) -> None:
        """Add rows (m, S + P + 1) of one timestep: shared and local derivatives and residual, by their weights' root.

        float32 rows are multiplied in float32 and accumulated in float64.
        """
        shared, local = slice(self.layout.shared_size), self.layout.local(step)
        products, s = rows.T @ rows, self.layout.shared_size
        for at, own in ((shared, slice(s)), (local, slice(s, -1))):
            for other, part in ((shared, slice(s)), (local, slice(s, -1))):
                self.hessian[at, other] += products[own, part]
            self.gradient[at] += products[own, -1]

    def add_priors(self, x: NDArray, priors: dict[str, float]) -> None:
        """Add ``weight * |x[name]|^2`` per group, for every timestep if the group is local."""
        for at, weight in _held(self.layout, priors):
            self.hessian[at, at] += weight * np.eye(at.stop - at.start)
            self.gradient[at] += weight * x[at]

    def system(self) -> DenseSystem:
        """The accumulated equations."""
        return DenseSystem(self.hessian, self.gradient)


def prior_energy(layout: Layout, x: NDArray, priors: dict[str, float]) -> float:
    """Energy that `NormalEquations.add_priors` linearises."""
    return sum(weight * float(x[at] @ x[at]) for at, weight in _held(layout, priors))


def _held(layout: Layout, priors: dict[str, float]) -> list[tuple[slice, float]]:
    """Unknowns that priors hold, and their weights."""
    steps = {name: range(layout.timesteps) if name in LOCAL else (0,) for name in priors}
    return [(layout.at(name, step), weight) for name, weight in priors.items() for step in steps[name]]
