"""The lighting's normal equations against plain ones: every unknown, no structure, double precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from mifit.stages.reflectance import lighting_equations
from mifit.stages.reflectance.albedo_priors import AlbedoPriors
from mifit.stages.reflectance.lighting_equations import LightingEquations, LightingProblem, bounded_step, texel_systems

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


def priors(problem: LightingProblem, state: State, pulls: tuple[float, float], most: float = 1.0) -> AlbedoPriors:
    """Priors about a state in which a specular albedo of 0.2 is expected."""
    albedo = np.full((N, 3), 0.4, np.float32)
    mean = float((problem.share * albedo).sum())
    weights, shape = (np.full(3, pulls[0]), pulls[1], 0.2), state.specular / 0.2
    return AlbedoPriors(albedo, *weights, shape, 0.0, most, problem.share, mean)


def plain_system(problem: LightingProblem, state: State, albedos: AlbedoPriors, target: NDArray) -> tuple:
    """Lighting, texels (N, 4), change of the expected specular albedo, multiplier of the level: one dense system."""
    rows = state.jacobian(problem).reshape(-1, 3 * K + 4 * N)
    weight, size = problem.weight.astype(np.float64).ravel(), rows.shape[1]
    system, right = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
    system[:size, :size], right[:size] = (rows * weight[:, None]).T @ rows, (rows * weight[:, None]).T @ target.ravel()
    texels = np.arange(3 * K, size)
    system[texels, texels] += np.tile(np.append(albedos.diffuse, albedos.specular), N)
    drawn = -albedos.specular * albedos.shape
    system[size, texels[3::4]] = system[texels[3::4], size] = drawn
    system[size, size] = -drawn @ albedos.shape
    level = albedos.level.ravel()
    of = texels.reshape(N, 4)[:, :3].ravel()
    system[size + 1, of] = system[of, size + 1] = level
    return system, right, texels


@pytest.mark.parametrize("free", [True, False])
@pytest.mark.parametrize("block", [8 * K, 1 << 20])
def test_a_step_is_that_of_all_unknowns_at_once(problem, block, free, monkeypatch):
    monkeypatch.setattr(lighting_equations, "BLOCK", block)
    monkeypatch.setattr("mifit.core.process.BLOCK", block)
    state = State(problem)
    albedos = priors(problem, state, (1.0, 1.0))
    off = albedos.albedo - state.diffuse, 0.2 - state.specular
    equations = state.equations(problem)
    texels = equations.texels.with_priors((albedos.diffuse, albedos.specular), *off)
    equations = replace(equations, texels=texels, ties=albedos.ties(free), stiffness=albedos.stiffness)
    system, right, own = plain_system(problem, state, albedos, state.residual)
    right[own] += np.concatenate([off[0], off[1][:, None]], axis=1).ravel()
    lights, diagonal = np.arange(3 * K), np.diag(system).copy()
    system[lights, lights] += DAMPING * diagonal[lights] + 1e-8 * diagonal[lights].mean()
    if not free:
        system, right = (np.delete(each, -2, axis=0) for each in (system, right))
        system = np.delete(system, -2, axis=1)
    expected = np.linalg.solve(system, right)[: 3 * K]
    np.testing.assert_allclose(equations.solve(DAMPING), expected.reshape(3, K).T, rtol=1e-3, atol=1e-4)


def test_albedos_follow_the_light_to_their_minimum(problem):
    state = State(problem)
    albedos = priors(problem, state, (20.0, 40.0))
    shown = problem.colour - state.residual
    found = albedos.solve(texel_systems(problem, state.shading, problem.weight, shown))
    system, right, own = plain_system(problem, state, albedos, shown)
    right[own] += np.tile([20.0 * 0.4] * 3 + [40.0 * 0.2], N)
    right[-2] = -albedos.specular * albedos.shape.sum() * 0.2
    right[-1] = albedos.mean
    keep = np.arange(3 * K, len(system))
    expected = np.linalg.solve(system[np.ix_(keep, keep)], right[keep])
    texels = expected[: 4 * N].reshape(N, 4)
    assert texels.min() > 0 and texels.max() < 1  # no bound is met
    np.testing.assert_allclose(found[0], texels[:, :3], atol=1e-4)
    np.testing.assert_allclose(found[1], texels[:, 3], atol=1e-4)
    assert found[2] == pytest.approx(0.2 + expected[-2], abs=1e-4)


def test_albedos_at_their_bounds_leave_the_mean_as_it_is(problem):
    state = State(problem)
    albedos = priors(problem, state, (0.1, 0.1))
    diffuse, specular, _ = albedos.solve(texel_systems(problem, state.shading, problem.weight, problem.colour))
    assert (diffuse == 0).any() and (specular == 0).any() and diffuse.min() == 0 and specular.max() <= 1
    assert (problem.share * diffuse).sum() == pytest.approx(albedos.mean, rel=1e-4)


def test_no_more_specular_albedo_is_expected_than_is_given(problem):
    state = State(problem)
    system = texel_systems(problem, state.shading, problem.weight, problem.colour)
    free = priors(problem, state, (20.0, 40.0)).solve(system)[2]
    assert free > 0.1 and priors(problem, state, (20.0, 40.0), most=0.1).solve(system)[2] == pytest.approx(0.1)


def test_a_scale_of_specular_albedos_costs_nothing(problem):
    """Light of the specular lobe may be brighter or darker."""
    state = State(problem)
    albedos = priors(problem, state, (1.0, 1.0))
    cost = albedos.cost(albedos.albedo, state.specular, 0.2)
    assert cost > 1.0
    assert albedos.cost(albedos.albedo, 0.5 * state.specular, 0.1) == pytest.approx(cost)
    assert albedos.cost(albedos.albedo, 0.5 * state.specular, 0.2) < 0.9 * cost


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
