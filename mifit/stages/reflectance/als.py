"""The fast solver: lighting by Gauss-Newton on a subset of the texels, then the maps of all texels by ADMM."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.config import ReflectanceConfig
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import (
    LightingProblem,
    LightingSolution,
    active_weight,
    solve_lighting,
)
from mifit.stages.reflectance.maps import Smoothness, TexelSystems, solve_maps

LIGHTING_TEXELS = 6000
"""Texels that determine the lighting; a few hundred unknowns against 24 values of eight images each."""
CHUNK_VALUES = 1 << 22
"""Texels x images that are held at a time."""
MAP_PASSES = 3
"""Passes over the maps: each takes new robust weights from the residuals of the last."""
NOISE_FLOOR = 0.03
"""Read noise over shot noise, as variance in units of linear colour; 8-bit sRGB is coded about so as well."""


@dataclass(frozen=True)
class Fitted:
    """Maps and lighting as a solver leaves them.

    Attributes
    ----------
    forward : Forward
    radiance : (K, 3) float64
    ambient : float
    maps : (S, S, 4) float32
        Diffuse and specular albedo.
    sigma : float
        Robust standard deviation of the residuals in linear colour.
    energies : dict of str to list of float
    converged : bool
    """

    forward: Forward
    radiance: NDArray[np.float64]
    ambient: float
    maps: NDArray[np.float32]
    sigma: float
    energies: dict[str, list[float]]
    converged: bool


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
    seen: Observations, forward: Forward, albedo: NDArray, config: ReflectanceConfig, iterations: int
) -> LightingSolution:
    """Lighting and the subset's albedos; the paper's dominant direction is found anew as the lighting changes."""
    radiance = np.zeros((forward.order**2, 3))
    if forward.model != "paper":
        problem = lighting_problem(seen, forward, radiance, albedo, config.robust)
        return solve_lighting(problem, robust=config.robust, iterations=iterations)
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


def fit_maps(
    surface: Surface,
    forward: Forward,
    found: LightingSolution,
    prior: NDArray,
    config: ReflectanceConfig,
    progress: Progress,
) -> tuple[NDArray[np.float32], dict[str, list[float]], float]:
    """Maps for a lighting: (S, S, 4), energies per pass, robust standard deviation of the residuals."""
    count = len(surface)
    step = max(1024, CHUNK_VALUES // surface.image_count)
    chunks = [np.arange(i, min(i + step, count)) for i in range(0, count, step)]
    pairs = surface.pairs
    index = surface.texels.index
    smoothness = Smoothness(config.smoothness_weight, config.smoothness_weight * config.specular_smoothness)
    maps: NDArray[np.float32] | None = None
    energies: dict[str, list[float]] = {"data": []}
    passes = MAP_PASSES if config.robust else 2
    kept: tuple[Observations, NDArray, NDArray] | None = None
    sigma = 0.0
    for number in range(passes):
        systems, data, sigmas = [], 0.0, []
        for done, chunk in enumerate(chunks):
            progress("Reflectance maps", number * len(chunks) + done, passes * len(chunks))
            if kept is None:
                seen = surface.observe(chunk)
                shade, glint = forward.shade(seen, found.radiance)
            else:
                seen, shade, glint = kept
            if len(chunks) == 1:
                kept = seen, shade, glint
            weight = seen.weight[..., None] * noise_weight(seen.colour, config.robust)
            target = seen.colour - np.float32(found.ambient)
            if maps is None:
                weight = np.where(seen.clipped[..., None], np.float32(0.0), weight)
            else:
                texel = maps.reshape(-1, 4)[index[chunk]]
                residual = target - texel[:, None, :3] * shade - texel[:, 3, None, None] * glint
                weight, spread = active_weight(weight, seen.clipped, residual, config.robust)
                data += float((weight * residual**2).sum())
                sigmas.append(spread)
            systems.append(
                TexelSystems.accumulate(target, weight, shade, glint, pairs, config.specular_difference_weight)
            )
        if maps is not None:
            energies["data"].append(data)
            sigma = float(np.median(sigmas))
        maps = solve_maps(TexelSystems.join(systems), index, prior, smoothness, maps)
    progress("Reflectance maps", passes * len(chunks), passes * len(chunks))
    assert maps is not None
    return maps, energies, sigma


EXPONENTS = (40.0, 80.0, 160.0, 320.0)
"""Exponents that are tried where none is given."""
EXPLAINED = 0.03
"""A costlier shading model is taken where it lowers the residual by more than this part."""


def fit_als(
    surface: Surface,
    faces: NDArray,
    albedo: NDArray,
    config: ReflectanceConfig,
    seed: int,
    progress: Progress,
) -> tuple[Fitted, dict, tuple[str, ...]]:
    """Choose the shading model, find the lighting on a subset of the texels, then all maps.

    Returns
    -------
    Fitted, and the choice of the shading model with its reasons, and warnings.
    """
    subset = surface.sample(LIGHTING_TEXELS, np.random.default_rng(seed))
    seen = surface.observe(subset)
    names = ["paper", "prefiltered"] if config.shading == "auto" else [config.shading]
    tried: dict[str, tuple[Forward, LightingSolution]] = {}
    for done, name in enumerate(names):
        progress("Reflectance lighting", done, len(names))
        tried[name] = _fit_model(name, surface, faces, seen, albedo[subset], config)
    progress("Reflectance lighting", len(names), len(names))
    chosen = names[0]
    for name in names[1:]:
        if tried[name][1].sigma < (1.0 - EXPLAINED) * tried[chosen][1].sigma:
            chosen = name
    forward, found = tried[chosen]
    choice = {
        "chosen": chosen,
        "why": "as configured"
        if config.shading != "auto"
        else f"cheapest whose residual no costlier model lowers by more than {EXPLAINED:.0%}",
        "residuals": {name: float(f.sigma) for name, (_, f) in tried.items()},
        "exponent": forward.exponent,
    }
    prior = np.zeros((surface.texels.size**2, 4), dtype=np.float32)
    prior[surface.texels.index, :3] = albedo
    prior[:, 3] = np.median(found.specular)
    prior = prior.reshape(surface.texels.size, surface.texels.size, 4)
    maps, energies, sigma = fit_maps(surface, forward, found, prior, config, progress)
    energies = {"lighting": found.energy}
    return Fitted(forward, found.radiance, found.ambient, maps, sigma, energies, found.converged), choice, ()


def _fit_model(
    name: str, surface: Surface, faces: NDArray, seen: Observations, albedo: NDArray, config: ReflectanceConfig
) -> tuple[Forward, LightingSolution]:
    """Lighting of one shading model on the subset, with the exponent that explains it best."""
    if name == "paper":
        forward = Forward(name, 3, config.exponent or 5.0)
        return forward, fit_lighting(seen, forward, albedo, config, config.max_iterations)
    traced: tuple[NDArray[np.float32], ...] = ()
    if name == "shadowed":
        traced = surface.trace(config.bands)
    exponents = EXPONENTS if config.exponent is None else (config.exponent,)
    best: tuple[float, Forward] | None = None
    few = slice(0, None, 4) if len(exponents) > 1 else slice(None)
    for exponent in exponents:
        forward = Forward(name, config.bands, exponent, traced, faces)
        if len(exponents) == 1:
            return forward, fit_lighting(seen, forward, albedo, config, config.max_iterations)
        trial = fit_lighting(seen.take(few), forward, albedo[few], config, 6)
        if best is None or trial.energy[-1] < best[0]:
            best = trial.energy[-1], forward
    assert best is not None
    return best[1], fit_lighting(seen, best[1], albedo, config, config.max_iterations)
