"""Stage 3: normals per timestep that explain the images better than the model's (paper, section 6).

Units of the weights. The paper's images and normal maps are 8-bit: a colour of 1 is 255 steps, a unit normal spans
127.5 steps to either side. With linear images 0..1 and unit normals its weights become

    w1 * 127.5 / 255^2,    w2 * 127.5^2 / 255^2 = w2 / 4.

The data term sums over the pixels of the views, each shared out among the texels that it shows. Gauss-Newton with 2 x 2
blocks per texel minimises it (the paper takes Adam); the energy and its derivatives are in `problem`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import Appearance
from mifit.appearance.occlusion import MeshPoints
from mifit.config import NormalsConfig
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import normalize
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap, bend, rasterize_uv, tangent_plane, texel_neighbours
from mifit.errors import InputError
from mifit.optim import Outcome, Solution
from mifit.progress import Progress, silent
from mifit.stages.observations import Surface

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel
    from mifit.stages.normals.problem import NormalProblem

IMAGE_STEPS = 255.0
NORMAL_STEPS = 127.5
OUTLIER = 3.0
"""Robust standard deviations of the residual beyond which an observation's pull stops growing."""


@one_blas_thread()
def refine_normals(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    cameras: Sequence[str],
    config: NormalsConfig,
    seed: int = 0,
    progress: Progress = silent,
) -> NormalsEstimate:
    """Refine the normals of every timestep of a fit, with reflectance and lighting held.

    Parameters
    ----------
    capture, model, geometry, reflectance
        The inputs and results of stages 1 and 2. Shading is the model that stage 2 used.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : NormalsConfig
    seed : int
        Seed of the tracing of shadows, which only the ``shadowed`` shading model needs.
    progress : Progress

    Returns
    -------
    NormalsEstimate
        Unit normals in object space. Texels without a measurement keep the model's normal.

    Raises
    ------
    InputError
        No camera or timestep, or maps that aren't square and of one size.

    Notes
    -----
    The paper's energy: squared residuals of all views, with a linear tail for outliers, ``laplacian_weight`` times the
    L1 norm of the correction's Laplacian, ``magnitude_weight`` times its squared length.
    """
    began = time.perf_counter()
    size = check_maps(reflectance)
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    normals, energies, warnings, seconds = [], {}, [], []
    outcomes = []
    for i, timestep in enumerate(geometry.timesteps):
        progress("refine normals", i, len(geometry.timesteps))
        frame = refine_frame(capture, model, geometry.at((timestep,)), reflectance, cameras, config, texels, seed=seed)
        normals.append(texels.to_map(frame.normal_object))
        if frame.measured == 0.0:
            text = f"timestep {timestep}: no camera measures the face; normals are the model's"
            warnings.append(Diagnostic("face-unseen", text))
        outcomes.append(frame.outcome)
        seconds.append(frame.seconds)
        for name, values in frame.energies.items():
            energies[f"{name} {timestep}"] = values
    progress("refine normals", len(geometry.timesteps), len(geometry.timesteps))
    longest = max((len(v) for v in energies.values()), default=0)
    report = Report(
        Outcome.worst(outcomes).value,
        {name: values + values[-1:] * (longest - len(values)) for name, values in energies.items()},
        time.perf_counter() - began,
        tuple(warnings),
        {"seconds_per_timestep": seconds},
    )
    return NormalsEstimate(geometry.timesteps, np.stack(normals), report)


@dataclass(frozen=True)
class FrameNormals:
    """Refined normals of one timestep.

    Attributes
    ----------
    normal_object : (N, 3) float32
        Unit normals per covered texel, object space.
    base_object : (N, 3) float32
        The model's normals there.
    measured : float
        Part of the texels that some camera measures.
    outcome : Outcome
        How the solver ended; converged where no texel is measured.
    energies : dict
        Per term, before and after each iteration.
    seconds : float
        Wall time of the solver.
    """

    normal_object: NDArray[np.float32]
    base_object: NDArray[np.float32]
    measured: float
    outcome: Outcome
    energies: dict[str, list[float]]
    seconds: float


@one_blas_thread()
def refine_frame(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    cameras: Sequence[str],
    config: NormalsConfig,
    texels: TexelMap,
    prior: NDArray | None = None,
    seed: int = 0,
) -> FrameNormals:
    """Refine the normals of a geometry of one timestep; parameters as in `refine_normals`.

    ``prior`` (N, 2) are offsets in the base normal's tangent plane (`core.uv`) that the correction is drawn
    to instead of to zero, and from which it starts.
    """
    problem, rows, base = frame_problem(capture, model, geometry, reflectance, cameras, config, texels, prior, seed)
    rotation = geometry.rotation[0]
    offsets = np.zeros((len(base), 2)) if prior is None else prior.copy()
    began = time.perf_counter()
    solution = None
    if problem is not None:
        solution = gauss_newton(problem, config.max_iterations, start=None if prior is None else prior[rows])
        offsets[rows] = solution.value
    elapsed = time.perf_counter() - began
    base_object = base @ rotation
    found = normalize(bend(base_object, tangent_plane(base_object), offsets))
    return FrameNormals(
        found.astype(np.float32),
        base_object.astype(np.float32),
        len(rows) / max(len(base), 1),
        Outcome.CONVERGED if solution is None else solution.outcome,
        {} if solution is None else solution.energies,
        elapsed,
    )


def frame_problem(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    cameras: Sequence[str],
    config: NormalsConfig,
    texels: TexelMap,
    prior: NDArray | None = None,
    seed: int = 0,
) -> tuple[NormalProblem | None, NDArray, NDArray]:
    """The optimisation of one timestep, the texels (rows of ``texels``) that it solves for, and all base normals.

    Without a measured texel there is no optimisation: None.
    """
    from mifit.stages.normals.problem import NormalProblem, NormalView, residual_scale, texel_shade

    rotation = geometry.rotation[0]
    surface = Surface(capture, model, geometry, cameras, texels.size, texels=texels)
    seen = surface.observe(np.arange(len(texels.index)))
    base = seen.normal[:, 0].astype(np.float64)
    rows = np.flatnonzero((seen.measured > 0).any(1))
    if not len(rows):
        return None, rows, base
    part = seen.take(rows)
    object_normal = base[rows] @ rotation
    object_tangents = tangent_plane(object_normal)
    tangents = object_tangents @ rotation.T
    views = [
        NormalView(part.colour[:, j], part.measured[:, j], part.view[:, j], base[rows], tangents)
        for j in range(len(part.step))
    ]
    diffuse, specular = (texels.from_map(m)[rows] for m in (reflectance.lit_diffuse, reflectance.specular))
    appearance = Appearance.of(reflectance, reflectance.lobe.at(lambda m: texels.from_map(m)[rows]))
    points = MeshPoints(part.point[:, 0], base[rows], part.face, part.barycentric)
    occlusion = appearance.trace(surface.meshes[0], points, seed)
    shade = texel_shade(appearance, diffuse, specular, views, occlusion, points.position)
    patch = TexelMap(texels.size, texels.index[rows], texels.face[rows], texels.weights[rows])
    prior_correction = None
    if prior is not None:
        prior_correction = bend(object_normal, object_tangents, prior[rows]) - object_normal
    problem = NormalProblem(
        object_normal,
        object_tangents,
        texel_neighbours(patch),
        views,
        shade,
        config.laplacian_weight * NORMAL_STEPS / IMAGE_STEPS**2,
        config.magnitude_weight * (NORMAL_STEPS / IMAGE_STEPS) ** 2,
        OUTLIER * max(residual_scale(views, shade), 1e-4) if config.robust else np.inf,
        prior_correction,
    )
    return problem, rows, base


def gauss_newton(
    problem: NormalProblem,
    max_iterations: int = 20,
    tolerance: float = 1e-3,
    start: NDArray | None = None,
    progress: Progress = silent,
) -> Solution:
    """Minimise by Gauss-Newton with 2 x 2 blocks per texel.

    The L1 norm is replaced by its quadratic majorant at the current point (iteratively reweighted least squares);
    the joint system is solved by conjugate gradients with block-diagonal preconditioning. A step that raises the
    energy is taken back and damped (Levenberg-Marquardt). Ends when the energy falls by less than ``tolerance``,
    relative.
    """
    import drjit as dr

    from mifit.stages.normals.problem import stored_offsets, term_totals

    began = time.perf_counter()
    a, b = problem.facing(*problem.load(None), *problem.load(start))
    local, system = problem.linearize(a, b)
    rough = problem.roughness(a, b)
    totals = term_totals(local, rough)
    history = {name: [value] for name, value in totals.items()}
    damping, outcome = problem.zeros(), Outcome.MAX_ITERATIONS
    iteration = rejected = 0
    if not np.isfinite(sum(totals.values())):
        outcome, max_iterations = Outcome.DIVERGED, 0
    for iteration in range(max_iterations):
        progress("normals", iteration, max_iterations)
        x, y = problem.facing(a, b, *problem.step(a, b, system, damping))
        found, new_system = problem.linearize(x, y)
        # Data and magnitude are separable: a texel whose own energy rises stays, and steps shorter next time.
        worse = ~(sum(found.values()) <= 1.0001 * sum(local.values()) + 1e-9)  # also where it is NaN
        x, y = dr.select(worse, a, x), dr.select(worse, b, y)
        found = {name: dr.select(worse, local[name], value) for name, value in found.items()}
        new_rough = problem.roughness(x, y)
        after = term_totals(found, new_rough)
        before = sum(totals.values())
        increased = sum(after.values()) > before
        damping = dr.select(worse | increased, dr.maximum(8.0 * damping, 0.05), 0.25 * damping)
        dr.eval(damping, x, y)
        if increased:
            rejected += 1
            continue
        system = tuple(dr.select(worse, old, new) for old, new in zip(system, new_system, strict=True))
        a, b, local, rough, totals = x, y, found, new_rough, after
        dr.eval(system, local)
        for name, value in totals.items():
            history[name].append(value)
        if before - sum(totals.values()) <= tolerance * before:
            outcome = Outcome.CONVERGED
            break
    progress("normals", max_iterations, max_iterations)
    seconds = time.perf_counter() - began
    return Solution(stored_offsets(a, b), outcome, history, None, iteration + 1, iteration + 2, rejected, seconds)


def check_maps(reflectance: ReflectanceEstimate) -> int:
    """Side of the maps; raises InputError when they don't belong together."""
    size = reflectance.diffuse.shape[0]
    if reflectance.diffuse.shape != (size, size, 3) or reflectance.specular.shape != (size, size):
        raise InputError(
            f"reflectance maps: found shapes {reflectance.diffuse.shape} and {reflectance.specular.shape}, expected "
            "(S, S, 3) and (S, S)"
        )
    return size
