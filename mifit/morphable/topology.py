"""What can be learned from a face mesh alone: loops, openings, mirror images, spread-out points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from mifit.core.files import read_json
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.core.mesh import edges
from mifit.errors import InputError

EYES_AND_MOUTH = (range(36, 42), range(42, 48), range(60, 68))
"""iBUG landmarks around the three openings of a face."""
BROWS = (range(17, 22), range(22, 27))
"""iBUG landmarks of the brows."""
FOREHEAD = 0.75
"""Heights of forehead and ears, in thirds of a face."""

INNER = np.arange(17, 68)
"""Those inside the face: the first ones lie on its contour, and slide over it as the head turns."""

IBUG_MIRROR = np.array(
    [
        *range(16, -1, -1),
        *range(26, 16, -1),
        *range(27, 31),
        *range(35, 30, -1),
        *(45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40),
        *(54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55),
        *(64, 63, 62, 61, 60, 67, 66, 65),
    ]
)
"""The iBUG point that is the mirror image of each iBUG point."""


def read_landmark_file(path: Path) -> NDArray[np.int64]:
    """Read a JSON list of 68 vertex indices, 0-based, in iBUG order."""
    values = read_json(path, MAX_SETTINGS_BYTES, "landmark file")
    if not isinstance(values, list) or len(values) != 68 or not all(type(v) is int for v in values):
        raise InputError(f"{path}: expected a list of 68 vertex indices in iBUG order")
    return np.array(values)


def adjacency(faces: NDArray, n_vertices: int) -> sp.csr_matrix:
    """(V, V) symmetric graph of edges, with weight 1."""
    e, _ = edges(faces)
    rows, columns = np.r_[e[:, 0], e[:, 1]], np.r_[e[:, 1], e[:, 0]]
    return sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n_vertices, n_vertices))


def closed_borders(faces: NDArray) -> list[NDArray[np.int64]]:
    """Vertices of each closed border of some faces (F, 3), in order."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    codes = sides.min(axis=1) * (int(faces.max()) + 1) + sides.max(axis=1)
    _, first, count = np.unique(codes, return_index=True, return_counts=True)
    following = dict(sides[first[count == 1]].tolist())
    found = []
    for start in list(following):
        if start not in following:
            continue
        loop, vertex = [start], following.pop(start)
        while vertex != start and vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == start and len(loop) > 2:
            found.append(np.array(loop))
    return found


def opening_faces(mean: NDArray, faces: NDArray, landmarks: NDArray) -> NDArray[np.bool_]:
    """(F,) faces between the rim of an eye or the mouth and the opening's boundary: no skin to look at.

    An opening is a boundary loop close to the landmarks that surround it. Its faces are those all of whose
    corners are no more edges away from the loop than the landmark nearest to the loop. Meshes with closed
    lids or lips have no such loops, and no such faces.
    """
    n = len(mean)
    out = np.zeros(len(faces), dtype=bool)
    graph = adjacency(faces, n)
    loops = closed_borders(faces)
    for ring in EYES_AND_MOUTH:
        points = mean[landmarks[list(ring)]]
        centre, width = points.mean(0), np.ptp(points, axis=0).max()
        for loop in loops:
            if np.linalg.norm(mean[loop] - centre, axis=1).max() > width:
                continue
            hops = csgraph.dijkstra(graph, indices=loop, unweighted=True, min_only=True, limit=20)
            rim = hops[landmarks[list(ring)]].min()
            if np.isfinite(rim):  # else the loop is of another piece, such as an eyeball
                out |= hops[faces].max(1) <= rim
    return out


def mirror_map(mean: NDArray, tolerance: float) -> NDArray[np.int32] | None:
    """(V,) index of each vertex's mirror image in x -> -x, or None where the mesh has no such symmetry.

    ``tolerance`` is how far a mirrored vertex may lie from its partner.
    """
    distance, partner = cKDTree(mean).query(mean * (-1.0, 1.0, 1.0))
    if distance.max() > tolerance or (partner[partner] != np.arange(len(mean))).any():
        return None
    return partner.astype(np.int32)


def farthest_points(points: NDArray, count: int) -> NDArray[np.int64]:
    """Indices of ``count`` points, each the farthest from those before it."""
    chosen = np.empty(min(count, len(points)), dtype=np.int64)
    chosen[0] = 0
    distance = ((points - points[0]) ** 2).sum(1)
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


def scalp_depth(points: NDArray, landmarks: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(V,) how far points (V, 3) lie behind the hairline, and above the ears, in thirds of a face; negative outside.

    A third reaches from the base of the nose to the brows. Seen from the side the hairline is straight: from `FOREHEAD`
    above the brows to the upper end of the jaw. Ears reach up to the outer ends of the brows, and back as far behind
    the jaw. Behind them the scalp ends as low as the nose. ``landmarks`` (68,) are indices of points.
    """
    points = points.astype(np.float64)
    marks = points[landmarks]
    nose, brow, jaw = marks[33, 1], marks[17:27, 1].max(), marks[[0, 16], 1:].mean(axis=0)
    third = max(brow - nose, 1e-9)
    height = min(brow + FOREHEAD * third, points[:, 1].max())
    line = np.array([height, points[points[:, 1] >= height, 2].max()]) - jaw
    behind = (points[:, 1:] - jaw) @ np.array([line[1], -line[0]]) / max(np.linalg.norm(line) * third, 1e-9)
    beyond = np.minimum(points[:, 1] - nose, jaw[1] - FOREHEAD * third - points[:, 2])
    return behind, np.maximum(points[:, 1] - marks[[17, 26], 1].mean(), beyond) / third
