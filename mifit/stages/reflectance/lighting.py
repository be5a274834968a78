"""Lighting by Gauss-Newton with the texels' albedos following it at every step (variable projection).

The image is bilinear in lighting and maps. Alternating between them crawls along the directions in which both can
give way. Here the lighting steps with the albedos eliminated (Schur complement): the four unknowns of a texel touch no
other texel, so what remains is one small dense system. Under the new lighting the albedos are solved for exactly (Ruhe
and Wedin 1980; Hong and Fitzgibbon 2015), which converges where joint steps wander. A few thousand texels determine a
few hundred coefficients, so a random subset is enough; the maps are solved afterwards for all texels.
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
from mifit.stages.reflectance.albedo_priors import AlbedoPriors, specular_pull
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting_equations import LightingEquations, LightingProblem, bounded_step, texel_systems

GROSS = 0.4
"""Part of the mean colour beyond which a residual tells of something that no shading model here explains. Chosen on
Emily c3,c4 and the scan of scan_city under two suns and in its lobby: from 0.2 to 1 little changes."""
MISFIT = 3.0
"""Deviations of the residuals beside which the spread of specular albedos counts: neighbours share what mesh and
shading leave of images. Chosen on Emily c3,c4, `ict_302` and the scan of scan_city under two suns."""
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
        Root of the mean robust square of the residuals, linear colour: comparable between shading models.
    energy : list of float
        Robust sum of squares per iteration; priors, for what images don't show, are not in it.
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
    expected : float
        Specular albedo to expect of a texel.
    shading : two of (M, 3)
        Diffuse and specular radiance at unit albedo.
    residual, weight : (M, 3)
        Image minus model, and robust weights.
    data : float
        Robust sum of squares.
    scale : float
        Cauchy's scale, linear colour; infinite for least squares.
    """

    light: NDArray[np.float64]
    maps: tuple[NDArray[np.float32], NDArray[np.float32]]
    expected: float
    shading: tuple[NDArray[np.float32], NDArray[np.float32]]
    residual: NDArray[np.float32]
    weight: NDArray[np.float32]
    data: float
    scale: float

    @classmethod
    def of(
        cls,
        problem: LightingProblem,
        light: NDArray,
        maps: tuple[NDArray, NDArray],
        expected: float,
        scale: float = np.inf,
        shading: tuple[NDArray, NDArray] | None = None,
    ) -> Residuals:
        """Residuals of a lighting (K, 3) and albedos (n, 3), (n,); ``shading`` where it is known."""
        shading = problem.shade(light) if shading is None else shading
        albedo = maps[0][problem.texel], maps[1][problem.texel, None]
        residual = problem.colour - form_image(np.float32(0.0), albedo[0], shading[0], albedo[1], shading[1])
        return cls(light, maps, expected, shading, residual, *robust_squares(problem, residual, scale), scale)

    def rescaled(self, problem: LightingProblem, least: float | None = None) -> Residuals:
        """The same with the scale of its own residuals, or ``least`` if that is more: by default `GROSS`."""
        least = GROSS * problem.level if least is None else least
        deviation = robust_deviation(problem.weight, problem.clipped, self.residual)
        scale = max(CAUCHY * deviation / problem.freedom**0.5, least, 1e-12)
        weight, data = robust_squares(problem, self.residual, scale)
        return replace(self, weight=weight, data=data, scale=scale)

    def following(self, problem: LightingProblem, light: NDArray, albedos: AlbedoPriors) -> Residuals:
        """Those under another lighting, once the albedos have followed it."""
        shading = problem.shade(light)
        diffuse, specular, expected = albedos.solve(texel_systems(problem, shading, self.weight, problem.colour))
        return Residuals.of(problem, light, (diffuse, specular), expected, self.scale, shading)

    def unexplained(self, problem: LightingProblem) -> float:
        """Root of the mean square of the residuals; those beyond `GROSS` count less."""
        data = robust_squares(problem, self.residual, max(GROSS * problem.level, 1e-12))[1]
        return float(np.sqrt(data / max(float(problem.weight.sum()), 1e-12)))

    def priors(self, problem: LightingProblem) -> AlbedoPriors:
        """Priors of the albedos about these; least squares have the weak ones alone."""
        priors = problem.priors
        texels = texel_systems(problem, self.shading, self.weight, self.residual)
        expected, robust = max(self.expected, 1e-4), np.isfinite(self.scale)
        noise = MISFIT * self.unexplained(problem) / problem.freedom**0.5 if robust else 0.0
        pull = max(priors.specular * float(np.median(texels.ss)) + 1e-12, specular_pull(expected, noise))
        return AlbedoPriors(
            albedo=problem.albedo,
            diffuse=np.asarray(priors.albedo * np.median(texels.dd, axis=0) + 1e-12, np.float64),
            specular=pull,
            expected=expected,
            shape=self.maps[1].astype(np.float64) / expected,
            least=0.5 * problem.gloss if problem.gloss < 1.0 else 0.0,
            most=problem.gloss,
            level=problem.share,
            mean=float((problem.share * problem.albedo).sum()),
        )

    def energy(self, problem: LightingProblem, albedos: AlbedoPriors) -> float:
        """Robust sum of squares and priors."""
        smooth, negative = light_weights(problem)
        dark = np.minimum(_sphere(problem.order) @ self.light[: problem.order**2], 0.0)
        light = float((smooth[:, None] * self.light**2).sum()) + negative * float((dark**2).sum())
        return self.data + light + albedos.cost(*self.maps, self.expected)

    def equations(self, problem: LightingProblem, albedos: AlbedoPriors) -> LightingEquations:
        """Normal equations about this state, priors included."""
        system = LightingEquations.accumulate(problem, self.maps, self.shading, self.residual, self.weight)
        off = problem.albedo - self.maps[0], albedos.wanted(self.expected) - self.maps[1]
        smooth, negative = light_weights(problem)
        directions = np.pad(_sphere(problem.order), ((0, 0), (0, len(smooth) - problem.order**2)))
        radiance, light, right = directions @ self.light, system.light.copy(), system.right.copy()
        for c in range(3):
            rows = directions[radiance[:, c] < 0]
            light[c] += negative * rows.T @ rows + np.diag(smooth)
            right[c] -= negative * rows.T @ (rows @ self.light[:, c]) + smooth * self.light[:, c]
        return replace(
            system,
            texels=system.texels.with_priors((albedos.diffuse, albedos.specular), *off),
            light=light,
            right=right,
            ties=albedos.ties(free=albedos.least < self.expected < albedos.most),
            stiffness=albedos.stiffness,
        )


def robust_squares(problem: LightingProblem, residual: NDArray, scale: float) -> tuple[NDArray[np.float32], float]:
    """(M, 3) weights of residuals and their sum, Cauchy's of this scale; clipped ones count where they are too dark."""
    bound = problem.clipped[:, None]
    weight = robust_weight(problem.weight, bound, residual, scale)
    if not np.isfinite(scale):
        return weight, float((weight * residual**2).sum())
    square = (residual / np.float32(scale)) ** 2
    counted = np.where(bound & (residual <= 0), np.float32(0.0), problem.weight)
    return weight, scale**2 * float((counted * np.where(bound, square, np.log1p(square))).sum())


def robust_weight(weight: NDArray, bound: NDArray, residual: NDArray, scale: float) -> NDArray[np.float32]:
    """Weights of residuals: where clipped, those that are too dark alone; else outliers less (Cauchy)."""
    part = np.where(bound & (residual <= 0), np.float32(0.0), weight)
    # Bounds are no outliers: a highlight far below its bound is missing.
    return np.where(bound, part, part / (1.0 + (residual / np.float32(scale)) ** 2)).astype(np.float32)


def light_weights(problem: LightingProblem) -> tuple[NDArray[np.float64], float]:
    """(K,) penalty of each squared coefficient, and that of squared negative radiance per direction."""
    smooth = problem.priors.roughness * problem.scale * _stiffness(problem.order, problem.diffuse.shape[1])
    return smooth, problem.priors.negative * problem.scale * 4.0 * np.pi / DIRECTIONS


def solve_lighting(
    problem: LightingProblem,
    start: tuple[NDArray, NDArray, NDArray] | None = None,
    specular: float = SPECULAR,
    robust: bool = True,
    iterations: int = 12,
    tolerance: float = 1e-3,
    noise: float | None = None,
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
    robust : bool
        Give outliers less weight (Cauchy).
    iterations : int
    tolerance : float
        Stop when the energy changes by less than this part.
    noise : float, optional
        Robust standard deviation of the residuals of an earlier fit, from which Cauchy's scale follows; by default that
        is `GROSS`. A scale that follows the residuals alone shrinks with them.
    """
    if start is None:
        maps = problem.albedo.astype(np.float32), np.full(len(problem.albedo), specular, np.float32)
        start = _initial(problem, *maps), *maps
    least = None if noise is None else CAUCHY * noise / problem.freedom**0.5

    def rescaled(state: Residuals) -> Residuals:
        return state.rescaled(problem, least) if robust else state

    expected = min(float(np.median(start[2])), problem.gloss)
    best = rescaled(Residuals.of(problem, start[0], start[1:], expected))
    energy, outcome, damping = [best.data], Outcome.MAX_ITERATIONS, 1e-4
    system: LightingEquations | None = None
    if not np.isfinite(best.data):
        outcome, iterations = Outcome.DIVERGED, 0
    for _ in range(iterations):
        if system is None:
            albedos = best.priors(problem)
            best = rescaled(best.following(problem, best.light, albedos))
            system, before = best.equations(problem, albedos), best.energy(problem, albedos)
            lowest = np.where(np.arange(len(best.light))[:, None] < problem.order**2, -np.inf, -best.light)
        trial = best.following(problem, best.light + system.solve(damping, lowest), albedos)
        after = trial.energy(problem, albedos)
        if after < before:
            best, system, damping = trial, None, max(0.1 * damping, 1e-5)
            energy.append(best.data)
        elif after >= (1.0 + tolerance) * before or damping > 1e-4:
            # The step made it worse: a shorter one.
            damping *= 10.0
            if damping > 1e3:
                outcome = Outcome.STALLED
                break
            continue
        if before - after < tolerance * before:
            outcome = Outcome.CONVERGED
            break
    sigma, unexplained = robust_deviation(problem.weight, problem.clipped, best.residual), best.unexplained(problem)
    return LightingSolution(best.light, *best.maps, best.expected, sigma, unexplained, energy, outcome)


@cache
def _sphere(order: int) -> NDArray[np.float64]:
    """Basis functions at the directions in which radiance is kept from being negative."""
    return basis(fibonacci_sphere(DIRECTIONS), order)


def _stiffness(order: int, count: int) -> NDArray[np.float64]:
    """(l (l + 1))^2 of each coefficient; 0 for the compact lights after them, about which nothing is smooth."""
    band = bands(order).astype(np.float64)
    return np.pad((band * (band + 1.0)) ** 2, (0, count - order * order))


def robust_deviation(weight: NDArray, clipped: NDArray, residual: NDArray) -> float:
    """Robust standard deviation of the residuals that are measured."""
    measured = np.flatnonzero((weight > 0) & ~clipped[..., None])
    return median_deviation(residual.reshape(-1)[measured[:: max(1, len(measured) // 200_000)]])


def active_weight(weight: NDArray, clipped: NDArray, residual: NDArray) -> tuple[NDArray[np.float32], float]:
    """Robust weights beside residuals of unknown size, and their robust standard deviation."""
    sigma = robust_deviation(weight, clipped, residual)
    active = np.empty(np.broadcast_shapes(weight.shape, residual.shape), np.float32)

    def fill(rows: slice) -> None:
        scale = max(CAUCHY * sigma, 1e-4)
        active[rows] = robust_weight(weight[rows], clipped[rows, ..., None], residual[rows], scale)

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
    shown = np.nonzero(there)[0], seen.colour[there], weight[there], seen.clipped[there]
    return LightingProblem(*shown, diffuse, specular, albedo, forward.order, forward.gloss)


def fit_lighting(
    seen: Observations, forward: Forward, albedo: NDArray, robust: bool, iterations: int, noise: float | None = None
) -> LightingSolution:
    """Lighting and the subset's albedos; a model that turns with the lighting is linearised anew."""
    problem = lighting_problem(seen, forward, forward.dark, albedo, robust)
    if not forward.model.turns:
        specular = SPECULAR if forward.gloss else 0.0
        return solve_lighting(problem, specular=specular, robust=robust, iterations=iterations, noise=noise)
    # Without highlights first, so that there is lighting to linearise about.
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    found = solve_lighting(problem, specular=0.05, robust=robust, iterations=6, noise=noise)
    before, lowest, energy = found, np.inf, list(found.energy)
    for _ in range(max(iterations // 12, 1)):
        problem = lighting_problem(seen, forward, found.light, albedo, robust)
        start = found.light, found.diffuse, found.specular
        trial = solve_lighting(problem, start, robust=robust, iterations=3, noise=noise)
        if not trial.energy[0] < lowest:
            return replace(before, energy=energy)  # what was found last is worse once linearised anew
        before, found, lowest = found, trial, trial.energy[0]
        energy += found.energy
    return replace(found, energy=energy)
