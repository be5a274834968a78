"""Lighting by Gauss-Newton with the texels eliminated.

The image is bilinear in lighting and maps. Alternating between them crawls along the directions in which both can
give way. Here both move at once: the four unknowns of a texel touch no other texel, so their blocks are
eliminated (Schur complement) and what remains is one small dense system for the lighting. A few thousand texels
determine a few hundred coefficients, so a random subset is enough; the maps are solved afterwards for all texels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.appearance.reception import fibonacci_sphere
from mifit.core.sh import bands, basis
from mifit.solve import Outcome
from mifit.stages.reflectance.lighting_equations import (
    PRIORS,
    LightingEquations,
    LightingPriors,
    LightingProblem,
    expected_specular,
)

NEGATIVE_DIRECTIONS = 400
"""Directions at which negative radiance is penalised."""
DAMPING = 1e-5
"""Levenberg-Marquardt damping at the least, relative to the diagonal."""
SLACK = 1.02
"""A step may raise the energy by this factor: robust weights and the gauge move between steps."""
GROSS = 0.1
"""Linear colour beyond which a residual tells of something that no shading model here explains."""
CAUCHY = 3.0
"""Residuals of this many robust standard deviations get half the weight."""


@dataclass(frozen=True)
class LightingSolution:
    """Lighting with the maps of the subset.

    Attributes
    ----------
    light : (K, 3) float64
        The lighting unknowns, `Illumination.unknowns`.
    ambient : float
        The paper's I_a; 0 unless asked for.
    diffuse : (n, 3), specular : (n,)
        Albedos of the subset's texels.
    sigma : float
        Robust standard deviation of the residuals, linear colour.
    unexplained : float
        Root of the mean squared residual, each bounded by `GROSS`: comparable between shading models.
    energy : list of float
        Robust data energy per iteration.
    outcome : Outcome
    """

    light: NDArray[np.float64]
    ambient: float
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    sigma: float
    unexplained: float
    energy: list[float]
    outcome: Outcome


def solve_lighting(
    problem: LightingProblem,
    start: NDArray | None = None,
    specular: float = 0.05,
    priors: LightingPriors = PRIORS,
    robust: bool = True,
    with_ambient: bool = False,
    iterations: int = 12,
    tolerance: float = 1e-3,
) -> LightingSolution:
    """Find lighting and the subset's albedos together.

    Parameters
    ----------
    problem : LightingProblem
    start : (K, 3), optional
        Lighting to start from; by default the best one for the model's albedo and the given specular albedo.
    specular : float
        Specular albedo to start from. Zero is a stationary point of the bands that only the specular lobe sees.
    priors : LightingPriors
    robust : bool
        Give outliers less weight (Cauchy).
    with_ambient : bool
        Also find the paper's scalar ambient term, not below zero.
    iterations : int
    tolerance : float
        Stop when the energy changes by less than this part.
    """
    n = len(problem.specular)
    diffuse = problem.albedo.astype(np.float32).copy()
    specular_albedo = np.full(n, specular, dtype=np.float32)
    light = _initial(problem, diffuse, specular_albedo) if start is None else np.array(start, dtype=np.float64)
    energy: list[float] = []
    ambient, sigma, unexplained, damping, outcome = 0.0, 0.0, np.inf, 1e-3, Outcome.MAX_ITERATIONS
    state = light, ambient, diffuse, specular_albedo
    best = state
    for _ in range(iterations):
        light, ambient, diffuse, specular_albedo = state
        diffuse_light = np.einsum("njk,kc->njc", problem.diffuse, light.astype(np.float32))
        specular_light = np.einsum("njk,kc->njc", problem.specular, light.astype(np.float32))
        shown = form_image(
            np.float32(ambient), diffuse[:, None], diffuse_light, specular_albedo[:, None, None], specular_light
        )
        residual = problem.colour - shown
        weight, deviation = active_weight(problem.weight, problem.clipped, residual, robust)
        current = float((weight * residual**2).sum())
        if not energy and not np.isfinite(current):
            outcome = Outcome.DIVERGED
            break
        if energy and not current < SLACK * energy[-1]:
            damping *= 10.0  # the step made it worse: take a shorter one from where it started
            if damping > 1e3:
                outcome = Outcome.STALLED
                break
        else:
            if energy and abs(energy[-1] - current) < tolerance * energy[-1]:
                outcome = Outcome.CONVERGED
            energy.append(current)
            best, sigma = state, deviation
            bounded = float((bounded_weight(problem, residual) * residual**2).sum())
            unexplained = float(np.sqrt(bounded / max(float(problem.weight.sum()), 1e-12)))
            damping = max(0.1 * damping, DAMPING)
            system = linearize(
                problem,
                light,
                diffuse,
                specular_albedo,
                diffuse_light,
                specular_light,
                residual,
                weight,
                priors,
                deviation,
            )
            if outcome is Outcome.CONVERGED:
                break
        step = system.solve(with_ambient, damping)
        light, ambient, diffuse, specular_albedo = best
        light = light + step.light
        ambient = max(ambient + step.ambient, 0.0)
        diffuse = np.clip(diffuse + step.diffuse, 0.0, 1.5).astype(np.float32)
        specular_albedo = np.clip(specular_albedo + step.specular_albedo, 0.0, 1.0).astype(np.float32)
        gain = gauge(diffuse, problem.albedo, problem.weight)
        state = light * gain, ambient, (diffuse / gain).astype(np.float32), (specular_albedo / gain).astype(np.float32)
    light, ambient, diffuse, specular_albedo = best
    return LightingSolution(light, ambient, diffuse, specular_albedo, sigma, unexplained, energy, outcome)


def linearize(
    problem: LightingProblem,
    light: NDArray,
    diffuse: NDArray,
    specular_albedo: NDArray,
    diffuse_light: NDArray,
    specular_light: NDArray,
    residual: NDArray,
    weight: NDArray,
    priors: LightingPriors = PRIORS,
    sigma: float = 0.0,
) -> LightingEquations:
    """Normal equations about a state, with priors beside residuals of standard deviation `sigma`."""
    k, order = problem.specular.shape[-1], problem.order
    system = LightingEquations.accumulate(
        problem, diffuse, specular_albedo, diffuse_light, specular_light, residual, weight
    )
    extra = k - order * order  # compact lights are kept from negative values one by one
    directions = np.pad(basis(fibonacci_sphere(NEGATIVE_DIRECTIONS), order), ((0, extra), (0, extra)))
    directions[NEGATIVE_DIRECTIONS:, order * order :] = np.eye(extra)
    expected = expected_specular(specular_albedo, (problem.weight > 0).any(axis=2))
    system.add_priors(
        priors, light, diffuse, specular_albedo, problem.albedo, _stiffness(order, k), directions, sigma, expected
    )
    return system


def _stiffness(order: int, count: int) -> NDArray[np.float64]:
    """(l (l + 1))^2 of each coefficient; 0 for the compact lights after them, about which nothing is smooth."""
    band = bands(order).astype(np.float64)
    return np.pad((band * (band + 1.0)) ** 2, (0, count - order * order))


def gauge(diffuse: NDArray, albedo: NDArray, weight: NDArray) -> float:
    """Factor between lighting and albedo that makes the mean seen diffuse albedo, over all channels, the model's."""
    seen = weight.sum(axis=1)
    return float((seen * diffuse).sum() / max((seen * albedo).sum(), 1e-12)) or 1.0


def active_weight(
    weight: NDArray, clipped: NDArray, residual: NDArray, robust: bool
) -> tuple[NDArray[np.float32], float]:
    """Weights of this iteration: clipped observations count only where the model is too dark, outliers less."""
    measured = (weight > 0) & ~clipped[..., None]
    values = np.abs(residual[measured])
    sigma = 1.4826 * float(np.median(values[:: max(1, len(values) // 200_000)])) if len(values) else 0.0
    bound = clipped[..., None]
    active = np.where(bound & (residual <= 0), np.float32(0.0), weight)
    if robust:
        # Not for bounds: a highlight far below its bound is missing, not an outlier.
        active = np.where(bound, active, active / (1.0 + (residual / max(CAUCHY * sigma, 1e-4)) ** 2))
    return active.astype(np.float32), sigma


def bounded_weight(problem: LightingProblem, residual: NDArray) -> NDArray[np.float32]:
    """Weights under which each residual counts `GROSS` at the most, the same whatever the others are."""
    weight = problem.weight / (1.0 + (residual / GROSS) ** 2)
    return np.where(problem.clipped[..., None] & (residual <= 0), np.float32(0.0), weight)


def _initial(problem: LightingProblem, diffuse: NDArray, specular_albedo: NDArray) -> NDArray[np.float64]:
    """Linear least squares for the lighting with fixed maps."""
    k = problem.specular.shape[-1]
    stiffness = _stiffness(problem.order, k)
    light = np.zeros((k, 3))
    for c in range(3):
        rows = (
            diffuse[:, None, None, c] * problem.diffuse + specular_albedo[:, None, None] * problem.specular
        ).reshape(-1, k)
        w = np.where(problem.clipped, 0, problem.weight[..., c]).ravel()
        h = (rows * w[:, None]).T @ rows
        scale = max(float(np.trace(h)) / k, 1e-12)
        g = (rows * w[:, None]).T @ problem.colour[..., c].ravel()
        light[:, c] = np.linalg.solve(h.astype(np.float64) + np.diag(scale * (1e-6 + 1e-4 * stiffness)), g)
    return light
