"""Accumulates the normal equations of stage 1 block by block."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.optim import ArrowSystem
from mifit.stages.geometry.parameters import LOCAL, Layout


class NormalEquations:
    """J^T J and J^T r of rows that each touch the shared unknowns and one timestep's."""

    def __init__(self, layout: Layout) -> None:
        s, p, t = layout.shared_size, layout.local_size, layout.timesteps
        self.layout = layout
        self.shared = np.zeros((s, s))
        self.shared_gradient = np.zeros(s)
        self.local = np.zeros((t, p, p))
        self.local_gradient = np.zeros((t, p))
        self.coupling = np.zeros((t, s, p))

    def add(self, step: int, shared: NDArray, local: NDArray, residual: NDArray, weight: NDArray) -> None:
        """Add rows of one timestep.

        Parameters
        ----------
        shared : (m, S), local : (m, P)
            Jacobian; float32 rows are multiplied in float32 and accumulated in float64.
        residual, weight : (m,)
            Residuals and the weights of their squares.
        """
        self.add_square(step, square(shared, local, residual, weight))

    def add_weighted(self, step: int, rows: NDArray) -> None:
        """Add rows (m, S + P + 1) of one timestep: shared, local and residual, by the root of their weights."""
        self.add_square(step, rows.T @ rows)

    def add_square(self, step: int, h: NDArray) -> None:
        """Add the `square` of rows of one timestep."""
        s = self.layout.shared_size
        self.shared += h[:s, :s]
        self.coupling[step] += h[:s, s:-1]
        self.local[step] += h[s:-1, s:-1]
        self.shared_gradient += h[:s, -1]
        self.local_gradient[step] += h[s:-1, -1]

    def add_priors(self, x: NDArray, priors: dict[str, float]) -> None:
        """Add ``weight * |x[name]|^2`` per group, for every timestep if the group is local."""
        for name, weight in priors.items():
            for step in range(self.layout.timesteps) if name in LOCAL else (0,):
                at = self.layout.at(name, step)
                start = self.layout.local(step).start if name in LOCAL else 0
                inside = np.arange(at.start - start, at.stop - start)
                block, gradient = (
                    (self.local[step], self.local_gradient[step])
                    if name in LOCAL
                    else (self.shared, self.shared_gradient)
                )
                block[inside, inside] += weight
                gradient[inside] += weight * x[at]

    def system(self) -> ArrowSystem:
        """The accumulated equations."""
        return ArrowSystem(
            self.shared, self.shared_gradient, list(self.local), list(self.local_gradient), list(self.coupling)
        )


def square(shared: NDArray, local: NDArray, residual: NDArray, weight: NDArray) -> NDArray:
    """Products (S + P + 1, S + P + 1) of rows, their residual as the last column; parameters as in `add`."""
    root = np.sqrt(weight).astype(shared.dtype)[:, None]
    rows = np.concatenate([shared, local, np.asarray(residual, shared.dtype)[:, None]], axis=1)
    rows *= root
    return rows.T @ rows


def prior_energy(layout: Layout, x: NDArray, priors: dict[str, float]) -> float:
    """Energy that `NormalEquations.add_priors` linearises."""
    total = 0.0
    for name, weight in priors.items():
        for step in range(layout.timesteps) if name in LOCAL else (0,):
            values = x[layout.at(name, step)]
            total += weight * float(values @ values)
    return total
