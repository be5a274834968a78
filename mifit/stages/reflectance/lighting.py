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
from mifit.appearance.reception import DIRECTIONS, fibonacci_sphere
from mifit.core.metrics import median_deviation
from mifit.core.process import blocks, on_all_cores
from mifit.core.sh import bands, basis
from mifit.morphable.pigment import SPECULAR
from mifit.optim import Outcome
from mifit.sampling.observations import Observations
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting_equations import (
    PRIORS,
    LightingEquations,
    LightingPriors,
    LightingProblem,
    bounded_step,
)

SLACK = 1.02
"""A step may raise the energy by this factor: robust weights and the gauge move between steps."""
GROSS = 0.1
"""Linear colour beyond which a residual tells of something that no shading model here explains."""
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
    ambient : float
        The paper's I_a, which the minimiser of its objective finds.
    """

    light: NDArray[np.float64]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    expected: float
    sigma: float
    unexplained: float
    energy: list[float]
    outcome: Outcome
    ambient: float = 0.0


@dataclass(frozen=True)
class Residuals:
    """What a lighting and albedos leave of a problem's observations.

    Attributes
    ----------
    light : (K, 3), maps : (n, 3) and (n,)
        Lighting, diffuse and specular albedo.
    shading : two of (M, 3)
        Diffuse and specular radiance at unit albedo.
    residual, weight : (M, 3)
        Image minus model, and robust weights.
    sigma : float
        Robust standard deviation of the residuals.
    """

    light: NDArray[np.float64]
    maps: tuple[NDArray[np.float32], NDArray[np.float32]]
    shading: tuple[NDArray[np.float32], NDArray[np.float32]]
    residual: NDArray[np.float32]
    weight: NDArray[np.float32]
    sigma: float

    @classmethod
    def of(
        cls,
        problem: LightingProblem,
        light: NDArray,
        maps: tuple[NDArray, NDArray],
        robust: bool = True,
    ) -> Residuals:
        """Residuals of a lighting (K, 3) and albedos (n, 3), (n,)."""
        shading = problem.diffuse @ light.astype(np.float32), problem.specular @ light.astype(np.float32)
        albedo = maps[0][problem.texel], maps[1][problem.texel, None]
        residual = problem.colour - form_image(np.float32(0.0), albedo[0], shading[0], albedo[1], shading[1])
        weight, sigma = active_weight(problem.weight, problem.clipped, residual, robust)
        return cls(light, maps, shading, residual, weight, sigma)

    @property
    def energy(self) -> float:
        """Robust sum of squares."""
        return float((self.weight * self.residual**2).sum())

    def unexplained(self, problem: LightingProblem) -> float:
        """Root of the mean squared residual, each bounded by `GROSS`."""
        weight = problem.weight / (1.0 + (self.residual / GROSS) ** 2)
        weight = np.where(problem.clipped[:, None] & (self.residual <= 0), np.float32(0.0), weight)
        return float(np.sqrt((weight * self.residual**2).sum() / max(float(problem.weight.sum()), 1e-12)))

    def equations(self, problem: LightingProblem, priors: LightingPriors = PRIORS) -> LightingEquations:
        """Normal equations about this state, priors included."""
        system = LightingEquations.accumulate(problem, self.maps, self.shading, self.residual, self.weight)
        k, order = problem.specular.shape[1], problem.order
        expected = (
            problem.albedo,
            problem.expected_specular(self.maps[1]),
        )
        directions = np.pad(_sphere(order), ((0, 0), (0, k - order * order)))
        system.add_priors(priors, self.light, self.maps, expected, _stiffness(order, k), directions, self.sigma)
        return system


def solve_lighting(
    problem: LightingProblem,
    start: tuple[NDArray, NDArray, NDArray] | None = None,
    specular: float = SPECULAR,
    priors: LightingPriors = PRIORS,
    robust: bool = True,
    iterations: int = 12,
    tolerance: float = 1e-3,
) -> LightingSolution:
    """Find lighting and the subset's albedos together.

    Parameters
    ----------
    problem : LightingProblem
    start : (K, 3), (n, 3) and (n,), optional
        Lighting, diffuse and specular albedo to start from; by default the model's albedo, the given specular one, and
        the best lighting for them.
    specular : float
        Specular albedo to start from. Zero is a stationary point of the bands that only the specular lobe sees.
    priors : LightingPriors
    robust : bool
        Give outliers less weight (Cauchy).
    iterations : int
    tolerance : float
        Stop when the energy changes by less than this part.
    """
    n = len(problem.albedo)
    seen = problem.sums(problem.weight)
    if start is None:
        maps = problem.albedo.astype(np.float32), np.full(n, specular, np.float32)
        start = _initial(problem, *maps), *maps
    state, energy, outcome = start, [], Outcome.MAX_ITERATIONS  # type: ignore[var-annotated]
    damping, failed, held = 1e-3, 0, 0
    for _ in range(iterations):
        found = Residuals.of(problem, state[0], state[1:], robust)
        if not energy and not np.isfinite(found.energy):
            best, outcome = found, Outcome.DIVERGED
            break
        if energy and not found.energy < SLACK * energy[-1]:
            # The step made it worse: take a shorter one from where it started, and no longer ones for a while.
            damping, failed = 10.0 * damping, failed + 1
            held = failed
            if damping > 1e3:
                outcome = Outcome.STALLED
                break
        else:
            energy.append(found.energy)
            settled = len(energy) > 1 and abs(energy[-2] - energy[-1]) < tolerance * energy[-2]
            best, held = found, max(held - 1, 0)
            damping = damping if held else max(0.1 * damping, 1e-5)
            if settled:
                outcome = Outcome.CONVERGED
                break
            system = best.equations(problem, priors)
        lowest = np.where(np.arange(len(best.light))[:, None] < problem.order**2, -np.inf, -best.light)
        light, x, y = system.solve(damping, lowest)
        light = best.light + light
        diffuse, specular_albedo = np.maximum(best.maps[0] + x, 0.0), np.maximum(best.maps[1] + y, 0.0)
        gain = gauge(np.minimum(diffuse, 1.5), problem.albedo, seen)
        diffuse, specular_albedo = np.minimum(diffuse / gain, 1.5), np.minimum(specular_albedo / gain, 1.0)
        state = light * gain, diffuse.astype(np.float32), specular_albedo.astype(np.float32)
    return LightingSolution(
        best.light,
        *best.maps,
        problem.expected_specular(best.maps[1]),
        best.sigma,
        best.unexplained(problem),
        energy,
        outcome,
    )


@cache
def _sphere(order: int) -> NDArray[np.float64]:
    """Basis functions at the directions in which radiance is kept from being negative."""
    return basis(fibonacci_sphere(DIRECTIONS), order)


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
    sigma = median_deviation(residual.reshape(-1)[some])
    active = np.empty(np.broadcast_shapes(weight.shape, residual.shape), np.float32)

    def fill(rows: slice) -> None:
        bound, off = clipped[rows, ..., None], residual[rows]
        part = np.where(bound & (off <= 0), np.float32(0.0), weight[rows])
        if robust:
            # Not for bounds: a highlight far below its bound is missing, not an outlier.
            part = np.where(bound, part, part / (1.0 + (off / max(CAUCHY * sigma, 1e-4)) ** 2))
        active[rows] = part

    on_all_cores(fill, blocks(len(active), 4 * active.size // max(len(active), 1)))
    return active, sigma


def _initial(problem: LightingProblem, diffuse: NDArray, specular_albedo: NDArray) -> NDArray[np.float64]:
    """Linear least squares for the lighting with fixed maps."""
    k = problem.specular.shape[1]
    stiffness = _stiffness(problem.order, k)
    light = np.zeros((k, 3))
    glossy = specular_albedo[problem.texel, None] * problem.specular
    lowest = np.where(np.arange(k) < problem.order**2, -np.inf, 0.0)
    for c in range(3):
        root = np.sqrt(np.where(problem.clipped, np.float32(0), problem.weight[:, c]))
        slope = (diffuse[problem.texel, c, None] * problem.diffuse + glossy) * root[:, None]
        h = (slope.T @ slope).astype(np.float64)
        scale = max(float(np.trace(h)) / k, 1e-12)
        g = ((root * problem.colour[:, c]) @ slope).astype(np.float64)
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
    """Collect the observations of some texels that count, with their transfer vectors."""
    diffuse, specular = forward.transfers(seen, light)
    weight = seen.weight[..., None] * noise_weight(seen.colour, robust)
    there = seen.weight > 0
    return LightingProblem(
        np.nonzero(there)[0],
        seen.colour[there],
        weight[there],
        seen.clipped[there],
        diffuse,
        specular,
        albedo,
        forward.order,
        forward.gloss,
    )


def fit_lighting(
    seen: Observations,
    forward: Forward,
    albedo: NDArray,
    robust: bool,
    iterations: int,
    specular: float = SPECULAR,
    priors: LightingPriors = PRIORS,
) -> LightingSolution:
    """Lighting and the subset's albedos; a model that turns with the lighting is linearised anew."""
    problem = lighting_problem(seen, forward, forward.dark, albedo, robust)
    if not forward.model.turns:
        specular = specular if forward.gloss else 0.0
        return solve_lighting(problem, specular=specular, priors=priors, robust=robust, iterations=iterations)
    # Without highlights first, so that there is lighting to linearise about.
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    found = solve_lighting(problem, specular=0.05, priors=priors, robust=robust, iterations=6)
    energy = list(found.energy)
    for _ in range(4):
        problem = lighting_problem(seen, forward, found.light, albedo, robust)
        maps = problem.albedo.astype(np.float32), np.full(len(albedo), 0.05, np.float32)
        some = max(2, iterations // 4)
        found = solve_lighting(problem, (found.light, *maps), priors=priors, robust=robust, iterations=some)
        energy += found.energy
    return replace(found, energy=energy)
