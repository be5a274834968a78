"""A small z-buffer renderer for pictures of models; nothing is estimated with it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.mesh import vertex_normals
from mifit.morphable.model import MorphableModel

_LIGHTS = (((0.35, 0.55, 0.8), 0.75), ((-0.7, 0.1, 0.5), 0.25))
_AMBIENT = 0.16


def sketch(
    model: MorphableModel,
    identity: ArrayLike | None = None,
    expression: ArrayLike | None = None,
    albedo: ArrayLike | None = None,
    yaw: float = 0.0,
    size: int = 220,
    exposure: float = 1.5,
) -> NDArray[np.float32]:
    """Draw a model with orthographic projection and two soft lights.

    Parameters
    ----------
    identity, expression, albedo : optional
        Coefficients in standard deviations.
    yaw : float
        Degrees by which the head turns to the viewer's left.
    size : int
        Width and height in pixels.

    Returns
    -------
    (size, size, 3) float32
        sRGB-encoded, white background.
    """
    vertices = model.shape(identity, expression).astype(np.float64) * model.unit_mm
    colour = np.clip(model.albedo(albedo), 0.0, 1.0) * exposure
    p = model.mean[model.landmarks].astype(np.float64) * model.unit_mm
    centre = np.array([0.0, p[[27, 33]].mean(0)[1], p[[0, 16]].mean(0)[2] - 10.0])
    extent = 2.1 * (p[17:27, 1].max() - p[8, 1])
    angle = np.radians(-yaw)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    v = (vertices - centre) @ turn.T
    n = vertex_normals(v, model.faces)
    light = _AMBIENT + sum(w * np.clip(n @ (np.array(d) / np.linalg.norm(d)), 0, 1) for d, w in _LIGHTS)
    shaded = colour * light[:, None]
    xy = np.stack([v[:, 0], -v[:, 1]], axis=1) * (size / extent) + size / 2
    image = _splat(xy, v[:, 2], model.faces, shaded, size)
    return np.where(image <= 0.0031308, 12.92 * image, 1.055 * np.maximum(image, 1e-9) ** (1 / 2.4) - 0.055).astype(
        np.float32
    )


def _splat(xy: NDArray, z: NDArray, faces: NDArray, colour: NDArray, size: int) -> NDArray:
    """Rasterise triangles that face the viewer, nearest on top; linear colour on white."""
    corner = xy[faces]
    a, b, c = (corner[:, i] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    front = np.flatnonzero(area < 0)  # y points down: counter-clockwise outside is negative here
    corner, area, faces = corner[front], area[front], faces[front]
    low = np.clip(np.ceil(corner.min(1) - 0.5), 0, size).astype(np.int64)
    high = np.clip(np.floor(corner.max(1) - 0.5) + 1, 0, size).astype(np.int64)
    extent = np.maximum(high - low, 0)
    count = extent[:, 0] * extent[:, 1]
    t = np.repeat(np.arange(len(faces)), count)
    k = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    x, y = low[t, 0] + k % extent[t, 0], low[t, 1] + k // extent[t, 0]
    a, b, c = (corner[t, i] for i in range(3))
    px, py = x + 0.5, y + 0.5
    w1 = ((px - a[:, 0]) * (c[:, 1] - a[:, 1]) - (py - a[:, 1]) * (c[:, 0] - a[:, 0])) / area[t]
    w2 = ((b[:, 0] - a[:, 0]) * (py - a[:, 1]) - (b[:, 1] - a[:, 1]) * (px - a[:, 0])) / area[t]
    w = np.stack([1 - w1 - w2, w1, w2], axis=1)
    inside = (w >= -1e-9).all(1)
    t, x, y, w = t[inside], x[inside], y[inside], w[inside]
    depth = (z[faces[t]] * w).sum(1)
    order = np.argsort(depth, kind="stable")  # painted from far to near: the last write stays
    image = np.ones((size, size, 3))
    image[y[order], x[order]] = (colour[faces[t]] * w[..., None]).sum(1)[order]
    return image
