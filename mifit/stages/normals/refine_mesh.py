"""Meshes that carry their refined normals as shape."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import MeshConfig
from mifit.core.calls import checked
from mifit.core.estimate import GeometryEstimate, MeshEstimate, NormalsEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.mesh_solve import MeshUpdater, interior_vertices, wanted_face_normals
from mifit.core.process import on_all_cores
from mifit.core.uv import rasterize_uv
from mifit.optim import Outcome
from mifit.progress import Progress, silent

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel

MAX_ITERATIONS = 30
SETTLED = 0.01
"""Part of the displacement by which the last iteration may still move the vertices."""


@checked
def refine_mesh(
    model: MorphableModel,
    geometry: GeometryEstimate,
    normals: NormalsEstimate,
    config: MeshConfig | None = None,
    progress: Progress = silent,
) -> MeshEstimate:
    """Meshes whose vertices in the face area are moved so that they have the refined normals.

    Parameters
    ----------
    model, geometry, normals
        Stage 1's mesh and stage 3's normals; timesteps without normals are left out.
    config : MeshConfig, optional
    progress : Progress

    Returns
    -------
    MeshEstimate
        The boundary of the face area and everything outside it stay; no face flips.

    Notes
    -----
    Nehab et al. 2005, see `core.mesh_solve`. The system is factorised once for all timesteps.
    """
    began, steps = time.perf_counter(), normals.timesteps
    refiner = MeshRefiner(model, normals.normal_object.shape[1], config or MeshConfig())
    vertices = np.empty((len(steps), *model.mean.shape), dtype=np.float32)
    progress("refine mesh", 0, len(steps))

    def refine(i: int) -> Outcome:
        vertices[i], outcome = refiner.refine(geometry, steps[i], normals.normal_object[i])
        return outcome

    outcomes = on_all_cores(refine, range(len(steps)))
    progress("refine mesh", len(steps), len(steps))
    return MeshEstimate(steps, vertices, Report(Outcome.worst(outcomes).value, seconds=time.perf_counter() - began))


class MeshRefiner:
    """Refines the meshes of one model by normal maps of ``size`` texels a side; the system is factorised here, once."""

    def __init__(self, model: MorphableModel, size: int, config: MeshConfig) -> None:
        self._faces = model.faces
        self._texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
        # Object space is in model units; a wave of length L keeps the share 1 / (1 + weight (L / 2 pi)^2) of its
        # normals.
        length = config.detail * 10.0 / model.unit_mm / (2.0 * np.pi)
        free = interior_vertices(model.faces, model.face_mask, len(model.mean))
        self._updater = MeshUpdater(model.mean.astype(np.float64), model.faces, free, 1.0 / length**2)

    def refine(
        self, geometry: GeometryEstimate, timestep: int, normal_object: NDArray
    ) -> tuple[NDArray[np.float32], Outcome]:
        """World-space vertices (V, 3) of a timestep from its normals (S, S, 3), and whether they stood at the end."""
        k, faces, texels = geometry.index(timestep), self._faces, self._texels
        rotation, translation, scale = geometry.rotation[k], geometry.translation[k], geometry.scale
        world = geometry.vertices[k].astype(np.float64)
        shape = (world - translation) @ rotation / scale
        base = normalize(interpolate(vertex_normals(shape, faces), faces, texels.face, texels.weights))
        refined = texels.from_map(normal_object).astype(np.float64)
        missing = np.linalg.norm(refined, axis=1) < 0.5
        refined[missing] = base[missing]
        wanted = wanted_face_normals(shape, faces, texels, base, refined)
        moved, change = self._updater.settle(shape, wanted, MAX_ITERATIONS, SETTLED)
        outcome = Outcome.CONVERGED if change <= SETTLED else Outcome.MAX_ITERATIONS
        # As a shift of the world's vertices, so that those that stay are the same to the last bit.
        return (world + scale * (moved - shape) @ rotation.T).astype(np.float32), outcome
