"""The surface that a camera sees, and meshes that are kept between pictures with their traced shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import mi
from mifit.appearance.occlusion import OccludingMesh
from mifit.core.arrays import Recent, content_key
from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize
from mifit.render.gbuffer import SurfaceScene


@dataclass(frozen=True)
class VisibleSurface:
    """What a camera sees of a mesh in an image of ``shape`` with ``oversampling`` samples along each side of a pixel.

    ``pixel`` (N,) is the flat number of the pixel that a sample is in, ``face`` (N,) and ``weights`` (N, 3) where on
    the mesh it lies, ``points`` (N, 3) its world position and ``view`` (N, 3) the unit vector towards the camera.
    ``count`` (N,) is the number of a pixel's samples that it stands for.
    """

    shape: tuple[int, int]
    oversampling: int
    pixel: NDArray[np.int64]
    face: NDArray[np.int32]
    weights: NDArray[np.float32]
    points: NDArray[np.float32]
    view: NDArray[np.float32]
    count: NDArray[np.float32]

    def image(self, values: NDArray) -> NDArray[np.float32]:
        """Mean of sample values (N, C) in each pixel, 0 where none is, and coverage: (H, W, C + 1)."""
        pixel, size = self.pixel, self.shape[0] * self.shape[1]
        total = np.bincount(pixel, self.count, minlength=size)
        sums = [np.bincount(pixel, c * self.count, minlength=size) / np.maximum(total, 1) for c in values.T]
        return np.stack([*sums, total / self.oversampling**2], axis=-1).astype(np.float32).reshape(*self.shape, -1)


def trace_mesh(
    vertices: NDArray, faces: NDArray, camera: Camera, oversampling: int, joined: NDArray[np.bool_] | None = None
) -> VisibleSurface:
    """The front-facing surface of a mesh under a camera's samples.

    A sample whose nearest surface shows its back (the inside of the head through an eye opening) is not covered.
    A pixel's samples on one of the faces ``joined`` (F,) become one in their middle.
    """
    k, shape = oversampling, (camera.height, camera.width)
    buffer = occluding_mesh(vertices, faces).scene.gbuffer(camera if k == 1 else camera.resized(k))
    by_pixel = buffer.face.reshape(shape[0], k, shape[1], k).transpose(0, 2, 1, 3).reshape(-1, k * k)
    covered = np.flatnonzero((by_pixel >= 0).any(axis=1))
    face = by_pixel[covered]
    row, column = np.divmod(covered, shape[1])
    first = row * (k * k * shape[1]) + column * k  # of a pixel's samples in the buffer
    within = np.add.outer(np.arange(k) * (k * shape[1]), np.arange(k)).ravel()
    weights = buffer.weights.reshape(-1, 3).take(first[:, None] + within, axis=0)
    count = (face >= 0).astype(np.float32)
    if joined is not None:
        _join(face, weights, count, joined)
    used = count > 0
    pixel, face, weights, count = np.repeat(covered, used.sum(axis=1)), face[used], weights[used], count[used]
    points = interpolate(vertices, faces, face, weights)
    view = normalize(camera.position - points)
    front = np.sum(face_cross(vertices, faces)[face] * view, axis=1) > 0
    single = (x[front].astype(np.float32) for x in (weights, points, view, count))
    return VisibleSurface(shape, k, pixel[front], face[front], *single)


def _join(face: NDArray, weights: NDArray, count: NDArray, joined: NDArray[np.bool_]) -> None:
    """Make samples (P, S) of a pixel on one face one, whose ``count`` is their number; that of the others becomes 0."""
    samples = face.shape[1]
    for i in range(samples - 1):
        may = (count[:, i] > 0) & joined[face[:, i]]
        for j in range(i + 1, samples):
            same = np.flatnonzero(may & (face[:, i] == face[:, j]))
            weights[same, i] += weights[same, j]
            count[same, i] += 1
            count[same, j] = 0
        weights[:, i] /= np.maximum(count[:, i], 1)[:, None]


_meshes = Recent[OccludingMesh](8)  # the timesteps of a result whose views are drawn one after the other


def occluding_mesh(vertices: NDArray, faces: NDArray) -> OccludingMesh:
    """A mesh to send rays at and its traced shadows; the same one for equal arrays, as long as it is among the last.

    Reports, evaluations and turning lights draw the same few meshes again and again, and their shadows cost
    more than all else in a picture.
    """
    # A fit holds its vertices in double precision, its result in single: the same mesh, whose shadows are traced once.
    vertices = np.asarray(vertices, dtype=np.float64)
    key = content_key(mi.variant(), vertices, faces)
    return _meshes.get(key, lambda: OccludingMesh(SurfaceScene(np.array(vertices), np.array(faces))))
