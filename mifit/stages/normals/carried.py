"""Tangent planes that move with the face, so that a correction found at one timestep holds at another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, tangent_plane, transport

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel


class CarriedTangents:
    """Tangents of the model's mean face, carried to other poses and expressions by the smallest rotations."""

    def __init__(self, model: MorphableModel, texels: TexelMap) -> None:
        self._faces, self._texels = model.faces, texels
        self.home = self._base(model.mean)
        self._tangents = tangent_plane(self.home)

    def frame(
        self, geometry: GeometryEstimate, rows: NDArray | slice = slice(None)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Base normals (N, 3) and tangents (N, 2, 3) of the first timestep of a geometry, object space.

        ``rows`` are the texels that are wanted; all by default.
        """
        base = self._base(geometry.vertices[0].astype(np.float64) @ geometry.rotation[0], rows)
        return base, transport(self.home[rows], self._tangents[rows], base)

    def _base(self, vertices: NDArray, rows: NDArray | slice = slice(None)) -> NDArray[np.float64]:
        texels = self._texels
        normals = vertex_normals(vertices, self._faces)
        return normalize(interpolate(normals, self._faces, texels.face[rows], texels.weights[rows]))
