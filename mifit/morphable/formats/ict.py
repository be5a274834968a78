"""ICT-FaceKit Light: the head-skin ``.npz`` and the original folder of OBJ files. Centimetres, y up, nose +z."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.arrays import read_npz
from mifit.core.files import read_bytes, read_json
from mifit.core.limits import MAX_FILE_BYTES, MAX_SETTINGS_BYTES
from mifit.errors import InputError
from mifit.morphable.assemble import ModelData, check_mesh
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import opening_faces

EXPRESSION_SIGMA = 0.3
"""One coefficient unit of an expression mode is this blend-shape weight; weights lie in 0..1."""

_SKIN_VERTICES = 11248
"""Vertices of face, head and neck skin come first in the original files, of them 9409 of the face."""

_KEYS = ("mean", "faces", "uv", "faces_uv", "identity", "expression", "expression_names", "landmarks_ibug68")


def is_ict_npz(keys: list[str]) -> bool:
    """Whether an ``.npz`` with these keys is the head-skin file."""
    return {"identity", "expression", "landmarks_ibug68", "face_area_faces"} <= set(keys)


def load_ict_npz(path: Path) -> MorphableModel:
    """Read the head-skin ``.npz``: modes first, sizes of the face area as scalars."""
    data = read_npz(path)
    missing = [k for k in (*_KEYS, "face_area_faces") if k not in data]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}, expected the keys of an ICT-FaceKit head")
    for key in ("identity", "expression"):
        if data[key].ndim != 3 or data[key].shape[1:] != data["mean"].shape:
            raise InputError(
                f"{path}: {key} has shape {data[key].shape}, expected (modes, V, 3) with V = {len(data['mean'])}"
            )
    return _assemble(
        data["mean"],
        data["faces"],
        (np.moveaxis(data["identity"], 0, 2), np.moveaxis(data["expression"], 0, 2)),
        tuple(str(n) for n in data["expression_names"]),
        (data["uv"], data["faces_uv"]),
        data["landmarks_ibug68"],
        np.arange(len(data["faces"])) < int(data["face_area_faces"]),
    )


def is_ict_folder(path: Path) -> bool:
    """Whether a folder holds the original OBJ files."""
    return (path / "generic_neutral_mesh.obj").is_file() and (path / "vertex_indices.json").is_file()


def load_ict_folder(path: Path) -> MorphableModel:
    """Read the original folder: neutral mesh, ``identityNNN.obj`` and the expressions that are there.

    Only the skin of face, head and neck is kept; quads are split along their first diagonal.
    """
    try:
        index = read_json(path / "vertex_indices.json", MAX_SETTINGS_BYTES)
        landmarks = np.array(index["idx_to_landmark_verts"])
        known = [str(name) for name in index["expressions"]]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path / 'vertex_indices.json'}: {type(error).__name__}: {error}; "
            "expected idx_to_landmark_verts and expressions"
        ) from None
    mean, uv, faces, faces_uv = _read_obj(path / "generic_neutral_mesh.obj")
    skin = (faces < _SKIN_VERTICES).all(1)
    faces, faces_uv = faces[skin], faces_uv[skin]
    if not len(faces):
        raise InputError(f"{path / 'generic_neutral_mesh.obj'}: no face lies within the skin's vertices")
    kept, faces_uv = np.unique(faces_uv, return_inverse=True)
    faces_uv = faces_uv.reshape(-1, 3)
    identities = sorted(path.glob("identity[0-9][0-9][0-9].obj"))
    names = tuple(n for n in known if (path / f"{n}.obj").is_file())
    files = [*identities, *(path / f"{n}.obj" for n in names)]
    modes = np.zeros((_SKIN_VERTICES, 3, len(files)), dtype=np.float32)
    for k, file in enumerate(files):
        vertices = _obj_vertices(file, _obj_lines(file))
        if vertices.shape != mean.shape:
            raise InputError(f"{file}: {len(vertices)} vertices, expected {len(mean)} as in the neutral mesh")
        modes[:, :, k] = (vertices - mean)[:_SKIN_VERTICES]
    return _assemble(
        mean[:_SKIN_VERTICES],
        faces,
        (modes[:, :, : len(identities)], modes[:, :, len(identities) :]),
        names,
        (uv[kept], faces_uv),
        landmarks,
        np.asarray((faces < 9409).all(1) & (uv[kept][faces_uv][..., 0] <= 1.0).all(1)),
    )


def _obj_lines(path: Path) -> list[bytes]:
    return read_bytes(path, MAX_FILE_BYTES, "mesh").splitlines()


def _obj_vertices(path: Path, lines: list[bytes], keyword: bytes = b"v ", columns: int = 3) -> NDArray[np.float64]:
    """Numbers after a keyword, (N, columns)."""
    rows = [line.split()[1 : columns + 1] for line in lines if line.startswith(keyword)]
    try:
        out = np.array(rows, dtype=np.float64).reshape(len(rows), columns)
    except ValueError:
        raise InputError(f"{path}: a '{keyword.decode().strip()}' line does not hold {columns} numbers") from None
    if not np.isfinite(out).all():
        raise InputError(f"{path}: a '{keyword.decode().strip()}' line holds a value that is not finite")
    return out


def _read_obj(path: Path) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Vertices, texture vertices, triangles and their texture indices of an OBJ file with quads."""
    lines = _obj_lines(path)
    vertices, uv = _obj_vertices(path, lines), _obj_vertices(path, lines, b"vt ", 2)
    corners, texture = [], []
    try:
        for line in lines:
            if line.startswith(b"f "):
                pairs = [c.split(b"/") for c in line.split()[1:]]
                v, t = [int(c[0]) - 1 for c in pairs], [int(c[1]) - 1 for c in pairs]
                for k in range(1, len(v) - 1):
                    corners.append((v[0], v[k], v[k + 1]))
                    texture.append((t[0], t[k], t[k + 1]))
    except (ValueError, IndexError):
        raise InputError(f"{path}: face line {line[:60]!r}, expected vertex/texture indices") from None
    faces, faces_uv = np.array(corners, dtype=np.int64), np.array(texture, dtype=np.int64)
    for name, index, count in (("vertex", faces, len(vertices)), ("texture", faces_uv, len(uv))):
        if not index.size or index.min() < 0 or index.max() >= count:
            raise InputError(f"{path}: faces hold {name} indices outside 1..{count}, or there are none")
    if len(vertices) < _SKIN_VERTICES:
        raise InputError(f"{path}: {len(vertices)} vertices, expected at least {_SKIN_VERTICES}")
    return vertices, uv, faces, faces_uv


def _assemble(
    mean: NDArray,
    faces: NDArray,
    modes: tuple[NDArray, NDArray],
    names: tuple[str, ...],
    uv: tuple[NDArray, NDArray],
    landmarks: NDArray,
    face_area: NDArray[np.bool_],
) -> MorphableModel:
    """A model of identity and expression modes (last); of ``face_area`` (F,) without the insides of lids and lips."""
    check_mesh("ict_facekit", mean, faces, landmarks)
    return ModelData(
        "ict_facekit",
        mean,
        faces,
        modes[0],
        np.float32(EXPRESSION_SIGMA) * modes[1],
        10.0,
        uv=uv,
        landmarks=landmarks,
        face_mask=face_area & ~opening_faces(mean, faces, landmarks),
        expression_names=names,
        expression_bounds=np.tile(np.array([0.0, 1.0 / EXPRESSION_SIGMA], dtype=np.float32), (len(names), 1)),
    ).complete()
