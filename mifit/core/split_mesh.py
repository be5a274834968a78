"""Meshes as files and renderers want them: split where texture coordinates differ, with a tangent space."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate
from mifit.core.uv import rasterize_uv


class TexturedMesh(Protocol):
    """Faces with the indices of their corners' positions and texture coordinates."""

    @property
    def faces(self) -> NDArray:
        """(F, 3) indices of positions."""
        ...

    @property
    def faces_uv(self) -> NDArray:
        """(F, 3) indices of texture coordinates."""
        ...

    @property
    def uv(self) -> NDArray:
        """(T, 2) texture coordinates."""
        ...


class MeshPart(NamedTuple):
    """Some faces with their texture coordinates: what `split_at_seams` takes, where there is no model."""

    faces: NDArray
    faces_uv: NDArray
    uv: NDArray


@dataclass(frozen=True)
class SplitMesh:
    """A mesh with one vertex per pair of position and texture coordinate.

    Attributes
    ----------
    origin : (N,) int64
        Vertex of the model that each split vertex is at.
    uv : (N, 2) float32
    faces : (F, 3) int32
        In the order of the model's faces.
    """

    origin: NDArray[np.int64]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]


def split_at_seams(mesh: TexturedMesh) -> SplitMesh:
    """Split the vertices of a mesh where texture coordinates differ; the order is by model vertex."""
    n = len(mesh.uv)
    key = mesh.faces.astype(np.int64) * n + mesh.faces_uv
    pairs, inverse = np.unique(key.ravel(), return_inverse=True)
    return SplitMesh(pairs // n, mesh.uv[pairs % n].astype(np.float32), inverse.reshape(-1, 3).astype(np.int32))


def part_of(mesh: SplitMesh, selected: NDArray[np.bool_]) -> SplitMesh:
    """The selected faces (F,) of a split mesh, with the vertices that they use."""
    kept, faces = np.unique(mesh.faces[selected].ravel(), return_inverse=True)
    return SplitMesh(mesh.origin[kept], mesh.uv[kept], faces.reshape(-1, 3).astype(np.int32))


def tangents(
    vertices: NDArray, normals: NDArray, uv: NDArray, faces: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Per-vertex tangents by MikkTSpace's rules for a mesh that is already split at its seams.

    Every corner's face tangent is projected onto the plane of its vertex normal, normalised, weighted by the
    corner's angle in that plane, and summed over the faces around the vertex.

    Parameters
    ----------
    vertices, normals : (N, 3)
    uv : (N, 2)
    faces : (F, 3)

    Returns
    -------
    tangent : (N, 3) float32
        Unit length, perpendicular to the normal.
    sign : (N,) float32
        Bitangent = sign * cross(normal, tangent).
    """
    p, t = vertices[faces].astype(np.float64), uv[faces].astype(np.float64)
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    face_tangent = np.where(area >= 0, 1.0, -1.0)[:, None] * (d2[:, 1:] * e1 - d1[:, 1:] * e2)
    total = np.zeros((len(vertices), 3))
    orientation = np.zeros(len(vertices))
    n = normals.astype(np.float64)
    for corner in range(3):
        v = faces[:, corner]
        sides = [p[:, (corner + k) % 3] - p[:, corner] for k in (1, 2)]
        flat = [_unit(s - np.sum(s * n[v], 1, keepdims=True) * n[v]) for s in sides]
        angle = np.arccos(np.clip(np.sum(flat[0] * flat[1], axis=1), -1, 1))
        along = _unit(face_tangent - np.sum(face_tangent * n[v], 1, keepdims=True) * n[v])
        np.add.at(total, v, angle[:, None] * along)
        np.add.at(orientation, v, np.abs(area) * np.sign(area))
    # A vertex without a usable texture direction takes any tangent in its plane.
    helper = np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    lost = np.linalg.norm(total, axis=1) < 1e-12
    total[lost] = np.cross(n, helper)[lost]
    return _unit(total).astype(np.float32), np.where(orientation < 0, -1.0, 1.0).astype(np.float32)


def _unit(v: NDArray) -> NDArray:
    """Unit vectors; zero stays zero."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 1e-30, length, 1.0)


def tangent_space_map(
    normal_object: NDArray, vertices: NDArray, normals: NDArray, mesh: SplitMesh, face_mask: NDArray
) -> NDArray[np.float32]:
    """Turn object-space normals into MikkTSpace tangent space (OpenGL: green is up in texture space).

    Parameters
    ----------
    normal_object : (S, S, 3)
        Unit normals; zero where there is none.
    vertices, normals : (N, 3)
        The split mesh in the same space.
    mesh : SplitMesh
    face_mask : (F,) bool
        Faces that the map belongs to.

    Returns
    -------
    (S, S, 3) float32
        Unit vectors in the interpolated, unnormalised frame as MikkTSpace wants it; (0, 0, 1) where the input
        is zero and outside the charts.
    """
    size = normal_object.shape[0]
    texels = rasterize_uv(mesh.uv, mesh.faces, size, face_mask)
    tangent, sign = tangents(vertices, normals, mesh.uv, mesh.faces)
    corners = (mesh.faces, texels.face, texels.weights)
    n, t = interpolate(normals, *corners), interpolate(tangent, *corners)
    b = sign[mesh.faces[texels.face, 0], None] * np.cross(n, t)
    wanted = texels.from_map(normal_object).astype(np.float64)
    # Rows of the inverse of [t b n], up to the determinant, whose sign is that of n . (t x b).
    local = np.stack([np.sum(wanted * np.cross(x, y), axis=1) for x, y in ((b, n), (n, t), (t, b))], axis=1)
    local *= np.sign(np.sum(n * np.cross(t, b), axis=1))[:, None]
    out = np.zeros((size, size, 3), dtype=np.float32)
    out[...] = (0.0, 0.0, 1.0)
    keep = np.linalg.norm(wanted, axis=1) > 0
    flat = out.reshape(-1, 3)
    flat[texels.index[keep]] = _unit(local[keep])
    return out
