"""The solvers of stage 3: Gauss-Newton on 2 x 2 blocks per texel, and the paper's Adam, on the same energy.

All arrays stay with Dr.Jit between iterations; the host reads one number per iteration, the energy.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.optim import Outcome, Solution
from mifit.progress import Progress, silent
from mifit.stages.normals.problem import NormalProblem, stored_offsets, term_totals


def gauss_newton(
    problem: NormalProblem,
    max_iterations: int = 20,
    tolerance: float = 1e-3,
    start: NDArray | None = None,
    progress: Progress = silent,
) -> Solution:
    """Minimise by Gauss-Newton with 2 x 2 blocks per texel.

    The L1 norm is replaced by its quadratic majorant at the current point (iteratively reweighted least squares);
    the joint system is solved by conjugate gradients with block-diagonal preconditioning. A step that raises the
    energy is taken back and damped (Levenberg-Marquardt). Ends when the energy falls by less than ``tolerance``,
    relative.
    """
    import drjit as dr

    began = time.perf_counter()
    a, b = problem.facing(*problem.load(None), *problem.load(start))
    local, system = problem.linearize(a, b)
    rough = problem.roughness(a, b)
    totals = term_totals(local, rough)
    history = {name: [value] for name, value in totals.items()}
    damping, outcome = problem.zeros(), Outcome.MAX_ITERATIONS
    iteration = rejected = 0
    if not np.isfinite(sum(totals.values())):
        outcome, max_iterations = Outcome.DIVERGED, 0
    for iteration in range(max_iterations):
        progress("normals", iteration, max_iterations)
        x, y = problem.facing(a, b, *problem.step(a, b, system, damping))
        found, new_system = problem.linearize(x, y)
        # Data and magnitude are separable: a texel whose own energy rises stays, and steps shorter next time.
        worse = ~(sum(found.values()) <= 1.0001 * sum(local.values()) + 1e-9)  # also where it is NaN
        x, y = dr.select(worse, a, x), dr.select(worse, b, y)
        found = {name: dr.select(worse, local[name], value) for name, value in found.items()}
        new_rough = problem.roughness(x, y)
        after = term_totals(found, new_rough)
        before = sum(totals.values())
        increased = sum(after.values()) > before
        damping = dr.select(worse | increased, dr.maximum(8.0 * damping, 0.05), 0.25 * damping)
        dr.eval(damping, x, y)
        if increased:
            rejected += 1
            continue
        system = tuple(dr.select(worse, old, new) for old, new in zip(system, new_system, strict=True))
        a, b, local, rough, totals = x, y, found, new_rough, after
        dr.eval(system, local)
        for name, value in totals.items():
            history[name].append(value)
        if before - sum(totals.values()) <= tolerance * before:
            outcome = Outcome.CONVERGED
            break
    progress("normals", max_iterations, max_iterations)
    seconds = time.perf_counter() - began
    return Solution(stored_offsets(a, b), outcome, history, None, iteration + 1, iteration + 2, rejected, seconds)


def adam_steps(
    problem: NormalProblem,
    iterations: int = 100,
    step: float = 0.01,
    start: NDArray | None = None,
    progress: Progress = silent,
) -> Solution:
    """Minimise by Adam with learning rate ``step`` (radians): the paper's solver, on the same energy.

    Converged by `Outcome.of_history`: Adam has no model of its steps to go by.
    """
    import drjit as dr
    import mitsuba as mi

    began = time.perf_counter()
    a, b = problem.load(start)
    optimizer = mi.ad.Adam(lr=step, params={"a": a, "b": b})
    totals = []
    for iteration in range(iterations):
        x = optimizer["a"], optimizer["b"]
        total = dr.zeros(mi.Float, 1)
        for k in range(len(problem.views)):  # one kernel, compiled once for all views
            total += _descend(problem.data(*x, k))
            dr.eval(total, *(dr.grad(v) for v in x))
        total += _descend(problem.magnitude(*x) + problem.roughness(*x))
        totals.append(total)
        optimizer.step()
        dr.eval(total, optimizer["a"], optimizer["b"])
        progress("normals (adam)", iteration + 1, iterations)
    a, b = problem.facing(*problem.load(None), dr.detach(optimizer["a"]), dr.detach(optimizer["b"]))
    found = term_totals(*problem.terms(a, b))
    energies = [float(t[0]) for t in totals]
    history = {"total": [*energies, sum(found.values())]}
    seconds = time.perf_counter() - began
    return Solution(
        stored_offsets(a, b), Outcome.of_history(energies), history, None, iterations, iterations + 1, 0, seconds
    )


def _descend(energy: Any) -> Any:
    """Sum an energy and add its gradient to that of the variables it depends on."""
    import drjit as dr

    total = dr.sum(energy)
    dr.backward(total)
    return dr.detach(total)
