"""Corrections of unit normals in a chart without poles.

The unknowns x are stereographic offsets in the tangent plane of a base normal n0: with q = x / 2,

    n(x) = (2 q1 t1 + 2 q2 t2 + (1 - |q|^2) n0) / (1 + |q|^2),

so |n| = 1 always, n(0) = n0, dn/dx(0) = (t1, t2), and the chart is smooth everywhere but at -n0, which never faces
the viewer. Spherical coordinates about a fixed axis have two poles on the head; this chart has none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.core.uv import TexelMap


def tangent_plane(normals: NDArray) -> NDArray:
    """Two unit tangents per normal, (N, 3) -> (N, 2, 3), right-handed with it (Duff et al. 2017)."""
    x, y, z = np.asarray(normals, dtype=np.float64).T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    return np.stack([first, np.stack([b, sign + y * y * a, -y], axis=1)], axis=1)


def bend(normals: NDArray, tangents: NDArray, offsets: NDArray) -> NDArray:
    """Normals n(x) from base normals (N, 3), tangents (N, 2, 3) and offsets (N, 2)."""
    q = 0.5 * offsets
    square = (q**2).sum(1, keepdims=True)
    bent = 2.0 * np.einsum("na,nac->nc", q, tangents) + (1.0 - square) * normals
    return bent / (1.0 + square)


def unbend(normals: NDArray, tangents: NDArray, bent: NDArray) -> NDArray:
    """Offsets (N, 2) that turn the base normals into the bent ones; inverse of `bend`."""
    along = np.einsum("nc,nac->na", bent, tangents)
    return 2.0 * along / np.maximum(1.0 + (bent * normals).sum(1, keepdims=True), 1e-6)


def transport(normals: NDArray, tangents: NDArray, target: NDArray) -> NDArray:
    """Tangents (N, 2, 3) of the base normals carried to other normals (N, 3) by the smallest rotation."""
    axis = normals + target
    scale = 2.0 / np.maximum((axis**2).sum(1), 1e-9)
    # A reflection at the bisecting plane takes n to -target and t to t - 2 (t.axis)/|axis|^2 axis.
    along = np.einsum("nac,nc->na", tangents, axis) * scale[:, None]
    return tangents - along[:, :, None] * axis[:, None, :]


def texel_neighbours(texels: TexelMap) -> NDArray[np.int64]:
    """(N, 4) neighbours (up, down, left, right) of each covered texel, as positions among the covered ones.

    A neighbour outside the charts is the texel itself, so that differences to it vanish.
    """
    size = texels.size
    number = np.full((size + 2, size + 2), -1, dtype=np.int64)
    row, column = np.divmod(texels.index, size)
    number[row + 1, column + 1] = np.arange(len(texels.index))
    found = np.stack([number[row + 1 + r, column + 1 + c] for r, c in ((-1, 0), (1, 0), (0, -1), (0, 1))], axis=1)
    return np.where(found >= 0, found, np.arange(len(texels.index))[:, None])
