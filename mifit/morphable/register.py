"""Registration of a morphable model's neutral shape to a surface, by landmarks and closest points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mifit.core.mesh import vertex_normals
from mifit.morphable.model import MorphableModel


@dataclass(frozen=True)
class Registration:
    """A model fitted to a surface, with ``target = rotation @ model + translation`` in mm.

    ``identity`` (Ki,) are coefficients in standard deviations, ``vertices`` (V, 3) the fitted model in the target's
    space, in mm.
    """

    identity: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    vertices: NDArray[np.float64]


def register(
    model: MorphableModel, vertices: NDArray, faces: NDArray, landmarks: NDArray | None = None, iterations: int = 20
) -> Registration:
    """Fit identity and pose to a surface.

    Each iteration finds, for vertices of the face area, the closest target vertices with a similar normal, and
    takes a Gauss-Newton step on point-to-plane distances, landmarks and the prior of the coefficients.

    The target, ``vertices`` (N, 3) in mm and ``faces`` (M, 3), counter-clockwise outwards, is roughly upright (y up)
    and faces +z; ``landmarks`` (68,) are its iBUG points. Without them the pose starts from the tips of the noses.
    """
    unit = model.unit_mm
    mean, basis = unit * model.mean.astype(np.float64), model.identity
    target_normals = vertex_normals(vertices, faces)
    tree = cKDTree(vertices)
    on_face = np.unique(model.faces[model.face_mask])
    rng = np.random.default_rng(0)
    sample = np.sort(rng.choice(on_face, min(4000, len(on_face)), replace=False))
    sample_basis = unit * basis[sample].astype(np.float64)
    lm = model.landmarks
    lm_basis = unit * basis[lm].astype(np.float64)

    c = np.zeros(model.n_identity)
    if landmarks is not None:
        rotation, translation = rigid_between(mean[lm], vertices[landmarks])
    else:
        rotation = np.eye(3)
        translation = nose_tip(vertices) - mean[lm[30]]
    for iteration in range(iterations):
        progress = iteration / max(iterations - 1, 1)
        shape = mean + unit * (model.identity_jacobian @ c.astype(np.float32)).reshape(-1, 3)
        normals = vertex_normals(shape, model.faces)[sample] @ rotation.T
        p = shape[sample] @ rotation.T + translation
        distance, nearest = tree.query(p)
        n = target_normals[nearest]
        reach = 30.0 * (1 - progress) + 6.0 * progress
        good = (distance < reach) & ((normals * n).sum(1) > 0.5)
        rows, residuals = [], []

        def add(jacobian: NDArray, direction: NDArray, point: NDArray, error: NDArray, weight: float) -> None:
            turned = direction @ rotation  # noqa: B023 - used within the iteration
            block = np.einsum("ni,nik->nk", turned, jacobian)
            pose = np.concatenate([np.cross(point, direction), direction], axis=1)
            rows.append(weight * np.concatenate([block, pose], axis=1))  # noqa: B023
            residuals.append(weight * error)  # noqa: B023

        weight = np.sqrt(600.0 / max(good.sum(), 1)) * (0.5 + 0.5 * progress)
        q = vertices[nearest]
        add(sample_basis[good], n[good], p[good], ((p - q) * n).sum(1)[good], weight)
        if landmarks is not None:
            lp = shape[lm] @ rotation.T + translation
            for axis in np.eye(3):
                direction = np.broadcast_to(axis, lp.shape)
                add(lm_basis, direction, lp, (lp - vertices[landmarks]) @ axis, 1.0 - 0.8 * progress)
        a, b = np.concatenate(rows), np.concatenate(residuals)
        prior = np.concatenate([np.ones(len(c)), np.full(6, 1e-3)])
        step = np.linalg.solve(a.T @ a + np.diag(prior), -(a.T @ b) - prior * np.concatenate([c, np.zeros(6)]))
        c = c + step[: len(c)]
        turn = Rotation.from_rotvec(step[len(c) : len(c) + 3]).as_matrix()
        rotation, translation = turn @ rotation, turn @ translation + step[len(c) + 3 :]
    shape = mean + unit * (model.identity_jacobian @ c.astype(np.float32)).reshape(-1, 3)
    return Registration(c, rotation, translation, shape @ rotation.T + translation)


def rigid_between(source: NDArray, target: NDArray) -> tuple[NDArray, NDArray]:
    """Rotation and translation that best take points (N, 3) to points (N, 3) (Kabsch)."""
    cs, ct = source.mean(0), target.mean(0)
    rotation = Rotation.align_vectors(target - ct, source - cs)[0].as_matrix()
    return rotation, ct - rotation @ cs


def nose_tip(vertices: NDArray) -> NDArray:
    """Foremost vertex near the median plane."""
    middle = np.abs(vertices[:, 0] - np.median(vertices[:, 0])) < 0.1 * np.ptp(vertices[:, 0])
    candidates = vertices[middle]
    return candidates[candidates[:, 2].argmax()]
