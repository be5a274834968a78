"""What a model is, in words and pictures: ``mifit model info`` and its preview sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import replacing
from mifit.errors import InputError
from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import lacks_eyes
from mifit.morphable.sketch import sketch


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
