"""How a minimisation ended."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mifit.solve.systems import System

FEWEST_ITERATIONS = 10
"""Iterations over which a first-order descent is judged, at the least."""


class Outcome(Enum):
    """Why the driver stopped; only ``CONVERGED`` and ``STALLED`` are minima to working precision."""

    CONVERGED = "converged"  # the step or the predicted decrease fell below the tolerance
    STALLED = "stalled"  # no step, however short, lowers the energy: at the minimum to rounding, or a wrong Jacobian
    MAX_ITERATIONS = "max_iterations"
    SINGULAR = "singular"  # the linear system has no finite solution at any damping
    DIVERGED = "diverged"  # energy or derivatives are not finite at the start

    @classmethod
    def worst(cls, outcomes: Iterable[Outcome]) -> Outcome:
        """The least satisfactory of several outcomes; ``CONVERGED`` where there is none."""
        return max(outcomes, key=list(cls).index, default=cls.CONVERGED)

    @classmethod
    def of_history(cls, energies: Sequence[float], window: float = 0.1, tolerance: float = 1e-2) -> Outcome:
        """How a descent without a model of its steps, such as Adam's, ended, read off its energies.

        Converged when the energy fell by less than ``tolerance``, relative, over the last ``window`` of the iterations,
        which must be ten or more.
        """
        if not np.isfinite(energies).all():
            return cls.DIVERGED
        last = round(window * len(energies))
        if last < FEWEST_ITERATIONS:
            return cls.MAX_ITERATIONS
        return (
            cls.CONVERGED
            if abs(energies[-1 - last] - energies[-1]) < tolerance * abs(energies[-1])
            else cls.MAX_ITERATIONS
        )


@dataclass(frozen=True)
class Solution:
    """What `minimize` returns.

    Attributes
    ----------
    value : (n,) float64
        Best parameters found.
    outcome : Outcome
    energies : dict of str to list of float
        Energy per term at the start and after each accepted step.
    system : System
        Linearisation at ``value`` when the run converged, else at the last linearised point; its
        ``covariance_diagonal`` gives the uncertainty of the parameters. None if it diverged at the start.
    iterations, evaluations, rejected : int
        Linearisations, energy evaluations and rejected steps.
    seconds : float
    """

    value: NDArray
    outcome: Outcome
    energies: dict[str, list[float]] = field(default_factory=dict)
    system: System | None = None
    iterations: int = 0
    evaluations: int = 0
    rejected: int = 0
    seconds: float = 0.0

    @property
    def energy(self) -> float:
        """Total energy at ``value``."""
        return float(sum(values[-1] for values in self.energies.values()))

    @property
    def usable(self) -> bool:
        """Whether ``value`` is a minimum, or on the way to one, rather than the wreck of a failed run."""
        return self.outcome not in (Outcome.DIVERGED, Outcome.SINGULAR)
