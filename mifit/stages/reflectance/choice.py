"""Choice of the image-formation model, and the lighting under it, from a subset of the texels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import ShadingModel
from mifit.config import ReflectanceConfig
from mifit.core.sh import LUMINANCE
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.key import RADII, STEPS, TEXELS, Candidates, find_lights, search
from mifit.stages.reflectance.lighting import LightingProblem, LightingSolution, solve_lighting
from mifit.stages.reflectance.priors import EXPONENT, NORMAL_REFLECTANCE

NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""
EXPLAINED = 0.03
"""A costlier shading model is taken where it lowers the residual by more than this part."""
FAINT = 0.2
"""Irradiance of a compact light, relative to that of all other light: below, it is taken for a flaw of the model."""
START_ITERATIONS = 5
"""Gauss-Newton iterations where they are only a start: the objective over all texels is minimised afterwards."""


@dataclass(frozen=True)
class Candidate:
    """A way to explain the images: a shading model by name, with or without a search for compact lights."""

    model: str
    lights: bool = False


CANDIDATES = {"shadowed": Candidate("shadowed"), "keyed": Candidate("shadowed", lights=True)}
"""What ``shading = auto`` chooses from, cheap to costly. Every face shadows itself: a model without shadows, free to
bend the light to its needs, explains images as well but predicts other light worse. Other registered shading models
can be asked for by name."""


def candidate(name: str) -> Candidate:
    """What a setting of ``shading`` asks for."""
    return CANDIDATES.get(name) or Candidate(name)


def wanted_candidates(config: ReflectanceConfig) -> list[str]:
    """Names of what is to be fitted, in order; a search for lights starts from the fit of its model without them."""
    if config.shading == "auto":
        return list(CANDIDATES)
    asked = candidate(config.shading)
    return [asked.model, config.shading] if asked.lights else [config.shading]


def fitted_models(config: ReflectanceConfig) -> list[ShadingModel]:
    """The shading models among which settings leave a choice."""
    return [models.get(candidate(name).model) for name in wanted_candidates(config)]


def plain_forward(model: ShadingModel, exponent: float, config: ReflectanceConfig, surface: Surface) -> Forward:
    """A model as it is fitted, with its own number of bands and kind of lobe, without compact lights."""
    lobe = Lobe(exponent, model.fresnel, model.normalized)
    return Forward.of(model, model.bands or config.bands, lobe, surface.meshes)


def choose_lighting(
    surface: Surface, seen: Observations, albedo: NDArray, config: ReflectanceConfig, progress: Progress
) -> tuple[Forward, LightingSolution, dict]:
    """Fit the lighting under the configured model, or under all of them, of which the cheapest sufficient one wins.

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
    tried: dict[str, tuple[Forward, LightingSolution]] = {}
    auto = config.shading == "auto"
    wanted = wanted_candidates(config)
    iterations = config.max_iterations if config.robust else min(START_ITERATIONS, config.max_iterations)
    for name in wanted:
        progress("Reflectance lighting", len(tried), len(wanted))
        way = candidate(name)
        model = models.get(way.model)
        if way.lights:
            found_light = _with_light(surface, seen, *tried[way.model], albedo, config)
            if found_light is None:
                continue
            forward = found_light
        else:
            exponent = config.exponent or model.exponent or EXPONENT
            forward = plain_forward(model, exponent, config, surface)
        tried[name] = forward, fit_lighting(seen, forward, albedo, config, iterations)
    progress("Reflectance lighting", len(wanted), len(wanted))
    chosen, why = list(tried)[-1], "as configured"
    if auto:
        chosen = next(iter(tried))
        for name in tried:
            if tried[name][1].unexplained < (1.0 - EXPLAINED) * tried[chosen][1].unexplained:
                chosen = name
        why = f"cheapest whose unexplained residual no costlier model lowers by more than {EXPLAINED:.0%}"
    elif chosen != config.shading:
        why = "no compact light explains enough"
    forward, found = tried[chosen]
    choice = {
        "chosen": chosen,
        "why": why,
        "residuals": {name: float(f.unexplained) for name, (_, f) in tried.items()},
        "exponent": forward.lobe.typical,
    }
    return forward, found, choice


def _with_light(
    surface: Surface,
    seen: Observations,
    forward: Forward,
    found: LightingSolution,
    albedo: NDArray,
    config: ReflectanceConfig,
) -> Forward | None:
    """A model with a compact light where one explains enough, found on some of the texels.

    The search starts from the fit without the light, which had to make up for it; a second one starts from the fit
    with it.
    """
    step = max(1, len(seen.texel) // TEXELS)
    part, expected = seen.take(slice(0, None, step)), albedo[::step]
    found = replace(found, diffuse=found.diffuse[::step], specular=found.specular[::step])
    problem = lighting_problem(part, forward, found.light, expected, config.robust)
    for light in find_lights(Candidates.about(part, forward, problem, found)):
        lit = forward.with_lights((light,))
        fitted = fit_lighting(part, lit, expected, config, 8)
        mean = np.sqrt(np.pi) / 2.0 * fitted.light[0]  # irradiance from everywhere, pi times the mean radiance
        (irradiance,) = (light.colour for light in lit.under(fitted.light).illumination.lights)
        if irradiance @ LUMINANCE < FAINT * mean @ LUMINANCE:
            continue
        problem = lighting_problem(part, lit, fitted.light, expected, config.robust)
        candidates = Candidates.about(part, lit, problem, fitted)
        _, light = search(candidates, light.direction, light.radius, 0.25 * STEPS[0])
        if light.radius < RADII[1]:
            return forward.with_lights((light,))
    return None


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
) -> LightingSolution:
    """Lighting and the subset's albedos; a model that turns with the lighting is linearised anew."""
    light = np.zeros((forward.unknowns, 3))
    if not forward.model.turns:
        problem = lighting_problem(seen, forward, light, albedo, config.robust)
        return solve_lighting(
            problem,
            specular=specular,
            robust=config.robust,
            with_ambient=forward.model.has_ambient,
            iterations=iterations,
        )
    # Without highlights first, so that there is lighting to linearise about.
    problem = lighting_problem(seen, forward, light, albedo, config.robust)
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    found = solve_lighting(problem, robust=config.robust, with_ambient=forward.model.has_ambient, iterations=6)
    energy = list(found.energy)
    for _ in range(4):
        problem = lighting_problem(seen, forward, found.light, albedo, config.robust)
        found = solve_lighting(
            problem,
            found.light,
            robust=config.robust,
            with_ambient=forward.model.has_ambient,
            iterations=max(2, iterations // 4),
        )
        energy += found.energy
    return replace(found, energy=energy)
