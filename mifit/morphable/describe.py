"""What a model is, in words: ``mifit model info``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import lacks_eyes


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
    return out
