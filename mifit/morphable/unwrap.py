"""Texture coordinates for meshes that have none."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from mifit.core.mesh import edges
from mifit.errors import InputError
from mifit.morphable.topology import adjacency, closed_borders


def unwrap(mean: NDArray, faces: NDArray, mask: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Texture vertices (T, 2) and indices (F, 3) that lay the masked faces out without overlap.

    A face area that is a disc (holes allowed) becomes one chart: its outer border goes around the unit square and
    every other vertex to the mean of its neighbours (Tutte's embedding, which cannot fold). Anything else is cut
    into charts by xatlas. Faces outside the mask get one spare texture vertex in the corner.
    """
    used = faces[mask]
    uv, corners = _disc(mean, used, closed_borders(used)) or _xatlas(mean, used)
    faces_uv = np.full(faces.shape, len(uv), dtype=np.int32)
    faces_uv[mask] = corners
    return np.vstack([uv, [[0.0, 0.0]]]).astype(np.float32), faces_uv


def _disc(mean: NDArray, faces: NDArray, loops: list[NDArray]) -> tuple[NDArray, NDArray] | None:
    """Tutte's embedding of a disc with holes; None where the faces are no such disc."""
    vertices, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    e, count = edges(local)
    pieces = sp.csgraph.connected_components(adjacency(local, len(vertices)), directed=False)[0]
    if not loops or count.max() > 2 or pieces != 1 or len(vertices) - len(e) + len(faces) != 2 - len(loops):
        return None
    index = {int(v): k for k, v in enumerate(vertices)}
    order = [np.array([index[int(v)] for v in loop]) for loop in loops]
    p = mean[vertices]
    length = [np.linalg.norm(p[o] - np.roll(p[o], 1, axis=0), axis=1).sum() for o in order]
    outer = order.pop(int(np.argmax(length)))
    n = len(vertices)
    extra = [np.stack([np.full(len(o), n + k), o], axis=1) for k, o in enumerate(order)]  # a hub in each hole
    e = np.concatenate([e, *extra])
    total = n + len(order)
    graph = sp.coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(total, total))
    graph = (graph + graph.T).tocsr()
    laplacian = sp.diags(np.asarray(graph.sum(1)).ravel()) - graph
    corner = np.argmin((p[outer, :2] - p[:, :2].min(0)).sum(1))  # start at the lower left
    outer = np.roll(outer, -corner)
    step = np.linalg.norm(np.roll(p[outer], -1, axis=0) - p[outer], axis=1)
    t = np.concatenate([[0.0], np.cumsum(step)[:-1]]) / step.sum()
    uv = np.zeros((total, 2))
    uv[outer] = _square(t)
    free = np.setdiff1d(np.arange(total), outer)
    system = laplacian.tocsc()[free]
    uv[free] = spsolve(system[:, free].tocsc(), -(system[:, outer] @ uv[outer]))
    return 0.01 + 0.98 * uv[:n], local


def _square(t: NDArray) -> NDArray:
    """Points of the unit square's border at fractions of its length, counter-clockwise from the lower left."""
    return np.stack([np.interp(4.0 * t, range(5), corners) for corners in ([0, 1, 1, 0, 0], [0, 0, 1, 1, 0])], axis=1)


def _xatlas(mean: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    try:
        import xatlas
    except ImportError:
        raise InputError(
            "found a face area that is no disc and has no texture coordinates; give it some, or pip install xatlas"
        ) from None

    _, corners, uv = xatlas.parametrize(np.ascontiguousarray(mean, dtype=np.float32), faces.astype(np.uint32))
    return np.clip(uv, 0.0, 1.0), corners
