"""Self-intersections of a triangle mesh, by brute force over close pairs of edge and triangle."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.spatial import cKDTree

from mifit.core.mesh import edges


def intersections(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N, 2) edge's first vertex and face index of every edge that pierces a triangle it shares no vertex with."""
    e, _ = edges(faces)
    a, b = vertices[e[:, 0]], vertices[e[:, 1]]
    corners = vertices[faces]
    centre = corners.mean(1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(1)
    middle, half = 0.5 * (a + b), 0.5 * np.linalg.norm(b - a, axis=1)
    found = [np.zeros((0, 2), int)]
    # short and long ones apart, so that one long one doesn't make all pairs close
    sizes = ((0.0, 1.5), (1.5, 3.0), (3.0, 6.0), (6.0, np.inf))
    for (low, high), (least, most) in itertools.product(sizes, sizes):
        rows, some = np.flatnonzero((half >= low) & (half < high)), np.flatnonzero((reach >= least) & (reach < most))
        if not len(rows) or not len(some):
            continue
        far = half[rows].max() + reach[some].max()
        pairs = cKDTree(middle[rows]).sparse_distance_matrix(cKDTree(centre[some]), far, output_type="ndarray")
        i, j = rows[pairs["i"]], some[pairs["j"]]
        close = pairs["v"] < half[i] + reach[j]
        i, j = i[close], j[close]
        apart = (faces[j][:, :, None] != e[i][:, None, :]).all((1, 2))
        i, j = i[apart], j[apart]
        hit = _pierces(a[i], b[i], corners[j])
        found.append(np.stack([e[i[hit], 0], j[hit]], axis=1))
    return np.concatenate(found)


def _pierces(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Whether segments cross triangles (Möller and Trumbore), with a hundredth of a micrometre to spare."""
    u, v, d = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0], b - a
    p = np.cross(d, v)
    det = (u * p).sum(1)
    ok = np.abs(det) > 1e-12
    inverse = 1.0 / np.where(ok, det, 1.0)
    s = a - t[:, 0]
    x = (s * p).sum(1) * inverse
    q = np.cross(s, u)
    y = (d * q).sum(1) * inverse
    z = (v * q).sum(1) * inverse
    eps = 1e-5
    return ok & (x > eps) & (y > eps) & (x + y < 1 - eps) & (z > eps) & (z < 1 - eps)
