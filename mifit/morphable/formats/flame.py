"""FLAME: ``.pkl`` (read without running it) or ``.npz``. Metres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.arrays import read_npz
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.morphable.assemble import ModelData, single, srgb_albedo
from mifit.morphable.formats.pickles import plain_array, read_pickle
from mifit.morphable.model import MorphableModel

KEYS = ("v_template", "shapedirs", "f")
_TEXTURE, _ALBEDO = "FLAME_texture.npz", "FLAME_albedo_from_BFM.npz"


def load_flame_pickle(path: Path) -> MorphableModel:
    """Read a FLAME pickle; anything in it but arrays is refused by name."""
    return _build(path, read_pickle(path))


def load_flame_npz(path: Path) -> MorphableModel:
    """Read FLAME's arrays from an ``.npz`` file."""
    return _build(path, dict(read_npz(path, KEYS)))


def _build(path: Path, data: Mapping[str, object]) -> MorphableModel:
    missing = [k for k in KEYS if k not in data]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}; found {', '.join(sorted(data)[:12])}")
    mean, directions, faces = (plain_array(data[k], f"{path}: {k}") for k in KEYS)
    if mean.ndim != 2 or mean.shape[1] != 3:
        raise InputError(f"{path}: v_template has shape {mean.shape}, expected (vertices, 3)")
    if directions.ndim != 3 or directions.shape[:2] != mean.shape:
        raise InputError(f"{path}: shapedirs has shape {directions.shape}, expected ({len(mean)}, 3, modes)")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise InputError(f"{path}: f has shape {faces.shape}, expected (triangles, 3)")
    # 300 identity and then 100 expression modes; shorter files split in the same ratio
    split = 300 if directions.shape[2] > 300 else directions.shape[2] * 3 // 4
    faces = faces.astype(np.int64)
    uv, albedo = _texture(path.parent, mean.shape[0], faces)
    return ModelData(
        f"flame:{path.stem}",
        single(mean),
        faces,
        single(directions[:, :, :split]),
        single(directions[:, :, split:]),
        1000.0,
        albedo=albedo,
        uv=uv,
        source=path,
    ).complete()


def _texture(
    folder: Path, n: int, faces: NDArray
) -> tuple[tuple[NDArray, NDArray] | None, tuple[NDArray, NDArray] | None]:
    """UVs and vertex albedo from a texture model in the same folder; (None, None) without one."""
    path = next((folder / f for f in (_ALBEDO, _TEXTURE) if (folder / f).is_file()), None)
    if path is None:
        return None, None
    mean_key, modes_key = ("MU", "PC") if path.name == _ALBEDO else ("mean", "tex_dir")
    data = read_npz(path, (mean_key, modes_key, "vt", "ft"))
    missing = [k for k in (mean_key, modes_key, "vt", "ft") if k not in data]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}")
    mean, modes, vt, ft = data[mean_key], data[modes_key], data["vt"], data["ft"].astype(np.int64)
    if mean.ndim != 3 or mean.shape[2] != 3 or mean.shape[0] != mean.shape[1] or modes.shape[:-1] != mean.shape:
        raise InputError(f"{path}: {mean_key} {mean.shape} and {modes_key} {modes.shape} are no square RGB maps")
    if vt.ndim != 2 or vt.shape[1] != 2 or ft.shape != faces.shape or ft.min() < 0 or ft.max() >= len(vt):
        raise InputError(f"{path}: vt {vt.shape} and ft {ft.shape} don't fit the mesh's {len(faces)} faces")
    place = np.zeros((n, 2))
    place[faces.ravel()] = vt[ft.ravel()]
    colour = sample_map(mean.astype(np.float32), place)
    colour_modes = sample_map(modes.astype(np.float32), place)
    if path.name == _TEXTURE:  # BGR, 0..255
        colour, colour_modes = colour[:, ::-1] / 255.0, colour_modes[:, ::-1] / 255.0
    return (vt.astype(np.float32), ft), srgb_albedo(colour, np.ascontiguousarray(colour_modes))
