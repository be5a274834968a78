"""Load a model of whatever kind: files and folders are recognised by content, not by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from mifit.core.arrays import npz_keys
from mifit.core.files import cache_folder, check_file
from mifit.core.limits import MAX_MODEL_BYTES
from mifit.errors import InputError
from mifit.morphable.builtin import builtin_model
from mifit.morphable.formats import bfm_mat
from mifit.morphable.formats.bfm_h5 import load_bfm_h5
from mifit.morphable.formats.eos import load_eos, looks_like_eos
from mifit.morphable.formats.flame import KEYS as FLAME_KEYS
from mifit.morphable.formats.flame import load_flame_npz, load_flame_pickle
from mifit.morphable.formats.gnm import KEYS as GNM_KEYS
from mifit.morphable.formats.gnm import load_gnm
from mifit.morphable.formats.ict import is_ict_folder, is_ict_npz, load_ict_folder, load_ict_npz
from mifit.morphable.formats.mat5 import is_mat5, mat_names
from mifit.morphable.formats.pickles import is_pickle
from mifit.morphable.model import FORMAT_KEY, MorphableModel, load_own
from mifit.morphable.openings import SUFFIX, with_eyes

BUILTIN = ("builtin", "builtin:coarse")

KINDS: dict[str, Callable[[Path], MorphableModel]] = {
    "mifit": load_own,
    "ict-npz": load_ict_npz,
    "ict-folder": load_ict_folder,
    "flame-npz": load_flame_npz,
    "gnm": load_gnm,
    "flame-pickle": load_flame_pickle,
    "bfm2009": bfm_mat.load_bfm2009,
    "3ddfa": bfm_mat.load_3ddfa,
    "deep3d": bfm_mat.load_deep3d,
    "bfm-h5": load_bfm_h5,
    "eos": load_eos,
}
"""Every kind of model file and its loader; ``mifit model convert --kind`` takes these names."""


def fetched_model(name: str) -> Path:
    """Where ``mifit model fetch`` puts a model, whether it is there or not."""
    return cache_folder() / "models" / f"{name}.npz"


def automatic_model() -> str:
    """What ``auto`` stands for: the fetched ICT-FaceKit where it is there, else ``builtin``."""
    path = fetched_model("ict")
    return str(path) if path.is_file() else "builtin"


def load_model(path: str | Path, kind: str | None = None) -> MorphableModel:
    """Load ``"builtin"``, ``"builtin:coarse"``, or a file or folder of a known kind; see `MorphableModel.load`."""
    if str(path) in BUILTIN:
        return builtin_model(coarse=str(path) == "builtin:coarse")
    base = str(path).removesuffix(SUFFIX)
    if base != str(path) and base and not Path(path).exists():
        return with_eyes(MorphableModel.load(base, kind))
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such model; expected {', '.join(BUILTIN)} or an existing file or folder")
    if kind is not None and kind not in KINDS:
        raise InputError(f"kind '{kind}' is unknown, expected one of {', '.join(KINDS)}")
    try:
        model = KINDS[kind or recognise(path)](path)
    except OSError as error:
        raise InputError(f"{path}: cannot read: {error}") from None
    _refuse_flat(model)
    return model


def _refuse_flat(model: MorphableModel) -> None:
    points = model.mean[model.landmarks].astype(np.float64)
    extent = np.linalg.svd(points - points.mean(0), compute_uv=False) * model.unit_mm / len(points) ** 0.5
    if extent[2] < 0.02 * extent[0]:  # heads have 0.3 and more
        found = " x ".join(f"{length:.3g}" for length in extent)
        raise InputError(f"{model.name}: the landmarks spread by {found} mm, in a plane; expected a face")


def recognise(path: Path) -> str:
    """Key of ``KINDS`` for a file or folder, by content; raises InputError when nothing fits."""
    if path.is_dir():
        if is_ict_folder(path):
            return "ict-folder"
        raise InputError(f"{path}: a folder without generic_neutral_mesh.obj and vertex_indices.json")
    check_file(path, MAX_MODEL_BYTES, "model file")
    keys = npz_keys(path)
    if keys is not None:
        for kind, fits in (
            ("mifit", FORMAT_KEY in keys),
            ("ict-npz", is_ict_npz(keys)),
            ("flame-npz", set(FLAME_KEYS) <= set(keys)),
            ("gnm", set(GNM_KEYS) <= set(keys)),
        ):
            if fits:
                return kind
        raise InputError(f"{path}: .npz with keys {', '.join(sorted(keys)[:8])}, expected those of a known model")
    if is_mat5(path):
        names = set(mat_names(path))
        for kind, needed in (
            ("bfm2009", bfm_mat.BFM_KEYS),
            ("3ddfa", bfm_mat.DDFA_KEYS),
            ("deep3d", bfm_mat.DEEP3D_KEYS),
        ):
            if len(names & set(needed)) * 2 > len(needed):  # most keys: the loader names those that are missing
                return kind
        raise InputError(f"{path}: MATLAB file with {', '.join(sorted(names)[:8])}, expected keys of a known model")
    if h5py.is_hdf5(path):
        return "bfm-h5"
    if is_pickle(path):
        return "flame-pickle"
    if looks_like_eos(path):
        return "eos"
    raise InputError(
        f"{path}: not a model of a known kind ({path.stat().st_size} bytes); expected .npz, .mat (version 5), .h5, "
        "FLAME .pkl, eos .bin or an ICT-FaceKit folder"
    )
