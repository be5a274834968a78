"""Choice of the image-formation model, and the lighting under it, from a subset of the texels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.illumination import DistantLight
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import ShadingModel
from mifit.config import ReflectanceConfig
from mifit.core.sh import LUMINANCE
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.key import RADII, STEPS, TEXELS, Candidates, WideLights, find_lights, search
from mifit.stages.reflectance.lighting import LightingSolution, solve_lighting
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingPriors, LightingProblem
from mifit.stages.reflectance.near import TEXELS as PLACE_TEXELS
from mifit.stages.reflectance.near import UNKNOWN_SKIN, Judge, approach, find_near, without_edges
from mifit.stages.reflectance.prediction import Prediction, predict
from mifit.stages.reflectance.priors import EXPONENT, NORMAL_REFLECTANCE

NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""
MARGIN = 0.03
"""Another way to explain the images is taken where it lowers the error of predicted images by more than this part."""
LEAN = 0.005
"""Logarithm of the predicted error by which a lobe an octave off the physical one has to predict better, fourfold for
two octaves: a normal prior of one octave beside a hundred independent measurements, which is about how many patches of
a face with their own error there are."""
EXPONENTS = (10.0, 160.0)
"""Exponents between which a lobe is looked for, an octave at a time: Beckmann roughness 0.4 to 0.1."""
JUDGES = 1200
"""Texels by which ways to explain the images are compared."""
PLACE_ITERATIONS = 20
"""Gauss-Newton iterations of a fit about which places of a light are judged: they differ by little."""
PLACE_SEARCHES, APPROACH = 3, 0.3
"""Searches for a place, and the first step of all but the first one, of log distance."""
NEARER, CLEARLY = 0.015, 0.1
"""Part by which a compact light at a place has to lower the error of predicted images below that of the same light far
away, which has one unknown less; and, where no image can be left out, that of the fit."""
FAINT = 0.2
"""Irradiance of a compact light, relative to that of all other light: below, it is taken for a flaw of the model."""
START_ITERATIONS = 5
"""Gauss-Newton iterations where they are only a start: the objective over all texels is minimised afterwards."""
SMOOTH = LightingPriors(roughness=10.0 * PRIORS.roughness)
"""Where no compact light helps beside lighting with the usual priors, one is looked for beside smoother lighting: on a
mesh that is millimetres off, ten bands twist themselves until they leave nothing for it to explain."""
TRIAL_ITERATIONS = 8
"""Gauss-Newton iterations of a way to explain the images that is only compared with others."""


@dataclass(frozen=True)
class Candidate:
    """A way to explain the images: a shading model by name, with or without compact lights and specular reflection.

    A compact light is distant, or ``near``.
    """

    model: str
    lights: bool = False
    glossy: bool = True
    near: bool = False


CANDIDATES = {
    "shadowed": Candidate("shadowed"),
    "keyed": Candidate("shadowed", lights=True),
    "near": Candidate("shadowed", lights=True, near=True),
    "matt": Candidate("shadowed", glossy=False),
}
"""What ``shading = auto`` chooses from. Every face shadows itself: a model without shadows, free to bend the light to
its needs, explains images as well but predicts other light worse. Other registered shading models can be asked for by
name."""


def candidate(name: str) -> Candidate:
    """What a setting of ``shading`` asks for."""
    return CANDIDATES.get(name) or Candidate(name)


def fitted_models(config: ReflectanceConfig) -> list[ShadingModel]:
    """The shading models among which settings leave a choice."""
    names = list(CANDIDATES) if config.shading == "auto" else [config.shading]
    return [models.get(candidate(name).model) for name in names]


def plain_forward(model: ShadingModel, exponent: float, config: ReflectanceConfig, surface: Surface) -> Forward:
    """A model as it is fitted, with its own number of bands and kind of lobe, without compact lights."""
    lobe = Lobe(exponent, model.fresnel, model.normalized)
    return Forward.of(model, model.bands or config.bands, lobe, surface.meshes)


def choose_lighting(
    surface: Surface, seen: Observations, albedo: NDArray, config: ReflectanceConfig, progress: Progress
) -> tuple[Forward, LightingSolution, dict]:
    """Choose a way to explain the images by how well it predicts images that it isn't shown, and fit its lighting.

    Parameters
    ----------
    surface : Surface
    seen : Observations
        The subset of the texels, with the albedo (n, 3) that the morphable model expects there.
    albedo : (n, 3)
    config : ReflectanceConfig
    progress : Progress

    Returns
    -------
    Forward, LightingSolution, and what was chosen and why, as JSON values.
    """
    auto = config.shading == "auto"
    way = candidate("shadowed" if auto else config.shading)
    model = models.get(way.model)
    plain = plain_forward(model, config.exponent or model.exponent or EXPONENT, config, surface)
    plain = replace(plain, glossy=way.glossy)
    step = max(1, len(seen.texel) // JUDGES)
    trials = _Trials(seen.take(slice(0, None, step)), albedo[::step], config, progress)
    chosen = trials.add(way.model if way.lights else config.shading if not auto else "shadowed", plain)
    free = config.exponent is None and model.exponent is None and way.glossy
    if free:
        chosen = trials.best_exponent(chosen)
    why = "as configured"
    if auto or way.lights:
        why = "no compact light explains enough"
        wide = WideLights.of(trials.seen.take(trials.few), chosen.forward)
        for priors in (PRIORS, SMOOTH):
            lit = _with_light(trials, chosen, priors, wide)
            if lit is None:
                continue
            keyed, why = trials.add("keyed", lit), "as configured"
            best = _nearer(trials, keyed, way.near) if auto or way.near else keyed
            if way.near and best is keyed:
                why = "the compact light is too far away to have a place"
            if not auto or best.error < (1.0 - MARGIN) * chosen.error:
                chosen = trials.best_exponent(best) if free else best
                break
    if auto:
        why = f"predicts images left out better than others by more than {MARGIN:.0%}, or is the likeliest beforehand"
        if chosen.prediction is not None:
            matt = trials.add("matt", replace(plain, glossy=False))
            if matt.error < (1.0 - MARGIN) * chosen.error:
                chosen = matt
    iterations = config.max_iterations if config.robust else min(START_ITERATIONS, config.max_iterations)
    found = fit_lighting(seen, chosen.forward, albedo, config, iterations)
    return chosen.forward, found, {"chosen": chosen.name, "why": why, **trials.figures()}


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


class _Trials:
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
            {"shading": t.name, "exponent": t.exponent if t.forward.glossy else None, "error": t.prediction.error}
            for t in self.done
            if t.prediction is not None
        ]
        left_out = next((t.prediction.left_out for t in self.done if t.prediction is not None), None)
        return {"residuals": residuals, "predicted": predicted, "left_out": left_out}


def _with_light(trials: _Trials, chosen: Trial, priors: LightingPriors, wide: WideLights) -> Forward | None:
    """A model with a compact light where one explains enough, found on some of the texels.

    The search starts from the fit without the light, which had to make up for it; a second one starts from the fit
    with it.
    """
    seen, config, forward, found = trials.seen, trials.config, chosen.forward, chosen.found
    if priors is not PRIORS:
        found = fit_lighting(seen, forward, trials.albedo, config, TRIAL_ITERATIONS, priors=priors)
    few = trials.few
    part, expected = seen.take(few), trials.albedo[few]
    found = replace(found, diffuse=found.diffuse[few], specular=found.specular[few])
    problem = lighting_problem(part, forward, found.light, expected, config.robust)
    for light in find_lights(Candidates.about(part, forward, problem, found, priors), wide):
        lit = forward.with_lights((light,))
        fitted = fit_lighting(part, lit, expected, config, 8, priors=priors)
        mean = np.sqrt(np.pi) / 2.0 * fitted.light[0]  # irradiance from everywhere, pi times the mean radiance
        (irradiance,) = (light.colour for light in lit.under(fitted.light).illumination.lights)
        if irradiance @ LUMINANCE < FAINT * mean @ LUMINANCE:
            continue
        problem = lighting_problem(part, lit, fitted.light, expected, config.robust)
        candidates = Candidates.about(part, lit, problem, fitted, priors)
        _, light = search(candidates, light.direction, light.radius, 0.25 * STEPS[0])
        if light.radius < RADII[1]:
            return forward.with_lights((light,))
    return None


def _nearer(trials: _Trials, keyed: Trial, wanted: bool) -> Trial:
    """The same with its compact light at a place, where that predicts better or is wanted; itself otherwise.

    The place is searched again from a fit with the light at the last one.
    """
    seen, config = trials.seen, trials.config
    step = max(1, len(seen.texel) // PLACE_TEXELS)
    part, expected = seen.take(slice(0, None, step)), trials.albedo[::step]
    light = keyed.forward.lights[0]
    for _ in range(PLACE_SEARCHES):
        forward = keyed.forward.with_lights((light,))
        certain = without_edges(part, forward)
        found = fit_lighting(certain, forward, expected, config, PLACE_ITERATIONS, priors=UNKNOWN_SKIN)
        problem = lighting_problem(certain, forward, found.light, expected, config.robust)
        judge = Judge.about(certain, forward, problem, found, UNKNOWN_SKIN)
        far = isinstance(light, DistantLight)
        light = find_near(judge, light, part.point) if far else approach(judge, light, APPROACH)
        if light is None:
            return keyed
    near = trials.add("near", keyed.forward.with_lights((light,)))
    margin = NEARER if near.prediction is not None else CLEARLY
    return near if wanted or near.error < (1.0 - margin) * keyed.error else keyed


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
