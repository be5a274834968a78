"""Tangent planes that move with the face, so that a correction found at one timestep holds at another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.bend import tangent_plane, transport
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel


class CarriedTangents:
    """Tangents of the model's mean face, carried to other poses and expressions by the smallest rotations."""

    def __init__(self, model: MorphableModel, texels: TexelMap) -> None:
        self._faces, self._texels = model.faces, texels
        self.home = self._base(model.mean)
        self._tangents = tangent_plane(self.home)

    def frame(self, geometry: GeometryEstimate) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Base normals (N, 3) and tangents (N, 2, 3) of the first timestep of a geometry, object space."""
        base = self._base(geometry.vertices[0].astype(np.float64) @ geometry.rotation[0])
        return base, transport(self.home, self._tangents, base)

    def _base(self, vertices: NDArray) -> NDArray[np.float64]:
        return normalize(
            interpolate(vertex_normals(vertices, self._faces), self._faces, self._texels.face, self._texels.weights)
        )
