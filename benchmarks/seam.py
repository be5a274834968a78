"""How visible the border of the face area is in a result: the colour step across it against the steps beside it.

    python -m benchmarks.seam RESULT [--model MODEL]

Steps are differences of the diffuse and of the specular albedo between neighbouring faces of the mesh, per length.
1 says that the border is as smooth as its surroundings.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.uv import sample_map
from mifit.morphable import MorphableModel
from mifit.output.surface import mapped_faces, surface_maps, vertex_materials
from mifit.reconstruction import Reconstruction
from mifit.result import Result

RINGS = 4
"""Faces about the border, on both sides, that it is compared with."""


def face_albedo(result: Result) -> NDArray[np.float64]:
    """(F, 4) diffuse and specular albedo at the centres of the faces, as renders have it."""
    model, maps = result.model, surface_maps(result, result.timesteps[0])
    out = vertex_materials(result)[model.faces].mean(axis=1).astype(np.float64)
    inside = mapped_faces(result)
    uv = model.uv[model.faces_uv[inside]].mean(axis=1)
    out[inside] = np.column_stack([sample_map(maps.diffuse, uv), sample_map(maps.specular, uv)])
    return out


def border_step(result: Result) -> dict[str, float]:
    """Mean step across the border of the face area, over that beside it: ``{"diffuse", "specular", "edges"}``.

    Only the border on the head's surface counts, where both sides are one skin: eyes and mouth have their own.
    """
    model = result.model
    corner = np.sort(np.concatenate([model.faces[:, [0, 1]], model.faces[:, [1, 2]], model.faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(model.faces)), 3)
    order = np.lexsort((corner[:, 1], corner[:, 0]))
    same = (corner[order][1:] == corner[order][:-1]).all(axis=1)
    a, b = face[order][:-1][same], face[order][1:][same]
    centre = result.geometry.vertices[0][model.faces].mean(axis=1)
    centroid = model.mean[model.faces].mean(axis=1)
    eyes_and_mouth = model.mean[model.landmarks[36:]]
    reach = float(np.ptp(eyes_and_mouth[:, 0]))
    skin = np.ones(len(a), dtype=bool)
    for feature in (slice(0, 6), slice(6, 12), slice(12, 32)):
        middle = eyes_and_mouth[feature].mean(axis=0)
        skin &= np.linalg.norm(centroid[a] - middle, axis=1) > 0.45 * reach
    across = (model.face_mask[a] != model.face_mask[b]) & skin
    near = np.zeros(len(model.faces))
    near[np.concatenate([a[across], b[across]])] = 1
    link = sp.coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), (len(model.faces),) * 2).tocsr()
    for _ in range(RINGS):
        near = np.minimum(near + link @ near, 1)
    beside = (near[a] > 0) & (near[b] > 0) & ~across & skin
    albedo = face_albedo(result)
    step = np.abs(albedo[a] - albedo[b]) / np.linalg.norm(centre[a] - centre[b], axis=1)[:, None]
    over = {
        name: float(step[across][:, part].mean() / max(step[beside][:, part].mean(), 1e-9))
        for name, part in (("diffuse", slice(0, 3)), ("specular", slice(3, 4)))
    }
    return {**over, "edges": int(across.sum())}


def main() -> None:
    """Print the steps of a result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("result")
    parser.add_argument("--model", default="builtin")
    arguments = parser.parse_args()
    print(json.dumps(border_step(Reconstruction.load(arguments.result, model=MorphableModel.load(arguments.model)))))


if __name__ == "__main__":
    main()
