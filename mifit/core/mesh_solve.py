"""Sparse linear systems on meshes: `MeshUpdater`, and `membrane` for values that are known on a part of one.

After Nehab, Rusinkiewicz, Davis, Ramamoorthi, "Efficiently combining positions and normals for precise 3D geometry",
2005: positions are trusted for the coarse shape, normals for the detail. Minimised over the free vertices p is

    sum_faces sum_edges w_e |(p_i - p_j) - P_f (p_i - p_j)|^2 + position_weight * sum_i a_i |p_i - q_i|^2

with P_f the projection onto the plane across the wanted normal of face f, w_e the cotangent weights of a reference
mesh, q the positions that are trusted and a_i the vertices' areas. With P_f (p_i - p_j) held from the last iterate one
matrix, which knows the reference mesh only, is factorised once for all iterations, timesteps and expressions. (Nehab's
own form couples x, y, z and needs a new factorisation for every set of normals.)
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mifit.core.mesh import edges, face_cross, normalize
from mifit.core.uv import TexelMap


class MeshUpdater:
    """Moves the free vertices of a mesh so that its faces take wanted normals.

    ``vertices`` (V, 3) and ``faces`` (F, 3) are a reference mesh, of which only edge weights are used; ``free`` (V,)
    vertices may move. ``position_weight`` is the weight of positions relative to normals, per unit of length: detail
    much smaller than ``1 / sqrt(position_weight)`` comes from the normals, larger shape from the positions.
    """

    def __init__(self, vertices: NDArray, faces: NDArray, free: NDArray[np.bool_], position_weight: float) -> None:
        self.faces = np.asarray(faces, dtype=np.int64)
        self._count = len(vertices)
        self.free = np.asarray(free, dtype=bool)
        rest = np.asarray(vertices, dtype=np.float64)
        self._corner_weight = _cotangents(rest, self.faces)
        area = np.linalg.norm(face_cross(rest, self.faces), axis=1) / 6.0
        self._anchor = position_weight * np.bincount(self.faces.ravel(), np.repeat(area, 3), minlength=self._count)
        laplacian = _stiffness(self.faces, self._corner_weight, self._count)
        matrix = (laplacian + sp.diags(self._anchor)).tocsr()[self.free]
        self._fixed_part = matrix[:, ~self.free]
        self._factor = spl.splu(matrix[:, self.free].tocsc()) if self.free.any() else None

    def settle(
        self, vertices: NDArray, normals: NDArray, iterations: int, tolerance: float
    ) -> tuple[NDArray[np.float64], float]:
        """Positions (V, 3) for wanted unit face normals (F, 3), and the relative change in the last iteration.

        Faces whose wanted normal is zero keep their own. No face turns by more than a right angle from where it was:
        displacements that would do so are halved around it. It ends after ``iterations``, or when one moves the
        vertices by no more than ``tolerance`` of their displacement from the given ``vertices``, both as root of mean
        squares.
        """
        trusted = np.asarray(vertices, dtype=np.float64)
        if self._factor is None:
            return trusted.copy(), 0.0
        own = normalize(face_cross(trusted, self.faces))
        silent = ~(np.linalg.norm(normals, axis=1) > 0.5)
        wanted = np.where(silent[:, None], own, normals)
        p, change = trusted.copy(), np.inf
        for _ in range(iterations):
            before = p.copy()
            right = self._divergence(p, wanted) + self._anchor[:, None] * trusted
            p[self.free] = self._factor.solve(right[self.free] - self._fixed_part @ trusted[~self.free])
            displaced = float(np.linalg.norm(p - trusted))
            change = float(np.linalg.norm(p - before)) / displaced if displaced > 0 else 0.0
            if change <= tolerance:
                break
        return self._unfold(trusted, p, own), change

    def _divergence(self, p: NDArray, wanted: NDArray) -> NDArray:
        """Right-hand side: weighted sums of every face's edges, projected to the wanted plane."""
        out = np.zeros_like(p)
        for k in range(3):
            i, j = self.faces[:, (k + 1) % 3], self.faces[:, (k + 2) % 3]
            edge = p[i] - p[j]
            edge = edge - np.sum(edge * wanted, axis=1, keepdims=True) * wanted
            edge *= self._corner_weight[:, k : k + 1]
            for axis in range(3):
                out[:, axis] += np.bincount(i, edge[:, axis], minlength=self._count)
                out[:, axis] -= np.bincount(j, edge[:, axis], minlength=self._count)
        return out

    def _unfold(self, trusted: NDArray, p: NDArray, own: NDArray) -> NDArray:
        """Halve the displacement of the vertices of folded faces until none is folded."""
        shift = p - trusted
        has_area = np.linalg.norm(own, axis=1) > 0
        # Ends: from the eighth round on every round puts at least one more vertex back for good.
        for attempt in itertools.count():
            folded = np.sum(face_cross(trusted + shift, self.faces) * own, axis=1) <= 0
            folded &= has_area & np.any(shift[self.faces] != 0, axis=(1, 2))
            if not folded.any():
                break
            shift[np.unique(self.faces[folded])] *= 0.5 if attempt < 8 else 0.0
        return trusted + shift


def cotangent_laplacian(vertices: NDArray, faces: NDArray, bounds: tuple[float, float] = (0.05, 20.0)) -> sp.csr_matrix:
    """(V, V) cotangent Laplacian, constants in its null space; cotangents are held within ``bounds``.

    It is positive semidefinite where small ones are raised.
    """
    faces = np.asarray(faces, dtype=np.int64)
    return _stiffness(faces, _cotangents(np.asarray(vertices, dtype=np.float64), faces, bounds), len(vertices))


def _stiffness(faces: NDArray, corner_weight: NDArray, count: int) -> sp.csr_matrix:
    """Laplacian from the corner weights (F, 3) of the edges opposite."""
    i = np.concatenate([faces[:, (k + 1) % 3] for k in range(3)])
    j = np.concatenate([faces[:, (k + 2) % 3] for k in range(3)])
    off = sp.csr_matrix((corner_weight.T.ravel(), (i, j)), shape=(count, count))
    off = off + off.T
    return (sp.diags(np.asarray(off.sum(1)).ravel()) - off).tocsr()


def _cotangents(vertices: NDArray, faces: NDArray, bounds: tuple[float, float] = (0.05, 20.0)) -> NDArray:
    """(F, 3) half cotangents of each corner, the weight of the opposite edge."""
    out = np.empty((len(faces), 3))
    for k in range(3):
        a, b, c = (vertices[faces[:, (k + m) % 3]] for m in range(3))
        u, v = b - a, c - a
        area = np.linalg.norm(np.cross(u, v), axis=1)
        out[:, k] = np.sum(u * v, axis=1) / np.maximum(area, 1e-12)
    # Raised where small: obtuse and degenerate triangles would make the system indefinite.
    return 0.5 * np.clip(out, *bounds)


def face_average(texels: TexelMap, values: NDArray, n_faces: int) -> NDArray[np.float64]:
    """Sums of per-texel vectors (N, 3) over the texels of each face, as unit vectors (F, 3); zero where none."""
    total = np.stack([np.bincount(texels.face, values[:, i], minlength=n_faces) for i in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-9, total / np.maximum(length, 1e-9), 0.0)


def rotate_between(start: NDArray, end: NDArray, vectors: NDArray) -> NDArray[np.float64]:
    """Vectors (N, 3) turned by the smallest rotation that takes unit vectors start to end (N, 3)."""
    axis = np.cross(start, end)
    cosine = np.sum(start * end, axis=1, keepdims=True)
    along = np.sum(axis * vectors, axis=1, keepdims=True)
    return vectors * cosine + np.cross(axis, vectors) + axis * along / np.maximum(1.0 + cosine, 1e-6)


def wanted_face_normals(
    vertices: NDArray, faces: NDArray, texels: TexelMap, base: NDArray, refined: NDArray
) -> NDArray[np.float64]:
    """(F, 3) face normals that a refined normal map asks of a mesh, zero for faces without a texel.

    The map's base is interpolated from vertex normals and so isn't the face's own normal; each face's normal is turned
    by the rotation that takes the average ``base`` normal (N, 3) of its texels to the average ``refined`` one. A map
    equal to its base asks for no change.
    """
    own = normalize(face_cross(np.asarray(vertices, dtype=np.float64), faces))
    before = face_average(texels, base, len(faces))
    after = face_average(texels, refined, len(faces))
    seen = (np.linalg.norm(before, axis=1) > 0.5) & (np.linalg.norm(after, axis=1) > 0.5)
    return np.where(seen[:, None], normalize(rotate_between(before, after, own)), 0.0)


def interior_vertices(faces: NDArray, face_mask: NDArray[np.bool_], n_vertices: int) -> NDArray[np.bool_]:
    """(V,) vertices all of whose faces lie in the mask and none of whose edges has one face only."""
    outside = np.zeros(n_vertices, dtype=bool)
    outside[faces[~face_mask].ravel()] = True
    used = np.zeros(n_vertices, dtype=bool)
    used[faces[face_mask].ravel()] = True
    unique, count = edges(faces)
    border = np.zeros(n_vertices, dtype=bool)
    border[unique[count == 1].ravel()] = True
    return used & ~outside & ~border


def membrane(
    vertices: NDArray, faces: NDArray, where: sp.spmatrix, weight: NDArray, stiffness: float
) -> Callable[[NDArray], NDArray[np.float64]]:
    """A function that turns known values (N, C) into vertex values (V, C) that fit them and else are as flat as
    possible.

    Minimises ``sum_i weight_i |(where x)_i - values_i|^2 + stiffness * tr(x' L x)`` with the cotangent Laplacian L of
    the mesh: an elastic sheet over the surface, whatever the atlas. ``where`` (N, V) interpolates from vertices to the
    points where values are known. A piece of the mesh without known values gets 0. Nearly all of the time goes into
    what doesn't depend on the values.
    """
    weighted = where.T @ sp.diags(np.asarray(weight, dtype=np.float64))
    flat = cotangent_laplacian(np.asarray(vertices, dtype=np.float64), faces)
    floor = 1e-8 * float(flat.diagonal().max())  # decides for pieces of which nothing is known
    system = weighted @ where + stiffness * (flat + floor * sp.identity(len(vertices)))
    factor = splu(sp.csc_matrix(system))
    return lambda values: factor.solve(np.asarray(weighted @ values, dtype=np.float64))
