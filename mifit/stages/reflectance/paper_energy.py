"""The paper's objective of stage 2 as it stands, and its minimum.

    E(l, C_d, C_s) = E_O + lambda_S E_S + lambda_H E_H

E_O are squared residuals of all measured pixels, E_S those of what differs between the views of a time, E_H the L1
norm of the Laplacians of the diffuse offset and of the specular map. No weight is robust and there is no other prior.
Lighting for the maps and maps for the lighting take turns, each the minimum of the whole objective.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.config import ReflectanceConfig
from mifit.core.sh import LUMINANCE
from mifit.optim import Outcome
from mifit.progress import Progress
from mifit.sampling.observations import Observations, Surface
from mifit.stages.reflectance.als import Fitted, lighting_of_subset, solve_texels
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution
from mifit.stages.reflectance.maps import laplacian

LENGTHS = (3.0, 1.0, 0.3, 0.1)
"""Step lengths of the lighting that are tried: alternation creeps, so the longer step is right more often than not."""
SETTLED = 1e-3
"""Part of the objective by which the last round may still lower it."""


def fit_paper(
    surface: Surface, forward: Forward, albedo: NDArray, config: ReflectanceConfig, seed: int, progress: Progress
) -> Fitted:
    """Minimise the objective over lighting and maps; parameters as in `als.fit_als`.

    Under a model that turns with the lighting a step can be too long: it is shortened until it lowers the objective.
    """
    found, prior = lighting_of_subset(surface, forward, albedo, config, seed)
    solved = solve_texels(surface, forward, found, prior, config, progress)
    terms = energies(surface, forward, found.light, found.ambient, solved.maps, albedo, config)
    history = {name: [value] for name, value in terms.items()}
    outcome = Outcome.MAX_ITERATIONS
    for _ in range(config.max_iterations):
        light, ambient = exact_lighting(surface, forward, found, solved.maps, config)
        before = sum(terms.values())
        for length in LENGTHS:
            trial = replace(
                found,
                light=found.light + length * (light - found.light),
                ambient=max(found.ambient + length * (ambient - found.ambient), 0.0),
            )
            trial_maps = solve_texels(surface, forward, trial, prior, config, progress, start=solved.maps)
            terms = energies(surface, forward, trial.light, trial.ambient, trial_maps.maps, albedo, config)
            if sum(terms.values()) < before:
                break
        else:  # no step lowers the objective, however short
            outcome = Outcome.STALLED
            break
        found, solved = trial, trial_maps
        for name, value in terms.items():
            history[name].append(value)
        if before - sum(terms.values()) < SETTLED * before:
            outcome = Outcome.CONVERGED
            break
    return Fitted(forward.under(found.light, found.ambient), solved, history, outcome)


def energies(
    surface: Surface,
    forward: Forward,
    light: NDArray,
    ambient: float,
    maps: NDArray,
    albedo: NDArray,
    config: ReflectanceConfig,
) -> dict[str, float]:
    """Data, specular difference and smoothness terms (paper, section 5), weighted by the lambdas of ``config``.

    Every measured pixel has the weight of its area, clipped ones have none. ``light`` (K, 3) are the lighting unknowns,
    ``maps`` (S, S, 4) diffuse and specular albedo; the offset is counted from the model's ``albedo`` (N, 3).
    """
    values = maps.reshape(-1, 4)[surface.texels.index]
    data = difference = 0.0
    for chunk in surface.chunks():
        seen = surface.observe(chunk)
        diffuse_light, specular_light = forward.shade(seen, light)
        weight = seen.measured[..., None]
        x, y = values[chunk, None, :3], values[chunk, 3, None, None]
        residual = seen.colour - form_image(np.float32(ambient), x, diffuse_light, y, specular_light)
        data += float((weight * residual**2).sum())
        for a, b in surface.pairs:
            both = np.minimum(weight[:, a], weight[:, b])
            reflected = y[:, 0] * (specular_light[:, a] - specular_light[:, b])
            difference += float((both * (seen.colour[:, a] - seen.colour[:, b] - reflected) ** 2).sum())
    offset = maps.copy()
    offset[..., :3] -= surface.texels.to_map(albedo.astype(maps.dtype))
    rough = np.abs(laplacian(offset))[surface.texels.mask].sum(0)
    return {
        "data": data,
        "difference": config.specular_difference_weight * difference,
        "smoothness": float(config.smoothness_weight * (rough[:3].sum() + config.specular_smoothness * rough[3])),
    }


def exact_lighting(
    surface: Surface, forward: Forward, found: LightingSolution, maps: NDArray, config: ReflectanceConfig
) -> tuple[NDArray[np.float64], float]:
    """Lighting, and for models that have it ambient, that minimise data and difference terms for the maps given.

    Where the model turns with the lighting this is a Gauss-Newton step, whose length is to be tried.
    """
    k, turns = forward.unknowns, forward.model.turns
    system, right = np.zeros((3 * k + 1, 3 * k + 1)), np.zeros(3 * k + 1)
    values = maps.reshape(-1, 4)[surface.texels.index]
    for chunk in surface.chunks((32 if turns else 8) * k):
        seen, y = surface.observe(chunk), values[chunk, 3][:, None, None]
        diffuse, specular = map(seen.spread, forward.transfers(seen, found.light))
        slopes = [y * slope for slope in _turning(forward, seen, found.light)] if turns else []
        for c in range(3):
            own = np.arange(c * k, (c + 1) * k)
            glossy = np.zeros((*diffuse.shape[:2], 3 * k + 1), np.float32)
            glossy[..., own] = y * specular
            for band, slope in enumerate(slopes):
                glossy[..., [band + 1, k + band + 1, 2 * k + band + 1]] += slope[..., c, None] * np.float32(LUMINANCE)
            rows = glossy.copy()
            rows[..., own] += values[chunk, c][:, None, None] * diffuse
            rows[..., -1] = float(forward.model.has_ambient)
            at = np.arange(3 * k + 1) if turns else np.append(own, 3 * k)
            given = rows[..., at], glossy[..., at], config.specular_difference_weight
            square, side = lighting_equations(seen, surface.pairs, c, *given)
            system[np.ix_(at, at)] += square
            right[at] += side
    system += 1e-9 * float(np.trace(system)) / len(system) * np.eye(len(system))
    solution = np.linalg.solve(system, right)
    if solution[-1] < 0.0:
        solution = np.append(np.linalg.solve(system[:-1, :-1], right[:-1]), 0.0)
    return np.asarray(solution[:-1].reshape(3, k).T), float(solution[-1])


def _turning(forward: Forward, seen: Observations, light: NDArray) -> list[NDArray[np.float32]]:
    """Derivatives (N, J, 3) of the specular radiance by the luminance of each linear coefficient, by differences.

    They are those of the highlight's direction, which is the same for the lighting at any scale: so the right-hand side
    of the normal equations stays as it is.
    """
    reach, found = 1e-2 * float(np.linalg.norm(light[1:4] @ LUMINANCE)), []
    for band in range(3):
        change = np.zeros_like(light)
        change[band + 1] = reach
        ahead, behind = (forward.transfers(seen, light + sign * change)[1] for sign in (1.0, -1.0))
        found.append(seen.spread((ahead - behind) @ light.astype(np.float32)) * np.float32(0.5 / reach))
    return found


def lighting_equations(
    seen: Observations, pairs: NDArray, channel: int, rows: NDArray, glossy: NDArray, difference: float
) -> tuple[NDArray, NDArray]:
    """Normal equations of one channel's data and difference terms.

    ``rows`` (N, J, K) are the derivatives of the image, ``glossy`` those of its specular part.
    """
    colour, weight = seen.colour[..., channel], seen.measured
    flat = rows.reshape(-1, rows.shape[-1])
    weighted = flat * weight.reshape(-1, 1)
    system, right = weighted.T @ flat, weighted.T @ colour.ravel()
    for a, b in pairs:
        step = glossy[:, a] - glossy[:, b]
        both = (difference * np.minimum(weight[:, a], weight[:, b]))[:, None] * step
        system, right = system + both.T @ step, right + both.T @ (colour[:, a] - colour[:, b])
    return system, right
