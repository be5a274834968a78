"""Points of the model's surface as linear functions of the coefficients, and their projection with derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.morphable import MorphableModel
from mifit.stages.geometry.parameters import Pose, cross_matrix


@dataclass(frozen=True)
class PointBasis:
    """N surface points: ``mean + identity @ x_id + expression @ x_exp`` in object space.

    Attributes
    ----------
    mean : (3N,), identity : (3N, Ki), expression : (3N, Ke)
        Coordinates of point n in rows 3n..3n+2.
    """

    mean: NDArray
    identity: NDArray
    expression: NDArray

    @classmethod
    def at_vertices(cls, model: MorphableModel, vertices: NDArray | slice) -> PointBasis:
        """Basis at some of the model's vertices."""
        mean = model.mean[vertices].reshape(-1)
        return cls(mean, *(modes[vertices].reshape(len(mean), -1) for modes in (model.identity, model.expression)))

    def evaluate(self, identity: NDArray, expression: NDArray) -> NDArray:
        """(N, 3) object-space points."""
        dtype = self.mean.dtype
        out = self.mean + self.identity @ identity.astype(dtype) + self.expression @ expression.astype(dtype)
        return out.reshape(-1, 3)


def corner_matrix(faces: NDArray, face: NDArray, weights: NDArray, n_vertices: int) -> sp.csr_matrix:
    """(N, V) sparse matrix that interpolates vertex values at surface points."""
    n = len(face)
    return sp.csr_matrix(
        (weights.astype(np.float32).reshape(-1), faces[face].reshape(-1), np.arange(0, 3 * n + 1, 3)),
        shape=(n, n_vertices),
    )


@dataclass(frozen=True)
class Projection:
    """Pixels of points in one camera, with derivatives.

    Attributes
    ----------
    pixels : (N, 2)
        Pixel coordinates.
    depth : (N,)
        Distance along the optical axis; not positive behind the camera, where ``pixels`` means nothing.
    by_object : (N, 2, 3)
        d pixels / d object-space point.
    by_pose : (N, 2, 6)
        d pixels / d (rotation vector, translation).
    by_log_scale : (N, 2)
    """

    pixels: NDArray
    depth: NDArray
    by_object: NDArray
    by_pose: NDArray
    by_log_scale: NDArray


def project(camera: Camera, pose: Pose, points: NDArray) -> Projection:
    """Project object-space points (N, 3); double precision throughout."""
    moved = pose.scale * (np.asarray(points, dtype=np.float64) @ pose.rotation.T)
    q = (moved + pose.translation) @ camera.rotation.T + camera.translation
    z = np.where(q[:, 2] > 1e-9, q[:, 2], 1e-9)
    u, v = camera.fx * q[:, 0] / z, camera.fy * q[:, 1] / z
    pixels = np.stack([u + camera.cx, v + camera.cy], axis=1)
    by_camera = np.zeros((len(q), 2, 3))
    by_camera[:, 0, 0], by_camera[:, 0, 2] = camera.fx / z, -u / z
    by_camera[:, 1, 1], by_camera[:, 1, 2] = camera.fy / z, -v / z
    by_world = by_camera @ camera.rotation
    by_pose = np.empty((len(q), 2, 6))
    by_pose[:, :, :3] = -by_world @ cross_matrix(moved) @ pose.left_jacobian
    by_pose[:, :, 3:] = by_world
    by_object = by_world @ (pose.scale * pose.rotation)
    return Projection(pixels, q[:, 2], by_object, by_pose, np.einsum("nij,nj->ni", by_world, moved))
