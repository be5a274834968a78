"""ICT-FaceKit Light: the head-skin ``.npz`` and the original folder of OBJ files. Centimetres, y up, nose +z."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.errors import InputError
from mifit.morphable.formats.archive import read_npz
from mifit.morphable.model import MorphableModel
from mifit.morphable.pigment import skin_model
from mifit.morphable.topology import mirror_map, opening_faces

EXPRESSION_SIGMA = 0.3
"""One coefficient unit of an expression mode is this blend-shape weight; weights lie in 0..1."""

N_ALBEDO = 60
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
    return assemble_ict(
        "ict_facekit",
        data["mean"],
        data["faces"],
        np.moveaxis(data["identity"], 0, 2),
        np.moveaxis(data["expression"], 0, 2),
        tuple(str(n) for n in data["expression_names"]),
        data["uv"],
        data["faces_uv"],
        data["landmarks_ibug68"],
        int(data["face_area_faces"]),
    )


def assemble_ict(
    name: str,
    mean: NDArray,
    faces: NDArray,
    identity: NDArray,
    expression: NDArray,
    expression_names: tuple[str, ...],
    uv: NDArray,
    faces_uv: NDArray,
    landmarks: NDArray,
    face_area_faces: int,
) -> MorphableModel:
    """Build a model from ICT-FaceKit's arrays (modes last), with the pigment model's albedo.

    The face area is the first ``face_area_faces`` faces without those inside the lids and behind the lips.
    Texture coordinates with u > 1 belong to the back of the head and the neck, outside the face area.
    """
    face_mask = np.arange(len(faces)) < face_area_faces
    face_mask &= ~opening_faces(mean, faces, landmarks)
    mean_albedo, albedo_modes = skin_model(mean, faces[face_mask], landmarks, 10.0, N_ALBEDO)
    bound = 1.0 / EXPRESSION_SIGMA
    return MorphableModel(
        name=name,
        mean=mean,
        faces=faces,
        identity=identity,
        expression=np.float32(EXPRESSION_SIGMA) * expression,
        mean_albedo=mean_albedo,
        albedo_modes=albedo_modes,
        uv=uv,
        faces_uv=faces_uv,
        landmarks=landmarks,
        face_mask=face_mask,
        symmetry=mirror_map(mean, 0.01),
        unit_mm=10.0,
        expression_names=expression_names,
        expression_bounds=np.tile(np.array([0.0, bound], dtype=np.float32), (len(expression_names), 1)),
    )
