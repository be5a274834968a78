"""The project's own format: one ``.npz`` file with the fields of ``MorphableModel`` under their names."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from mifit.core.arrays import read_npz
from mifit.core.files import replacing
from mifit.errors import InputError
from mifit.morphable.model import MorphableModel

FORMAT_KEY = "mifit_model"
_VERSION = 1


def save_model(model: MorphableModel, path: str | Path) -> None:
    """Write a model; loading it gives back every array bit for bit. InputError where the path isn't ``.npz``."""
    if Path(path).suffix != ".npz":
        raise InputError(f"{path}: found suffix '{Path(path).suffix}', expected .npz")
    arrays = {f.name: np.asarray(getattr(model, f.name)) for f in fields(model) if f.name != "symmetry"}
    if model.symmetry is not None:
        arrays["symmetry"] = model.symmetry
    arrays[FORMAT_KEY] = np.asarray(_VERSION)
    with replacing(path) as temporary:
        np.savez(temporary, **arrays)  # type: ignore[arg-type]


def load_own(path: Path) -> MorphableModel:
    """Read a model written by ``save_model``."""
    data = read_npz(path)
    version = data.pop(FORMAT_KEY)
    if version.shape != () or version != _VERSION:
        raise InputError(f"{path}: {FORMAT_KEY} version {version}, expected {_VERSION}")
    known = {f.name for f in fields(MorphableModel)}
    missing = sorted(known - {"symmetry", "fingerprint"} - set(data))
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}; expected every field of a mifit model")
    unit = data["unit_mm"]
    if unit.shape != () or unit.dtype.kind not in "fiu":
        raise InputError(f"{path}: unit_mm is {unit}, expected a number")
    values: dict = {k: v for k, v in data.items() if k in known}
    values["name"] = str(data["name"])
    values["fingerprint"] = str(data.get("fingerprint", ""))
    values["unit_mm"] = float(unit)
    values["expression_names"] = tuple(str(n) for n in data["expression_names"].ravel())
    return MorphableModel(**values)
