"""Deep3DFaceRecon's ``BFM_model_front.mat``: decimetres, modes scaled by their deviations, colours 0..255."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mifit.errors import InputError
from mifit.morphable.assemble import complete, find_face_mask, interleaved, single, srgb_albedo
from mifit.morphable.formats.bfm2009 import check_modes, triangles, vector
from mifit.morphable.formats.mat5 import read_mat
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import oriented_outwards

KEYS = ("meanshape", "meantex", "idBase", "exBase", "texBase", "tri", "keypoints")


def load_deep3d(path: Path) -> MorphableModel:
    """Read the model; where ``skinmask`` is present it narrows the face area."""
    data = read_mat(path, KEYS, ("skinmask",))
    n3, _ = check_modes(path, data["idBase"], "idBase")
    check_modes(path, data["exBase"], "exBase", n3)
    check_modes(path, data["texBase"], "texBase", n3)
    mean = vector(path, data["meanshape"], "meanshape", n3).reshape(-1, 3)
    faces = oriented_outwards(mean, triangles(path, data["tri"], "tri", n3 // 3))
    keypoints = data["keypoints"].ravel().astype(np.int64) - 1
    if keypoints.size != 68 or keypoints.min() < 0 or keypoints.max() >= n3 // 3:
        raise InputError(f"{path}: keypoints has shape {data['keypoints'].shape}, expected 68 1-based vertices")
    mask = find_face_mask(mean, faces, keypoints)
    if "skinmask" in data:
        skin = vector(path, data["skinmask"], "skinmask", n3 // 3) > 0.5
        mask &= skin[faces].all(1)
    texture = vector(path, data["meantex"], "meantex", n3).reshape(-1, 3) / 255.0
    return complete(
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
    )
