"""The solver of stage 2: lighting by Gauss-Newton on a subset of the texels, then the maps of all texels by ADMM."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.core.metrics import median_deviation
from mifit.core.process import blocks, on_all_cores
from mifit.core.uv import TexelMap
from mifit.optim import Outcome
from mifit.progress import Progress
from mifit.sampling.observations import Surface
from mifit.stages.reflectance.albedo_priors import specular_pull
from mifit.stages.reflectance.compact_lights import ITERATIONS, OBSERVATIONS, find_lights
from mifit.stages.reflectance.fill import ALIKE
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution, active_weight, fit_lighting, noise_weight
from mifit.stages.reflectance.maps import WEAK, TexelSystems, solve_maps

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel

EXPONENT = 80.0
"""Exponent of the lobe where none is given: a Beckmann roughness of 0.15. Chosen on gloss; narrower lobes gain less
than 0.1 dB there, and nothing on scan_city and the first head of Table 1."""
WIDE = 0.5 * EXPONENT
"""Exponent while compact lights are looked for: the directions that are tried lie about 10 degrees apart."""
LIGHTING_TEXELS = 6000
"""Texels that determine the lighting; a few hundred unknowns against 24 values of eight images each."""
MAP_PASSES = 3
"""Passes over the maps: each takes new robust weights from the residuals of the last."""
MAP_ITERATIONS = 40
"""ADMM iterations of a pass; the first, there for the weights alone, takes half of them. Every pass starts from its
maps: going on from the multipliers of the pass before saves half, but carries over what the last weights took an
outlier for."""


@dataclass(frozen=True)
class SolvedMaps:
    """Maps for a lighting.

    Attributes
    ----------
    maps : (S, S, 4) float32
        Diffuse and specular albedo.
    energy : list of float
        Robust data energy at the start of each pass but the first.
    sigma : float
        Robust standard deviation of the residuals in linear colour.
    outcome : Outcome
        Of the last pass.
    observability : (N,) float32
        Share of the images in the specular albedo (`specular_observability`).
    """

    maps: NDArray[np.float32]
    energy: list[float]
    sigma: float
    outcome: Outcome
    observability: NDArray[np.float32]


@dataclass(frozen=True)
class Fitted:
    """Reflectance and lighting.

    Attributes
    ----------
    appearance : Appearance
        Model, illumination and lobe.
    solved : SolvedMaps
    energies : dict of str to list of float
    outcome : Outcome
        Of the lighting, or of the whole objective where that is minimised.
    """

    appearance: Appearance
    solved: SolvedMaps
    energies: dict[str, list[float]]
    outcome: Outcome


def expected_albedo(model: MorphableModel, texels: TexelMap, geometry: GeometryEstimate) -> NDArray[np.float32]:
    """(N, 3) diffuse albedo that the fitted model expects of texels."""
    albedo = interpolate(geometry.vertex_albedo, model.faces, texels.face, texels.weights)
    return np.clip(np.nan_to_num(albedo, nan=0.3), 0.01, 1.0).astype(np.float32)


# The model and its lighting ------------------------------------------------------------------------------------------


def find_forward(
    surface: Surface, albedo: NDArray, config: ReflectanceConfig, seed: int
) -> tuple[Forward, LightingSolution | None]:
    """The model that is fitted, its compact lights and its lobe, and a first lighting of some of the texels.

    Lights are those of the geometry where it has any. The lighting is None where weights aren't robust: nothing is
    found out then before the fit itself.
    """
    model = models.get("shadowed" if config.shading == "auto" else config.shading)
    given, robust, found = config.exponent or model.exponent, config.robust, None
    lobe = Lobe(given or WIDE, model.fresnel, model.normalized)
    forward = Forward.of(model, model.bands or config.bands, lobe, surface.meshes)
    forward = replace(forward, gloss=config.specular_albedo if config.specular else 0.0)
    if robust:
        some = surface.sample(max(1, OBSERVATIONS // surface.image_count), np.random.default_rng(seed))
        seen, expected = surface.observe(some), albedo[some]
        lights = surface.geometry.lights if model.needs_shadows else ()
        if lights is None:
            lights, found = find_lights(seen, forward, expected)
            forward = forward.with_lights(lights)
        else:
            forward = forward.with_lights(lights)
            found = fit_lighting(seen, forward, expected, robust, ITERATIONS)
    return forward.with_lobe(replace(lobe, exponent=given or EXPONENT)), found


def fit_als(
    surface: Surface,
    forward: Forward,
    albedo: NDArray,
    config: ReflectanceConfig,
    seed: int,
    progress: Progress,
    noise: float,
) -> Fitted:
    """Find the lighting on a subset of the texels, which ``seed`` chooses, then all maps.

    ``forward`` has the model, compact lights and lobe; ``albedo`` (N, 3) is the fitted model's diffuse one, ``noise``
    the robust standard deviation of the first lighting's residuals, linear colour.
    """
    found, prior = lighting_of_subset(surface, forward, albedo, config, seed, noise)
    solved = solve_texels(surface, forward, found, prior, config, progress)
    energy = {"lighting": found.energy, "data": solved.energy}
    return Fitted(forward.under(found.light, found.ambient), solved, energy, found.outcome)


def lighting_of_subset(
    surface: Surface,
    forward: Forward,
    albedo: NDArray,
    config: ReflectanceConfig,
    seed: int,
    noise: float | None = None,
) -> tuple[LightingSolution, NDArray[np.float32]]:
    """The lighting, and the maps (S, S, 4) that are expected of all texels."""
    subset = surface.sample(LIGHTING_TEXELS, np.random.default_rng(seed))
    given = forward, albedo[subset], config.robust, config.max_iterations, noise
    found = fit_lighting(surface.observe(subset), *given)
    prior = np.full((surface.texels.size, surface.texels.size, 4), found.expected, np.float32)
    prior[..., :3] = surface.texels.to_map(np.asarray(albedo, np.float32))
    return found, prior


# Maps ----------------------------------------------------------------------------------------------------------------


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

    def residual(self, albedo: NDArray) -> NDArray[np.float32]:
        """(n, J, 3) what images show beyond albedos (n, 4)."""
        found = np.empty_like(self.colour)

        def fill(part: slice) -> None:
            x, y = albedo[part, None, :3], albedo[part, 3, None, None]
            found[part] = self.colour[part] - form_image(0.0, x, self.diffuse[part], y, self.specular[part])

        on_all_cores(fill, blocks(len(self.rows), 32 * self.colour.shape[1]))
        return found

    def systems(self, weight: NDArray, pairs: NDArray, difference: float) -> TexelSystems:
        """Blocks of all N texels, zero where nothing is seen, under weights (n, J, 3)."""
        joined = TexelSystems.accumulate(self.colour, weight, self.diffuse, self.specular, pairs, difference)
        return TexelSystems(*(self.spread(getattr(joined, f.name)) for f in fields(joined)))

    def spread(self, values: NDArray) -> NDArray:
        """Values (n, ...) among zeros (N, ...)."""
        out = np.zeros((self.count, *values.shape[1:]), values.dtype)
        out[self.rows] = values
        return out


def solve_texels(
    surface: Surface,
    forward: Forward,
    found: LightingSolution,
    prior: NDArray,
    config: ReflectanceConfig,
    progress: Progress,
    start: NDArray | None = None,
) -> SolvedMaps:
    """Maps for a lighting, expected to be ``prior`` (S, S, 4); without robust weights in one pass."""
    chunks, index = surface.chunks(), surface.texels.index
    smoothness = config.smoothness_weight, config.smoothness_weight * config.specular_smoothness
    passes, expected = MAP_PASSES if config.robust else 1, float(prior[0, 0, 3])
    maps, energy, sigma, outcome = start, [], found.sigma, Outcome.MAX_ITERATIONS
    observability = np.ones(len(index), np.float32)
    kept: _Shaded | None = None
    for number in range(passes):
        weighted = config.robust and number > 0
        systems, sizes, data, sigmas = [], [], 0.0, []
        for done, chunk in enumerate(chunks):
            progress("Reflectance maps", number * len(chunks) + done, passes * len(chunks))
            shaded = kept or _Shaded.of(surface, chunk, forward, found, config.robust)
            if len(chunks) == 1:
                kept = shaded
            weight = np.where(shaded.clipped[..., None], np.float32(0.0), shaded.weight)
            if weighted and maps is not None:
                residual = shaded.residual(maps.reshape(-1, 4)[index[shaded.texel]])
                if number == passes - 1:
                    sizes.append(residual_sizes(shaded, weight, residual))
                weight, deviation = active_weight(shaded.weight, shaded.clipped, residual)
                data += float((weight * residual**2).sum())
                sigmas.append(deviation)
            systems.append(shaded.systems(weight, surface.pairs, config.specular_difference_weight))
        joined = TexelSystems.join(systems)
        if weighted:
            energy.append(data)
            sigma = float(np.median(sigmas))
        if sizes:
            usual, each = float(np.median([usual for usual, _ in sizes])), np.concatenate([each for _, each in sizes])
            observability = specular_observability(surface.texels, joined, each, usual, expected)
        pull = specular_pull(expected, sigma) if config.robust else 0.0
        iterations = -(-MAP_ITERATIONS // 2) if number == 0 < passes - 1 else MAP_ITERATIONS
        maps, outcome = solve_maps(joined, index, prior, smoothness, maps, (pull, WEAK), iterations=iterations)
    progress("Reflectance maps", passes * len(chunks), passes * len(chunks))
    assert maps is not None
    return SolvedMaps(maps, energy, sigma, outcome, observability)


# How far images determine the specular albedo ------------------------------------------------------------------------


def residual_sizes(shaded: _Shaded, weight: NDArray, residual: NDArray) -> tuple[float, NDArray[np.float32]]:
    """Robust deviation of residuals as if their weight were 1, and per texel (N, 2) the sum of deviations and a count.

    Those of more weight are the smaller for it. Beside a sum of weighted squares these say how much a prior of known
    spread is worth; the plain residuals don't: where most of a head lies in the dark, theirs are those of the dark.
    """
    measured = weight > 0
    size = np.abs(residual) * np.sqrt(weight)
    some = size[measured]
    usual = median_deviation(some[:: max(1, len(some) // 200_000)])
    sums = np.sqrt(np.pi / 2) * np.where(measured, size, 0.0).sum((1, 2))
    return usual, shaded.spread(np.stack([sums, measured.sum((1, 2))], axis=1).astype(np.float32))


def specular_observability(
    texels: TexelMap, systems: TexelSystems, sizes: NDArray, usual: float, expected: float
) -> NDArray[np.float32]:
    """(N,) posterior weight of each texel's own images in its specular albedo, against what is expected of it.

    0 where they show nothing of it beside the diffuse one, 1 where they show all. The normal equations say how sharply
    the residuals ask for a specular albedo once the diffuse ones follow it; that is worth something beside residuals of
    a known size. In deep shade and at borders of what is modelled these come from the model instead of from noise, and
    neighbours share them; so their size is that of the surroundings, and no smaller than the usual one.

    ``sizes`` (N, 2) are the sum of the deviations of each texel's residuals at weight 1, and their number, ``usual`` is
    the deviation of all; ``expected`` is the specular albedo beforehand.
    """
    side = 2 * max(1, round(0.5 * ALIKE * texels.size)) + 1
    image, border = texels.to_map(sizes), cv2.BORDER_CONSTANT
    around = cv2.boxFilter(image, cv2.CV_32F, (side, side), normalize=False, borderType=border)
    total, count = texels.from_map(around).T
    size = np.maximum(total / np.maximum(count, 1e-12), usual)
    information = systems.specular_information
    share = information / np.maximum(information + specular_pull(expected, 1.0) * size**2, 1e-20)
    return share.astype(np.float32)
