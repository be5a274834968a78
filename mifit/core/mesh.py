"""Triangle-mesh geometry on plain arrays."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray


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
    unique, count = np.unique(_sides(faces), axis=0, return_counts=True)
    return unique, count


def edges_of_faces(faces: NDArray) -> tuple[NDArray, NDArray]:
    """As `edges`, but with the edge of every side: (E, 2), and (3, F) for the sides 01, 12 and 20 of each face."""
    unique, which = np.unique(_sides(faces), axis=0, return_inverse=True)
    return unique, which.reshape(3, len(faces))


def _sides(faces: NDArray) -> NDArray:
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)


def vertex_sum_matrix(faces: NDArray, n_vertices: int) -> sp.csr_matrix:
    """(V, F) 0/1 matrix that sums face values over the faces around each vertex."""
    f = np.repeat(np.arange(len(faces)), 3)
    return sp.csr_matrix((np.ones(3 * len(faces)), (faces.ravel(), f)), shape=(n_vertices, len(faces)))


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


def interpolate(values: NDArray, faces: NDArray, face: NDArray, weights: NDArray) -> NDArray:
    """Vertex values (V, C) at points given by face index (N,) and barycentric weights (N, 3) -> (N, C)."""
    # As one sparse product: the corners' values are added up on the fly instead of being gathered first.
    corners = faces[face]
    rows = np.arange(0, corners.size + 1, 3, dtype=corners.dtype)
    mixing = sp.csr_array((weights.ravel(), corners.ravel(), rows), shape=(len(corners), len(values)))
    return mixing @ values
