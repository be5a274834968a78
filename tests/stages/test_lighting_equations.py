"""The lighting's normal equations against plain ones: every unknown, no structure, double precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mifit.stages.reflectance import lighting_equations
from mifit.stages.reflectance.lighting_equations import LightingEquations, LightingProblem, bounded_step

N, J, ORDER = 30, 4, 2
K = ORDER**2 + 1
"""A compact light beside the smooth one."""
DAMPING = 1e-2


@pytest.fixture
def problem() -> LightingProblem:
    rng = np.random.default_rng(0)
    there = rng.random((N, J)) > 0.4
    there[7] = False  # a texel that nothing shows
    texel = np.nonzero(there)[0]
    values = [rng.random((len(texel), size)) for size in (3, 3, K, K)]
    colour, weight, diffuse, specular = (v.astype(np.float32) for v in values)
    clipped = rng.random(len(texel)) > 0.9
    return LightingProblem(texel, colour, weight, clipped, diffuse, specular, np.full((N, 3), 0.5, np.float32), ORDER)


def test_no_more_specular_albedo_is_expected_than_is_given(problem):
    found = np.full(9, 0.2)
    assert problem.expected_specular(found) == pytest.approx(0.2)
    assert replace(problem, gloss=0.03).expected_specular(found) == 0.03
    assert replace(problem, gloss=0.03).expected_specular(found / 20) == pytest.approx(0.01)


class State:
    """Where the equations are linearised."""

    def __init__(self, problem: LightingProblem) -> None:
        rng = np.random.default_rng(1)
        self.light, self.diffuse, self.specular = rng.normal(size=(K, 3)), rng.random((N, 3)), rng.random(N)
        self.shading = problem.diffuse @ self.light, problem.specular @ self.light
        shown = self.diffuse[problem.texel] * self.shading[0] + self.specular[problem.texel, None] * self.shading[1]
        self.residual = problem.colour - shown

    def equations(self, problem: LightingProblem) -> LightingEquations:
        shading, residual = [v.astype(np.float32) for v in self.shading], self.residual.astype(np.float32)
        return LightingEquations.accumulate(problem, (self.diffuse, self.specular), shading, residual, problem.weight)

    def jacobian(self, problem: LightingProblem) -> NDArray[np.float64]:
        """(M, 3, 3K + 4N) derivatives of the images."""
        out = np.zeros((len(problem.texel), 3, 3 * K + 4 * N))
        for m, n in enumerate(problem.texel):
            for c in range(3):
                block = slice(c * K, (c + 1) * K)
                out[m, c, block] = self.diffuse[n, c] * problem.diffuse[m] + self.specular[n] * problem.specular[m]
                out[m, c, 3 * K + 4 * n + c] = self.shading[0][m, c]
                out[m, c, 3 * K + 3 + 4 * n] = self.shading[1][m, c]
        return out


def plain_step(problem: LightingProblem, state: State) -> tuple[NDArray, NDArray]:
    """Step of lighting and of the texels (N, 4), by one dense solve; a texel's pull is 1."""
    rows = state.jacobian(problem).reshape(-1, 3 * K + 4 * N)
    weight = problem.weight.astype(np.float64).ravel()
    system, right = (rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ state.residual.ravel()
    texels, lights = np.arange(3 * K, len(system)), np.arange(3 * K)
    system[texels, texels] += 1.0
    diagonal = np.diag(system)
    damping = np.zeros(len(system))
    damping[lights] = DAMPING * diagonal[lights] + 1e-8 * diagonal[lights].mean()
    damping[texels] = DAMPING * diagonal[texels] + 1e-6 * np.median(diagonal[texels]) + 1e-12
    step = np.linalg.solve(system + np.diag(damping), right)
    return step[: 3 * K], step[3 * K :].reshape(N, 4)


@pytest.mark.parametrize("block", [8 * K, 1 << 20])
def test_a_step_is_that_of_all_unknowns_at_once(problem, block, monkeypatch):
    monkeypatch.setattr(lighting_equations, "BLOCK", block)
    monkeypatch.setattr("mifit.core.process.BLOCK", block)
    state = State(problem)
    equations = state.equations(problem)
    equations.diffuse += 1.0
    equations.specular += 1.0
    light, diffuse, specular = equations.solve(DAMPING)
    expected, own = plain_step(problem, state)
    np.testing.assert_allclose(light, expected.reshape(3, K).T, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(diffuse, own[:, :3], atol=1e-4)
    np.testing.assert_allclose(specular, own[:, 3], atol=1e-4)


def test_sums_are_those_of_each_texel(problem):
    sums = problem.sums(problem.weight)
    for n in range(N):
        np.testing.assert_allclose(sums[n], problem.weight[problem.texel == n].sum(axis=0), atol=1e-5)
    assert np.array_equal(np.diff(problem.start), np.bincount(problem.texel, minlength=N))


def test_a_bounded_step_is_the_constrained_minimum():
    rng = np.random.default_rng(0)
    rows, target = rng.normal(size=(90, 60)), rng.normal(size=90)
    system, right = rows.T @ rows + np.eye(60), rows.T @ target
    lowest = np.where(np.arange(60) < 20, -np.inf, rng.normal(size=60) - 0.2)
    step = bounded_step(system, right, lowest)
    slope = system @ step - right
    held = step <= lowest + 1e-9
    assert 5 < held.sum() < 35 and (step >= lowest - 1e-9).all()
    assert np.abs(slope[~held]).max() < 1e-6 and slope[held].min() > -1e-6
