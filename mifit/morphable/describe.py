"""What a model is, in words and pictures: ``mifit model info`` and its preview sheet."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.files import write_bytes
from mifit.core.image import encode_png, linear_to_srgb
from mifit.core.mesh import face_cross, vertex_normals
from mifit.errors import InputError
from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import lacks_eyes

_LIGHTS = (((0.35, 0.55, 0.8), 0.75), ((-0.7, 0.1, 0.5), 0.25))
"""Directions and weights of the lights of pictures."""


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
        ("expression", expression + (f" mm, {bounded} bounded" if model.n_expression else "")),
        ("albedo", spread(model.albedo_modes, 1.0)),
        ("mean albedo", " ".join(f"{c:.3f}" for c in skin)),
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
            limits = model.expression_bounds[k] if kind == "expression" else (-np.inf, np.inf)
            pair = [
                sketch(model, **{kind: np.eye(k + 1)[k] * np.clip(sigma, *limits)}, yaw=20) for sigma in (-2.0, 2.0)
            ]
            columns.append([*pair, np.ones_like(pair[0])])
    sheet = np.concatenate([np.concatenate(column, axis=0) for column in columns], axis=1)
    save_png(sheet, path)


def save_png(image: NDArray, path: str | Path) -> None:
    """Write an sRGB image in 0..1 as an 8-bit PNG, whole or not at all."""
    if Path(path).suffix.lower() != ".png":
        raise InputError(f"{path}: found suffix '{Path(path).suffix}', expected .png")
    write_bytes(path, encode_png((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)))


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
    normals = vertex_normals(v, model.faces)
    light = 0.16 + sum(w * np.clip(normals @ (np.array(d) / np.linalg.norm(d)), 0, 1) for d, w in _LIGHTS)
    corners = (np.stack([v[:, 0], -v[:, 1]], axis=1) * (size / extent) + size / 2 - 0.5)[model.faces]
    shaded = linear_to_srgb((colour * light[:, None])[model.faces].mean(1))
    image = np.ones((size, size, 3), dtype=np.float32)
    front = face_cross(v, model.faces)[:, 2] > 0
    for face in np.argsort(v[model.faces, 2].mean(1)):  # from far to near
        if front[face]:
            cv2.fillConvexPoly(image, np.round(corners[face] * 16).astype(int), shaded[face].tolist(), shift=4)
    return image
