"""The reconstructed surface as renderers want it: maps without gaps.

Maps belong to the faces that have a place in the atlas (`mapped_faces`). Other faces are shown with vertex
albedo that continues the maps without a seam, by the mesh's normals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mifit.core.mesh import (
    SplitMesh,
    interpolate,
    normalize,
    part_of,
    split_at_seams,
    tangent_space_map,
    vertex_normals,
)
from mifit.core.mesh_solve import membrane
from mifit.core.uv import TexelMap, rasterize_uv, sample_map
from mifit.morphable import MorphableModel
from mifit.morphable.topology import scalp_depth
from mifit.result import Reconstruction


@dataclass(frozen=True)
class SurfaceMaps:
    """Maps of the faces that have a place in the atlas, padded across seams; row 0 at v = 1.

    ``diffuse`` (S, S, 3) and ``specular`` (S, S) are linear albedo 0..1; ``normal`` (S, S, 3) are unit normals in
    object space of one timestep.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    normal: NDArray[np.float32]


@dataclass(frozen=True)
class Shape:
    """The mesh of one timestep as files hold it: ``vertices`` and unit ``normals`` (V, 3), and its split at the seams.

    ``mapped`` (F,) are the faces with maps.
    """

    vertices: NDArray
    normals: NDArray
    mesh: SplitMesh
    mapped: NDArray[np.bool_]

    def parts(self) -> dict[str, SplitMesh]:
        """The faces with maps, ``face``, and without, ``rest``, as far as there are any."""
        both = {"face": self.mapped, "rest": ~self.mapped}
        return {name: part_of(self.mesh, selected) for name, selected in both.items() if selected.any()}

    def tangent_map(self, normals: NDArray) -> NDArray[np.float32]:
        """A map of normals in this shape's space, in MikkTSpace tangent space (`core.mesh.tangent_space_map`)."""
        at = self.mesh.origin
        return tangent_space_map(normals, self.vertices[at], self.normals[at], self.mesh, self.mapped)


def shape_of(result: Reconstruction, timestep: int, world: bool = True) -> Shape:
    """The mesh of a timestep in world space, or as posed in object space, in the result's units."""
    i, geometry = result.index(timestep), result.geometry
    vertices = geometry.vertices[i]
    if not world:
        vertices = (vertices - geometry.translation[i]) @ geometry.rotation[i]
    model = result.model
    normals = vertex_normals(vertices, model.faces)
    return Shape(vertices, normals, split_at_seams(model.faces, model.faces_uv, model.uv), mapped_faces(result))


def surface_maps(result: Reconstruction, timestep: int, skin: bool = False) -> SurfaceMaps:
    """Maps of one timestep as a renderer wants them.

    Texels that belong to no face repeat the nearest texel inside, so bilinear look-ups at a seam see no gap.
    Without stage 2 the albedo is the fitted model's at 512 texels; without stage 3, or for a timestep that it
    did not refine, the normals are the mesh's. ``skin`` asks for the albedo alone, for files without a light of their
    own: what the capture's light leaves unexplained (``residual_shading``) is part of the diffuse map otherwise.
    """
    model, geometry = result.model, result.geometry
    reflectance = result.reflectance
    size = 512 if reflectance is None else reflectance.diffuse.shape[0]
    texels, nearest = _texels(model, size, _whole(result))
    corners = (model.faces, texels.face, texels.weights)
    if reflectance is None:
        diffuse = texels.to_map(np.clip(interpolate(geometry.vertex_albedo, *corners), 0, 1).astype(np.float32))
        specular = np.zeros((size, size), dtype=np.float32)
    else:
        diffuse, specular = reflectance.diffuse if skin else reflectance.lit_diffuse, reflectance.specular
    i = result.index(timestep)
    normals = vertex_normals(geometry.vertices[i], model.faces) @ geometry.rotation[i]
    normal = texels.to_map(normalize(interpolate(normals, *corners)).astype(np.float32))
    refined = result.refined_normal(timestep)
    if refined is not None:
        filled = np.any(refined != 0, axis=-1)
        normal[filled] = refined[filled]
    return SurfaceMaps(*(_padded(values, nearest) for values in (diffuse, specular, normal)))


def vertex_materials(result: Reconstruction, skin: bool = False) -> NDArray[np.float32]:
    """(V, 4) diffuse and specular albedo at the vertices: the maps' where there are maps, continued over the other
    faces.

    Linear, 0..1. The diffuse part is the fitted model's albedo plus an offset that is a membrane over the mesh, and on
    a scalp with hair that colour alone. ``skin`` as in `surface_maps`.
    """
    model, geometry, reflectance = result.model, result.geometry, result.reflectance
    albedo, scalp = np.array(geometry.vertex_albedo, dtype=np.float64), np.zeros(model.n_vertices, bool)
    if reflectance is not None and reflectance.hair is not None:
        scalp = np.minimum(*scalp_depth(model.mean, model.landmarks)) > 0
        albedo[scalp] = reflectance.hair
    expected = np.column_stack([albedo, np.zeros(len(albedo))])
    if reflectance is None:
        return np.clip(expected, 0.0, 1.0).astype(np.float32)
    whole = _whole(result)
    known, uv, continued = _continuation(model, whole)
    _, nearest = _texels(model, len(reflectance.diffuse), whole)
    diffuse = reflectance.diffuse if skin else reflectance.lit_diffuse
    values = _padded(np.concatenate([diffuse, reflectance.specular[..., None]], axis=2), nearest)
    offset = sample_map(values, uv) - expected[known]
    expected += np.where(scalp[:, None], 0.0, continued(offset))  # the offset is skin's
    expected[known] = offset + np.column_stack([albedo, np.zeros(len(albedo))])[known]
    return np.clip(expected, 0.0, 1.0).astype(np.float32)


def _padded(values: NDArray, nearest: NDArray[np.intp]) -> NDArray:
    """A map (S, S, ...) whose texels repeat those at ``nearest``."""
    return values.reshape(-1, *values.shape[2:]).take(nearest, axis=0)


def _whole(result: Reconstruction) -> bool:
    return np.array_equal(mapped_faces(result), result.model.mapped)


def mapped_faces(result: Reconstruction) -> NDArray[np.bool_]:
    """(F,) faces that are shown with the maps: all that the atlas holds, or the face area where a fit stayed in it."""
    model, reflectance = result.model, result.reflectance
    if reflectance is None:
        return model.mapped
    outside = _outside(model, len(reflectance.diffuse))
    return model.mapped if reflectance.diffuse.reshape(-1, 3).take(outside, axis=0).any() else model.face_mask


@lru_cache(maxsize=4)
def _outside(model: MorphableModel, size: int) -> NDArray[np.int64]:
    """Flat positions of the texels of faces that have a place in the atlas, but outside the face area."""
    texels, _ = _texels(model, size, True)
    return texels.index[~model.face_mask[texels.face]]


@lru_cache(maxsize=4)
def _texels(model: MorphableModel, size: int, whole: bool) -> tuple[TexelMap, NDArray[np.intp]]:
    """Texels of the faces with maps, and for every texel of the map (S, S) the flat position of the nearest of them."""
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.mapped if whole else model.face_mask)
    rows, columns = distance_transform_edt(~texels.mask, return_distances=False, return_indices=True)
    # By one number: NumPy takes three times as long to find texels by two.
    return texels, rows.astype(np.intp) * size + columns


@lru_cache(maxsize=2)
def _continuation(model: MorphableModel, whole: bool) -> tuple[NDArray, NDArray, Callable[[NDArray], NDArray]]:
    """Vertices of the faces with maps, where in the maps they are, and what continues values there over the mesh."""
    inside, count = model.mapped if whole else model.face_mask, len(model.mean)
    known = np.unique(model.faces[inside])
    uv = np.zeros((count, 2))
    uv[model.faces[inside].ravel()] = model.uv[model.faces_uv[inside].ravel()]
    if len(known) == count:
        return known, uv[known], lambda values: values
    where = sp.csr_matrix((np.ones(len(known)), (np.arange(len(known)), known)), (len(known), count))
    return known, uv[known], membrane(model.mean, model.faces, where, np.ones(len(known)), 1e-3)
