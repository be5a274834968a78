"""The reconstructed surface as renderers want it: maps without gaps.

Maps belong to the faces of the model's ``face_mask``. Other faces may have any texture coordinates, so they are
shown with the fitted model's vertex albedo, without specular, by the mesh's normals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, rasterize_uv

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel
    from mifit.result import Result


@dataclass(frozen=True)
class SurfaceMaps:
    """Maps of the face area, padded across seams; row 0 at v = 1.

    Attributes
    ----------
    diffuse : (S, S, 3) float32
        Linear albedo 0..1.
    specular : (S, S) float32
        Specular albedo 0..1.
    normal : (S, S, 3) float32
        Unit normals in object space of one timestep.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    normal: NDArray[np.float32]


def surface_maps(reconstruction: Result, timestep: int) -> SurfaceMaps:
    """Maps of one timestep as a renderer wants them.

    Texels outside the face area repeat the nearest texel inside, so bilinear look-ups at a seam see no gap.
    Without stage 2 the albedo is the fitted model's at 512 texels; without stage 3, or for a timestep that it
    did not refine, the normals are the mesh's.
    """
    model, geometry = reconstruction.model, reconstruction.geometry
    reflectance = reconstruction.reflectance
    size = 512 if reflectance is None else reflectance.diffuse.shape[0]
    texels, nearest = _face_texels(model, size)
    corners = (model.faces, texels.face, texels.weights)
    if reflectance is None:
        diffuse = texels.to_map(np.clip(interpolate(geometry.vertex_albedo, *corners), 0, 1).astype(np.float32))
        specular = np.zeros((size, size), dtype=np.float32)
    else:
        diffuse, specular = reflectance.diffuse, reflectance.specular
    i = reconstruction.index(timestep)
    normals = vertex_normals(geometry.vertices[i], model.faces) @ geometry.rotation[i]
    normal = texels.to_map(normalize(interpolate(normals, *corners)).astype(np.float32))
    refined = reconstruction.refined_normal(timestep)
    if refined is not None:
        filled = np.any(refined != 0, axis=-1)
        normal[filled] = refined[filled]
    return SurfaceMaps(diffuse[nearest], specular[nearest], normal[nearest])


@lru_cache(maxsize=4)
def _face_texels(model: MorphableModel, size: int) -> tuple[TexelMap, tuple[NDArray, NDArray]]:
    """Texels of the face area, and for every texel of the map the row and column of the nearest of them."""
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    rows, columns = distance_transform_edt(~texels.mask, return_distances=False, return_indices=True)
    return texels, (rows, columns)
