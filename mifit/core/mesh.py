"""Triangle meshes on plain arrays: normals, edges, and vertices split at the seams of the atlas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.uv import rasterize_uv


def face_cross(vertices: NDArray, faces: NDArray) -> NDArray:
    """(F, 3) unnormalised face normals; the length is twice the area. Counter-clockwise is outward."""
    a = np.take(vertices, faces[:, 0], axis=0)
    u, v = (np.take(vertices, faces[:, i], axis=0) - a for i in (1, 2))
    out = np.empty_like(u)  # by hand: numpy's cross product takes three times as long
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = u[:, j] * v[:, k] - u[:, k] * v[:, j]
    return out


def edges(faces: NDArray) -> tuple[NDArray, NDArray]:
    """Undirected edges (E, 2), each with its lower vertex first, and the number of faces at each (E,)."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    sides = np.sort(sides, axis=1).astype(np.int64)
    base = int(sides.max(initial=0)) + 1
    unique, count = np.unique(sides[:, 0] * base + sides[:, 1], return_counts=True)
    return np.stack(np.divmod(unique, base), axis=1).astype(faces.dtype), count


def vertex_normals(vertices: NDArray, faces: NDArray) -> NDArray:
    """(V, 3) unit normals, area weighted; a vertex without area gets (0, 0, 1)."""
    cross = face_cross(np.asarray(vertices, dtype=np.float64), faces)
    n = np.zeros((len(vertices), 3))
    for axis in range(3):
        for corner in range(3):
            n[:, axis] += np.bincount(faces[:, corner], cross[:, axis], minlength=len(vertices))
    return normalize(n)


def normalize(v: NDArray) -> NDArray:
    """Unit vectors along the last axis; a zero vector becomes (0, 0, 1)."""
    length = lengths(v)
    zero = length == 0
    if not zero.any():
        return v / length[..., None]
    out = v / np.where(zero, length.dtype.type(1.0), length)[..., None]
    out[zero] = (0.0, 0.0, 1.0)
    return out


def lengths(v: NDArray) -> NDArray:
    """(...) lengths of vectors (..., 3); sums along three neighbours in memory take NumPy three times as long."""
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    return np.sqrt(x * x + y * y + z * z)


def dot(a: NDArray, b: NDArray) -> NDArray:
    """(N,) products of vectors (N, 3)."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def interpolate(values: NDArray, faces: NDArray, face: NDArray, weights: NDArray) -> NDArray:
    """Vertex values (V, C) at points given by face index (N,) and barycentric weights (N, 3) -> (N, C)."""
    # As one sparse product: the corners' values are added up on the fly instead of being gathered first.
    corners = faces[face]
    rows = np.arange(0, corners.size + 1, 3, dtype=corners.dtype)
    mixing = sp.csr_array((weights.ravel(), corners.ravel(), rows), shape=(len(corners), len(values)))
    return mixing @ values


@dataclass(frozen=True)
class SplitMesh:
    """A mesh with one vertex per pair of position and texture coordinate.

    ``origin`` (N,) is the vertex of the model that each split vertex is at, ``uv`` (N, 2) its texture coordinate;
    ``faces`` (F, 3) are in the order of the model's.
    """

    origin: NDArray[np.int64]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]


def split_at_seams(faces: NDArray, faces_uv: NDArray, uv: NDArray) -> SplitMesh:
    """Split the vertices of a mesh where texture coordinates differ; the order is by model vertex.

    ``faces`` and ``faces_uv`` (F, 3) are indices of positions and of texture coordinates ``uv`` (T, 2).
    """
    n = len(uv)
    pairs, inverse = np.unique((faces.astype(np.int64) * n + faces_uv).ravel(), return_inverse=True)
    return SplitMesh(pairs // n, uv[pairs % n].astype(np.float32), inverse.reshape(-1, 3).astype(np.int32))


def part_of(mesh: SplitMesh, selected: NDArray[np.bool_]) -> SplitMesh:
    """The selected faces (F,) of a split mesh, with the vertices that they use."""
    kept, faces = np.unique(mesh.faces[selected].ravel(), return_inverse=True)
    return SplitMesh(mesh.origin[kept], mesh.uv[kept], faces.reshape(-1, 3).astype(np.int32))


def tangents(
    vertices: NDArray, normals: NDArray, uv: NDArray, faces: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Per-vertex unit tangents (N, 3) by MikkTSpace's rules for a mesh split at its seams, and the sign (N,) of
    bitangents.

    Every corner's face tangent is projected onto the plane of its vertex normal, normalised, weighted by the corner's
    angle in that plane, and summed over the faces around the vertex. Bitangent = sign * cross(normal, tangent).
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
    """Object-space normals (S, S, 3) in MikkTSpace tangent space (OpenGL: green is up in texture space).

    Unit vectors in the interpolated, unnormalised frame as MikkTSpace wants it; (0, 0, 1) where the input is zero and
    outside the charts. ``vertices`` and ``normals`` (N, 3) are those of the split mesh in the same space;
    ``face_mask`` (F,) says which faces the map belongs to.
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
