"""Stage 2: diffuse and specular albedo maps with the lighting (paper, section 5), geometry held fixed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mifit.config import ReflectanceConfig
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate, Report, hidden
from mifit.core.process import one_blas_thread
from mifit.errors import ConvergenceError
from mifit.optim import Outcome
from mifit.progress import Progress, silent
from mifit.sampling.observations import Surface
from mifit.stages.reflectance.als import expected_albedo, find_forward, fit_als
from mifit.stages.reflectance.fill import BLEND, blend_unseen, light_error, light_known, light_level
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.hair import find_hair, paint
from mifit.stages.reflectance.paper_energy import energies, fit_paper
from mifit.stages.segment import segment

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


GAUGE = (
    "mean diffuse albedo over seen texels and channels equals stage 1's, which has the level of the morphable model's "
    "mean face unless the paper's objective was fitted as written"
)


@checked
@one_blas_thread()
def infer_reflectance(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: ReflectanceConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> ReflectanceEstimate:
    """Diffuse and specular albedo maps and the lighting of a fitted face.

    All timesteps of the geometry and all named cameras enter; albedo and lighting are shared by them. Images hold
    the product of albedo and lighting alone. A convention fixes the scale between the two: the mean
    diffuse albedo over the visible texels and channels is stage 1's, which has the level of the morphable model's mean
    face. Texels that no image shows or no light reaches are filled from the mean face's albedo, in proportion to their
    surroundings, and have confidence 0. Where images show hair on the scalp, all of it gets one colour (`find_hair`).

    Parameters
    ----------
    capture : Capture
    model : MorphableModel
    geometry : GeometryEstimate
        Stage 1.
    cameras : sequence of str
        Cameras to use; no other camera of the capture is read.
    config : ReflectanceConfig, optional
    seed : int
        Chooses the texels that determine the lighting.
    progress : Progress

    Returns
    -------
    ReflectanceEstimate
        The details of its report hold the shading model, the gauge, residuals and coverage.

    Raises
    ------
    InputError
        Settings out of range, no camera, or images that show nothing of the face.
    ConvergenceError
        The solver ended without finite maps.
    """
    started = time.perf_counter()
    config = config or ReflectanceConfig()
    surface = Surface(capture, model, geometry, cameras, config.texture_size, config.robust, whole=config.robust)
    albedo = expected_albedo(model, surface.texels, geometry)
    progress("Reflectance lighting", 0, 2)
    forward, first = find_forward(surface, albedo, config, seed)
    labels: tuple = ()
    if first is not None and config.segment:
        labels = segment(surface, capture, model, forward, first.light)
        surface = surface.without([hidden(image) for image in labels])
    progress("Reflectance lighting", 1, 2)
    given = surface, forward, albedo, config, seed, progress
    fitted = fit_paper(*given) if first is None else fit_als(*given, first.sigma)
    solved = fitted.solved
    warnings: list[Diagnostic] = []
    illumination = fitted.appearance.illumination
    if not (np.isfinite(solved.maps).all() and np.isfinite(illumination.unknowns).all()):
        raise ConvergenceError("stage 2 (reflectance): the maps or the lighting are not finite; see the images' range")
    quality = surface.quality()
    filled = shown = blend_unseen(model, surface.texels, solved.maps, quality, solved.observability)
    if fitted.outcome is Outcome.MAX_ITERATIONS:
        text = "the lighting had not converged when the iterations ran out; raise max_iterations"
        warnings.append(Diagnostic("not-converged", text, "note"))
    shading = {"model": fitted.appearance.model.name, "exponent": fitted.appearance.lobe.exponent}
    details: dict = {
        "shading": {**shading, "lights": len(illumination.lights)},
        "gauge": GAUGE,
        "residual": float(solved.sigma),
        "seen": float((quality[surface.facial] > 0).mean()),
        "texels": int(surface.facial.sum()),
        "texels_of_head": len(surface),
        "images": surface.image_count,
        "maps_outcome": solved.outcome.value,
        "hidden": [float(hidden(image).sum() / max(int((image > 0).sum()), 1)) for image in labels],
    }
    if not config.robust:
        forward = Forward(fitted.appearance, surface.meshes)
        light = illumination.unknowns, illumination.ambient
        terms = energies(surface, forward, *light, solved.maps, albedo, config)
        details["objective"] = {**terms, "total": sum(terms.values())}
    residual_shading = hair = None
    if first is not None and config.residual_shading:
        # Skin under any light; what the images show beside it belongs to the capture's own.
        brightness = surface.brightness()
        level = surface.texels.from_map(light_level(surface.texels.to_map(brightness)))
        error = light_error(model, surface.texels, solved.maps, quality, level)
        lit = light_known(level, error)
        filled = blend_unseen(model, surface.texels, solved.maps, quality, solved.observability, lit)
        hair = find_hair(model, surface.texels, solved.maps, quality, brightness, error)
        if hair is not None:
            # Under the capture's own light hair stays as images show it.
            shown = paint(surface.texels, shown, hair, BLEND / (quality + BLEND))
            filled = paint(surface.texels, filled, hair)
            text = "images show hair on the scalp, which is painted in one colour"
            warnings.append(Diagnostic("hair-painted", text, "note"))
        factor = shown.diffuse / np.maximum(filled.diffuse, 1e-3)
        residual_shading = np.where(surface.texels.mask[..., None], factor, 1.0).astype(np.float32)
    return ReflectanceEstimate(
        diffuse=filled.diffuse,
        residual_shading=residual_shading,
        specular=filled.specular,
        confidence=filled.confidence,
        specular_confidence=filled.specular_confidence,
        hair=None if hair is None else tuple(hair.colour.tolist()),
        illumination=illumination,
        lobe=fitted.appearance.lobe,
        shading_model=fitted.appearance.model.name,
        report=Report(fitted.outcome.value, fitted.energies, time.perf_counter() - started, tuple(warnings), details),
        labels=labels,
        labelled=tuple((c, t) for t in geometry.timesteps for c in cameras) if labels else (),
    )
