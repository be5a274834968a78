"""The paper's solver: Adam on the whole objective, through the shading functions that the plugins use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.sh import radiance_of_shading
from mifit.optim import Outcome
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.adam import HISTORY, Samples, minimize_by_adam
from mifit.stages.reflectance.als import PAPER_EXPONENT, Fitted
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import fit_lighting, noise_weight

STEPS_PER_ITERATION = 10
"""Gradient steps that stand for one of ``max_iterations``: a Gauss-Newton step costs and does as much."""


def fit_adam(
    surface: Surface,
    forward: Forward,
    albedo: NDArray,
    config: ReflectanceConfig,
    seed: int,
    progress: Progress,
) -> Fitted:
    """Minimise the paper's objective by Adam; ``shading = auto`` means the paper's model.

    Without robust weights lighting and ambient start from stage 1's, as in the paper; with them from a Lambertian
    least-squares fit with the model's albedo. The specular map starts from zero.
    """
    seen = surface.observe(np.arange(len(surface)))
    radiance, ambient = np.zeros((forward.unknowns, 3)), 0.0
    if config.robust or not surface.geometry.shading.any():
        subset = surface.sample(2000, np.random.default_rng(seed))
        lambert = Forward.of(models.get("prefiltered"), 3, Lobe(PAPER_EXPONENT))
        radiance[:9] = fit_lighting(seen.take(subset), lambert, albedo[subset], config.robust, 1, specular=0.0).light
    else:
        radiance[:9] = radiance_of_shading(surface.geometry.shading)
        ambient = max(surface.geometry.ambient, 0.0) if forward.model.has_ambient else 0.0
    steps = config.max_iterations * STEPS_PER_ITERATION
    result = minimize_by_adam(
        gather_samples(surface, seen, forward, albedo, config),
        forward.under(radiance, ambient),
        config.specular_difference_weight,
        (config.smoothness_weight, config.smoothness_weight * config.specular_smoothness),
        steps,
        on_iteration=lambda done: progress("Reflectance by Adam", done, steps),
    )
    maps = np.zeros((surface.texels.size**2, 4), dtype=np.float32)
    maps[surface.texels.index, :3], maps[surface.texels.index, 3] = result.diffuse, result.specular
    total = np.sum([result.history[k] for k in HISTORY], axis=0)
    outcome = Outcome.of_history(total)
    sigma = float(np.sqrt(result.history["data"][-1] / max(3.0 * float(seen.measured.sum()), 1e-12)))
    return Fitted(
        replace(forward.appearance, illumination=result.illumination),
        maps.reshape(surface.texels.size, surface.texels.size, 4),
        sigma,
        result.history,
        outcome,
        outcome,
        np.ones(len(surface.texels.index), np.float32),
    )


def gather_samples(
    surface: Surface, seen: Observations, forward: Forward, albedo: NDArray, config: ReflectanceConfig
) -> Samples:
    """Flatten the measured observations for Dr.Jit."""
    weight = seen.measured
    texel, image = np.nonzero(weight > 0)
    row = np.full(weight.shape, -1, dtype=np.int64)
    row[texel, image] = np.arange(len(texel))
    first, second = [], []
    for a, b in surface.pairs:
        both = (row[:, a] >= 0) & (row[:, b] >= 0)
        first.append(row[both, a])
        second.append(row[both, b])
    colour = seen.colour[texel, image]
    return Samples(
        seen.normal[texel, seen.step[image]],
        seen.view[texel, image],
        colour,
        weight[texel, image][:, None] * noise_weight(colour, config.robust),
        texel,
        np.concatenate(first) if first else np.zeros(0, np.int64),
        np.concatenate(second) if second else np.zeros(0, np.int64),
        surface.texels.index,
        surface.texels.size,
        albedo,
        forward.occlusion(seen).take(texel * len(seen.step) + image).rows,
    )
