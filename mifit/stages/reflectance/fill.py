"""What to show where no image looked: the morphable model's albedo, shifted to meet its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate
from mifit.core.mesh_solve import membrane
from mifit.core.uv import TexelMap, sample_map
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.stages.geometry.points import corner_matrix

BLEND = 0.05
"""Confidence at which a texel's own estimate counts as much as its surroundings'."""
STIFFNESS = 0.02
"""Of the membrane, beside texels of confidence 1."""


@dataclass(frozen=True)
class Filled:
    """Maps without gaps, and how far they are what images told.

    Attributes
    ----------
    diffuse : (S, S, 3), specular : (S, S) float32
    confidence, specular_confidence : (S, S) float32
        Of the diffuse and of the specular map. They count what was seen, not what was filled in.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    confidence: NDArray[np.float32]
    specular_confidence: NDArray[np.float32]


def blend_unseen(
    model: MorphableModel,
    texels: TexelMap,
    albedo: NDArray,
    maps: NDArray,
    quality: NDArray,
    told: NDArray,
    mirrored: NDArray | None = None,
) -> Filled:
    """Replace texels that were hardly seen by the model's albedo plus an offset that continues the seen ones.

    The offset is a membrane over the mesh (`core.mesh_solve`), so that it crosses the atlas's seams.

    Parameters
    ----------
    model : MorphableModel
    texels : TexelMap
    albedo : (N, 3)
        Diffuse albedo of the fitted model.
    maps : (S, S, 4)
        Diffuse and specular albedo from the images.
    quality : (N,)
        How often and how well each texel was seen, 0..1.
    told : (N,)
        Share of what images tell of the specular albedo, 0..1: a texel that was well seen may tell nothing of it, in
        deep shade or where no lobe points at a light.
    mirrored : (N, 2), optional
        Texture coordinates of the point opposite to each texel: a texel that was hardly seen first takes the offset
        found there.
    """
    confidence, of_specular = (texels.to_map(np.asarray(x, np.float32)) for x in (quality, quality * told))
    expected = texels.to_map(albedo.astype(np.float32))
    offset, known = maps.copy(), confidence
    offset[..., :3] -= expected
    if mirrored is not None:
        there = texels.to_map(sample_map(confidence, mirrored))
        opposite = texels.to_map(sample_map(offset * confidence[..., None], mirrored))
        opposite /= np.maximum(there, 1e-12)[..., None]
        known = confidence + there * (1.0 - np.clip(confidence / BLEND, 0.0, 1.0))
        own = (confidence / np.maximum(known, 1e-12))[..., None]
        offset = own * offset + (1.0 - own) * opposite
    where = corner_matrix(model.faces, texels.face, texels.weights, model.n_vertices)
    sheet = membrane(model.mean, model.faces, where, texels.from_map(offset), texels.from_map(known), STIFFNESS)
    smooth = texels.to_map((where @ sheet).astype(np.float32))
    share = (known / (known + BLEND))[..., None]
    blended = share * offset + (1.0 - share) * smooth
    blended[..., :3] += expected
    blended = np.clip(blended, 0.0, 1.0).astype(np.float32)
    blended[~texels.mask] = 0.0
    return Filled(blended[..., :3], blended[..., 3], confidence, of_specular)


def mirrored_coordinates(model: MorphableModel, texels: TexelMap) -> NDArray[np.float64]:
    """(N, 2) texture coordinates of the point opposite to each texel on the other half of the face.

    Raises
    ------
    InputError
        The model doesn't say which vertices are opposite to one another.
    """
    if model.symmetry is None:
        raise InputError(f"reflectance.symmetric_fill: model {model.name!r} has no symmetry; leave it false")
    inside = model.face_mask
    of_vertex = np.zeros((len(model.mean), 2))
    of_vertex[model.faces[inside].ravel()] = model.uv[model.faces_uv[inside].ravel()]
    return interpolate(of_vertex[model.symmetry], model.faces, texels.face, texels.weights)
