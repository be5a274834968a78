"""Stage 1 once more, with the light that stage 2 found: smooth shading joins texture and landmarks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.occlusion import MeshPoints
from mifit.config import GeometryConfig, ShapeConfig
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate, Report
from mifit.errors import ConvergenceError
from mifit.progress import Progress, silent
from mifit.solve import minimize
from mifit.stages.geometry.displaced import displaced
from mifit.stages.geometry.refine import ENERGY_TOLERANCE, joint_state, texture_problem
from mifit.stages.geometry.shading import Shade, ShadedTextureProblem, ShadingTerm
from mifit.stages.geometry.start import bounds, landmark_views
from mifit.stages.geometry.visibility import Visibility, spread_points
from mifit.stages.observations import Observations, Surface

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

POINTS = 6000
"""Texels whose shading is compared."""
RELATIVE_NOISE, NOISE = 0.02, 0.004
"""Standard deviation of the shading model: part of the radiance, and linear image units."""
OUTLIER = 3.0
"""Standard deviations beyond which an observation's pull stops growing."""
ITERATIONS = 3


def refine_shape(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    cameras: Sequence[str],
    config: ShapeConfig,
    geometry_config: GeometryConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> GeometryEstimate:
    """Improve identity, expressions and poses by shading, lighting and specular albedo held.

    Parameters
    ----------
    capture, model, geometry, reflectance
        The inputs, and the results of stages 1 and 2. Diffuse albedo is found anew, point by point.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : ShapeConfig
    geometry_config : GeometryConfig, optional
        Stage 1's, whose texture, landmark and prior terms go on.
    seed : int
        Seed of the choice of points, and of the tracing of shadows.
    progress : Progress

    Returns
    -------
    GeometryEstimate
        With albedo, shading and ambient term of ``geometry``.

    Raises
    ------
    InputError
        No image shows the face.
    ConvergenceError
        The fit diverged.
    """
    began = time.perf_counter()
    progress("refine shape", 0, 1)
    geometry_config = geometry_config or GeometryConfig()
    noise = float(geometry.report.details.get("landmark_noise_pixels", geometry_config.landmark_noise))
    geometry_config = replace(geometry_config, landmark_noise=noise)
    model = displaced(model, geometry)
    state = joint_state(model, geometry)
    visibility = Visibility(capture, model, tuple(cameras), geometry.timesteps, geometry.gains)
    views = landmark_views(capture, model, tuple(cameras), geometry.timesteps, noise, fewest=0)
    points = spread_points(model, geometry_config.surface_points, seed)
    texture = texture_problem(state, views, visibility, points, geometry_config)

    surface = Surface(capture, model, geometry, cameras, len(reflectance.diffuse))
    seen = surface.observe(surface.sample(POINTS, np.random.default_rng(seed)))
    specular = surface.texels.from_map(reflectance.specular)[seen.texel]
    shade = _shade(surface, seen, reflectance, specular)
    term = ShadingTerm(
        model,
        state.layout,
        state.frames,
        seen.face,
        seen.barycentric.astype(np.float64),
        seen.step,
        seen.colour.astype(np.float64),
        np.zeros(seen.colour.shape),
        shade,
    )
    normals = list(seen.normal.transpose(1, 0, 2).astype(np.float64))
    term = replace(term, precision=_precision(term, normals, seen, config.shading_weight))
    low, high = bounds(state.layout, model.expression_bounds)
    solution = minimize(
        ShadedTextureProblem(texture, term),
        state.x,
        lower=low,
        upper=high,
        max_iterations=ITERATIONS,
        energy_tolerance=ENERGY_TOLERANCE,
    )
    if not solution.usable or not np.isfinite(solution.value).all():
        raise ConvergenceError(f"refine shape: ended as '{solution.outcome.value}'; leave it out: shape.rounds = 0")
    state, layout = replace(state, x=solution.value), state.layout
    steps = range(layout.timesteps)
    poses = [state.frames.pose(layout, state.x, k) for k in steps]
    progress("refine shape", 1, 1)
    energies = {name: [float(e) for e in values] for name, values in solution.energies.items()}
    seconds = time.perf_counter() - began
    phase = {
        "name": "shading",
        "outcome": solution.outcome.value,
        "iterations": solution.iterations,
        "seconds": seconds,
        "energies": energies,
    }
    return replace(
        geometry,
        identity=state.x[layout.at("identity")].copy(),
        expression=np.stack([state.x[layout.at("expression", k)] for k in steps]),
        rotation=np.stack([pose.rotation for pose in poses]),
        translation=np.stack([pose.translation for pose in poses]),
        vertices=visibility.world(state).astype(np.float32),
        report=Report(
            geometry.report.outcome,
            energies,
            geometry.report.seconds + seconds,
            geometry.report.warnings,
            {**geometry.report.details, "phases": [*geometry.report.details.get("phases", []), phase]},
        ),
    )


def _shade(surface: Surface, seen: Observations, reflectance: ReflectanceEstimate, specular: NDArray) -> Shade:
    """Shading of the points by stage 2's model; shadows are those of the normals at the start."""
    appearance = Appearance.of(reflectance, reflectance.lobe.at(lambda m: surface.texels.from_map(m)[seen.texel]))
    ambient = reflectance.illumination.ambient
    shadows = [
        appearance.trace(mesh, MeshPoints(seen.point[:, k], seen.normal[:, k], seen.face, seen.barycentric))
        for k, mesh in enumerate(surface.meshes)
    ]

    def shade(normals: NDArray, image: int) -> tuple[NDArray, NDArray]:
        step = seen.step[image]
        diffuse, specular_light = appearance.shade_bent(
            normals, seen.normal[:, step], seen.view[:, image], shadows[step], seen.point[:, step]
        )
        rest = form_image(ambient, 0.0, diffuse, specular[:, None], specular_light)
        return diffuse.astype(np.float64), rest.astype(np.float64)

    return shade


def _precision(term: ShadingTerm, normals: list[NDArray], seen: Observations, strength: float) -> NDArray:
    """Weights of the squared residuals: pixels over the noise's variance, less for outliers."""
    deviation = RELATIVE_NOISE * np.maximum(term.colour, 0.0) + NOISE
    plain = strength * np.maximum(seen.measured, 0.0)[..., None] / deviation**2
    residual, _, _ = replace(term, precision=plain).residual(normals)
    return plain * np.minimum(1.0, OUTLIER * deviation / np.maximum(np.abs(residual), 1e-12))
