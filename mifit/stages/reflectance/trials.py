"""Ways to explain some of the texels, each fitted and judged by how well it predicts images that it isn't shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.config import ReflectanceConfig
from mifit.progress import Progress
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.key import TEXELS
from mifit.stages.reflectance.lighting import LightingSolution, solve_lighting
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingPriors, LightingProblem
from mifit.stages.reflectance.prediction import Prediction, predict
from mifit.stages.reflectance.priors import EXPONENT, NORMAL_REFLECTANCE

NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""
LEAN = 0.005
"""Logarithm of the predicted error by which a lobe an octave off the physical one has to predict better, fourfold for
two octaves: a normal prior of one octave beside a hundred independent measurements, which is about how many patches of
a face with their own error there are."""
EXPONENTS = (10.0, 160.0)
"""Exponents between which a lobe is looked for, an octave at a time: Beckmann roughness 0.4 to 0.1."""
TRIAL_ITERATIONS = 8
"""Gauss-Newton iterations of a way to explain the images that is only compared with others."""


@dataclass(frozen=True)
class Trial:
    """A way to explain the images, fitted to some of the texels.

    Attributes
    ----------
    name : str
        Of the candidate.
    forward : Forward
    fit : callable
        Finds the lighting by all images.
    prediction : Prediction or None
        None where there is nothing to leave out.
    """

    name: str
    forward: Forward
    fit: Callable[[], LightingSolution] = field(repr=False)
    prediction: Prediction | None

    @cached_property
    def found(self) -> LightingSolution:
        """The fit to all images: what is compared are predictions, so that most trials do without."""
        return self.fit()

    @property
    def exponent(self) -> float:
        """Of its lobe."""
        return self.forward.lobe.typical

    @property
    def error(self) -> float:
        """Error of predicted images; of the fitted ones where none can be predicted."""
        return self.found.unexplained if self.prediction is None else self.prediction.error

    @property
    def score(self) -> float:
        """Logarithm of the error, and of how unlikely the lobe is beforehand."""
        return float(np.log(max(self.error, 1e-12)) + LEAN * np.log2(self.exponent / EXPONENT) ** 2)


class Trials:
    """Ways to explain some of the texels, each tried once."""

    def __init__(self, seen: Observations, albedo: NDArray, config: ReflectanceConfig, progress: Progress) -> None:
        self.seen, self.albedo, self.config, self.progress = seen, albedo, config, progress
        self.done: list[Trial] = []

    @property
    def few(self) -> slice:
        """Those of the texels by which compact lights are looked for."""
        return slice(0, None, max(1, len(self.seen.texel) // TEXELS))

    def add(self, name: str, forward: Forward) -> Trial:
        """Fit one, and let it predict."""
        self.progress("Reflectance lighting", len(self.done), len(self.done) + 1)
        config, prediction = self.config, None
        specular = NORMAL_REFLECTANCE if forward.glossy else 0.0
        if forward.model.turns:
            fit = partial(fit_lighting, self.seen, forward, self.albedo, config, TRIAL_ITERATIONS, specular)
        else:
            problem = lighting_problem(self.seen, forward, forward.dark, self.albedo, config.robust)
            fit = partial(solve_held, problem, forward, config, TRIAL_ITERATIONS, specular)
            if config.robust:
                prediction = predict(self.seen, problem, specular)
        self.done.append(Trial(name, forward, fit, prediction))
        return self.done[-1]

    def best_exponent(self, best: Trial) -> Trial:
        """The exponent that predicts best, beginning with a trial's; its own where there is nothing to predict."""
        if best.prediction is None:
            return best
        start = best
        for factor in (2.0, 0.5):
            while EXPONENTS[0] <= factor * best.exponent <= EXPONENTS[1]:
                lobe = replace(best.forward.lobe, exponent=factor * best.exponent)
                trial = self.add(start.name, best.forward.with_lobe(lobe))
                if not trial.score < best.score:
                    break
                best = trial
            if best is not start:
                break
        return best

    def figures(self) -> dict[str, Any]:
        """Errors of images: fitted, by candidate with the exponent that predicts best, and predicted, by exponent."""
        best: dict[str, Trial] = {}
        for trial in self.done:
            if trial.name not in best or trial.score < best[trial.name].score:
                best[trial.name] = trial
        residuals = {name: float(trial.found.unexplained) for name, trial in best.items()}
        predicted = [
            {
                "shading": t.name,
                "lights": len(t.forward.lights),
                "exponent": t.exponent if t.forward.glossy else None,
                "error": t.prediction.error,
            }
            for t in self.done
            if t.prediction is not None
        ]
        left_out = next((t.prediction.left_out for t in self.done if t.prediction is not None), None)
        return {"residuals": residuals, "predicted": predicted, "left_out": left_out}


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
    config: ReflectanceConfig,
    iterations: int,
    specular: float = NORMAL_REFLECTANCE,
    priors: LightingPriors = PRIORS,
) -> LightingSolution:
    """Lighting and the subset's albedos; a model that turns with the lighting is linearised anew."""
    if not forward.model.turns:
        problem = lighting_problem(seen, forward, forward.dark, albedo, config.robust)
        return solve_held(problem, forward, config, iterations, specular, priors)
    # Without highlights first, so that there is lighting to linearise about.
    problem = lighting_problem(seen, forward, forward.dark, albedo, config.robust)
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    ambient = forward.model.has_ambient
    found = solve_lighting(problem, priors=priors, robust=config.robust, with_ambient=ambient, iterations=6)
    energy = list(found.energy)
    for _ in range(4):
        problem = lighting_problem(seen, forward, found.light, albedo, config.robust)
        found = solve_lighting(
            problem,
            found.light,
            priors=priors,
            robust=config.robust,
            with_ambient=ambient,
            iterations=max(2, iterations // 4),
        )
        energy += found.energy
    return replace(found, energy=energy)


def solve_held(
    problem: LightingProblem,
    forward: Forward,
    config: ReflectanceConfig,
    iterations: int,
    specular: float = NORMAL_REFLECTANCE,
    priors: LightingPriors = PRIORS,
) -> LightingSolution:
    """Lighting and albedos under a model that doesn't turn with the lighting."""
    return solve_lighting(
        problem,
        specular=specular if forward.glossy else 0.0,
        priors=priors,
        robust=config.robust,
        with_ambient=forward.model.has_ambient,
        iterations=iterations,
    )
