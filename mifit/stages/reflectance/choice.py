"""Choice of the image-formation model, and the lighting under it, from a subset of the texels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.config import ReflectanceConfig
from mifit.core.sh import LUMINANCE
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.key import TEXELS, Candidates, find_key
from mifit.stages.reflectance.lighting import LightingProblem, LightingSolution, solve_lighting

NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""
PAPER_EXPONENT = 5.0
EXPONENTS = (50.0, 150.0, 400.0)
"""Exponents that are tried where none is given."""
FRESNEL = 8.0
"""Rise of the lobe towards grazing views. Schlick's for skin is 24 times the value at normal incidence, of which
shadowing and masking between microfacets take a part; fits of path-traced skin change by about 0.1 dB from 8 to 24."""
EXPLAINED = 0.03
"""A costlier shading model is taken where it lowers the residual by more than this part."""
FAINT = 0.2
"""Irradiance of a compact light, relative to that of all other light: below, it is taken for a flaw of the model."""
START_ITERATIONS = 5
"""Gauss-Newton iterations where they are only a start: the objective over all texels is minimised afterwards."""
MODELS = ("paper", "prefiltered", "shadowed", "keyed")
"""Image-formation models from cheap to costly."""


def choose_lighting(
    surface: Surface, faces: NDArray, seen: Observations, albedo: NDArray, config: ReflectanceConfig, progress: Progress
) -> tuple[Forward, LightingSolution, dict]:
    """Fit the lighting under the configured model, or under all of them, of which the cheapest sufficient one wins.

    Parameters
    ----------
    surface : Surface
    faces : (F, 3)
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
    total = len(MODELS) if auto else 1
    iterations = config.max_iterations if config.robust else min(START_ITERATIONS, config.max_iterations)

    def attempt(name: str, forward: Forward) -> None:
        progress("Reflectance lighting", len(tried), total)
        tried[name] = forward, fit_lighting(seen, forward, albedo, config, iterations)

    if auto or config.shading == "paper":
        attempt("paper", Forward("paper", 3, config.exponent or PAPER_EXPONENT))
    if config.shading != "paper":
        plain = Forward("prefiltered", config.bands, 0.0, FRESNEL, faces=faces)
        plain = replace(plain, exponent=config.exponent or _best_exponent(seen, plain, albedo, config))
        if auto or config.shading == "prefiltered":
            attempt("prefiltered", plain)
        if config.shading != "prefiltered":
            shadowed = replace(plain, model="shadowed", traced=surface.trace(config.bands))
            attempt("shadowed", shadowed)
            if config.shading != "shadowed":
                keyed = _with_key(surface, seen, *tried["shadowed"], albedo, config)
                if keyed is not None:
                    attempt("keyed", keyed)
    progress("Reflectance lighting", total, total)
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
        "exponent": forward.exponent,
    }
    return forward, found, choice


def _best_exponent(seen: Observations, forward: Forward, albedo: NDArray, config: ReflectanceConfig) -> float:
    """The exponent of `EXPONENTS` that explains some texels best."""
    some = seen.take(slice(0, None, 3))
    trials = {
        m: fit_lighting(some, replace(forward, exponent=m), albedo[::3], config, 5).unexplained for m in EXPONENTS
    }
    return min(trials, key=lambda m: trials[m])


def _with_key(
    surface: Surface,
    seen: Observations,
    forward: Forward,
    found: LightingSolution,
    albedo: NDArray,
    config: ReflectanceConfig,
) -> Forward | None:
    """The shadowed model with a compact light where one explains enough, found on some of the texels.

    The search starts from the fit without the light, which had to make up for it; a second one starts from the fit
    with it.
    """
    step = max(1, len(seen.texel) // TEXELS)
    part, expected = seen.take(slice(0, None, step)), albedo[::step]
    found = replace(found, diffuse=found.diffuse[::step], specular=found.specular[::step])
    forward = replace(forward, scenes=tuple(surface.scenes))
    for again in (False, True):
        problem = lighting_problem(part, forward, found.radiance, expected, config.robust)
        key = find_key(Candidates.about(part, forward, problem, found), forward.key)
        if key is None:
            return None
        forward = replace(forward, key=key)
        if not again:
            if config.exponent is None:
                forward = replace(forward, exponent=_best_exponent(seen, forward, albedo, config))
            found = fit_lighting(part, forward, expected, config, 8)
            mean = np.sqrt(np.pi) / 2.0 * found.radiance[0]  # irradiance from everywhere, pi times the mean radiance
            if found.radiance[-1] @ LUMINANCE < FAINT * mean @ LUMINANCE:
                return None
    return forward


def noise_weight(colour: NDArray, robust: bool) -> NDArray[np.float32]:
    """(..., 3) inverse variance of read and shot noise, 1 at mid-grey; 1 everywhere when not robust."""
    if not robust:
        return np.ones_like(colour)
    return ((NOISE_FLOOR + 0.3) / (NOISE_FLOOR + np.clip(colour, 0.0, 1.0))).astype(np.float32)


def lighting_problem(
    seen: Observations, forward: Forward, radiance: NDArray, albedo: NDArray, robust: bool
) -> LightingProblem:
    """Collect the transfer vectors and weights of some texels."""
    diffuse, specular = forward.transfers(seen, radiance)
    weight = seen.weight[..., None] * noise_weight(seen.colour, robust)
    return LightingProblem(seen.colour, weight, seen.clipped, diffuse, specular, albedo)


def fit_lighting(
    seen: Observations,
    forward: Forward,
    albedo: NDArray,
    config: ReflectanceConfig,
    iterations: int,
    specular: float = 0.05,
) -> LightingSolution:
    """Lighting and the subset's albedos; the paper's dominant direction is found anew as the lighting changes."""
    radiance = np.zeros((forward.lights, 3))
    if forward.model != "paper":
        problem = lighting_problem(seen, forward, radiance, albedo, config.robust)
        return solve_lighting(problem, specular=specular, robust=config.robust, iterations=iterations)
    # Without highlights first, so that there is a direction to start from.
    problem = lighting_problem(seen, replace(forward, model="prefiltered"), radiance, albedo, config.robust)
    problem = replace(problem, specular=np.zeros_like(problem.specular))
    found = solve_lighting(problem, robust=config.robust, with_ambient=True, iterations=6)
    energy = list(found.energy)
    for _ in range(4):
        problem = lighting_problem(seen, forward, found.radiance, albedo, config.robust)
        found = solve_lighting(
            problem, found.radiance, robust=config.robust, with_ambient=True, iterations=max(2, iterations // 4)
        )
        energy += found.energy
    return replace(found, energy=energy)
