"""The built-in model put together: template, identity, expressions and albedo, in centimetres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.builtin.expressions import expression_modes
from mifit.morphable.builtin.landmarks import landmark_vertices
from mifit.morphable.builtin.template import Template, make_template
from mifit.morphable.gaussian_process import deformation_modes
from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import with_eyes
from mifit.morphable.pigment import skin_model


def make_head(coarse: bool = False) -> MorphableModel:
    """Compute the built-in model: about 31 000 vertices, or 8 000 when ``coarse``; takes seconds."""
    t = make_template(2 if coarse else 1)
    landmarks = landmark_vertices(t)
    mask = template_face_mask(t)
    v = t.vertices
    identity = deformation_modes(v, (v[:, 2] > -30.0) & (v[:, 1] > -125.0), 160)
    expression, names, bounds = expression_modes(t)
    mean_albedo, albedo_modes = skin_model(v, t.faces[mask], landmarks, 1.0, 100)
    skin = MorphableModel(
        name="builtin",
        mean=0.1 * (v + np.array([0.0, 34.0, 10.0])),
        faces=t.faces,
        identity=np.float32(0.1) * identity,
        expression=np.float32(0.1) * expression,
        mean_albedo=mean_albedo,
        albedo_modes=albedo_modes,
        uv=t.uv,
        faces_uv=t.faces_uv,
        landmarks=landmarks,
        face_mask=mask,
        symmetry=t.symmetry,
        unit_mm=10.0,
        expression_names=names,
        expression_bounds=bounds,
    )
    return replace(with_eyes(skin), name="builtin:coarse" if coarse else "builtin")


def template_face_mask(t: Template) -> NDArray[np.bool_]:
    """(F,) faces from the hairline to under the jaw and to the ears, without the insides of lids and lips."""
    v = t.vertices
    inside = (v[:, 1] < 76.0) & (v[:, 1] > -120.0) & (v[:, 2] > 8.0 - 0.25 * np.maximum(v[:, 1], 0.0))
    out = np.asarray(inside[t.faces].all(1))
    hidden = np.zeros(len(v), dtype=bool)
    for margin in (t.upper_lids, t.lower_lids, t.upper_lip, t.lower_lip):
        hidden[margin] = True
    return out & ~hidden[t.faces].any(1)
