"""The one driver: linearise, propose, evaluate, judge, repeat."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.solve.acceptance import Acceptance, TrustRatio
from mifit.solve.descent import Descent, LevenbergMarquardt
from mifit.solve.solution import Outcome, Solution
from mifit.solve.systems import System

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
