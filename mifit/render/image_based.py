"""Image-based rendering on a mesh: what a view shows when nothing is known of light or skin.

A pixel of the wanted view is traced to the mesh and takes the mean colour of the fitted views that see the point,
weighted by the squared cosine between the view and the surface. A fit that doesn't beat it on a held-out view has
recovered nothing of how the face is lit or what its skin is like.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize
from mifit.core.uv import bilinear

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.render.gbuffer import SurfaceScene

LEAST_COSINE = 0.15
"""Views that see a point at a flatter angle don't show it: a pixel of theirs covers too much of the surface."""


@dataclass(frozen=True)
class ImageBased:
    """One view as the fitted photographs show it.

    Attributes
    ----------
    colour : (H, W, 3) float32
        Linear; 0 where nothing is hit.
    face : (H, W) int32
        Face of the mesh whose front is seen; -1 where none is.
    seen : (H, W) bool
        Pixels whose point of the mesh at least one fitted view sees. Elsewhere the colour is that of the fitted
        view that faces the point best, whatever hides it.
    """

    colour: NDArray[np.float32]
    face: NDArray[np.int32]
    seen: NDArray[np.bool_]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(H, W) pixels that see the front of the mesh."""
        return self.face >= 0


def image_based(
    capture: Capture,
    fitted: Sequence[Camera],
    camera: Camera,
    timestep: int,
    vertices: NDArray,
    faces: NDArray,
    scene: SurfaceScene | None = None,
    moments: Mapping[int, NDArray] | None = None,
) -> ImageBased:
    """Render one view of one timestep from the photographs of other views.

    Parameters
    ----------
    capture : Capture
        Only images of the fitted cameras are read.
    fitted : sequence of Camera
        Undistorted cameras whose photographs give the colours.
    camera : Camera
        Undistorted camera of the wanted view.
    timestep : int
    vertices : (V, 3), faces : (F, 3)
        Mesh in the capture's world space.
    scene : SurfaceScene, optional
        The mesh, where one was made of it already.
    moments : dict of timestep to (V, 3), optional
        Timesteps whose photographs give the colours, with the mesh's vertices then; ``timestep`` alone by default.

    Raises
    ------
    InputError
        A fitted camera or the timestep is not in the capture.
    """
    from mifit.render.gbuffer import SurfaceScene

    scene = scene or SurfaceScene(vertices, faces)
    buffer = scene.gbuffer(camera)
    index = np.flatnonzero(buffer.face.ravel() >= 0)
    face = buffer.face.ravel()[index]
    normal = normalize(face_cross(vertices, faces)[face])
    point = interpolate(np.asarray(vertices, np.float64), faces, face, buffer.weights.reshape(-1, 3)[index])
    front = np.sum(normal * (camera.position - point), axis=1) > 0
    index, face, normal, point = index[front], face[front], normal[front], point[front]
    total, weight = np.zeros((len(index), 3)), np.zeros(len(index))
    spare, best = np.zeros((len(index), 3)), np.full(len(index), -np.inf)
    weights = buffer.weights.reshape(-1, 3)[index]
    for moment, then in (moments or {timestep: vertices}).items():
        there = scene
        if then is not vertices:
            there = SurfaceScene(then, faces)
            normal = normalize(face_cross(then, faces)[face])
            point = interpolate(np.asarray(then, np.float64), faces, face, weights)
        for view in fitted:
            frame = capture.frame(view.name, moment)
            x, y = (view.project(point) - 0.5).T
            inside = (x >= 0) & (y >= 0) & (x <= view.width - 1) & (y <= view.height - 1)
            x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
            inside &= bilinear(frame.valid.astype(np.float32), x, y) > 0.999
            colour = bilinear(frame.image, x, y)
            cosine = np.sum(normal * normalize(view.position - point), axis=1)
            facing = np.where(inside, cosine, -np.inf)
            spare[facing > best] = colour[facing > best]
            best = np.maximum(best, facing)
            visible = inside & (cosine > LEAST_COSINE) & there.visible_from(point, view.position)
            total += np.where(visible, cosine**2, 0.0)[:, None] * colour
            weight += np.where(visible, cosine**2, 0.0)
    total = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-12)[:, None], spare)
    shape = (camera.height, camera.width)
    image, shown, seen = np.zeros((*shape, 3), np.float32), np.full(shape, -1, np.int32), np.zeros(shape, bool)
    image.reshape(-1, 3)[index], shown.ravel()[index], seen.ravel()[index] = total, face, weight > 0
    return ImageBased(image, shown, seen)
