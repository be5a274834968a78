"""Google's GNM head (``gnm_head.npz``, Apache-2.0), with eyes, teeth and tongue. Metres, y up, nose +z.

The arrays, as its public code documents them: ``template_vertex_positions`` (V, 3), ``vertex_identity_basis`` (I, V, 3)
and ``expression_basis`` (E, V, 3) per standard deviation, ``triangles`` (T, 3) with ``triangle_uvs`` (T, 3, 2), and
``vertex_groups`` (G, V), weights 0..1 of the groups in ``vertex_group_names``. Every separate piece of the mesh has the
unit square of texture coordinates for itself. Joints turn neck and eyes; they aren't read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from mifit.core.arrays import read_npz
from mifit.errors import InputError
from mifit.morphable.assemble import N_ALBEDO, ModelData, check_mesh, find_face_mask, single, transfer_landmarks
from mifit.morphable.model import MorphableModel
from mifit.morphable.openings import IRIS_ALBEDO, MARGIN, MOUTH_ALBEDO, PUPIL_ALBEDO, SCLERA_ALBEDO, STRIP
from mifit.morphable.pigment import skin_model
from mifit.morphable.topology import adjacency

KEYS = (
    "template_vertex_positions", "vertex_identity_basis", "expression_basis", "triangles", "triangle_uvs",
    "vertex_groups", "vertex_group_names",
)  # fmt: skip
CLEAR = ("eye_exteriors", "eyeball_exterior")
"""Groups of the corneas, which are clear: the eyes' insides are what images show."""
ALBEDO = {
    "scleras": SCLERA_ALBEDO, "sclera": SCLERA_ALBEDO, "irises": IRIS_ALBEDO, "iris": IRIS_ALBEDO,
    "pupils": PUPIL_ALBEDO, "pupil": PUPIL_ALBEDO, "mouth_sock": MOUTH_ALBEDO, "tongue": (0.35, 0.12, 0.1),
    "gums": (0.4, 0.14, 0.12), "teeth": (0.6, 0.56, 0.48),
}  # fmt: skip
"""Linear albedo of groups that aren't skin, by the names of both versions; later ones count."""


def load_gnm(path: Path) -> MorphableModel:
    """Read the head's skin, eyes, teeth and tongue.

    Landmarks are found by registering the built-in head to the skin, or read from ``NAME.landmarks.json`` beside it.
    """
    data = read_npz(path, KEYS)
    mean, triangles = data["template_vertex_positions"], data["triangles"].astype(np.int64)
    check_mesh(str(path), mean, triangles, None)
    corners = data["triangle_uvs"]
    if corners.shape != (*triangles.shape, 2) or not (np.abs(corners) <= 1.0).all():
        raise InputError(f"{path}: triangle_uvs has shape {corners.shape}, expected {(*triangles.shape, 2)} in 0..1")
    names, weights = data["vertex_group_names"], data["vertex_groups"]
    if names.ndim != 1 or weights.shape != (len(names), len(mean)):
        raise InputError(f"{path}: vertex_groups has shape {weights.shape}, expected {(names.size, len(mean))}")
    groups = {str(name): np.asarray(row > 0.5) for name, row in zip(names, weights, strict=True)}
    clear = np.any([groups[name] for name in CLEAR if name in groups] or [np.zeros(len(mean), bool)], axis=0)
    shown = ~clear[triangles].all(axis=1)
    used, faces = np.unique(triangles[shown], return_inverse=True)
    faces, mean = faces.reshape(-1, 3), mean[used].astype(np.float64)
    piece = connected_components(adjacency(faces, len(mean)), directed=False)[1]
    skin = piece == np.bincount(piece).argmax()
    identity, expression = (
        _modes(path, data[key], key, used, skin, most)
        for key, most in (("vertex_identity_basis", 150), ("expression_basis", 100))
    )
    landmarks = _landmarks(mean * 1000.0, faces[skin[faces[:, 0]]])
    face_mask = find_face_mask(mean, faces, landmarks)
    if not face_mask.any():
        raise InputError(f"{path}: no face lies in the face area that the landmarks span; expected a face mesh")
    albedo, albedo_modes = skin_model(mean, faces[face_mask], landmarks, 1000.0, N_ALBEDO)
    for name, colour in ALBEDO.items():
        if name in groups:
            albedo[groups[name][used]], albedo_modes[groups[name][used]] = colour, 0.0
    albedo_modes[~skin] = 0.0
    return ModelData(
        f"gnm:{path.stem}",
        single(mean),
        faces,
        identity,
        expression,
        1000.0,
        albedo=(albedo, albedo_modes),
        uv=_atlas(corners[shown], piece[faces[:, 0]]),
        landmarks=landmarks,
        face_mask=face_mask,
        source=path,
    ).complete()


def _modes(path: Path, basis: NDArray, key: str, used: NDArray, skin: NDArray, most: int) -> NDArray[np.float32]:
    """(V', 3, K) of the vertices that are used, the modes that move the skin most, in their order."""
    if basis.ndim != 3 or basis.shape[2] != 3 or basis.shape[1] <= used.max():
        raise InputError(f"{path}: {key} has shape {basis.shape}, expected (modes, vertices, 3)")
    basis = single(basis[:, used])
    energy = np.einsum("kvi,kvi->k", basis[:, skin], basis[:, skin])
    kept = np.sort(np.argsort(-energy, kind="stable")[:most])
    return np.ascontiguousarray(np.moveaxis(basis[kept[energy[kept] > 0.0]], 0, 2))


def _landmarks(vertices: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """The 68 points, on the skin alone: teeth and tongue lie near the lips."""
    own, local = np.unique(faces, return_inverse=True)
    return own[transfer_landmarks(vertices[own], local.reshape(-1, 3))]


def _atlas(corners: NDArray, piece: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Texture vertices (N, 2) and indices (F, 3): the largest piece above a strip in which the others lie in a row."""
    place = np.empty(corners.shape)
    order = np.argsort(-np.bincount(piece), kind="stable")
    place[piece == order[0]] = corners[piece == order[0]] * (1.0, 1.0 - STRIP) + (0.0, STRIP)
    width = 1.0 / max(len(order) - 1, 1)
    extent = np.array([width, STRIP]) - 2.0 * MARGIN
    for k, number in enumerate(order[1:]):
        place[piece == number] = (k * width + MARGIN, MARGIN) + corners[piece == number] * extent
    unique, index = np.unique(place.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
    return unique, index.reshape(-1, 3)
