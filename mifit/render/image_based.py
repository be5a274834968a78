"""Image-based rendering on a mesh: what a view shows when nothing is known of light or skin.

A pixel of the wanted view is traced to the mesh and takes a blend of the colours of fitted views that see the point:

- ``cosine``: weighted by the squared cosine between the view and the surface;
- ``nearest``: the view nearest in angle to the wanted one;
- ``angle``: weighted by nearness in angle, as in an unstructured lumigraph (Buehler et al. 2001).

A fit that doesn't beat the best of them on a held-out view has recovered nothing of how the face is lit or what its
skin is like.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize
from mifit.core.uv import bilinear

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.render.gbuffer import SurfaceScene

Blend = Literal["cosine", "nearest", "angle"]
BLENDS: tuple[Blend, ...] = ("cosine", "nearest", "angle")
LEAST_COSINE = 0.15
"""Views that see a point at a flatter angle don't show it: a pixel of theirs covers too much of the surface."""


@dataclass(frozen=True)
class ImageBased:
    """One view as the fitted photographs show it.

    Attributes
    ----------
    colours : dict of blend to (H, W, 3) float32
        Linear; 0 where nothing is hit.
    face : (H, W) int32
        Face of the mesh whose front is seen; -1 where none is.
    seen : (H, W) bool
        Pixels whose point of the mesh at least one fitted view sees. Elsewhere the colour is that of the fitted
        view that faces the point best, whatever hides it.
    """

    colours: dict[Blend, NDArray[np.float32]]
    face: NDArray[np.int32]
    seen: NDArray[np.bool_]

    @property
    def colour(self) -> NDArray[np.float32]:
        """(H, W, 3) of the first blend that was asked for."""
        return next(iter(self.colours.values()))

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
    blends: Sequence[Blend] = ("cosine",),
    oversampling: int = 1,
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
    blends : sequence of {"cosine", "nearest", "angle"}
    oversampling : int
        Samples per pixel along each side; a pixel is the mean of its samples that hit, and has a face (that of one of
        them) or is seen where all of its samples do.

    Raises
    ------
    InputError
        A fitted camera or the timestep is not in the capture.
    """
    from mifit.render.gbuffer import SurfaceScene

    scene = scene or SurfaceScene(vertices, faces)
    k = oversampling
    buffer = scene.gbuffer(camera if k == 1 else _finer(camera, k))
    index = np.flatnonzero(buffer.face.ravel() >= 0)
    face = buffer.face.ravel()[index]
    normal = normalize(face_cross(vertices, faces)[face])
    point = interpolate(np.asarray(vertices, np.float64), faces, face, buffer.weights.reshape(-1, 3)[index])
    front = np.sum(normal * (camera.position - point), axis=1) > 0
    index, face, normal, point = index[front], face[front], normal[front], point[front]
    wanted = normalize(camera.position - point)
    total = {blend: np.zeros((len(index), 3)) for blend in blends}
    weight = {blend: np.zeros(len(index)) for blend in blends}
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
            towards = normalize(view.position - point)
            cosine = np.sum(normal * towards, axis=1)
            facing = np.where(inside, cosine, -np.inf)
            spare[facing > best] = colour[facing > best]
            best = np.maximum(best, facing)
            visible = inside & (cosine > LEAST_COSINE) & there.visible_from(point, view.position)
            for blend in blends:
                share = np.where(visible, _weight(blend, cosine, np.sum(towards * wanted, axis=1)), 0.0)
                if blend == "nearest":  # the largest takes all
                    nearer = share > weight[blend]
                    total[blend][nearer] = share[nearer, None] * colour[nearer]
                    weight[blend] = np.maximum(weight[blend], share)
                else:
                    total[blend] += share[:, None] * colour
                    weight[blend] += share
    shape, seen = (camera.height, camera.width), next(iter(weight.values())) > 0
    pixel = index // (camera.width * k) // k * camera.width + index % (camera.width * k) // k
    count = np.bincount(pixel, minlength=shape[0] * shape[1])
    images: dict[Blend, NDArray[np.float32]] = {}
    for blend in blends:
        found = np.where(seen[:, None], total[blend] / np.maximum(weight[blend], 1e-12)[:, None], spare)
        sums = np.stack([np.bincount(pixel, found[:, c], minlength=len(count)) for c in range(3)], axis=1)
        images[blend] = (sums / np.maximum(count, 1)[:, None]).reshape(*shape, 3).astype(np.float32)
    shown = np.full(len(count), -1, np.int32)
    shown[pixel] = face
    shown[count < k * k] = -1
    covered = np.bincount(pixel, seen, minlength=len(count)) == k * k
    return ImageBased(images, shown.reshape(shape), covered.reshape(shape))


def _finer(camera: Camera, k: int) -> Camera:
    """The same view with k times the pixels along each side."""
    width, height = camera.width * k, camera.height * k
    fx, fy, cx, cy = (value * k for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _weight(blend: Blend, cosine: NDArray, nearness: NDArray) -> NDArray[np.float64]:
    """Weight of a view, above 0: by the cosine at the surface, or that of the angle from the wanted view."""
    if blend == "cosine":
        return cosine**2
    if blend == "nearest":
        return 2.0 + nearness
    angle = np.arccos(np.clip(nearness, -1.0, 1.0))
    return (1.0 - angle / np.pi) / np.maximum(angle, 1e-3)
