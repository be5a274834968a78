"""The least-squares solvers on problems whose answer is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from mifit.optim import DenseSystem, Outcome, geman_mcclure, minimize
from mifit.optim.minimize import trust


def of_rows(residual, jacobian):
    return DenseSystem(jacobian.T @ jacobian, jacobian.T @ residual)


@dataclass
class Rosenbrock:
    """r = (10 (y - x^2), 1 - x): a curved valley with its minimum 0 at (1, 1)."""

    def energies(self, x):
        return {"valley": float(100 * (x[1] - x[0] ** 2) ** 2), "slope": float((1 - x[0]) ** 2)}

    def linearize(self, x):
        return of_rows(np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]))


@dataclass
class Linear:
    """|A x - b|^2."""

    a: np.ndarray
    b: np.ndarray

    def energies(self, x):
        return {"rows": float(((self.a @ x - self.b) ** 2).sum())}

    def linearize(self, x):
        return of_rows(self.a @ x - self.b, self.a)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_systems_take_the_step_of_damped_least_squares(damping):
    rng = np.random.default_rng(0)
    jacobian, residual = rng.normal(size=(60, 12)), rng.normal(size=60)
    frozen = np.zeros(jacobian.shape[1], dtype=bool)
    frozen[[1, 5, 9]] = True
    free = jacobian[:, ~frozen]
    rows = np.vstack([free, np.diag(np.sqrt(damping * (free**2).sum(0)))])
    expected = np.zeros(len(frozen))
    expected[~frozen] = np.linalg.lstsq(rows, np.append(-residual, np.zeros(free.shape[1])), rcond=None)[0]
    assert np.abs(expected).max() > 1e-3
    system = of_rows(residual, jacobian)
    np.testing.assert_allclose(system.solve(damping, frozen), expected, atol=1e-10)
    np.testing.assert_allclose(system.solve(damping, frozen, 2.0 * jacobian.T @ residual), 2.0 * expected, atol=1e-9)
    np.testing.assert_allclose(system.product(expected), jacobian.T @ (jacobian @ expected), atol=1e-10)


def test_rosenbrock_from_the_classic_start():
    solution = minimize(Rosenbrock(), np.array([-1.2, 1.0]), max_iterations=200)
    assert solution.outcome is Outcome.CONVERGED
    np.testing.assert_allclose(solution.value, 1.0, atol=1e-6)
    total = np.sum(list(solution.energies.values()), axis=0)
    assert np.all(np.diff(total) < 0), "every accepted step must lower the energy"
    assert len(total) <= solution.iterations + 1


def test_a_linear_problem_is_solved_in_few_steps():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(30, 5)), rng.normal(size=30)
    solution = minimize(Linear(a, b), np.zeros(5), step_tolerance=1e-12, energy_tolerance=0.0)
    np.testing.assert_allclose(solution.value, np.linalg.lstsq(a, b, rcond=None)[0], atol=1e-9)
    assert solution.iterations < 8 and solution.rejected == 0


def test_bounds_hold_and_the_rest_is_optimal():
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(3)
    for _ in range(20):
        a, b = rng.normal(size=(12, 6)), 3 * rng.normal(size=12)
        low, high = np.zeros(6), np.full(6, 0.5)
        solution = minimize(Linear(a, b), np.full(6, 0.2), lower=low, upper=high, max_iterations=100)
        assert np.all(solution.value >= low) and np.all(solution.value <= high)
        best = lsq_linear(a, b, (low, high)).x
        assert Linear(a, b).energies(solution.value)["rows"] <= Linear(a, b).energies(best)["rows"] * (1 + 1e-6)


def test_equal_bounds_hold_a_parameter():
    a, b = np.eye(3), np.array([1.0, 2.0, 3.0])
    low = np.array([-np.inf, 0.5, -np.inf])
    high = np.array([np.inf, 0.5, np.inf])
    solution = minimize(Linear(a, b), np.zeros(3), lower=low, upper=high)
    np.testing.assert_allclose(solution.value, [1.0, 0.5, 3.0], atol=1e-6)


def test_damping_carries_a_rank_deficient_problem():
    a = np.array([[1.0, 1.0], [2.0, 2.0]])
    problem = Linear(a, np.array([1.0, 2.0]))
    solution = minimize(problem, np.zeros(2))
    assert solution.usable and solution.energy < 1e-12


def test_outcomes_are_told_apart():
    @dataclass
    class Nan(Linear):
        def energies(self, x):
            return {"rows": float("nan")}

    @dataclass
    class WrongJacobian(Linear):
        def linearize(self, x):
            return of_rows(self.a @ x - self.b, -self.a)

    a, b = np.eye(2), np.ones(2)
    start = np.zeros(2)
    assert minimize(Nan(a, b), start).outcome is Outcome.DIVERGED
    assert not minimize(Nan(a, b), start).usable
    stalled = minimize(WrongJacobian(a, b), start)
    assert stalled.outcome is Outcome.STALLED and np.all(stalled.value == start)
    assert minimize(Rosenbrock(), np.array([-1.2, 1.0]), max_iterations=2).outcome is Outcome.MAX_ITERATIONS


def test_trust_ratio_rule():
    assert trust(1.0, 1.0, 8.0, 0) == (True, 24.0)  # as promised: damping falls by 3
    accepted, size = trust(1.0, 0.5, 8.0, 0)
    assert accepted and size == 8.0  # half of what was promised: as it was
    assert trust(1.0, -0.1, 8.0, 0) == (False, 4.0)
    assert trust(1.0, -0.1, 8.0, 2) == (False, 1.0)  # growing faster with each rejection
    assert trust(1.0, float("nan"), 8.0, 0)[0] is False
    assert trust(-1.0, 1.0, 8.0, 0)[0] is False


def test_robust_weight_is_the_slope_of_the_geman_mcclure():
    squared = np.linspace(0.01, 30.0, 400)
    rho, weight = geman_mcclure(squared, 1.7)
    np.testing.assert_allclose(np.gradient(rho, squared)[1:-1], weight[1:-1], atol=5e-3)
    small_rho, small_weight = geman_mcclure(np.array([1e-8]), 1.7)
    np.testing.assert_allclose([small_rho[0] / 1e-8, small_weight[0]], 1.0, atol=1e-6)
    assert np.all(np.diff(weight) <= 1e-12) and weight[-1] < 0.4


def test_outliers_do_not_pull_a_robust_mean():
    data = np.concatenate([np.random.default_rng(4).normal(size=90), np.full(10, 50.0)])

    @dataclass
    class Mean:
        def energies(self, x):
            return {"data": float(geman_mcclure((x[0] - data) ** 2, 3.0)[0].sum())}

        def linearize(self, x):
            root = np.sqrt(geman_mcclure((x[0] - data) ** 2, 3.0)[1])
            return of_rows(root * (x[0] - data), root[:, None])

    solution = minimize(Mean(), np.array([np.median(data)]))
    assert solution.usable and abs(solution.value[0] - data[:90].mean()) < 0.1
    assert abs(data.mean()) > 4.0


def test_the_worst_of_several_outcomes_counts():
    assert Outcome.worst([]) is Outcome.CONVERGED
    assert Outcome.worst([Outcome.CONVERGED, Outcome.MAX_ITERATIONS, Outcome.STALLED]) is Outcome.MAX_ITERATIONS
    assert Outcome.worst([Outcome.DIVERGED, Outcome.CONVERGED]) is Outcome.DIVERGED
