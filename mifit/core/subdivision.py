"""Meshes with every face split into four."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.mesh_update import subdivide
from mifit.core.split_mesh import TexturedMesh


class MaskedMesh(TexturedMesh, Protocol):
    """A mesh of which some faces have maps, as morphable models are."""

    @property
    def mean(self) -> NDArray:
        """(V, 3) positions."""
        ...

    @property
    def face_mask(self) -> NDArray:
        """(F,) bool, the faces that have maps."""
        ...


@dataclass(frozen=True)
class Topology:
    """A mesh with its faces split.

    Attributes
    ----------
    faces, faces_uv : (F', 3) int32
    uv : (T', 2) float32
    face_mask : (F',) bool
    matrix : (V', V) sparse
        Values at the mesh's vertices -> values at these; the mesh's come first, unchanged.
    """

    faces: NDArray[np.int32]
    faces_uv: NDArray[np.int32]
    uv: NDArray[np.float32]
    face_mask: NDArray[np.bool_]
    matrix: sp.csr_matrix

    @property
    def n_vertices(self) -> int:
        """Number of vertices V'."""
        return self.matrix.shape[0]


def split_faces(mesh: MaskedMesh, subdivisions: int) -> Topology:
    """A mesh with every face split into four, ``subdivisions`` times."""
    faces: NDArray = mesh.faces
    faces_uv: NDArray = mesh.faces_uv
    uv = mesh.uv.astype(np.float64)
    matrix = sp.identity(len(mesh.mean), format="csr")
    for _ in range(subdivisions):
        split, split_uv = subdivide(faces, matrix.shape[0]), subdivide(faces_uv, len(uv))
        matrix, uv = split.matrix @ matrix, split_uv.matrix @ uv
        faces, faces_uv = split.faces, split_uv.faces
    mask = np.repeat(mesh.face_mask, 4**subdivisions)
    return Topology(faces.astype(np.int32), faces_uv.astype(np.int32), uv.astype(np.float32), mask, matrix)
