"""What a model is, in words and pictures: ``mifit model info`` and its preview sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.files import replacing
from mifit.core.mesh import vertex_normals
from mifit.errors import InputError
from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import lacks_eyes

_LIGHTS = (((0.35, 0.55, 0.8), 0.75), ((-0.7, 0.1, 0.5), 0.25))
_AMBIENT = 0.16
"""Directions and weights of the lights of pictures, and what comes from everywhere."""


def model_info(model: MorphableModel) -> str:
    """Return a table of sizes, extents and anything odd, one fact per line."""
    size = np.ptp(model.mean, axis=0) * model.unit_mm

    def spread(modes: NDArray, unit: float) -> str:
        if modes.shape[2] == 0:
            return "none"
        deviation = unit * np.sqrt((modes.astype(np.float64) ** 2).sum((1, 2)).mean())
        return f"{modes.shape[2]} modes, {deviation:.3g} rms"

    bounded = np.isfinite(model.expression_bounds).all(1).sum()
    skin = model.mean_albedo[np.unique(model.faces[model.face_mask])].mean(0)
    expression = spread(model.expression, model.unit_mm)
    rows = [
        ("name", model.name),
        ("digest", model.digest),
        ("vertices", f"{model.n_vertices}"),
        ("faces", f"{len(model.faces)}, of which {model.face_mask.sum()} in the face area"),
        ("texture vertices", f"{len(model.uv)}"),
        ("unit", f"{model.unit_mm:g} mm"),
        ("size", " x ".join(f"{s:.0f}" for s in size) + " mm"),
        ("identity", spread(model.identity, model.unit_mm) + (" mm" if model.n_identity else "")),
        (
            "expression",
            expression + (f" mm, {bounded} bounded" if model.n_expression else ""),
        ),
        ("albedo", spread(model.albedo_modes, 1.0)),
        (
            "mean albedo",
            " ".join(f"{c:.3f}" for c in skin),
        ),
        ("symmetry", "known" if model.symmetry is not None else "unknown"),
        *(("notice", n) for n in notices(model)),
    ]
    width = max(len(k) for k, _ in rows)
    return "\n".join(f"{k:<{width}}  {v}" for k, v in rows)


def notices(model: MorphableModel) -> list[str]:
    """Things about a valid model that a person should know."""
    out = []
    if lacks_eyes(model):
        out.append("its eyes are holes; a fit, and mifit model convert --eyes, put simple ones there")
    if len(model.degenerate_faces):
        out.append(
            f"{len(model.degenerate_faces)} faces of the mean have no area, the first is {model.degenerate_faces[0]}"
        )
    for name, jacobian in (("identity", model.identity_jacobian), ("albedo", model.albedo_jacobian)):
        if jacobian.shape[1] > 1:
            gram = (jacobian.T @ jacobian).astype(np.float64)
            norm = np.sqrt(np.diag(gram))
            if (norm == 0).any():
                out.append(f"{(norm == 0).sum()} {name} modes are zero")
            cosine = np.abs(gram / np.maximum(np.outer(norm, norm), 1e-30)) - np.eye(len(norm))
            if cosine.max() > 0.05:
                out.append(f"{name} modes are not orthogonal: largest cosine {cosine.max():.2f}")
    return out


def save_preview(model: MorphableModel, path: str | Path, modes: int = 4) -> None:
    """Write a PNG sheet: the mean, then the first modes of each kind at -2 and +2 standard deviations."""
    columns = [[sketch(model, yaw=y) for y in (0, 40, 90)]]
    for kind in ("identity", "expression", "albedo"):
        count = getattr(model, f"n_{kind}")
        for k in range(min(modes, count)):
            c = np.zeros(k + 1)
            pair = []
            for sigma in (-2.0, 2.0):
                value = sigma
                if kind == "expression":
                    value = float(np.clip(sigma, *model.expression_bounds[k]))
                c[k] = value
                given = {"identity": None, "expression": None, "albedo": None} | {kind: c.copy()}
                pair.append(sketch(model, given["identity"], given["expression"], given["albedo"], yaw=20))
            columns.append([*pair, np.ones_like(pair[0])])
    sheet = np.concatenate([np.concatenate(column, axis=0) for column in columns], axis=1)
    save_png(sheet, path)


def save_png(image: NDArray, path: str | Path) -> None:
    """Write an sRGB image in 0..1 as an 8-bit PNG, whole or not at all."""
    import cv2

    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: found suffix '{Path(path).suffix}', expected .png")
    bytes_ = (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
    with replacing(path) as temporary:
        if not cv2.imwrite(str(temporary), bytes_[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9]):
            raise InputError(f"{path}: cannot write")


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
