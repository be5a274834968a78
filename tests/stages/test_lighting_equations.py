"""The lighting's normal equations against plain ones: every unknown, no structure, double precision."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mifit.stages.reflectance import lighting_equations
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingEquations, LightingProblem

N, J, ORDER = 30, 4, 2
K = ORDER**2 + 1
"""A compact light beside the smooth one."""
DAMPING = 1e-2


@pytest.fixture
def problem() -> LightingProblem:
    rng = np.random.default_rng(0)
    weight = rng.random((N, J, 3)) * (rng.random((N, J, 1)) > 0.4)
    weight[7] = 0.0  # a texel that nothing shows
    values = [rng.random(shape) for shape in ((N, J, 3), (N, J, K), (N, J, K), (N, 3))]
    colour, diffuse, specular, albedo = (v.astype(np.float32) for v in values)
    clipped = rng.random((N, J)) > 0.9
    return LightingProblem(colour, weight.astype(np.float32), clipped, diffuse, specular, albedo, ORDER)


class State:
    """Where the equations are linearised."""

    def __init__(self, problem: LightingProblem) -> None:
        rng = np.random.default_rng(1)
        self.light, self.diffuse, self.specular = rng.normal(size=(K, 3)), rng.random((N, 3)), rng.random(N)
        self.shading = problem.diffuse @ self.light, problem.specular @ self.light
        shown = self.diffuse[:, None] * self.shading[0] + self.specular[:, None, None] * self.shading[1]
        self.residual = problem.colour - shown

    def equations(self, problem: LightingProblem) -> LightingEquations:
        rows, seen = problem.rows(), problem.seen
        at = (self.shading[0][seen], self.shading[1][seen], self.residual[seen], rows.weight)
        return LightingEquations.accumulate(rows, self.diffuse, self.specular, *(v.astype(np.float32) for v in at))

    def jacobian(self, problem: LightingProblem) -> NDArray[np.float64]:
        """(N, J, 3, 3K + 1 + 4N) derivatives of the images."""
        out = np.zeros((N, J, 3, 3 * K + 1 + 4 * N))
        for n in range(N):
            for c in range(3):
                block = slice(c * K, (c + 1) * K)
                out[n, :, c, block] = self.diffuse[n, c] * problem.diffuse[n] + self.specular[n] * problem.specular[n]
                out[n, :, c, 3 * K] = 1.0
                out[n, :, c, 3 * K + 1 + 4 * n + c] = self.shading[0][n, :, c]
                out[n, :, c, 3 * K + 4 + 4 * n] = self.shading[1][n, :, c]
        return out


def plain_step(problem: LightingProblem, state: State, with_ambient: bool) -> tuple[NDArray, NDArray]:
    """Step of lighting with ambient, and of the texels (N, 4), by one dense solve; a texel's pull is 1."""
    rows = state.jacobian(problem).reshape(-1, 3 * K + 1 + 4 * N)
    weight = problem.weight.astype(np.float64).ravel()
    system, right = (rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ state.residual.ravel()
    texels = np.arange(3 * K + 1, len(system))
    system[texels, texels] += 1.0
    lights = np.arange(3 * K + with_ambient)
    used = np.concatenate([lights, texels])
    diagonal = np.diag(system)
    damping = np.zeros(len(system))
    damping[lights] = DAMPING * diagonal[lights] + 1e-8 * diagonal[lights].mean()
    damping[texels] = DAMPING * diagonal[texels] + 1e-6 * np.median(diagonal[texels]) + 1e-12
    step = np.zeros(len(system))
    step[used] = np.linalg.solve((system + np.diag(damping))[np.ix_(used, used)], right[used])
    return step[: 3 * K + 1], step[3 * K + 1 :].reshape(N, 4)


@pytest.mark.parametrize("with_ambient", [False, True])
@pytest.mark.parametrize(("block", "crossed"), [(8 * K, 7 * K), (1 << 20, 1 << 17)])
def test_a_step_is_that_of_all_unknowns_at_once(problem, with_ambient, block, crossed, monkeypatch):
    monkeypatch.setattr(lighting_equations, "BLOCK", block)
    monkeypatch.setattr(lighting_equations, "CROSSED", crossed)
    state = State(problem)
    equations = state.equations(problem)
    equations.diffuse += 1.0
    equations.specular += 1.0
    found = equations.solve(with_ambient, DAMPING)
    light, own = plain_step(problem, state, with_ambient)
    np.testing.assert_allclose(found.light, light[:-1].reshape(3, K).T, rtol=1e-3, atol=1e-4)
    assert found.ambient == pytest.approx(light[-1], rel=1e-3, abs=1e-5)
    np.testing.assert_allclose(found.diffuse, own[:, :3], atol=1e-4)
    np.testing.assert_allclose(found.specular_albedo, own[:, 3], atol=1e-4)


def test_inverse_blocks_are_those_of_the_texels(problem):
    equations = State(problem).equations(problem)
    basis = np.zeros((400 + 1, K))
    equations.add_priors(
        PRIORS, np.zeros((K, 3)), problem.albedo, np.zeros(N), problem.albedo, np.zeros(K), basis, 0.1, 0.03
    )
    found = equations.eliminate(False, 0.0)
    blocks = np.zeros((N, 4, 4))
    blocks[:, range(3), range(3)] = equations.diffuse
    blocks[:, 3, :3] = blocks[:, :3, 3] = equations.both
    blocks[:, 3, 3] = equations.specular
    floor = 1e-6 * np.median(np.einsum("nii->ni", blocks)) + 1e-12
    np.testing.assert_allclose(found.inverse() @ (blocks + floor * np.eye(4)), np.tile(np.eye(4), (N, 1, 1)), atol=1e-6)


def test_rows_are_the_observations_that_there_are(problem):
    rows = problem.rows()
    assert len(rows.texel) == (problem.weight[..., 0] > 0).sum()
    np.testing.assert_allclose(rows.sums(rows.weight), problem.weight.sum(axis=1), atol=1e-5)
    assert np.array_equal(rows.colour, problem.colour[problem.weight[..., 0] > 0])
