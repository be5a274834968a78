"""Nonlinear least squares by Gauss-Newton or Levenberg-Marquardt: linearise, propose, evaluate, judge, repeat.

A *problem* linearises itself into a *system* (normal equations with their structure, `optim.systems`); a *descent*
turns a system into a step; an *acceptance* judges the step and sets the size of the next one; `minimize` drives the
three and returns a `Solution` that says in an enumerated `Outcome` how it ended.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.optim.systems import System

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


class Descent(Protocol):
    """``descent(system, size, frozen, gradient)`` gives a step.

    ``size`` shrinks after rejections; ``gradient`` replaces the system's own when parameters are moved by hand.
    ``regularizes`` tells whether a smaller size can make a step of a system that is singular.
    """

    regularizes: ClassVar[bool]

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose a step."""
        ...


@dataclass(frozen=True)
class GaussNewton:
    """The minimiser of the linear model, shortened by ``size`` (1 = the full step)."""

    regularizes: ClassVar[bool] = False

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose ``size`` times the Gauss-Newton step."""
        return min(size, 1.0) * system.solve(0.0, frozen, gradient)


@dataclass(frozen=True)
class LevenbergMarquardt:
    """The minimiser of the linear model plus ``1 / size`` times Marquardt's diagonal."""

    regularizes: ClassVar[bool] = True

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose the step damped by ``1 / size``."""
        return system.solve(1.0 / size, frozen, gradient)


class Acceptance(Protocol):
    """Decides on a step and on the size of the next."""

    @property
    def initial_size(self) -> float:
        """Size of the first step."""
        ...

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """Whether to take the step, and the next size.

        Parameters
        ----------
        predicted, actual : float
            Decrease of the energy by the linear model, and as evaluated (NaN when not finite).
        size : float
            Size the step was made with.
        rejections : int
            Steps rejected in a row before this one.
        """
        ...


@dataclass(frozen=True)
class TrustRatio:
    """Trust by the ratio of actual to predicted decrease.

    Nielsen's rule (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004): the damping
    1 / size shrinks smoothly with the ratio, at most by 3, and grows by 2, 4, 8, ... over successive rejections.
    """

    initial_size: float = 1e3
    minimum_ratio: float = 1e-4

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """See `Acceptance`."""
        ratio = actual / predicted if predicted > 0 else -1.0
        if ratio >= self.minimum_ratio:  # False for NaN
            return True, min(size / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e12)
        return False, size / 2.0 ** (rejections + 1)


@dataclass(frozen=True)
class Backtracking:
    """Armijo's rule on the linear model's promise: halve until enough of it is kept; then start from full again."""

    initial_size: float = 1.0
    minimum_ratio: float = 1e-4

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """See `Acceptance`."""
        if predicted > 0 and actual >= self.minimum_ratio * predicted:
            return True, min(2.0 * size, 1.0)
        return False, size / 2.0


SMALLEST_SIZE = 1e-12
BOUND_ROUNDS = 12


class Problem(Protocol):
    """A sum of squares, E(x) = sum of the energies of its terms."""

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        ...

    def linearize(self, x: NDArray) -> System:
        """Normal equations at x."""
        ...


def minimize(
    problem: Problem,
    start: NDArray,
    *,
    descent: Descent | None = None,
    acceptance: Acceptance | None = None,
    lower: NDArray | None = None,
    upper: NDArray | None = None,
    max_iterations: int = 50,
    step_tolerance: float = 1e-8,
    energy_tolerance: float = 1e-8,
    callback: Callable[[int, dict[str, float]], None] | None = None,
) -> Solution:
    """Minimise a sum of squares, with optional bounds.

    Parameters
    ----------
    problem : Problem
    start : (n,)
        Clipped to the bounds.
    descent : Descent
        `LevenbergMarquardt` (default) or `GaussNewton`.
    acceptance : Acceptance
        `TrustRatio` (default) or `Backtracking`.
    lower, upper : (n,), optional
        Bounds. A parameter at a bound whose gradient points outwards is frozen for the step; one that would cross
        a bound is put on it and the others are solved for again.
    max_iterations : int
        Linearisations.
    step_tolerance : float
        Converged when the step is this small relative to ``1 + |x|`` in the largest entry.
    energy_tolerance : float
        Converged when the predicted decrease is below this fraction of the energy.
    callback : callable
        Called with the iteration and the energies after each accepted step.
    """
    began = time.perf_counter()
    descent = descent if descent is not None else LevenbergMarquardt()
    acceptance = acceptance if acceptance is not None else TrustRatio()
    x = np.array(start, dtype=np.float64)
    low = np.full(len(x), -np.inf) if lower is None else np.asarray(lower, dtype=np.float64)
    high = np.full(len(x), np.inf) if upper is None else np.asarray(upper, dtype=np.float64)
    x = np.clip(x, low, high)
    terms = problem.energies(x)
    history = {name: [value] for name, value in terms.items()}
    energy = sum(terms.values())
    evaluations, rejected, iterations = 1, 0, 0
    size, system, outcome = acceptance.initial_size, None, Outcome.MAX_ITERATIONS
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
            step = _bounded_step(descent, system, size, frozen, low - x, high - x)
            if step is None:
                size /= 10.0
                if size < SMALLEST_SIZE or not descent.regularizes:
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
            accepted, size = acceptance.judge(predicted, actual, size, rejections)
            if accepted:
                x, energy = candidate, new
                for name, value in terms.items():
                    history[name].append(value)
                if callback is not None:
                    callback(iterations, terms)
                break
            rejections += 1
            rejected += 1
            if size < SMALLEST_SIZE:
                outcome, done = Outcome.STALLED, True
                break
        if done:
            break
    return Solution(x, outcome, history, system, iterations, evaluations, rejected, time.perf_counter() - began)


def _bounded_step(
    descent: Descent, system: System, size: float, frozen: NDArray, low: NDArray, high: NDArray
) -> NDArray | None:
    """A finite step within its bounds, or None when the system is singular at this size.

    Parameters that the step would carry across a bound are put on it, and the others are solved for again given
    that; clipping alone can turn a descent into an ascent.
    """
    fixed, held = np.zeros(len(frozen)), frozen
    gradient = None
    for _ in range(BOUND_ROUNDS):
        try:
            step = descent(system, size, held, gradient)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        step = np.where(held, fixed, step)
        below, above = ~held & (step < low), ~held & (step > high)
        if not (below.any() or above.any()):
            break
        fixed = np.where(below, low, np.where(above, high, fixed))
        held = held | below | above
        gradient = system.gradient + system.product(fixed)
    return step
