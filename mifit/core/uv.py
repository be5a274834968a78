"""UV space: which point of the surface each texel of a map shows, and how maps are read.

A map is an (S, S, ...) array with row 0 at v = 1; the centre of texel (row, column) lies at
u = (column + 0.5) / S, v = 1 - (row + 0.5) / S.

Corrections of unit normals in a chart without poles.

The unknowns x are stereographic offsets in the tangent plane of a base normal n0: with q = x / 2,

    n(x) = (2 q1 t1 + 2 q2 t2 + (1 - |q|^2) n0) / (1 + |q|^2),

so |n| = 1 always, n(0) = n0, dn/dx(0) = (t1, t2), and the chart is smooth everywhere but at -n0, which never faces
the viewer. Spherical coordinates about a fixed axis have two poles on the head; this chart has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.core.arrays import Recent, content_key


@dataclass(frozen=True)
class TexelMap:
    """Surface points of the texels of one square map of ``size`` texels a side.

    ``index`` (N,) is the flat index (row * size + column) of each covered texel, ascending; ``face`` (N,) its face, and
    ``weights`` (N, 3) the barycentric weights of the face's corners.
    """

    size: int
    index: NDArray[np.int64]
    face: NDArray[np.int32]
    weights: NDArray[np.float32]

    def to_map(self, values: NDArray, fill: float = 0.0) -> NDArray:
        """Scatter per-texel values (N, ...) into a map (S, S, ...)."""
        out = np.full((self.size * self.size, *values.shape[1:]), fill, dtype=values.dtype)
        out[self.index] = values
        return out.reshape(self.size, self.size, *values.shape[1:])

    def from_map(self, image: NDArray) -> NDArray:
        """Gather a map (S, S, ...) into per-texel values (N, ...)."""
        return image.reshape(self.size * self.size, *image.shape[2:])[self.index]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(S, S) coverage."""
        out = np.zeros(self.size * self.size, dtype=bool)
        out[self.index] = True
        return out.reshape(self.size, self.size)


_maps = Recent[TexelMap](8)  # stages read the same few


def rasterize_uv(uv: NDArray, faces_uv: NDArray, size: int, face_mask: NDArray | None = None) -> TexelMap:
    """The face and the barycentric weights under the centre of every texel.

    ``uv`` (T, 2) are texture vertices in [0, 1], ``faces_uv`` (F, 3) their indices per face; ``face_mask`` (F,) selects
    faces. Faces that reach outside [0, 1] are clipped to the map.
    """
    key = content_key(size, uv, faces_uv, face_mask)
    return _maps.get(key, lambda: _rasterize(uv, faces_uv, size, face_mask))


def _rasterize(uv: NDArray, faces_uv: NDArray, size: int, face_mask: NDArray | None) -> TexelMap:
    """`rasterize_uv`, where it isn't known yet; arrays that can't be written to, since others read them as well."""
    selected = np.arange(len(faces_uv)) if face_mask is None else np.flatnonzero(face_mask)
    corners = uv[faces_uv[selected]].astype(np.float64) * (size, -size) + (0.0, size)  # pixel x, y
    low = np.clip(np.ceil(corners.min(1) - 0.5), 0, size).astype(np.int64)
    high = np.clip(np.floor(corners.max(1) - 0.5) + 1, 0, size).astype(np.int64)
    extent = np.maximum(high - low, 0)
    count = extent[:, 0] * extent[:, 1]
    tri = np.repeat(np.arange(len(selected)), count)
    k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    x = low[tri, 0] + k % np.maximum(extent[tri, 0], 1)
    y = low[tri, 1] + k // np.maximum(extent[tri, 0], 1)
    a, b, c = (corners[:, i] for i in range(3))
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        # The second and third corner's weights are products with these (F, 2), from the first corner on.
        second, third = (np.stack(w, 1) / area[:, None] for w in ((ac[:, 1], -ac[:, 0]), (-ab[:, 1], ab[:, 0])))
        px, py = x + 0.5 - a[tri, 0], y + 0.5 - a[tri, 1]
        w1, w2 = (px * slope[tri, 0] + py * slope[tri, 1] for slope in (second, third))
        w = np.stack([1.0 - w1 - w2, w1, w2], axis=1)  # degenerate faces give NaN or infinity, refused below
    inside = np.flatnonzero((np.minimum(np.minimum(w1, w2), w[:, 0]) >= -1e-9) & np.isfinite(w1) & np.isfinite(w2))
    first = np.full(size * size, -1)
    first[(y * size + x)[inside[::-1]]] = inside[::-1]  # of faces that share a texel the first one counts
    flat = np.flatnonzero(first >= 0)
    chosen = first[flat]
    found = flat, selected[tri[chosen]].astype(np.int32), w[chosen].astype(np.float32)
    for array in found:
        array.flags.writeable = False
    return TexelMap(size, *found)


def sample_map(image: NDArray, uv: NDArray) -> NDArray:
    """Bilinear look-up of a map (S, S, ...) at (N, 2) texture coordinates, clamped at the border."""
    size = image.shape[0]
    x = np.clip(uv[:, 0] * size - 0.5, 0, size - 1)
    y = np.clip((1.0 - uv[:, 1]) * size - 0.5, 0, size - 1)
    return bilinear(image, x, y)


def bilinear(image: NDArray, x: NDArray, y: NDArray) -> NDArray:
    """Bilinear look-up of (H, W, ...) at integer-centred column x and row y (N,), clamped at the border."""
    h, w = image.shape[:2]
    x, y = np.clip(x, 0, w - 1), np.clip(y, 0, h - 1)
    x0 = np.minimum(x.astype(np.int64), max(w - 2, 0))
    y0 = np.minimum(y.astype(np.int64), max(h - 2, 0))
    x1, y1 = np.minimum(x0 + 1, w - 1), np.minimum(y0 + 1, h - 1)
    shape = (-1,) + (1,) * (image.ndim - 2)
    fx, fy = (x - x0).reshape(shape).astype(image.dtype), (y - y0).reshape(shape).astype(image.dtype)
    # Pixels by one number: NumPy takes three times as long to find them by two.
    pixels, at, below = image.reshape(h * w, *image.shape[2:]), y0 * w + x0, (y1 - y0) * w
    right = x1 - x0
    top = pixels.take(at, 0) * (1 - fx) + pixels.take(at + right, 0) * fx
    at += below
    bottom = pixels.take(at, 0) * (1 - fx) + pixels.take(at + right, 0) * fx
    return top * (1 - fy) + bottom * fy


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
    bent = 2.0 * (q[:, :1] * tangents[:, 0] + q[:, 1:] * tangents[:, 1]) + (1.0 - square) * normals
    return bent / (1.0 + square)


def bend_jacobian(normals: NDArray, tangents: NDArray, offsets: NDArray) -> NDArray:
    """(N, 2, 3) derivatives of `bend` by the offsets."""
    q = 0.5 * offsets
    total = normals + bend(normals, tangents, offsets)
    return (tangents - q[:, :, None] * total[:, None]) / (1.0 + (q**2).sum(1))[:, None, None]


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
