"""Self-intersections of a triangle mesh, by brute force over close pairs of edge and triangle."""

from __future__ import annotations

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
    half = 0.5 * np.linalg.norm(b - a, axis=1)
    found = []
    # short and long triangles apart, so that one long one doesn't make all pairs close
    for low, high in ((0.0, 3.0), (3.0, 6.0), (6.0, np.inf)):
        some = np.flatnonzero((reach >= low) & (reach < high))
        if not len(some):
            continue
        tree = cKDTree(centre[some])
        near = tree.query_ball_point(0.5 * (a + b), half + reach[some].max(), return_sorted=False)
        count = np.array([len(n) for n in near])
        if not count.sum():
            continue
        i = np.repeat(np.arange(len(e)), count)
        j = some[np.concatenate([n for n in near if n])]
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
