"""The built-in model: template, identity, expressions and albedo put together, in centimetres, and kept once made."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import cache_folder
from mifit.errors import InputError
from mifit.morphable.builtin.expressions import expression_modes
from mifit.morphable.builtin.landmarks import landmark_vertices
from mifit.morphable.builtin.template import Template, make_template
from mifit.morphable.gaussian_process import deformation_modes
from mifit.morphable.model import VERSION, MorphableModel, load_own
from mifit.morphable.openings import with_eyes
from mifit.morphable.pigment import skin_model

DENSITY = 0.66
"""Part of the drawn lines; with all of them surfaces are no better, at twice the cost: scan_city and Emily."""


@cache
def builtin_model(coarse: bool = False) -> MorphableModel:
    """The built-in model, made now, read from the cache folder, or still in memory.

    It has about 15 000 vertices, or 9 000 when ``coarse``.
    """
    name = f"builtin-{'coarse' if coarse else 'full'}"
    path = cache_folder() / f"{name}-{VERSION}-{_DIGEST}.npz"
    if path.is_file():
        try:
            model = load_own(path)
        except InputError:
            pass  # damaged: make it anew and replace it
        else:
            with contextlib.suppress(OSError):
                os.utime(path)
            return model
    model = replace(make_head(coarse), fingerprint=f"{name}-{VERSION}")
    try:
        for other in path.parent.glob(f"{name}-*.npz"):
            if time.time() - other.stat().st_mtime > 30 * 86400:  # of other versions, unused for a month
                other.unlink(missing_ok=True)
        model.save(path)
    except (OSError, InputError):
        pass  # a cache that can't be written only costs time
    return model


def make_head(coarse: bool = False) -> MorphableModel:
    """Compute the built-in model: about 15 000 vertices, or 9 000 when ``coarse``; takes seconds."""
    t = make_template(1.0, 2) if coarse else make_template(DENSITY)
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


def _source_digest() -> str:
    """Digest of the code that makes the model: a cached file is valid for this code only."""
    here = Path(__file__).parent
    files = [here.parent / f for f in ("gaussian_process.py", "openings.py", "pigment.py", "topology.py")]
    files += [here.parents[1] / "core" / f for f in ("mesh.py", "mesh_solve.py")]
    h = hashlib.blake2b(digest_size=8)
    for file in sorted([*here.glob("*.py"), *files]):
        h.update(file.read_bytes())
    return h.hexdigest()


_DIGEST = _source_digest()  # at import, while the files are those that were imported
