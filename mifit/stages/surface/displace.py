"""A surface from offsets measured along its normals: the model's modes and a thin plate, in one least squares.

A surface ``mean + U`` over V vertices is ``U = M m + d``, with the modes M of the model (coefficients m of unit
deviation) and a smooth displacement d. Minimised over both, in object space:

    sum_i p_i rho(n_i . (W U)_i - o_i) + stiffness * E(d) + |m|^2
    E(d) = sum_v |(L d)_v|^2 / a_v + (2 pi / longest)^4 a_v |d_v|^2

with the measured points W (barycentric; of a thin wall, one side less the other), their normals n, offsets o and
precisions p, the cotangent Laplacian L and areas a of the rest mesh. Only the normal component of U is measured: a
point that slides on the surface costs nothing, so that what the views show decides where the surface lies and the prior
decides how the mesh lies on it.

Coefficients stay within the model's bounds: one that would leave them is held there for a solution. The others are
eliminated: with the plate's matrix K and the stiffness s, the best ones for a surface are
``m = G^-1 s M'K U`` with ``G = s M'KM + 1``. What remains is solved for U by conjugate gradients, with the
plate and the measurements, axes decoupled, as preconditioner: one sparse factorisation serves all axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as la
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.mesh import dot, face_cross, normalize, vertex_normals
from mifit.core.mesh_solve import cotangent_laplacian

CONTACT_WEIGHT = 30.0
"""Of vertices that nearly touch, times the squared distance at which they do."""
OPPOSED = -0.2
"""Cosine between the normals of sheets that face each other."""
RELATIVE = 0.1
"""Residual at which conjugate gradients stop, of that at the start: more rounds follow."""
MOST_ITERATIONS = 60
ACROSS = 0.7
"""Cosine of the angle between the normals and the way from one sheet to the other."""
THINNEST = 0.25
"""Part of a wall's thickness at rest below which it is held, and the deviation that holds it.
Chosen on gloss, Emily c3,c4."""
SLIDE = 0.02
"""Part of a point's weight that holds it along the surface, where it is."""


@dataclass(frozen=True)
class Measurements:
    """Offsets from a surface.

    Attributes
    ----------
    points : (N, V) sparse
        Barycentric weights of the measured points; of a wall, one side less the other.
    normals : (N, 3)
        The directions that are measured.
    offsets, precision : (N,)
        And their inverse variance; 0 where nothing is measured.
    robust : (N, R)
        Residual where Geman and McClure's penalty turns, one for each weighting.
    """

    points: sp.csr_matrix
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    precision: NDArray[np.float64]
    robust: NDArray[np.float64]

    def where(self, used: NDArray[np.bool_]) -> Measurements:
        """Some of them."""
        return Measurements(*(getattr(self, name)[used] for name in self.__dataclass_fields__))

    def with_others(self, other: Measurements) -> Measurements:
        """All of both; ``robust`` of the others may be one for all weightings."""
        robust = np.broadcast_to(other.robust, (len(other.offsets), self.robust.shape[1]))
        return Measurements(
            sp.vstack([self.points, other.points]).tocsr(),
            np.concatenate([self.normals, other.normals]),
            np.concatenate([self.offsets, other.offsets]),
            np.concatenate([self.precision, other.precision]),
            np.concatenate([self.robust, robust]),
        )


@dataclass(frozen=True)
class Walls:
    """Parts of the skin that are thin, such as the nose's wing: the side that is seen may not pass the other.

    Attributes
    ----------
    points : (N, V) sparse
        A vertex less the nearest one behind it, on the other side.
    across : (N, 3)
        From there to the vertex.
    least : (N,)
        Thickness below which a wall is held.
    """

    points: sp.csr_matrix
    across: NDArray[np.float64]
    least: NDArray[np.float64]

    @classmethod
    def of(cls, vertices: NDArray, faces: NDArray, thickest: float) -> Walls:
        """Of a rest mesh (V, 3), (F, 3); both sides lie nearer to each other than ``thickest``."""
        rest, used = np.asarray(vertices, np.float64), np.unique(faces)
        pairs = used[cKDTree(rest[used]).query_pairs(thickest, output_type="ndarray")]
        front, back = np.concatenate([pairs, pairs[:, ::-1]]).T
        normal, across = vertex_normals(rest, faces), normalize(rest[front] - rest[back])
        opposed = (dot(normal[front], across) > ACROSS) & (dot(normal[back], across) < -ACROSS)
        thickness = np.linalg.norm(rest[front] - rest[back], axis=1)
        order = np.argsort(thickness, kind="stable")
        order = order[opposed[order]]
        nearest = order[np.unique(front[order], return_index=True)[1]]
        signs, rows = np.repeat([1.0, -1.0], len(nearest)), np.tile(np.arange(len(nearest)), 2)
        columns = np.concatenate([front[nearest], back[nearest]])
        points = sp.csr_matrix((signs, (rows, columns)), shape=(len(nearest), len(rest)))
        return cls(points, across[nearest], THINNEST * thickness[nearest])

    def at(self, surface: NDArray) -> Measurements:
        """What they measure where a surface (V, 3) is thinner than it may be."""
        lacks = self.least - dot(self.points @ surface, self.across)
        precision = np.where(lacks > 0, 1.0 / self.least**2, 0.0)
        return Measurements(self.points, self.across, lacks, precision, np.full((len(lacks), 1), np.inf))


@dataclass(frozen=True)
class SurfacePrior:
    """Thin plate and modes on one mesh.

    Attributes
    ----------
    plate : (V, V) sparse
        Thin-plate energy, scale free: the energy of a displacement doesn't change when mesh and displacement are
        scaled together.
    modes : (3 V, K) float32
        Change of the vertices by coefficients of unit deviation.
    bent : (3 V, K) float32
        ``plate`` times the modes.
    gram : (K, K)
        Energies of the modes.
    """

    plate: sp.csr_matrix
    modes: NDArray[np.float32]
    bent: NDArray[np.float32]
    gram: NDArray[np.float64]

    @classmethod
    def of(
        cls, vertices: NDArray, faces: NDArray, modes: NDArray, longest: float, contact: float = 0.0
    ) -> SurfacePrior:
        """Of a rest mesh (V, 3), (F, 3) and modes (V, 3, K).

        Waves longer than ``longest`` are held by their height rather than by their bending; sheets closer than
        ``contact``, such as closed lips, move together.
        """
        rest = np.asarray(vertices, dtype=np.float64)
        bending, area = bending_energy(rest, faces)
        plate = bending + (2.0 * np.pi / longest) ** 4 * sp.diags(area)
        if contact > 0:
            plate = plate + CONTACT_WEIGHT / contact**2 * _contacts(rest, faces, contact)
        plate = plate.tocsr()
        flat = np.ascontiguousarray(modes, np.float32).reshape(len(rest), -1)
        bent = np.asarray(plate @ flat, np.float32).reshape(3 * len(rest), -1)
        flat = flat.reshape(3 * len(rest), -1)
        return cls(plate, flat, bent, (flat.T @ bent).astype(np.float64))

    def factor(self, measured: Measurements, stiffness: float) -> spl.SuperLU:
        """Of the plate and the measurements with decoupled axes, in single precision: it steers the iterations."""
        points = measured.points
        return symmetric_factor(stiffness * self.plate + points.T @ sp.diags(measured.precision) @ points)

    def move(self, coefficients: NDArray) -> NDArray[np.float64]:
        """(V, 3) change of the vertices by coefficients (K,)."""
        moved: NDArray = self.modes @ np.asarray(coefficients, np.float32)
        return moved.astype(np.float64).reshape(-1, 3)

    def coefficients(
        self, surface: NDArray, stiffness: float, bounds: NDArray
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(K,) coefficients of least energy for a surface (V, 3) within bounds (K, 2), and which lie between them."""
        matrix = stiffness * self.gram + np.eye(len(self.gram))
        right = stiffness * (self.bent.T @ surface.ravel().astype(np.float32)).astype(np.float64)
        found, free = np.zeros(len(right)), np.ones(len(right), bool)
        while free.any():
            held = matrix[np.ix_(free, ~free)] @ found[~free]
            found[free] = la.solve(matrix[np.ix_(free, free)], right[free] - held, assume_a="pos")
            within = np.clip(found, *bounds.T)
            beyond = within != found
            if not beyond.any():
                break
            found, free = within, free & ~beyond
        return found, free


def symmetric_factor(matrix: sp.spmatrix) -> spl.SuperLU:
    """Of a symmetric positive definite matrix, in single precision: it steers iterations."""
    how = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    return spl.splu(matrix.tocsc().astype(np.float32), **how)


def bending_energy(vertices: NDArray, faces: NDArray) -> tuple[sp.csr_matrix, NDArray[np.float64]]:
    """(V, V) matrix of a thin plate's bending energy, and the area (V,) that belongs to each vertex."""
    laplacian = cotangent_laplacian(vertices, faces)
    size = np.linalg.norm(face_cross(vertices, faces), axis=1) / 6.0
    area: NDArray = np.bincount(faces.ravel(), np.repeat(size, 3), minlength=len(vertices))
    area = np.maximum(area, 1e-3 * max(float(np.median(area)), 1e-12))
    return laplacian.T @ sp.diags(1.0 / area) @ laplacian, area


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


def solve_surface(
    prior: SurfacePrior,
    measured: Measurements,
    surface: NDArray,
    bounds: NDArray,
    stiffness: float,
    factor: spl.SuperLU | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The displacement (V, 3) and the coefficients (K,) of least energy.

    Parameters
    ----------
    prior : SurfacePrior
    measured : Measurements
        Relative to the current surface.
    surface : (V, 3)
        The current surface: what modes and displacement together add to the mean.
    bounds : (K, 2)
        Of the coefficients.
    stiffness : float
        Weight of the plate.
    factor : SuperLU, optional
        ``prior.factor`` of these measurements, or of others that are alike.
    """
    factor = factor or prior.factor(measured, stiffness)
    measured = measured.where(measured.precision > 0)
    points, normals, precision = measured.points, measured.normals, measured.precision
    transposed = points.T.tocsr()
    now, free = prior.coefficients(surface, stiffness, bounds)
    held_modes = prior.move(np.where(free, 0.0, now))
    bent, gram = prior.bent[:, free], prior.gram[np.ix_(free, free)]
    start = surface - held_modes
    at_start = points @ start
    along_start = (at_start * normals).sum(1)
    target = along_start + measured.offsets
    held = at_start - along_start[:, None] * normals

    def precondition(r: NDArray) -> NDArray:
        return np.asarray(factor.solve(r.reshape(-1, 3).astype(np.float32)).ravel(), np.float64)

    inner = la.cho_factor(stiffness * gram + np.eye(len(gram)))

    def without_modes(x: NDArray) -> NDArray[np.float64]:
        """What the free modes take from the plate's pull on a surface (V, 3), flat."""
        along_modes = stiffness * (bent.T @ x.ravel().astype(np.float32)).astype(np.float64)
        return np.asarray(bent @ la.cho_solve(inner, along_modes).astype(np.float32), np.float64)

    change, size, goal = np.zeros_like(start), (start.size, start.size), None
    for robust in measured.robust.T:
        residual = measured.offsets - ((points @ change) * normals).sum(1)
        weight = precision / (1.0 + (residual / robust) ** 2) ** 2
        along = SLIDE * weight[:, None]
        across = weight[:, None] - along

        def apply(flat: NDArray, across: NDArray = across, along: NDArray = along) -> NDArray:
            x = flat.reshape(-1, 3)
            at = points @ x
            normal = (at * normals).sum(1, keepdims=True) * normals
            out = (stiffness * (prior.plate @ x) + transposed @ (across * normal + along * at)).ravel()
            return np.asarray(out - stiffness * without_modes(x))

        right = transposed @ ((weight * target)[:, None] * normals + along * held)
        left = right.ravel() - apply(start + change)
        goal = RELATIVE * float(np.linalg.norm(left)) if goal is None else goal  # all weightings are equally exact
        matrix, near = (spl.LinearOperator(size, matvec=each) for each in (apply, precondition))
        step, _ = spl.cg(matrix, left, rtol=0.0, atol=goal, maxiter=MOST_ITERATIONS, M=near)
        change += step.reshape(-1, 3)
    surface = start + change + held_modes
    coefficients, _ = prior.coefficients(surface, stiffness, bounds)
    return surface - prior.move(coefficients), coefficients
