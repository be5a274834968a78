"""Stage 2 fitted without any specular reflection: what a matt model makes of the same images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

import mifit
from mifit import Capture, MorphableModel, Reconstruction
from mifit.config import ReflectanceConfig
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate
from mifit.progress import Progress
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.choice import choose_lighting
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution
from mifit.stages.reflectance.trials import fit_lighting


def choose_diffuse_lighting(
    surface: Surface, seen: Observations, albedo: Any, config: ReflectanceConfig, progress: Progress
) -> tuple[Forward, LightingSolution, dict]:
    """The model that stage 2 chooses, and the lighting that explains the images best without its specular part."""
    forward, _, choice = choose_lighting(surface, seen, albedo, config, progress)
    diffuse = replace(forward, glossy=False)
    return diffuse, fit_lighting(seen, diffuse, albedo, config, config.max_iterations), choice


def infer_matt(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: ReflectanceConfig,
    seed: int = 0,
) -> ReflectanceEstimate:
    """Lighting and diffuse map by the fast solver, under the shading model that stage 2 chooses; no specular map."""
    with patch("mifit.stages.reflectance.als.choose_lighting", choose_diffuse_lighting):
        found = mifit.infer_reflectance(capture, model, geometry, cameras, config, seed=seed)
    return replace(found, specular=np.zeros_like(found.specular))


def as_chosen(full: Reconstruction, config: ReflectanceConfig) -> ReflectanceConfig:
    """Settings with the shading model that a full fit chose, so that it isn't chosen again."""
    chosen = full.reports["reflectance"].details["shading"]["chosen"]
    return replace(config, shading=chosen)
