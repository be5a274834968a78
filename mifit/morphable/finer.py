"""Models on subdivided meshes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import split_faces

if TYPE_CHECKING:
    from mifit.morphable.model import MorphableModel


def finer_model(model: MorphableModel, subdivisions: int) -> MorphableModel:
    """A model on the split mesh of `split_faces`: shapes and albedos are those of the model, landmarks its vertices."""
    if not subdivisions:
        return model
    topology = split_faces(model, subdivisions)

    def lift(values: NDArray) -> NDArray[np.float32]:
        flat = topology.matrix @ values.reshape(len(values), -1)
        return flat.reshape(topology.n_vertices, *values.shape[1:]).astype(np.float32)

    return replace(
        model,
        mean=lift(model.mean),
        identity=lift(model.identity),
        expression=lift(model.expression),
        mean_albedo=lift(model.mean_albedo),
        albedo_modes=lift(model.albedo_modes),
        faces=topology.faces,
        faces_uv=topology.faces_uv,
        uv=topology.uv,
        face_mask=topology.face_mask,
        symmetry=None,
        fingerprint=f"{model.digest}-{subdivisions}" if model.fingerprint else "",
    )
