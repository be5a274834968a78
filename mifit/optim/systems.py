"""Linearised least squares: sum of squares r + J d, kept in the form that suits its structure.

The energy is E = sum r^2 (no half), so the model of a step d is E + 2 g.d + d.H d with g = J^T r and H = J^T J.
A damped step solves (H + lambda D) d = -g, D = diag(H): Marquardt's scaling, which makes it independent of the
parameters' units. Frozen parameters (at a bound, pushed outwards) keep d = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg


class System(Protocol):
    """What `minimize` needs to know of a linearisation."""

    @property
    def gradient(self) -> NDArray[np.float64]:
        """(n,) g = J^T r, half the gradient of the energy."""
        ...

    def product(self, step: NDArray) -> NDArray[np.float64]:
        """H times a vector."""
        ...

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        """Damped step with the frozen parameters held, for another right-hand side if given.

        Raises numpy's LinAlgError when singular.
        """
        ...

    def covariance_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of H^-1: the parameters' variances in units of the residuals' variance."""
        ...


def _scaling(diagonal: NDArray) -> NDArray:
    """Marquardt's D, kept away from zero so that a parameter without data is still held by damping."""
    largest = diagonal.max(initial=0.0)
    return np.maximum(diagonal, 1e-12 * largest if largest > 0 else 1.0)


class DenseSystem:
    """Normal equations in one dense matrix: ``hessian`` (n, n) = J^T J and ``gradient`` (n,) = J^T r."""

    def __init__(self, hessian: NDArray, gradient: NDArray) -> None:
        self.hessian = np.asarray(hessian, dtype=np.float64)
        self.gradient = np.asarray(gradient, dtype=np.float64)

    def product(self, step: NDArray) -> NDArray[np.float64]:
        """H d."""
        return self.hessian @ step

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        """Cholesky of the damped matrix over the free parameters."""
        free = np.flatnonzero(~frozen)
        h = self.hessian[np.ix_(free, free)]
        h[np.diag_indices(len(free))] += damping * _scaling(np.diag(h))
        step = np.zeros(len(frozen))
        g = self.gradient if gradient is None else gradient
        step[free] = linalg.cho_solve(linalg.cho_factor(h), -g[free])
        return step

    def covariance_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of H^-1."""
        return _inverse_diagonal(self.hessian)


class ArrowSystem:
    """Normal equations of parameters shared by all blocks and parameters of each block alone.

    H is an arrow: ``shared`` (S, S), and per block t ``local`` (P_t, P_t) and its ``coupling`` (S, P_t) to the shared
    one; blocks don't see one another. Eliminating the local parameters (Schur complement) costs one small Cholesky per
    block. Parameters are ordered shared first, then block by block.
    """

    def __init__(
        self,
        shared: NDArray,
        shared_gradient: NDArray,
        local: Sequence[NDArray],
        local_gradient: Sequence[NDArray],
        coupling: Sequence[NDArray],
    ) -> None:
        self.shared = np.asarray(shared, dtype=np.float64)
        self.local = [np.asarray(block, dtype=np.float64) for block in local]
        self.coupling = [np.asarray(block, dtype=np.float64) for block in coupling]
        self.gradient = np.concatenate([shared_gradient, *local_gradient]).astype(np.float64)
        sizes = [len(self.shared), *(len(block) for block in self.local)]
        ends = np.cumsum(sizes)
        self.slices = [slice(end - size, end) for size, end in zip(sizes, ends, strict=True)]

    def dense(self) -> NDArray[np.float64]:
        """(n, n) the whole matrix."""
        h = np.zeros((len(self.gradient),) * 2)
        s = self.slices[0]
        h[s, s] = self.shared
        for at, block, coupling in zip(self.slices[1:], self.local, self.coupling, strict=True):
            h[at, at] = block
            h[s, at] = coupling
            h[at, s] = coupling.T
        return h

    def product(self, step: NDArray) -> NDArray[np.float64]:
        """H d without forming H."""
        s = self.slices[0]
        out = np.empty(len(step))
        out[s] = self.shared @ step[s]
        for at, block, coupling in zip(self.slices[1:], self.local, self.coupling, strict=True):
            out[s] += coupling @ step[at]
            out[at] = coupling.T @ step[s] + block @ step[at]
        return out

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        """Damped step by the Schur complement on the shared parameters."""
        s = self.slices[0]
        right = np.where(frozen, 0.0, -(self.gradient if gradient is None else gradient))
        schur, rhs = _damped(self.shared, damping, frozen[s]), right[s].copy()
        factors = []
        for at, block, coupling in zip(self.slices[1:], self.local, self.coupling, strict=True):
            factor = linalg.cho_factor(_damped(block, damping, frozen[at]))
            c = coupling * ~frozen[s][:, None] * ~frozen[at]
            w = linalg.cho_solve(factor, c.T)
            schur -= c @ w
            rhs -= w.T @ right[at]
            factors.append((factor, w))
        step = np.empty(len(frozen))
        step[s] = linalg.cho_solve(linalg.cho_factor(schur), rhs)
        for at, (factor, w) in zip(self.slices[1:], factors, strict=True):
            step[at] = linalg.cho_solve(factor, right[at]) - w @ step[s]
        return step

    def covariance_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of H^-1."""
        return _inverse_diagonal(self.dense())


def _damped(block: NDArray, damping: float, frozen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Copy of a diagonal block with damping added and frozen rows and columns replaced by the identity's."""
    out = block * ~frozen * ~frozen[:, None]
    diagonal = np.where(frozen, 1.0, np.diag(block) + damping * _scaling(np.diag(block)))
    out[np.diag_indices(len(out))] = diagonal
    return out


def _inverse_diagonal(hessian: NDArray) -> NDArray[np.float64]:
    """Diagonal of the inverse, infinite throughout when the matrix is singular."""
    scale = 1.0 / np.sqrt(_scaling(np.diag(hessian)))  # unit diagonal first: units must not decide what is singular
    try:
        factor = linalg.cho_factor(hessian * scale * scale[:, None])
    except np.linalg.LinAlgError:
        return np.full(len(hessian), np.inf)
    return np.diag(linalg.cho_solve(factor, np.eye(len(hessian)))) * scale**2
