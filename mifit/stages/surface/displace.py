"""Displacements of a mesh from offsets measured along its normals: sparse least squares with a thin-plate prior.

Minimised over vectors d at the vertices (object space):

    sum_i p_i rho(n_i . (W d)_i - o_i) + stiffness * (E(d) + B(d) + sided B(d - m))
    B(d) = sum_v |(L d)_v|^2 / a_v,    E(d) = sum_v (2 pi / longest)^4 a_v |d_v|^2

with the measured points W (barycentric), their normals n, offsets o and precisions p, the cotangent Laplacian L and
areas a of the rest mesh. Faces are nearly symmetric: m is the displacement of the other half, mirrored, so that a flank
of the nose that no two views show follows the one that they do rather than the cheek beside it. It is that of the
round before, which leaves one plate, stiffer, and all axes apart. Only the normal component of d is measured: a point
that slides on the surface costs nothing, so that what the views show decides where the surface lies and the prior
decides how the mesh lies on it.
The system couples x, y, z through the normals; it is solved by conjugate gradients with the decoupled system as
preconditioner, whose one sparse factorisation serves all three axes and all reweightings. That one is in single
precision: it steers the iterations, whose residuals are double.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.mesh import face_cross, normalize, vertex_normals
from mifit.core.mesh_solve import cotangent_laplacian

CONTACT_WEIGHT = 30.0
"""Of vertices that nearly touch, times the squared distance at which they do."""
SIDED = 10.0
"""Stiffness against bending unlike the other half, relative to that against bending at all."""
USUAL, KNOWN = 8.0, 4.0
"""Stiffness of the displacements that heads beyond a model's span ask for, and degrees of freedom that it counts as."""
PROBES = 16
"""Random vectors that estimate a trace."""
OPPOSED = -0.2
"""Cosine between the normals of sheets that face each other."""
RELATIVE = 1e-3
"""Residual at which conjugate gradients stop, of the right side's: hundredths of a millimetre at the most."""
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
    bending : (V, V) sparse
        The part of it that no shift and hardly a turn of the whole adds to: a pose that is off isn't symmetric.
    symmetry : (V,) int or None
        For each vertex its mirror image's index in x -> -x; None where halves aren't compared.
    """

    matrix: sp.csr_matrix
    bending: sp.csr_matrix
    symmetry: NDArray[np.int32] | None = None

    @classmethod
    def of(
        cls,
        vertices: NDArray,
        faces: NDArray,
        longest: float,
        contact: float = 0.0,
        symmetry: NDArray[np.int32] | None = None,
    ) -> Plate:
        """Of a rest mesh (V, 3), (F, 3).

        Waves longer than ``longest`` are held by their height rather than by their bending; sheets closer than
        ``contact``, such as closed lips, move together; halves that mirror each other by ``symmetry`` move alike.
        """
        rest = np.asarray(vertices, dtype=np.float64)
        laplacian = cotangent_laplacian(rest, faces)
        size = np.linalg.norm(face_cross(rest, faces), axis=1) / 6.0
        area = np.bincount(faces.ravel(), np.repeat(size, 3), minlength=len(rest))
        area = np.maximum(area, 1e-3 * max(float(np.median(area)), 1e-12))
        bending = (laplacian.T @ sp.diags(1.0 / area) @ laplacian).tocsr()
        matrix = bending + (2.0 * np.pi / longest) ** 4 * sp.diags(area)
        if contact > 0:
            matrix = matrix + CONTACT_WEIGHT / contact**2 * _contacts(rest, faces, contact)
        return cls(matrix.tocsr(), bending, symmetry)

    @property
    def sided(self) -> sp.csr_matrix:
        """(V, V) of what the halves don't share."""
        return (0.0 if self.symmetry is None else SIDED) * self.bending

    def mirrored(self, displacement: NDArray) -> NDArray[np.float64]:
        """(V, 3) what the other half's displacement is on this one."""
        return displacement if self.symmetry is None else displacement[self.symmetry] * (-1.0, 1.0, 1.0)

    def energy(self, displacement: NDArray) -> float:
        """Of a displacement (V, 3), at stiffness 1."""
        apart = displacement - self.mirrored(displacement)
        parts = (self.matrix, displacement), (self.sided, apart)
        return sum(float((d * (matrix @ d)).sum()) for matrix, d in parts)


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


@dataclass(frozen=True)
class Displaced:
    """A solution.

    Attributes
    ----------
    displacement : (V, 3)
    measured : float
        Number of degrees of freedom along the normals that the measurements determine rather than the prior.
    energy : float
        Of the prior, at stiffness 1.
    """

    displacement: NDArray[np.float64]
    measured: float
    energy: float

    def likely_stiffness(self, low: float, high: float) -> float:
        """Stiffness under which the displacement is as large as one expects, within bounds (MacKay 1992, eq. 4.8).

        A head that the model spans needs no displacement: what little is found then is noise, and is held down.
        ``USUAL`` counts as ``KNOWN`` further degrees of freedom (a gamma prior), so that a coarse sweep that measures
        next to nothing doesn't hold down all that come after it.
        """
        return float(np.clip((self.measured + KNOWN) / max(self.energy + KNOWN / USUAL, 1e-30), low, high))


def solve_displacement(
    plate: Plate,
    points: sp.csr_matrix,
    normals: NDArray,
    offsets: NDArray,
    precision: NDArray,
    start: NDArray,
    stiffness: float,
    robust: float,
    rounds: int = 3,
    slide: float = 0.02,
) -> Displaced:
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
    stiffness : float
        Weight of the prior.
    robust : float
        Residual where Geman and McClure's penalty turns.
    rounds : int
        Reweightings; the penalty turns at twice the residual in each one before the last.
    slide : float
        Part of a point's weight that holds it along the surface.
    """
    used = precision > 0
    points, normals, precision = points[used], normals[used], precision[used]
    at_start = points @ start
    normal_start = (at_start * normals).sum(1)
    target = normal_start + offsets[used]
    held = at_start - normal_start[:, None] * normals
    sided = stiffness * plate.sided
    prior = stiffness * plate.matrix + sided
    factor = spl.splu(
        (prior + points.T @ sp.diags(precision) @ points).tocsc().astype(np.float32),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    transposed = points.T.tocsr()
    d, weight = start.copy(), precision
    for number in range(rounds):
        scale = robust * 2.0 ** (rounds - 1 - number)
        residual = ((points @ d) * normals).sum(1) - target
        weight = precision / (1.0 + (residual / scale) ** 2) ** 2
        d = _solve(
            prior, sided @ plate.mirrored(d), points, transposed, normals, weight, target, held, d, factor, slide
        )
    probes = np.random.default_rng(0).choice((-1.0, 1.0), (plate.matrix.shape[0], PROBES))
    weighted = transposed @ (weight[:, None] * (points @ probes))
    measured = float((probes * factor.solve(weighted.astype(np.float32))).sum()) / PROBES
    return Displaced(d, measured, plate.energy(d))


def _solve(
    prior: sp.csr_matrix,
    alike: NDArray,
    points: sp.csr_matrix,
    transposed: sp.csr_matrix,
    normals: NDArray,
    weight: NDArray,
    target: NDArray,
    held: NDArray,
    start: NDArray,
    factor: spl.SuperLU,
    slide: float,
) -> NDArray[np.float64]:
    """The minimum for given weights, by conjugate gradients from ``start``; ``alike`` (V, 3) pulls to the mirror."""
    along = slide * weight[:, None]
    across = weight[:, None] - along

    def apply(flat: NDArray) -> NDArray:
        x = flat.reshape(-1, 3)
        at = points @ x
        normal = (at * normals).sum(1, keepdims=True) * normals
        return (prior @ x + transposed @ (across * normal + along * at)).ravel()

    right = transposed @ ((weight * target)[:, None] * normals + along * held) + alike
    size = start.size
    d, _ = spl.cg(
        spl.LinearOperator((size, size), matvec=apply),
        right.ravel(),
        x0=start.ravel(),
        rtol=RELATIVE,
        maxiter=60,
        M=spl.LinearOperator(
            (size, size), matvec=lambda r: factor.solve(r.reshape(-1, 3).astype(np.float32)).astype(np.float64).ravel()
        ),
    )
    return d.reshape(-1, 3)
