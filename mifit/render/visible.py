"""The surface that a camera sees, and meshes that are kept between pictures with their traced shadows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.occlusion import OccludingMesh
from mifit.core.arrays import Recent, content_key
from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize
from mifit.render.gbuffer import SurfaceScene


@dataclass(frozen=True)
class VisibleSurface:
    """What a camera sees of a mesh in an image of ``shape`` with ``oversampling`` samples along each side of a pixel.

    ``index`` (N,) is the flat number (row * width * oversampling + column) of every covered sample, ``face`` (N,) and
    ``weights`` (N, 3) where on the mesh it lies, ``points`` (N, 3) its world position and ``view`` (N, 3) the unit
    vector towards the camera.
    """

    shape: tuple[int, int]
    oversampling: int
    index: NDArray[np.int64]
    face: NDArray[np.int32]
    weights: NDArray[np.float32]
    points: NDArray[np.float32]
    view: NDArray[np.float32]

    @property
    def pixel(self) -> NDArray[np.int64]:
        """(N,) flat number of the pixel that each sample is in."""
        k, width = self.oversampling, self.shape[1]
        return self.index // (width * k) // k * width + self.index % (width * k) // k

    def image(self, values: NDArray) -> NDArray[np.float32]:
        """Mean of sample values (N, C) in each pixel, 0 where none is, and coverage: (H, W, C + 1)."""
        pixel, size = self.pixel, self.shape[0] * self.shape[1]
        count = np.bincount(pixel, minlength=size)
        sums = [np.bincount(pixel, channel, minlength=size) / np.maximum(count, 1) for channel in values.T]
        return np.stack([*sums, count / self.oversampling**2], axis=-1).astype(np.float32).reshape(*self.shape, -1)


def trace_mesh(
    vertices: NDArray, faces: NDArray, camera: Camera, oversampling: int, scene: SurfaceScene | None = None
) -> VisibleSurface:
    """The front-facing surface of a mesh under a camera's samples.

    A sample whose nearest surface shows its back (the inside of the head through an eye opening) is not covered.
    ``scene`` is one of this mesh, where there is one.
    """
    k = oversampling
    buffer = (scene or occluding_mesh(vertices, faces).scene).gbuffer(camera if k == 1 else camera.resized(k))
    index = np.flatnonzero(buffer.face.ravel() >= 0)
    face = buffer.face.ravel()[index]
    weights = buffer.weights.reshape(-1, 3)[index]
    points = interpolate(vertices, faces, face, weights)
    view = normalize(camera.position - points)
    front = np.sum(face_cross(vertices, faces)[face] * view, axis=1) > 0
    single = (x[front].astype(np.float32) for x in (weights, points, view))
    return VisibleSurface((camera.height, camera.width), k, index[front], face[front], *single)


_meshes = Recent[OccludingMesh](8)  # the timesteps of a result whose views are drawn one after the other


def occluding_mesh(vertices: NDArray, faces: NDArray) -> OccludingMesh:
    """A mesh to send rays at and its traced shadows; the same one for equal arrays, as long as it is among the last.

    Reports, evaluations and turning lights draw the same few meshes again and again, and their shadows cost
    more than all else in a picture.
    """
    import mitsuba as mi

    # A fit holds its vertices in double precision, its result in single: the same mesh, whose shadows are traced once.
    vertices = np.asarray(vertices, dtype=np.float64)
    key = content_key(mi.variant(), vertices, faces)
    return _meshes.get(key, lambda: OccludingMesh(SurfaceScene(np.array(vertices), np.array(faces))))
