"""Meshes that carry their refined normals as shape: finer vertices and displacement maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate, NormalsEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.mesh_update import MeshUpdater, displacement, interior_vertices, subdivide, wanted_face_normals
from mifit.core.uv import TexelMap, rasterize_uv

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel

DETAIL = 0.3
"""Length in centimetres below which shape comes from the normals and above which it comes from the positions."""


@dataclass(frozen=True)
class RefinedMesh:
    """Meshes of all refined timesteps on one topology.

    Attributes
    ----------
    timesteps : tuple of int
    vertices : (T, V', 3) float32
        World space. With subdivision the model's vertices come first.
    faces, faces_uv : (F', 3) int
    uv : (T', 2) float32
    displacement : (T, S, S) float32
        Distance from the fitted mesh along its normals, capture units; 0 outside the covered texels.
    """

    timesteps: tuple[int, ...]
    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    faces_uv: NDArray[np.int64]
    uv: NDArray[np.float32]
    displacement: NDArray[np.float32]


def refine_mesh(
    model: MorphableModel,
    geometry: GeometryEstimate,
    normals: NormalsEstimate,
    subdivisions: int = 0,
    detail: float = DETAIL,
) -> RefinedMesh:
    """Move the vertices of the face area so that the mesh takes the refined normals.

    Parameters
    ----------
    model, geometry, normals
        Stage 1's mesh and stage 3's normals; timesteps without normals are left out.
    subdivisions : int
        Times that every face is split into four first: a mesh holds no detail finer than its edges.
    detail : float
        Length in centimetres, see ``DETAIL``.

    Returns
    -------
    RefinedMesh
        The boundary of the face area and everything outside it stay; no face flips.

    Notes
    -----
    Nehab et al. 2005, see `core.mesh_update`. The system is factorised once for all timesteps.
    """
    size = normals.normal_object.shape[1]
    faces, faces_uv, uv = model.faces.astype(np.int64), model.faces_uv.astype(np.int64), model.uv.astype(np.float64)
    mask, lift = model.face_mask, None
    rest = model.mean.astype(np.float64)
    for _ in range(subdivisions):
        split, split_uv = subdivide(faces, len(rest)), subdivide(faces_uv, len(uv))
        lift = split.matrix if lift is None else split.matrix @ lift
        rest, uv = split.matrix @ rest, split_uv.matrix @ uv
        faces, faces_uv, mask = split.faces, split_uv.faces, np.repeat(mask, 4)
    texels = rasterize_uv(uv, faces_uv, size, mask)
    # Object space is in model units; a wave of length L keeps the share 1 / (1 + weight (L / 2 pi)^2) of its normals.
    length = detail * 10.0 / model.unit_mm / (2.0 * np.pi)
    updater = MeshUpdater(rest, faces, interior_vertices(faces, mask, len(rest)), 1.0 / length**2)
    vertices, heights = [], []
    for timestep, wanted in zip(normals.timesteps, normals.normal_object, strict=True):
        k = geometry.index(timestep)
        rotation, translation, scale = geometry.rotation[k], geometry.translation[k], geometry.scale
        shape = (geometry.vertices[k].astype(np.float64) - translation) @ rotation / scale
        shape = shape if lift is None else lift @ shape
        moved, height = _update(updater, shape, faces, texels, wanted)
        vertices.append(scale * moved @ rotation.T + translation)
        heights.append(texels.to_map(scale * height))
    return RefinedMesh(
        normals.timesteps,
        np.stack(vertices).astype(np.float32),
        faces,
        faces_uv,
        uv.astype(np.float32),
        np.stack(heights).astype(np.float32),
    )


def _update(
    updater: MeshUpdater, shape: NDArray, faces: NDArray, texels: TexelMap, wanted: NDArray
) -> tuple[NDArray, NDArray]:
    """One timestep in object space: positions, and displacement per covered texel."""
    base = normalize(interpolate(vertex_normals(shape, faces), faces, texels.face, texels.weights))
    refined = texels.from_map(wanted).astype(np.float64)
    missing = np.linalg.norm(refined, axis=1) < 0.5
    refined[missing] = base[missing]
    moved = updater.update(shape, wanted_face_normals(shape, faces, texels, base, refined))
    return moved, displacement(texels, faces, shape, moved, base)
