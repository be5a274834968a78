"""Nonlinear least squares by Levenberg and Marquardt's method: linearise, propose, evaluate, judge, repeat.

A *problem* linearises itself into a *system* (normal equations with their structure); `minimize` takes damped steps and
returns a `Solution` that says in an enumerated `Outcome` how it ended.

The energy is E = sum r^2 (no half), so the model of a step d is E + 2 g.d + d.H d with g = J^T r and H = J^T J.
A damped step solves (H + lambda D) d = -g, D = diag(H): Marquardt's scaling, which makes it independent of the
parameters' units. Frozen parameters (at a bound, pushed outwards) keep d = 0.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import linalg


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


@dataclass(frozen=True)
class Solution:
    """What `minimize` returns.

    ``value`` (n,) are the best parameters found; ``energies`` per term at the start and after each accepted step;
    ``iterations`` count linearisations, ``evaluations`` energies and ``rejected`` steps.
    """

    value: NDArray
    outcome: Outcome
    energies: dict[str, list[float]] = field(default_factory=dict)
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


class System(Protocol):
    """What `minimize` needs to know of a linearisation."""

    @property
    def gradient(self) -> NDArray[np.float64]:
        """(n,) g = J^T r, half the gradient of the energy."""

    def product(self, step: NDArray) -> NDArray[np.float64]:
        """H times a vector."""

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        """Damped step with the frozen parameters held, for another right-hand side if given.

        Raises numpy's LinAlgError when singular.
        """


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
        diagonal = np.diag(h)
        # D is kept away from zero, so that a parameter without data is still held by damping.
        h[np.diag_indices(len(free))] += damping * np.maximum(diagonal, 1e-12 * diagonal.max(initial=0.0) or 1.0)
        step = np.zeros(len(frozen))
        g = self.gradient if gradient is None else gradient
        step[free] = linalg.cho_solve(linalg.cho_factor(h), -g[free])
        return step


class Problem(Protocol):
    """A sum of squares, E(x) = sum of the energies of its terms."""

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""

    def linearize(self, x: NDArray) -> System:
        """Normal equations at x."""


def minimize(
    problem: Problem,
    start: NDArray,
    *,
    lower: NDArray | None = None,
    upper: NDArray | None = None,
    max_iterations: int = 50,
    damping: float = 1e-3,
    step_tolerance: float = 1e-8,
    energy_tolerance: float = 1e-8,
) -> Solution:
    """Minimise a sum of squares, with optional bounds, by Levenberg and Marquardt's method.

    Damping follows Nielsen's rule, see `trust`. A parameter at a bound whose gradient points outwards is frozen for the
    step; one that would cross a bound is put on it and the others are solved for again.

    ``start`` (n,) is clipped to the bounds ``lower`` and ``upper`` (n,); ``max_iterations`` counts linearisations;
    ``damping`` is that of the first step. It has converged when the step is within ``step_tolerance`` relative to
    ``1 + |x|`` in the largest entry, or the predicted decrease is below the part ``energy_tolerance`` of the energy.
    """
    began = time.perf_counter()
    x = np.array(start, dtype=np.float64)
    low = np.full(len(x), -np.inf) if lower is None else np.asarray(lower, dtype=np.float64)
    high = np.full(len(x), np.inf) if upper is None else np.asarray(upper, dtype=np.float64)
    x = np.clip(x, low, high)
    terms = problem.energies(x)
    history = {name: [value] for name, value in terms.items()}
    energy = sum(terms.values())
    evaluations, rejected, iterations = 1, 0, 0
    size, outcome = 1.0 / damping, Outcome.MAX_ITERATIONS
    if not np.isfinite(energy):
        outcome, max_iterations = Outcome.DIVERGED, 0
    while iterations < max_iterations:
        iterations += 1
        system = problem.linearize(x)
        g = system.gradient
        if not np.isfinite(g).all():
            outcome = Outcome.DIVERGED
            break
        frozen = ((x <= low) & (g > 0)) | ((x >= high) & (g < 0))
        rejections, done = 0, False
        while True:
            step = _bounded_step(system, size, frozen, low - x, high - x)
            if step is None:
                size /= 10.0
                if size < 1e-12:
                    outcome, done = Outcome.SINGULAR, True
                    break
                continue
            candidate = np.clip(x + step, low, high)
            step = candidate - x
            predicted = -float(2.0 * g @ step + step @ system.product(step))
            small = np.abs(step).max(initial=0.0) <= step_tolerance * (1.0 + np.abs(x).max(initial=0.0))
            if small or (0.0 <= predicted <= energy_tolerance * energy and rejections == 0):
                outcome, done = Outcome.CONVERGED if rejections == 0 else Outcome.STALLED, True
                break
            terms = problem.energies(candidate)
            evaluations += 1
            new = sum(terms.values())
            actual = energy - new if np.isfinite(new) else float("nan")
            accepted, size = trust(predicted, actual, size, rejections)
            if accepted:
                x, energy = candidate, new
                for name, value in terms.items():
                    history[name].append(value)
                break
            rejections += 1
            rejected += 1
            if size < 1e-12:
                outcome, done = Outcome.STALLED, True
                break
        if done:
            break
    return Solution(x, outcome, history, iterations, evaluations, rejected, time.perf_counter() - began)


def trust(predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
    """Whether to take a step, and the size (one over the damping) of the next, by the ratio of the energy's decreases.

    Nielsen's rule (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004): the damping
    shrinks smoothly with the ratio, at most by 3, and grows by 2, 4, 8, ... over successive ``rejections``.
    ``predicted`` is the decrease by the linear model, ``actual`` the evaluated one (NaN when not finite).
    """
    ratio = actual / predicted if predicted > 0 else -1.0
    if ratio >= 1e-4:  # False for NaN
        return True, min(size / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e12)
    return False, size / 2.0 ** (rejections + 1)


def _bounded_step(system: System, size: float, frozen: NDArray, low: NDArray, high: NDArray) -> NDArray | None:
    """A finite step within its bounds, damped by ``1 / size``, or None when the system is singular at this size."""
    fixed, held = np.zeros(len(frozen)), frozen
    gradient = None
    for _ in range(12):
        try:
            step = system.solve(1.0 / size, held, gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        step = np.where(held, fixed, step)
        below, above = ~held & (step < low), ~held & (step > high)
        if not (below.any() or above.any()):
            break
        # Solved again with these on their bounds: clipping alone can turn a descent into an ascent.
        fixed = np.where(below, low, np.where(above, high, fixed))
        held = held | below | above
        gradient = system.gradient + system.product(fixed)
    return step


def geman_mcclure(squared: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Geman and McClure's penalty s^2 r^2 / (s^2 + r^2): bounded, so that a gross outlier has no pull.

    It equals r^2 to second order at zero. Returned are rho and the weight rho'(r) / 2r of iteratively reweighted least
    squares, like ``squared``; an infinite ``scale`` s gives least squares.
    """
    if np.isinf(scale):
        return squared, np.ones_like(squared)
    q = scale * scale / (scale * scale + squared)
    return squared * q, q * q
