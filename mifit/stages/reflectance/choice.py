"""Choice of the image-formation model, and the lighting under it, from a subset of the texels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.illumination import DistantLight, NearLight
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import ShadingModel
from mifit.config import ReflectanceConfig
from mifit.core.sh import LUMINANCE
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.key import RADII, STEPS, Candidates, WideLights, find_lights, search
from mifit.stages.reflectance.lighting import LightingSolution
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingPriors
from mifit.stages.reflectance.near import TEXELS as PLACE_TEXELS
from mifit.stages.reflectance.near import UNKNOWN_SKIN, Judge, approach, find_near, without_edges
from mifit.stages.reflectance.priors import EXPONENT
from mifit.stages.reflectance.trials import TRIAL_ITERATIONS, Trial, Trials, fit_lighting, lighting_problem

MARGIN = 0.03
"""Another way to explain the images is taken where it lowers the error of predicted images by more than this part."""
JUDGES = 1200
"""Texels by which ways to explain the images are compared."""
PLACE_ITERATIONS = 20
"""Gauss-Newton iterations of a fit about which places of a light are judged: they differ by little."""
PLACE_SEARCHES, APPROACH = 3, 0.3
"""Searches for a place, and the first step of all but the first one, of log distance."""
NEARER, CLEARLY = 0.015, 0.1
"""Part by which a compact light at a place has to lower the error of predicted images below that of the same light far
away, which has one unknown less; and, where no image can be left out, that of the fit."""
LIGHTS = 3
"""Compact lights at the most: a face shows a few lamps apart, and what more there are is smooth light to it."""
FAINT = 0.2
"""Irradiance of a compact light, relative to that of all other light: below, it is taken for a flaw of the model."""
START_ITERATIONS = 5
"""Gauss-Newton iterations where they are only a start: the objective over all texels is minimised afterwards."""
SMOOTH = LightingPriors(roughness=10.0 * PRIORS.roughness)
"""Where no compact light helps beside lighting with the usual priors, one is looked for beside smoother lighting: on a
mesh that is millimetres off, ten bands twist themselves until they leave nothing for it to explain."""
SETTLING_ITERATIONS = 8
"""Gauss-Newton iterations of a fit about which the places of compact lights are searched again."""


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
    trials = Trials(seen.take(slice(0, None, step)), albedo[::step], config, progress)
    chosen = trials.add(way.model if way.lights else config.shading if not auto else "shadowed", plain)
    free = config.exponent is None and model.exponent is None and way.glossy
    if free:
        chosen = trials.best_exponent(chosen)
    why = "as configured"
    if auto or way.lights:
        why = "no compact light explains enough"
        wide = WideLights.of(trials.seen.take(trials.few), chosen.forward)
        beside: tuple[LightingPriors, ...] = (PRIORS, SMOOTH)
        while len(chosen.forward.lights) < LIGHTS:
            lit = _lit(trials, chosen, wide, way, auto, beside)
            if lit is None:
                break
            best, priors = lit
            beside, why = (priors,), "as configured"  # what showed the first light is what may show another
            if way.near and best.name != "near":
                why = "the compact light is too far away to have a place"
            chosen = trials.best_exponent(best) if free else best
    told = True
    if auto:
        why = f"predicts images left out better than others by more than {MARGIN:.0%}, or is the likeliest beforehand"
        if chosen.prediction is not None:
            matt = trials.add("matt", replace(plain, glossy=False))
            # Where images are predicted as well without gloss, they tell none: its level is then that of skin.
            told = chosen.error < (1.0 - MARGIN) * matt.error
            if matt.error < (1.0 - MARGIN) * chosen.error:
                chosen = matt
    iterations = config.max_iterations if config.robust else min(START_ITERATIONS, config.max_iterations)
    found = fit_lighting(seen, chosen.forward, albedo, config, iterations, priors=replace(PRIORS, gloss_told=told))
    return chosen.forward, found, {"chosen": chosen.name, "why": why, "gloss_told": told, **trials.figures()}


def _lit(
    trials: Trials,
    chosen: Trial,
    wide: WideLights,
    way: Candidate,
    auto: bool,
    beside: Sequence[LightingPriors],
) -> tuple[Trial, LightingPriors] | None:
    """A trial with one compact light more, or two, and beside which lighting they were found.

    None where it doesn't predict better; the first one that is asked for is taken all the same.
    """
    first = not chosen.forward.lights
    if not first and chosen.prediction is None:
        return None  # the fit's own error is lower with every light
    for priors in beside:
        lit = _with_light(trials, chosen, priors, wide)
        if lit is None:
            continue
        best, limit = trials.add("near" if _has_near(lit) else "keyed", lit), (1.0 - MARGIN) * chosen.error
        # The strongest light tells best how far away it is: beside one that is distant the others stay so as well.
        if (auto or way.near) and (first or (_has_near(chosen.forward) and best.error < limit)):
            best = _nearer(trials, best, len(lit.lights) - len(chosen.forward.lights), way.near and first)
        if (first and not auto) or best.error < limit:
            return best, priors
    return None


def _has_near(forward: Forward) -> bool:
    return any(isinstance(light, NearLight) for light in forward.lights)


def _with_light(trials: Trials, chosen: Trial, priors: LightingPriors, wide: WideLights) -> Forward | None:
    """A model with compact lights more where they explain enough, found on some of the texels.

    The search starts from the fit without them, which had to make up for them; a second one starts from the fit with
    them.
    """
    seen, config, forward, found = trials.seen, trials.config, chosen.forward, chosen.found
    if priors is not PRIORS:
        found = fit_lighting(seen, forward, trials.albedo, config, TRIAL_ITERATIONS, priors=priors)
    few = trials.few
    part, expected = seen.take(few), trials.albedo[few]
    found = replace(found, diffuse=found.diffuse[few], specular=found.specular[few])
    problem = lighting_problem(part, forward, found.light, expected, config.robust)
    for lights in find_lights(Candidates.about(part, forward, problem, found, priors, forward.lights), wide):
        if len(forward.lights) + len(lights) > LIGHTS:
            continue
        lit = _settled(part, forward.with_lights((*forward.lights, *lights)), expected, config, priors)
        if lit is not None:
            return lit
    return None


def _settled(
    seen: Observations, forward: Forward, albedo: NDArray, config: ReflectanceConfig, priors: LightingPriors
) -> Forward | None:
    """The same with each distant compact light, the last one first, searched again beside all others.

    Each was found where others were missing or elsewhere. None where one turns out faint, or not compact.
    """
    for _ in forward.lights:
        *others, light = forward.lights
        fitted = fit_lighting(seen, forward, albedo, config, SETTLING_ITERATIONS, priors=priors)
        mean = np.sqrt(np.pi) / 2.0 * fitted.light[0]  # irradiance from everywhere, pi times the mean radiance
        if fitted.light[-1] @ LUMINANCE < FAINT * mean @ LUMINANCE:
            return None
        if isinstance(light, DistantLight):
            problem = lighting_problem(seen, forward, fitted.light, albedo, config.robust)
            candidates = Candidates.about(seen, forward, problem, fitted, priors, tuple(others))
            _, light = search(candidates, light.direction, light.radius, 0.25 * STEPS[0])
            if not light.radius < RADII[1]:
                return None
        forward = forward.with_lights((light, *others))  # once around, they are in their order again
    return forward


def _nearer(trials: Trials, keyed: Trial, count: int, wanted: bool) -> Trial:
    """The same with some of its last compact lights at places, where that predicts better.

    Where it doesn't for any of them, but is wanted, the last one gets its place all the same.
    """
    best, unlikely = keyed, None
    for number in range(count):
        near = _placed(trials, best, -1 - number)
        if near is None:
            continue
        margin = NEARER if near.prediction is not None else CLEARLY
        if near.error < (1.0 - margin) * best.error:
            best = near
        else:
            unlikely = unlikely or near
    return unlikely if wanted and best is keyed and unlikely is not None else best


def _placed(trials: Trials, keyed: Trial, number: int) -> Trial | None:
    """The same with one of its compact lights at a place, and last; None where it is too far away to have one.

    The place is searched again from a fit with the light at the last one.
    """
    seen, config = trials.seen, trials.config
    step = max(1, len(seen.texel) // PLACE_TEXELS)
    part, expected = seen.take(slice(0, None, step)), trials.albedo[::step]
    others = list(keyed.forward.lights)
    light = others.pop(number)
    for _ in range(PLACE_SEARCHES):
        forward = keyed.forward.with_lights((*others, light))
        certain = without_edges(part, forward)
        found = fit_lighting(certain, forward, expected, config, PLACE_ITERATIONS, priors=UNKNOWN_SKIN)
        problem = lighting_problem(certain, forward, found.light, expected, config.robust)
        judge = Judge.about(certain, forward, problem, found, UNKNOWN_SKIN)
        far = isinstance(light, DistantLight)
        light = find_near(judge, light, part.point) if far else approach(judge, light, APPROACH)
        if light is None:
            return None
    return trials.add("near", keyed.forward.with_lights((*others, light)))
