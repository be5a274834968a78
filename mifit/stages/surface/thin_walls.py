"""Thin parts of the surface, such as the wings of the nose, keep their two sides apart.

Nothing sees the inside of a nostril, so nothing holds it back where the outside moves inwards: it would come through
the skin and show as a hole. Pairs of vertices on both sides of such walls are found on the model's mean; where a fit
leaves less than a part of their distance, the side that lies in a cavity gives way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import edges, normalize, vertex_normals
from mifit.morphable import MorphableModel
from mifit.stages.geometry.surfaces import moved_by, object_shapes

THICKEST_MM, CAVITY_MM = 6.0, 15.0
"""Distance between the sides of a wall, and between the sides of a cavity, at the most."""
OPPOSED, ACROSS = -0.5, 0.7
"""Largest cosine between the normals of both sides, and least one between them and the way across."""
KEPT = 0.3
"""Part of a wall's thickness in the model's mean that a fit keeps."""
SMOOTH = 0.1
"""Weight of the movement's bending against the walls."""
PASSES = 4


@dataclass(frozen=True)
class Walls:
    """Pairs of vertices of the model, one on either side of a wall.

    Attributes
    ----------
    outer, inner : (N,) int
        The inner ones lie in a cavity, the outer ones don't.
    thickness : (N,)
        In the model's mean, its units.
    giving : (M,) int
        All vertices in cavities.
    """

    outer: NDArray[np.int64]
    inner: NDArray[np.int64]
    thickness: NDArray[np.float64]
    giving: NDArray[np.int64]

    @classmethod
    def of(cls, model: MorphableModel) -> Walls:
        """Of the mean of a model's face area."""
        mean = model.mean.astype(np.float64)
        normal = vertex_normals(mean, model.faces)
        used = np.unique(model.faces[model.face_mask])
        _, hollow = _opposite(mean, normal, used, CAVITY_MM / model.unit_mm, 1.0)
        cavity = np.zeros(len(mean), bool)
        cavity[hollow] = True
        other, vertex = _opposite(mean, normal, used, THICKEST_MM / model.unit_mm, -1.0)
        walls = cavity[other] & ~cavity[vertex]
        outer, inner = vertex[walls], other[walls]
        return cls(outer, inner, ((mean[outer] - mean[inner]) * normal[outer]).sum(1), np.flatnonzero(cavity))


def _opposite(
    mean: NDArray, normal: NDArray, used: NDArray, reach: float, side: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The nearest vertex across, outside (1) or inside (-1) the surface, and the vertex itself, where there is one."""
    pairs = used[cKDTree(mean[used]).query_pairs(reach, output_type="ndarray")]
    first, second = normal[pairs[:, 0]], normal[pairs[:, 1]]
    pairs = pairs[np.einsum("nc,nc->n", first, second) < OPPOSED]  # few of many: first of all
    here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
    way = mean[there] - mean[here]
    length = np.linalg.norm(way, axis=1)
    along = side * (way * normal[here]).sum(1) > ACROSS * length
    facing = -side * (way * normal[there]).sum(1) > ACROSS * length
    good = along & facing
    here, there, length = here[good], there[good], length[good]
    order = np.lexsort((length, here))
    _, first = np.unique(here[order], return_index=True)
    return there[order][first].astype(np.int64), here[order][first].astype(np.int64)


def keep_walls(model: MorphableModel, geometry: GeometryEstimate) -> tuple[GeometryEstimate, int]:
    """Move what lies in cavities back behind the skin.

    Parameters
    ----------
    model : MorphableModel
    geometry : GeometryEstimate

    Returns
    -------
    geometry : GeometryEstimate
        With ``displacement`` and ``vertices`` changed in cavities only; the input where all walls keep their part.
    count : int
        Pairs of vertices that were too near or had crossed.
    """
    walls = Walls.of(model)
    if not len(walls.outer):
        return geometry, 0
    count = 0
    for _ in range(PASSES):
        shapes = object_shapes(model, geometry)
        normal = normalize(np.mean([vertex_normals(shape, model.faces) for shape in shapes], axis=0))[walls.outer]
        left = [((shape[walls.outer] - shape[walls.inner]) * normal).sum(1) for shape in shapes]
        lacking = KEPT * walls.thickness - np.min(left, axis=0)
        near = lacking > 0
        count = count or int(near.sum())
        if not near.any():
            break
        geometry = moved_by(model, geometry, _give_way(model, walls, near, -lacking[near, None] * normal[near]))
    return geometry, count


def _give_way(model: MorphableModel, walls: Walls, near: NDArray, movement: NDArray) -> NDArray[np.float64]:
    """(V, 3) movement of the vertices in cavities that takes those of near pairs by (n, 3), with little bending."""
    giving = walls.giving
    links, _ = edges(model.faces)
    ones = np.ones(len(links))
    half = sp.coo_matrix((ones, (links[:, 0], links[:, 1])), (model.n_vertices,) * 2)
    tied = (half + half.T).tocsr()
    laplacian = (sp.diags(np.asarray(tied.sum(axis=1)).ravel()) - tied).tocsr()[:, giving]
    inner = walls.inner[near]
    asked = sp.csr_matrix((np.ones(len(inner)), (np.arange(len(inner)), inner)), (len(inner), model.n_vertices))[
        :, giving
    ]
    system = asked.T @ asked + SMOOTH * (laplacian.T @ laplacian)
    out = np.zeros((model.n_vertices, 3))
    out[giving] = spl.splu(system.tocsc()).solve(asked.T @ movement)
    return out
