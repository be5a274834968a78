"""Load a model of whatever kind: files and folders are recognised by content, not by name."""

from __future__ import annotations

from pathlib import Path

from mifit.errors import InputError
from mifit.morphable.builtin import builtin_model
from mifit.morphable.formats.archive import npz_keys
from mifit.morphable.formats.ict import is_ict_npz, load_ict_npz
from mifit.morphable.formats.own import FORMAT_KEY, load_own
from mifit.morphable.model import MorphableModel


def load_model(path: str | Path) -> MorphableModel:
    """Load ``"builtin"``, ``"builtin:coarse"``, or a file or folder of a known format.

    Raises
    ------
    InputError
        The file is missing, damaged or of no known kind.
    """
    if str(path) in ("builtin", "builtin:coarse"):
        return builtin_model(coarse=str(path) == "builtin:coarse")
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such model; expected 'builtin', 'builtin:coarse' or an existing file or folder")
    keys = npz_keys(path)
    if keys is not None:
        if FORMAT_KEY in keys:
            return load_own(path)
        if is_ict_npz(keys):
            return load_ict_npz(path)
        raise InputError(f"{path}: .npz with keys {', '.join(sorted(keys)[:8])}, expected those of a known model")
    raise InputError(f"{path}: not a model file of a known kind")
