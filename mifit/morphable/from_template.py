"""A model of any face mesh, made the way the built-in one is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mifit.errors import InputError
from mifit.morphable.assemble import check_mesh, complete, find_face_mask, transfer_landmarks
from mifit.morphable.gaussian_process import deformation_modes
from mifit.morphable.model import MorphableModel, provides

_EXPRESSION_KERNELS = ((22.0, 40, (1.2, 1.5, 1.2)), (11.0, 90, (0.5, 0.7, 0.5)))


@provides("from_template")
def model_of_template(
    mesh: object, landmarks: ArrayLike | None, kernels: tuple | None, unit_mm: float, modes: int, name: str
) -> MorphableModel:
    """See ``MorphableModel.from_template``; raises InputError for a mesh that is no face surface."""
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        vertices, faces = np.asarray(mesh[0]), np.asarray(mesh[1])
    elif hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    else:
        raise InputError(f"{name}: mesh is a {type(mesh).__name__}, expected (vertices, faces)")
    points = vertices.astype(np.float64) * unit_mm
    check_mesh(name, points, faces, None)
    vertex = transfer_landmarks(points, faces) if landmarks is None else np.asarray(landmarks)
    check_mesh(name, points, faces, vertex)
    where = np.zeros(len(points), dtype=bool)
    where[np.unique(faces[find_face_mask(points, faces, vertex)])] = True
    if not where.any():
        raise InputError(f"{name}: no face lies in the face area that the landmarks span; expected a face mesh")
    options = {} if kernels is None else {"symmetric": kernels}
    centred = points - (np.median(points[vertex, 0]), 0.0, 0.0)
    identity = deformation_modes(centred, where, modes, **options)
    # expressions: smaller deformations, where the mouth, eyes and brows are
    p = points[vertex[17:]]
    near = np.full(len(points), np.inf)
    for q in p:
        near = np.minimum(near, ((points - q) ** 2).sum(1))
    window = np.exp(-0.5 * near / 14.0**2).astype(np.float32)
    expression = deformation_modes(centred, where, 30, _EXPRESSION_KERNELS, (), stretch=(0.0, 0.0, 0.0))
    return complete(
        name,
        vertices.astype(np.float32),
        faces,
        identity / np.float32(unit_mm),
        expression * (window / np.float32(unit_mm))[:, None, None],
        unit_mm,
        landmarks=vertex,
        expression_names=tuple(f"field_{k:02d}" for k in range(expression.shape[2])),
    )
