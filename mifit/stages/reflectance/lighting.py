"""Lighting by Gauss-Newton with the texels eliminated.

The image is bilinear in lighting and maps. Alternating between them crawls along the directions in which both can
give way. Here both move at once: the four unknowns of a texel touch no other texel, so their blocks are
eliminated (Schur complement) and what remains is one small dense system for the lighting. A few thousand texels
determine a few hundred coefficients, so a random subset is enough; the maps are solved afterwards for all texels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.appearance.reception import fibonacci_sphere
from mifit.core.process import on_all_cores
from mifit.core.sh import bands, basis
from mifit.optim import Outcome
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting_equations import (
    PRIORS,
    LightingEquations,
    LightingPriors,
    LightingProblem,
    SeenRows,
    bounded_step,
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
WEIGHTED = 1 << 18
"""Residuals that are weighted at a time."""
NORMAL_REFLECTANCE = 0.028
"""Specular albedo of skin at normal incidence: ((n - 1) / (n + 1))^2 for its index of refraction n = 1.4."""
NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""
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
    expected : float
        Specular albedo to expect of all others.
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
    expected: float
    sigma: float
    unexplained: float
    energy: list[float]
    outcome: Outcome


def solve_lighting(
    problem: LightingProblem,
    start: NDArray | None = None,
    albedos: tuple[NDArray, NDArray] | None = None,
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
    albedos : (n, 3) and (n,), optional
        Diffuse and specular albedos to start from; by default the model's and the given specular albedo.
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
    rows = problem.rows()
    prior_weight = problem.weight.sum(axis=1)
    diffuse = problem.albedo.astype(np.float32).copy()
    specular_albedo = np.full(n, specular, dtype=np.float32)
    if albedos is not None:
        diffuse, specular_albedo = (np.asarray(each, np.float32) for each in albedos)
    light = _initial(problem, rows, diffuse, specular_albedo) if start is None else np.array(start, dtype=np.float64)
    energy: list[float] = []
    ambient, sigma, unexplained, damping, outcome = 0.0, 0.0, np.inf, 1e-3, Outcome.MAX_ITERATIONS
    state = light, ambient, diffuse, specular_albedo
    best = state
    for _ in range(iterations):
        light, ambient, diffuse, specular_albedo = state
        diffuse_light, specular_light = (t @ light.astype(np.float32) for t in (rows.diffuse, rows.specular))
        maps = diffuse[rows.texel], specular_albedo[rows.texel, None]
        residual = rows.colour - form_image(np.float32(ambient), maps[0], diffuse_light, maps[1], specular_light)
        weight, deviation = active_weight(rows.weight, rows.clipped, residual, robust)
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
            bounded = float((bounded_weight(rows, residual) * residual**2).sum())
            unexplained = float(np.sqrt(bounded / max(float(rows.weight.sum()), 1e-12)))
            damping = max(0.1 * damping, DAMPING)
            if outcome is Outcome.CONVERGED:
                break
            system = linearize(
                problem,
                rows,
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
        penalty = 0.5 * priors.sparsity * energy[-1] / flux(best[0], problem.order)
        lowest = np.where(np.arange(len(best[0]))[:, None] < problem.order**2, -np.inf, -best[0])
        step = system.solve(with_ambient, damping, lowest, penalty)
        light, ambient, diffuse, specular_albedo = best
        light = light + step.light
        ambient = max(ambient + step.ambient, 0.0)
        diffuse = np.clip(diffuse + step.diffuse, 0.0, 1.5).astype(np.float32)
        specular_albedo = np.clip(specular_albedo + step.specular_albedo, 0.0, 1.0).astype(np.float32)
        gain = gauge(diffuse, problem.albedo, prior_weight)
        state = light * gain, ambient, (diffuse / gain).astype(np.float32), (specular_albedo / gain).astype(np.float32)
    light, ambient, diffuse, specular_albedo = best
    expected = expected_specular(specular_albedo, problem.seen)
    return LightingSolution(light, ambient, diffuse, specular_albedo, expected, sigma, unexplained, energy, outcome)


def linearize(
    problem: LightingProblem,
    rows: SeenRows,
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
    """Normal equations about a state, with priors beside residuals of standard deviation `sigma`.

    Light, residual and weight (M, 3) are those of a problem's rows.
    """
    k, order = problem.specular.shape[-1], problem.order
    system = LightingEquations.accumulate(
        rows, diffuse, specular_albedo, diffuse_light, specular_light, residual, weight
    )
    directions = np.pad(_sphere(order), ((0, 0), (0, k - order * order)))
    expected = expected_specular(specular_albedo, problem.seen)
    system.add_priors(
        priors, light, diffuse, specular_albedo, problem.albedo, _stiffness(order, k), directions, sigma, expected
    )
    return system


@cache
def _sphere(order: int) -> NDArray[np.float64]:
    """Basis functions at the directions in which radiance is kept from being negative."""
    return basis(fibonacci_sphere(NEGATIVE_DIRECTIONS), order)


def flux(light: NDArray, order: int) -> float:
    """All light (K, 3), channels summed: over the sphere for the B*B coefficients, and irradiances."""
    return max(float(np.sqrt(4.0 * np.pi) * light[0].sum() + light[order * order :].sum()), 1e-9)


def _stiffness(order: int, count: int) -> NDArray[np.float64]:
    """(l (l + 1))^2 of each coefficient; 0 for the compact lights after them, about which nothing is smooth."""
    band = bands(order).astype(np.float64)
    return np.pad((band * (band + 1.0)) ** 2, (0, count - order * order))


def gauge(diffuse: NDArray, albedo: NDArray, seen: NDArray) -> float:
    """Factor between lighting and albedo that makes the mean diffuse albedo, over all channels, the model's.

    ``seen`` (n, 3) is the weight of each texel's observations.
    """
    return float((seen * diffuse).sum() / max((seen * albedo).sum(), 1e-12)) or 1.0


def active_weight(
    weight: NDArray, clipped: NDArray, residual: NDArray, robust: bool
) -> tuple[NDArray[np.float32], float]:
    """Weights of this iteration: clipped observations count only where the model is too dark, outliers less."""
    measured = np.flatnonzero((weight > 0) & ~clipped[..., None])
    some = measured[:: max(1, len(measured) // 200_000)]
    sigma = 1.4826 * float(np.median(np.abs(residual.reshape(-1)[some]))) if len(some) else 0.0
    active = np.empty(np.broadcast_shapes(weight.shape, residual.shape), np.float32)

    def fill(rows: slice) -> None:
        bound, off = clipped[rows, ..., None], residual[rows]
        part = np.where(bound & (off <= 0), np.float32(0.0), weight[rows])
        if robust:
            # Not for bounds: a highlight far below its bound is missing, not an outlier.
            part = np.where(bound, part, part / (1.0 + (off / max(CAUCHY * sigma, 1e-4)) ** 2))
        active[rows] = part

    step = max(1, WEIGHTED * len(active) // max(active.size, 1))
    on_all_cores(fill, [slice(at, at + step) for at in range(0, len(active), step)])
    return active, sigma


def bounded_weight(problem: LightingProblem | SeenRows, residual: NDArray) -> NDArray[np.float32]:
    """Weights under which each residual counts `GROSS` at the most, the same whatever the others are."""
    weight = problem.weight / (1.0 + (residual / GROSS) ** 2)
    return np.where(problem.clipped[..., None] & (residual <= 0), np.float32(0.0), weight)


def _initial(
    problem: LightingProblem, rows: SeenRows, diffuse: NDArray, specular_albedo: NDArray
) -> NDArray[np.float64]:
    """Linear least squares for the lighting with fixed maps."""
    k = problem.specular.shape[-1]
    stiffness = _stiffness(problem.order, k)
    light = np.zeros((k, 3))
    glossy = specular_albedo[rows.texel, None] * rows.specular
    lowest = np.where(np.arange(k) < problem.order**2, -np.inf, 0.0)
    for c in range(3):
        root = np.sqrt(np.where(rows.clipped, np.float32(0), rows.weight[:, c]))
        slope = (diffuse[rows.texel, c, None] * rows.diffuse + glossy) * root[:, None]
        h = (slope.T @ slope).astype(np.float64)
        scale = max(float(np.trace(h)) / k, 1e-12)
        g = ((root * rows.colour[:, c]) @ slope).astype(np.float64)
        light[:, c] = bounded_step(h + np.diag(scale * (1e-6 + 1e-4 * stiffness)), g, lowest)
    return light


def noise_weight(colour: NDArray, robust: bool) -> NDArray[np.float32]:
    """(..., 3) inverse variance of read and shot noise, 1 at mid-grey; 1 everywhere when not robust."""
    if not robust:
        return np.ones_like(colour)
    return ((NOISE_FLOOR + 0.3) / (NOISE_FLOOR + np.clip(colour, 0.0, 1.0))).astype(np.float32)


def lighting_problem(
    seen: Observations, forward: Forward, light: NDArray, albedo: NDArray, robust: bool
) -> LightingProblem:
    """Collect the transfer vectors and weights of some texels."""
    diffuse, specular = forward.transfers(seen, light)
    weight = seen.weight[..., None] * noise_weight(seen.colour, robust)
    return LightingProblem(seen.colour, weight, seen.clipped, diffuse, specular, albedo, forward.order)


def fit_lighting(
    seen: Observations,
    forward: Forward,
    albedo: NDArray,
    robust: bool,
    iterations: int,
    specular: float = NORMAL_REFLECTANCE,
    priors: LightingPriors = PRIORS,
) -> LightingSolution:
    """Lighting and the subset's albedos; a model that turns with the lighting is linearised anew."""
    ambient, specular = forward.model.has_ambient, specular if forward.glossy else 0.0
    problem = lighting_problem(seen, forward, forward.dark, albedo, robust)
    if not forward.model.turns:
        return solve_lighting(
            problem,
            specular=specular,
            priors=priors,
            robust=robust,
            with_ambient=ambient,
            iterations=iterations,
        )
    # Without highlights first, so that there is lighting to linearise about.
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    found = solve_lighting(problem, priors=priors, robust=robust, with_ambient=ambient, iterations=6)
    energy = list(found.energy)
    for _ in range(4):
        problem = lighting_problem(seen, forward, found.light, albedo, robust)
        found = solve_lighting(
            problem,
            found.light,
            priors=priors,
            robust=robust,
            with_ambient=ambient,
            iterations=max(2, iterations // 4),
        )
        energy += found.energy
    return replace(found, energy=energy)
