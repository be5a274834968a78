"""The fast solver: lighting by Gauss-Newton on a subset of the texels, then the maps of all texels by ADMM."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.process import on_all_cores
from mifit.core.sh import LUMINANCE
from mifit.optim import Outcome
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.compact_lights import EXPONENT, OBSERVATIONS, best_exponent, find_lights
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution, active_weight, fit_lighting, noise_weight
from mifit.stages.reflectance.lighting_equations import specular_pull
from mifit.stages.reflectance.maps import Smoothness, Splits, TexelSystems, solve_maps
from mifit.stages.reflectance.objective import energies
from mifit.stages.reflectance.told import deviations, find_told, robust_deviation, whitened

LIGHTING_TEXELS = 6000
"""Texels that determine the lighting; a few hundred unknowns against 24 values of eight images each."""
MAP_PASSES = 3
"""Passes over the maps: each takes new robust weights from the residuals of the last."""
MAP_ITERATIONS = 40
"""ADMM iterations of a pass. Every pass starts from its maps alone: going on from the multipliers of the pass before
saves half of them, but carries over what the last weights took an outlier for (a hand before one camera left 0.016
instead of less than 0.01 in the albedo under it)."""
SUMMED = 1 << 13
"""Texels whose observations are summed at a time."""
PAPER_EXPONENT = 5.0
"""Exponent of Adam where none is given, as in the paper, whatever the model."""
FIRST_ITERATIONS = 12
"""Gauss-Newton iterations of the lighting by which objects in front of the face are found."""
START_ITERATIONS = 5
"""Gauss-Newton iterations where they are only a start: the objective over all texels is minimised afterwards."""
ROUNDS = 20
"""Rounds of `alternate` at the most."""


@dataclass(frozen=True)
class Fitted:
    """Maps and lighting as a solver leaves them.

    Attributes
    ----------
    appearance : Appearance
        Model, illumination and lobe.
    maps : (S, S, 4) float32
        Diffuse and specular albedo.
    sigma : float
        Robust standard deviation of the residuals in linear colour.
    energies : dict of str to list of float
    outcome : Outcome
        Of the lighting, or of the whole objective where that is minimised.
    maps_outcome : Outcome
        Of the last solve for the maps.
    told : (N,) float32
        Share of the images in the specular albedo (`told.find_told`).
    """

    appearance: Appearance
    maps: NDArray[np.float32]
    sigma: float
    energies: dict[str, list[float]]
    outcome: Outcome
    maps_outcome: Outcome
    told: NDArray[np.float32]


@dataclass(frozen=True)
class SolvedMaps:
    """Maps for a lighting.

    Attributes
    ----------
    maps : (S, S, 4) float32
        Diffuse and specular albedo.
    energy : dict of str to list of float
        Per pass.
    sigma : float
        Robust standard deviation of the residuals in linear colour.
    outcome : Outcome
    told : (N,) float32
        Share of the images in the specular albedo (`told.find_told`).
    """

    maps: NDArray[np.float32]
    energy: dict[str, list[float]]
    sigma: float
    outcome: Outcome
    told: NDArray[np.float32]


@dataclass(frozen=True)
class _Shaded:
    """Those of some texels that images show, n of N: what these see there, and what is reflected at unit albedo.

    Attributes
    ----------
    texel : (n,) int
        Positions in the `TexelMap`.
    rows : (n,) int
        Places among the N.
    count : int
        N.
    colour, weight, diffuse, specular : (n, J, 3) float32
        Without ambient; weights before any residual is looked at.
    clipped : (n, J) bool
    """

    texel: NDArray[np.int64]
    rows: NDArray[np.intp]
    count: int
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    clipped: NDArray[np.bool_]

    @classmethod
    def of(
        cls, surface: Surface, texels: NDArray[np.int64], forward: Forward, found: LightingSolution, robust: bool
    ) -> _Shaded:
        """Read and shade texels; half of a head's may be turned away from all images."""
        seen = surface.observe(texels)
        rows = np.flatnonzero((seen.weight > 0).any(axis=1))
        seen = seen.take(rows)
        diffuse, specular = forward.shade(seen, found.light)
        weight = seen.weight[..., None] * noise_weight(seen.colour, robust)
        colour = seen.colour - np.float32(found.ambient)
        return cls(seen.texel, rows, len(texels), colour, weight, diffuse, specular, seen.clipped)

    @property
    def _parts(self) -> list[slice]:
        return [slice(at, at + SUMMED) for at in range(0, len(self.rows), SUMMED)]

    def residual(self, albedo: NDArray) -> NDArray[np.float32]:
        """(n, J, 3) what images show beyond albedos (n, 4)."""
        found = np.empty_like(self.colour)

        def fill(part: slice) -> None:
            x, y = albedo[part, None, :3], albedo[part, 3, None, None]
            found[part] = self.colour[part] - form_image(0.0, x, self.diffuse[part], y, self.specular[part])

        on_all_cores(fill, self._parts)
        return found

    def systems(self, weight: NDArray, pairs: NDArray, difference: float) -> TexelSystems:
        """Blocks of all N texels, zero where nothing is seen, under weights (n, J, 3)."""

        def accumulate(part: slice) -> TexelSystems:
            diffuse, specular = self.diffuse[part], self.specular[part]
            return TexelSystems.accumulate(self.colour[part], weight[part], diffuse, specular, pairs, difference)

        parts = on_all_cores(accumulate, self._parts or [slice(0, 0)])
        joined = TexelSystems.join(parts)
        return TexelSystems(*(self.spread(getattr(joined, f.name)) for f in fields(joined)))

    def spread(self, values: NDArray) -> NDArray:
        """Values (n, ...) among zeros (N, ...)."""
        out = np.zeros((self.count, *values.shape[1:]), values.dtype)
        out[self.rows] = values
        return out


def fit_maps(
    surface: Surface,
    forward: Forward,
    found: LightingSolution,
    prior: NDArray,
    config: ReflectanceConfig,
    progress: Progress,
    start: NDArray | None = None,
) -> SolvedMaps:
    """Maps for a lighting."""
    chunks = surface.chunks()
    pairs = surface.pairs
    index = surface.texels.index
    smoothness = Smoothness(config.smoothness_weight, config.smoothness_weight * config.specular_smoothness)
    maps: NDArray[np.float32] | None = start
    energy: dict[str, list[float]] = {"data": []}
    passes, expected = MAP_PASSES if config.robust else 1, float(prior[0, 0, 3])
    kept: _Shaded | None = None
    sigma = found.sigma
    for number in range(passes):
        systems, data, sigmas, units, errors = [], 0.0, [], [], []
        for done, chunk in enumerate(chunks):
            progress("Reflectance maps", number * len(chunks) + done, passes * len(chunks))
            shaded = kept or _Shaded.of(surface, chunk, forward, found, config.robust)
            if len(chunks) == 1:
                kept = shaded
            if maps is None or not config.robust:
                weight = np.where(shaded.clipped[..., None], np.float32(0.0), shaded.weight)
            else:
                residual = shaded.residual(maps.reshape(-1, 4)[index[shaded.texel]])
                sizes = whitened(shaded.weight, shaded.clipped, residual)
                units.append(robust_deviation(sizes))
                errors.append([shaded.spread(values) for values in deviations(sizes)])
                weight, deviation = active_weight(shaded.weight, shaded.clipped, residual, config.robust)
                data += float((weight * residual**2).sum())
                sigmas.append(deviation)
            systems.append(shaded.systems(weight, pairs, config.specular_difference_weight))
        if sigmas:
            energy["data"].append(data)
            sigma = float(np.median(sigmas))
        unit = float(np.median(units)) if units else 0.0
        pull = specular_pull(expected, sigma) if config.robust else 0.0
        splits = Splits()
        joined = TexelSystems.join(systems)
        maps = solve_maps(
            joined, index, prior, smoothness, maps, specular_pull=pull, iterations=MAP_ITERATIONS, splits=splits
        )
    progress("Reflectance maps", passes * len(chunks), passes * len(chunks))
    assert maps is not None
    told = np.ones(len(index), np.float32)
    if errors and config.robust:
        size, count = (np.concatenate(part) for part in zip(*errors, strict=True))
        told = find_told(surface.texels, joined, size, count, expected, unit)
    return SolvedMaps(maps, energy, sigma, splits.outcome, told)


def find_forward(
    surface: Surface, albedo: NDArray, config: ReflectanceConfig, seed: int
) -> tuple[Forward, LightingSolution | None]:
    """The model that is fitted, its compact lights and its lobe, and a first lighting of some of the texels.

    That lighting is None where weights aren't robust: nothing is found out then before the fit itself.
    """
    name = config.shading
    if name == "auto":
        name = "paper" if config.solver == "adam" else "shadowed"
    model = models.get(name)
    given = config.exponent or (PAPER_EXPONENT if config.solver == "adam" else model.exponent)
    forward = Forward.of(
        model, model.bands or config.bands, Lobe(given or EXPONENT, model.fresnel, model.normalized), surface.meshes
    )
    forward = replace(forward, glossy=config.specular)
    count = max(1, OBSERVATIONS // surface.image_count)
    some = surface.sample(count, np.random.default_rng(seed))
    seen, expected = surface.observe(some), albedo[some]
    if config.robust and config.solver == "als" and model.needs_shadows:
        forward = forward.with_lights(find_lights(seen, forward, expected))
    if given is None and config.specular:
        exponent = best_exponent(seen, forward, expected, config.robust)
        forward = forward.with_lobe(replace(forward.lobe, exponent=exponent))
    return forward, fit_lighting(seen, forward, expected, True, FIRST_ITERATIONS) if config.robust else None


def fit_als(
    surface: Surface,
    forward: Forward,
    albedo: NDArray,
    config: ReflectanceConfig,
    seed: int,
    progress: Progress,
) -> Fitted:
    """Find the lighting on a subset of the texels, then all maps."""
    subset = surface.sample(LIGHTING_TEXELS, np.random.default_rng(seed))
    seen, expected = surface.observe(subset), albedo[subset]
    iterations = config.max_iterations if config.robust else min(START_ITERATIONS, config.max_iterations)
    found = fit_lighting(seen, forward, expected, config.robust, iterations)
    prior = np.zeros((surface.texels.size**2, 4), dtype=np.float32)
    prior[surface.texels.index, :3] = albedo
    prior[:, 3] = found.expected
    image = prior.reshape(surface.texels.size, surface.texels.size, 4)
    solved = fit_maps(surface, forward, found, image, config, progress)
    maps, energy = solved.maps, {"lighting": found.energy}
    if not config.robust:
        found, maps, energy = alternate(surface, forward, found, maps, image, albedo, config, progress)
    return Fitted(
        forward.under(found.light, found.ambient),
        maps,
        solved.sigma,
        energy,
        found.outcome,
        solved.outcome,
        solved.told,
    )


def alternate(
    surface: Surface,
    forward: Forward,
    found: LightingSolution,
    maps: NDArray,
    prior: NDArray,
    albedo: NDArray,
    config: ReflectanceConfig,
    progress: Progress,
) -> tuple[LightingSolution, NDArray[np.float32], dict[str, list[float]]]:
    """Minimise the paper's objective as it stands: exact lighting for the maps, maps for the lighting, and again.

    Under a model that turns with the lighting a step can be too long: it is shortened
    until it lowers the objective.
    """
    terms = energies(surface, forward, found.light, found.ambient, maps, albedo, config)
    history = {name: [value] for name, value in terms.items()}
    outcome = Outcome.MAX_ITERATIONS
    for _ in range(ROUNDS):
        light, ambient = exact_lighting(surface, forward, found, maps, config)
        before = sum(terms.values())
        for length in (3.0, 1.0, 0.3, 0.1):  # alternation creeps: the longer step is right more often than not
            mixed = found.light + length * (light - found.light)
            trial = replace(found, light=mixed, ambient=found.ambient + length * (ambient - found.ambient))
            trial_maps = fit_maps(surface, forward, trial, prior, config, progress, start=maps).maps
            trial_terms = energies(surface, forward, mixed, trial.ambient, trial_maps, albedo, config)
            if sum(trial_terms.values()) < before:
                break
        else:  # no step lowers the objective, however short
            outcome = Outcome.STALLED
            break
        found, maps, terms = trial, trial_maps, trial_terms
        for name, value in terms.items():
            history[name].append(value)
        if before - sum(terms.values()) < 1e-3 * before:
            outcome = Outcome.CONVERGED
            break
    return replace(found, outcome=outcome), maps, history


def exact_lighting(
    surface: Surface, forward: Forward, found: LightingSolution, maps: NDArray, config: ReflectanceConfig
) -> tuple[NDArray[np.float64], float]:
    """Lighting, and for models that have it ambient, that minimise data and difference terms for the maps given.

    Where the model turns with the lighting this is a Gauss-Newton step, whose length is to be tried.
    """
    if forward.model.turns:
        return _turning_step(surface, forward, found, maps, config)
    k = forward.unknowns
    system, right = np.zeros((3, k, k)), np.zeros((3, k))
    values = maps.reshape(-1, 4)[surface.texels.index]
    for chunk in surface.chunks(8 * k):
        seen = surface.observe(chunk)
        diffuse, specular = forward.transfers(seen, found.light)
        specular_light = values[chunk, 3][:, None, None] * specular
        for c in range(3):
            rows = values[chunk, c][:, None, None] * diffuse + specular_light
            _add(system[c], right[c], surface.pairs, seen, c, rows, specular_light, config.specular_difference_weight)
    floor = 1e-9 * np.trace(system, axis1=1, axis2=2)[:, None, None] / k
    return np.linalg.solve(system + floor * np.eye(k), right[..., None])[..., 0].T, 0.0


def _turning_step(
    surface: Surface, forward: Forward, found: LightingSolution, maps: NDArray, config: ReflectanceConfig
) -> tuple[NDArray[np.float64], float]:
    """Gauss-Newton step of lighting and ambient under the paper's model.

    The factor that makes specular of diffuse shading depends on the direction of the linear band's luminance. It is
    differentiated by differences; being the same for the lighting at any scale, it leaves the right-hand side as it is.
    """
    k = forward.unknowns
    system, right = np.zeros((3 * k + 1, 3 * k + 1)), np.zeros(3 * k + 1)
    values = maps.reshape(-1, 4)[surface.texels.index]
    light = found.light.astype(np.float32)
    reach = 1e-2 * float(np.linalg.norm(found.light[1:4] @ LUMINANCE))
    turned = [np.zeros_like(found.light) for _ in range(3)]
    for band, change in enumerate(turned):
        change[band + 1] = reach
    for chunk in surface.chunks(32 * k):
        seen = surface.observe(chunk)
        diffuse, specular = forward.transfers(seen, found.light)
        y = values[chunk, 3][:, None, None]
        turning = []
        for change in turned:
            ahead, behind = (forward.transfers(seen, found.light + s * change)[1] for s in (1.0, -1.0))
            turning.append(y * ((ahead - behind) @ light) * np.float32(0.5 / reach))
        for c in range(3):
            specular_light = np.zeros((*diffuse.shape[:2], 3 * k + 1), np.float32)
            specular_light[..., c * k : (c + 1) * k] = y * specular
            for band, slope in enumerate(turning):
                for other in range(3):
                    specular_light[..., other * k + band + 1] += np.float32(LUMINANCE[other]) * slope[..., c]
            rows = specular_light.copy()
            rows[..., c * k : (c + 1) * k] += values[chunk, c][:, None, None] * diffuse
            rows[..., -1] = 1.0
            _add(system, right, surface.pairs, seen, c, rows, specular_light, config.specular_difference_weight)
    floor = 1e-9 * float(np.trace(system)) / len(system)
    solution = np.linalg.solve(system + floor * np.eye(len(system)), right)
    if solution[-1] < 0.0:
        solution[:-1] = np.linalg.solve(system[:-1, :-1] + floor * np.eye(3 * k), right[:-1])
    return np.asarray(solution[:-1].reshape(3, k).T, dtype=np.float64), max(float(solution[-1]), 0.0)


def _add(
    system: NDArray,
    right: NDArray,
    pairs: NDArray,
    seen: Observations,
    channel: int,
    rows: NDArray,
    specular_light: NDArray,
    difference: float,
) -> None:
    """Add one channel's data and difference terms to normal equations, in place.

    ``rows`` (N, J, K) are the derivatives of the image, ``specular_light`` those of its specular part.
    """
    colour, weight = seen.colour[..., channel], seen.measured
    flat = rows.reshape(-1, rows.shape[-1])
    weighted = flat * weight.reshape(-1, 1)
    system += weighted.T @ flat
    right += weighted.T @ colour.ravel()
    for a, b in pairs:
        both = difference * np.minimum(weight[:, a], weight[:, b])
        step = specular_light[:, a] - specular_light[:, b]
        system += (step * both[:, None]).T @ step
        right += (step * both[:, None]).T @ (colour[:, a] - colour[:, b])
