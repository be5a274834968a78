"""What can be learned from a face mesh alone: boundary loops, openings, mirror images, spread-out points."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from mifit.core.mesh import edges

EYES_AND_MOUTH = (range(36, 42), range(42, 48), range(60, 68))
"""iBUG landmarks around the three openings of a face."""


def adjacency(faces: NDArray, n_vertices: int, lengths_of: NDArray | None = None) -> sp.csr_matrix:
    """(V, V) symmetric graph of edges, with weight 1 or the edge's length in the given vertices."""
    e, _ = edges(faces)
    w = np.ones(len(e)) if lengths_of is None else np.linalg.norm(lengths_of[e[:, 0]] - lengths_of[e[:, 1]], axis=1)
    w = np.maximum(w, 1e-12)  # an explicit zero would be no edge
    return sp.csr_matrix(
        (np.r_[w, w], (np.r_[e[:, 0], e[:, 1]], np.r_[e[:, 1], e[:, 0]])), shape=(n_vertices, n_vertices)
    )


def boundary_loops(faces: NDArray, n_vertices: int) -> list[NDArray]:
    """Vertex sets of the connected boundaries, largest first."""
    e, count = edges(faces)
    b = e[count == 1]
    if not len(b):
        return []
    graph = sp.coo_matrix((np.ones(len(b)), (b[:, 0], b[:, 1])), shape=(n_vertices, n_vertices))
    label = csgraph.connected_components(graph, directed=False)[1]
    on = np.unique(b)
    loops = [on[label[on] == k] for k in np.unique(label[on])]
    return sorted(loops, key=len, reverse=True)


def opening_faces(mean: NDArray, faces: NDArray, landmarks: NDArray) -> NDArray[np.bool_]:
    """(F,) faces between the rim of an eye or the mouth and the opening's boundary: no skin to look at.

    An opening is a boundary loop close to the landmarks that surround it. Its faces are those all of whose
    corners are no more edges away from the loop than the landmark nearest to the loop. Meshes with closed
    lids or lips have no such loops, and no such faces.
    """
    n = len(mean)
    out = np.zeros(len(faces), dtype=bool)
    graph = adjacency(faces, n)
    for ring in EYES_AND_MOUTH:
        points = mean[landmarks[list(ring)]]
        centre, width = points.mean(0), np.ptp(points, axis=0).max()
        for loop in boundary_loops(faces, n):
            if np.linalg.norm(mean[loop] - centre, axis=1).max() > width:
                continue
            hops = csgraph.dijkstra(graph, indices=loop, unweighted=True, min_only=True, limit=20)
            rim = hops[landmarks[list(ring)]].min()
            if np.isfinite(rim):  # else the loop is of another piece, such as an eyeball
                out |= hops[faces].max(1) <= rim
    return out


def mirror_map(mean: NDArray, tolerance: float) -> NDArray[np.int32] | None:
    """(V,) index of each vertex's mirror image in x -> -x, or None where the mesh has no such symmetry.

    Parameters
    ----------
    mean : (V, 3) float
    tolerance : float
        How far a mirrored vertex may lie from its partner.
    """
    distance, partner = cKDTree(mean).query(mean * (-1.0, 1.0, 1.0))
    if distance.max() > tolerance or (partner[partner] != np.arange(len(mean))).any():
        return None
    return partner.astype(np.int32)


def farthest_points(points: NDArray, count: int, start: int = 0) -> NDArray[np.int64]:
    """Indices of ``count`` points, each the farthest from those before it."""
    chosen = np.empty(min(count, len(points)), dtype=np.int64)
    chosen[0] = start
    distance = ((points - points[start]) ** 2).sum(1)
    for k in range(1, len(chosen)):
        chosen[k] = distance.argmax()
        np.minimum(distance, ((points - points[chosen[k]]) ** 2).sum(1), out=distance)
    return chosen


def oriented_outwards(mean: NDArray, faces: NDArray) -> NDArray:
    """Triangles turned so that a face's front looks along +z, the side that readers don't agree on."""
    corners = mean[faces].astype(np.float64)
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    front = corners[:, :, 2].mean(1) > np.median(mean[:, 2])
    return faces if n[front, 2].sum() >= 0 else faces[:, [1, 0, 2]]
