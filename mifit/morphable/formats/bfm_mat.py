"""Basel Face Model 2009 and what was cut from it, in MATLAB files.

``01_MorphableModel.mat`` itself, with FaceWarehouse expressions where they lie beside it; 3DDFA's ``Model_Shape.mat``
with ``Model_Expression.mat`` beside it, in micrometres; Deep3DFaceRecon's ``BFM_model_front.mat``, in decimetres, modes
scaled by their deviations, colours 0..255.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import opened, read_text
from mifit.core.limits import MAX_MODEL_BYTES, MAX_SETTINGS_BYTES
from mifit.errors import InputError
from mifit.morphable.assemble import ModelData, find_face_mask, interleaved, single, srgb_albedo
from mifit.morphable.formats.mat5 import read_mat
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import oriented_outwards

BFM_KEYS = ("shapeMU", "shapePC", "shapeEV", "texMU", "texPC", "texEV", "tl")
DDFA_KEYS = ("mu_shape", "w", "sigma", "tri", "keypoints")
DEEP3D_KEYS = ("meanshape", "meantex", "idBase", "exBase", "texBase", "tri", "keypoints")


def load_bfm2009(path: Path, add_expression_mean: bool = False) -> MorphableModel:
    """Read the model; micrometres, colours 0..255 in sRGB, standard deviations in ``shapeEV``, inward triangles.

    Expressions are read from ``Exp_Pca.bin``, ``std_exp.txt`` and ``BFM_exp_idx.mat`` in the same folder; without
    them the model has none. Their stored mean isn't zero: readers differ, here it is dropped unless
    ``add_expression_mean`` is set.
    """
    data = read_mat(path, BFM_KEYS)
    n3, k = check_modes(path, data["shapePC"], "shapePC")
    mean = vector(path, data["shapeMU"], "shapeMU", n3)
    sigma = vector(path, data["shapeEV"], "shapeEV", k)
    _, kt = check_modes(path, data["texPC"], "texPC", n3)
    texture = vector(path, data["texMU"], "texMU", n3) / 255.0
    texture_sigma = vector(path, data["texEV"], "texEV", kt)
    faces = triangles(path, data["tl"], "tl", n3 // 3)[:, [1, 0, 2]]
    albedo = srgb_albedo(texture.reshape(-1, 3), interleaved(data["texPC"] * (texture_sigma / 255.0)))
    expression, mean_offset = _facewarehouse(path.parent, n3 // 3)
    if add_expression_mean:
        mean = mean + mean_offset
    return ModelData(
        "bfm2009",
        single(mean / 1000.0).reshape(-1, 3),
        faces,
        interleaved(data["shapePC"] * (sigma / 1000.0)),
        expression / np.float32(1000.0),
        1.0,
        albedo=albedo,
        source=path,
    ).complete()


def _facewarehouse(folder: Path, n: int) -> tuple[NDArray, NDArray]:
    """Expression modes (n, 3, K) with their deviations and the stored mean (3n,), in micrometres."""
    basis_file, deviation_file, index_file = (folder / f for f in ("Exp_Pca.bin", "std_exp.txt", "BFM_exp_idx.mat"))
    if not basis_file.is_file():
        return np.zeros((n, 3, 0), dtype=np.float32), np.zeros(3 * n)
    for needed in (deviation_file, index_file):
        if not needed.is_file():
            raise InputError(f"{needed}: missing; {basis_file.name} needs it beside")
    trim = read_mat(index_file, ("trimIndex",))["trimIndex"].ravel().astype(np.int64) - 1
    if trim.size == 0 or trim.min() < 0 or trim.max() >= n:
        raise InputError(f"{index_file}: trimIndex spans {trim.min() + 1}..{trim.max() + 1}, expected 1..{n}")
    with opened(basis_file, MAX_MODEL_BYTES) as (f, size):
        head = f.read(4)
        count = int(np.frombuffer(head, "<i4")[0]) if len(head) == 4 else -1
        expected = 4 + 4 * 3 * len(trim) * (count + 1)
        if not 0 < count <= 1000 or size != expected:
            raise InputError(
                f"{basis_file}: {count} modes and {size} bytes; expected {expected} bytes for {len(trim)} vertices"
            )
        values = np.frombuffer(f.read(), "<f4").reshape(count + 1, len(trim), 3)
    try:
        sigma = np.array(read_text(deviation_file, MAX_SETTINGS_BYTES).split(), dtype=np.float32)
    except ValueError as error:
        raise InputError(f"{deviation_file}: {error}; expected {count} numbers") from None
    if sigma.shape != (count,):
        raise InputError(f"{deviation_file}: {sigma.size} numbers, expected {count}")
    modes = np.zeros((n, 3, count), dtype=np.float32)
    modes[trim] = np.moveaxis(values[1:], 0, 2) * sigma
    offset = np.zeros((n, 3))
    offset[trim] = values[0]
    return modes, offset.ravel()


def check_modes(path: Path, basis: NDArray, key: str, rows: int | None = None) -> tuple[int, int]:
    """Shape (3N, K) of a basis, checked."""
    if basis.ndim != 2 or basis.shape[0] % 3 or basis.shape[0] < 12 or (rows is not None and basis.shape[0] != rows):
        raise InputError(f"{path}: {key} has shape {basis.shape}, expected ({rows or '3 x vertices'}, modes)")
    return basis.shape[0], basis.shape[1]


def vector(path: Path, values: NDArray, key: str, count: int) -> NDArray[np.float64]:
    """Flatten a (count, 1) or (1, count) array."""
    if values.size != count:
        raise InputError(f"{path}: {key} has shape {values.shape}, expected {count} values")
    out = values.ravel().astype(np.float64)
    if not (np.abs(out) < 1e20).all():  # also false for NaN
        raise InputError(f"{path}: {key} holds values that are not finite or beyond 1e20")
    return out


def triangles(path: Path, values: NDArray, key: str, n: int) -> NDArray[np.int64]:
    """(F, 3) 0-based triangles from 1-based ones of shape (F, 3) or (3, F)."""
    if values.ndim != 2 or 3 not in values.shape:
        raise InputError(f"{path}: {key} has shape {values.shape}, expected (triangles, 3)")
    t = values if values.shape[1] == 3 else values.T
    if not np.isfinite(t).all() or t.min() < 1 or t.max() > n:
        raise InputError(f"{path}: {key} holds {t.min()}..{t.max()}, expected 1-based indices up to {n}")
    return t.astype(np.int64) - 1


def load_3ddfa(path: Path) -> MorphableModel:
    """Read shape and expressions; keypoints are the 68 landmarks. The albedo is the pigment model's."""
    data = read_mat(path, DDFA_KEYS)
    n3, k = check_modes(path, data["w"], "w")
    mean = vector(path, data["mu_shape"], "mu_shape", n3)
    identity = interleaved(data["w"] * (vector(path, data["sigma"], "sigma", k) / 1000.0))
    faces = triangles(path, data["tri"], "tri", n3 // 3)
    beside = path.parent / "Model_Expression.mat"
    expression = np.zeros((n3 // 3, 3, 0), dtype=np.float32)
    if beside.is_file():
        extra = read_mat(beside, ("mu_exp", "w_exp", "sigma_exp"))
        _, ke = check_modes(beside, extra["w_exp"], "w_exp", n3)
        expression = interleaved(extra["w_exp"] * (vector(beside, extra["sigma_exp"], "sigma_exp", ke) / 1000.0))
        mean = mean + vector(beside, extra["mu_exp"], "mu_exp", n3)
    return ModelData(
        "3ddfa",
        single(mean / 1000.0).reshape(-1, 3),
        oriented_outwards(mean.reshape(-1, 3), faces),
        identity,
        expression,
        1.0,
        landmarks=_keypoints(path, data["keypoints"], n3 // 3),
        source=path,
    ).complete()


def _keypoints(path: Path, values: NDArray, n: int) -> NDArray:
    """68 vertex indices from 1-based vertices, or from 1-based positions of coordinates (x, y, z of each)."""
    k = values.ravel().astype(np.int64)
    if k.size == 204:
        k = (k[::3] - 1) // 3 + 1
    if k.size != 68 or k.min() < 1 or k.max() > n:
        raise InputError(f"{path}: keypoints has {k.size} values up to {k.max()}, expected 68 vertices of {n}, 1-based")
    return k - 1


def load_deep3d(path: Path) -> MorphableModel:
    """Read the model; where ``skinmask`` is present it narrows the face area."""
    data = read_mat(path, DEEP3D_KEYS, ("skinmask",))
    n3, _ = check_modes(path, data["idBase"], "idBase")
    check_modes(path, data["exBase"], "exBase", n3)
    check_modes(path, data["texBase"], "texBase", n3)
    mean = vector(path, data["meanshape"], "meanshape", n3).reshape(-1, 3)
    faces = oriented_outwards(mean, triangles(path, data["tri"], "tri", n3 // 3))
    keypoints = _keypoints(path, data["keypoints"], n3 // 3)
    mask = find_face_mask(mean, faces, keypoints)
    if "skinmask" in data:
        skin = vector(path, data["skinmask"], "skinmask", n3 // 3) > 0.5
        mask &= skin[faces].all(1)
    texture = vector(path, data["meantex"], "meantex", n3).reshape(-1, 3) / 255.0
    return ModelData(
        "deep3dfacerecon",
        single(mean),
        faces,
        interleaved(data["idBase"]),
        interleaved(data["exBase"]),
        100.0,
        albedo=srgb_albedo(texture, interleaved(data["texBase"]) / np.float32(255.0)),
        landmarks=keypoints,
        face_mask=mask,
        source=path,
    ).complete()
