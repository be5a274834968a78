"""Displacements of a mesh from offsets measured along its normals: sparse least squares with a thin-plate prior.

Minimised over vectors d at the vertices (object space):

    sum_i p_i rho(n_i . (W d)_i - o_i) + stiffness * sum_v |(L d)_v|^2 / a_v + pull * sum_v a_v |d_v|^2

with the measured points W (barycentric), their normals n, offsets o and precisions p, the cotangent Laplacian L and
areas a of the rest mesh. Only the normal component of d is measured: a point that slides on the surface costs
nothing, so that what the views show decides where the surface lies and the prior decides how the mesh lies on it.
The system couples x, y, z through the normals; it is solved by conjugate gradients with the decoupled system as
preconditioner, whose one sparse factorisation serves all three axes and all reweightings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.mesh import face_cross, normalize, vertex_normals
from mifit.core.mesh_update import cotangent_laplacian

CONTACT_WEIGHT = 30.0
"""Of vertices that nearly touch, times the squared distance at which they do."""
OPPOSED = -0.2
"""Cosine between the normals of sheets that face each other."""
ACROSS = 0.7
"""Cosine of the angle between the normals and the way from one sheet to the other."""


@dataclass(frozen=True)
class Plate:
    """The prior's matrix on one mesh.

    Attributes
    ----------
    matrix : (V, V) sparse
        Thin-plate energy, scale free: the energy of a displacement doesn't change when mesh and displacement are
        scaled together.
    area : (V,)
    """

    matrix: sp.csr_matrix
    area: NDArray[np.float64]

    @classmethod
    def of(cls, vertices: NDArray, faces: NDArray, contact: float = 0.0) -> Plate:
        """Of a rest mesh (V, 3), (F, 3); sheets closer than ``contact``, such as closed lips, move together."""
        rest = np.asarray(vertices, dtype=np.float64)
        laplacian = cotangent_laplacian(rest, faces)
        size = np.linalg.norm(face_cross(rest, faces), axis=1) / 6.0
        area = np.bincount(faces.ravel(), np.repeat(size, 3), minlength=len(rest))
        area = np.maximum(area, 1e-3 * max(float(np.median(area)), 1e-12))
        matrix = laplacian.T @ sp.diags(1.0 / area) @ laplacian
        if contact > 0:
            matrix = matrix + CONTACT_WEIGHT / contact**2 * _contacts(rest, faces, contact)
        return cls(matrix.tocsr(), area)


def _contacts(vertices: NDArray, faces: NDArray, distance: float) -> sp.csr_matrix:
    """(V, V) sum of |d_i - d_j|^2 over vertices of different sheets that nearly touch.

    Two vertices lie on different sheets where their normals are opposed, or where the way from one to the other
    leaves both along the normal.
    """
    count = len(vertices)
    used = np.unique(faces)
    pairs = used[cKDTree(vertices[used]).query_pairs(distance, output_type="ndarray")]
    normal = vertex_normals(vertices, faces)
    way = normalize(vertices[pairs[:, 1]] - vertices[pairs[:, 0]])
    first, second = normal[pairs[:, 0]], normal[pairs[:, 1]]
    opposed = (first * second).sum(1) < OPPOSED
    across = np.minimum(np.abs((first * way).sum(1)), np.abs((second * way).sum(1))) > ACROSS
    pairs = pairs[opposed | across]
    i, j = pairs.T
    edges = sp.csr_matrix((np.ones(len(pairs)), (i, j)), shape=(count, count))
    edges = edges + edges.T
    return (sp.diags(np.asarray(edges.sum(1)).ravel()) - edges).tocsr()


def solve_displacement(
    plate: Plate,
    points: sp.csr_matrix,
    normals: NDArray,
    offsets: NDArray,
    precision: NDArray,
    start: NDArray,
    stiffness: float,
    pull: float,
    robust: float,
    sweeps: int = 3,
    slide: float = 0.02,
) -> NDArray[np.float64]:
    """Displacements (V, 3) from offsets measured relative to ``start``.

    Parameters
    ----------
    plate : Plate
    points : (N, V) sparse
        Barycentric weights of the measured points.
    normals : (N, 3)
    offsets, precision : (N,)
        Relative to the mesh displaced by ``start``, and their inverse variance.
    start : (V, 3)
        Current displacement; the offsets are added to it.
    stiffness, pull : float
        Weights of the prior.
    robust : float
        Residual where Geman and McClure's penalty turns.
    sweeps : int
        Reweightings.
    slide : float
        Part of a point's weight that holds it along the surface.
    """
    prior = stiffness * plate.matrix + pull * sp.diags(plate.area)
    target = ((points @ start) * normals).sum(1) + offsets
    d = start.copy()
    used = precision > 0
    points, normals, target, precision = points[used], normals[used], target[used], precision[used]
    factor = spl.splu(
        (prior + points.T @ sp.diags(precision) @ points).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    transposed = points.T.tocsr()
    for number in range(sweeps):
        scale = robust * 2.0 ** (sweeps - 1 - number)
        residual = ((points @ d) * normals).sum(1) - target
        weight = precision / (1.0 + (residual / scale) ** 2) ** 2
        along = slide * weight[:, None]

        def apply(flat: NDArray, weight: NDArray = weight, along: NDArray = along) -> NDArray:
            x = flat.reshape(-1, 3)
            at = points @ x
            normal = (at * normals).sum(1, keepdims=True) * normals
            return (prior @ x + transposed @ ((weight[:, None] - along) * normal + along * at)).ravel()

        right = transposed @ (
            (weight * target)[:, None] * normals
            + along * ((points @ start) - ((points @ start) * normals).sum(1, keepdims=True) * normals)
        )
        size = d.size
        d, _ = spl.cg(
            spl.LinearOperator((size, size), matvec=apply),
            right.ravel(),
            x0=d.ravel(),
            rtol=1e-4,
            maxiter=60,
            M=spl.LinearOperator((size, size), matvec=lambda r: factor.solve(r.reshape(-1, 3)).ravel()),
        )
        d = d.reshape(-1, 3)
    return d
