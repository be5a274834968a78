"""Image-based rendering on a mesh: what a view shows when nothing is known of light or skin.

A pixel of the wanted view is traced to the mesh and takes a blend of the colours of fitted views that see the point:

- ``cosine``: weighted by the squared cosine between the view and the surface;
- ``nearest``: the view nearest in angle to the wanted one;
- ``angle``: weighted by nearness in angle, as in an unstructured lumigraph (Buehler et al. 2001).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize
from mifit.core.uv import bilinear
from mifit.render.visible import occluding_mesh, trace_mesh

Blend = Literal["cosine", "nearest", "angle"]
BLENDS: tuple[Blend, ...] = ("cosine", "nearest", "angle")


@dataclass(frozen=True)
class ImageBased:
    """One view as the fitted photographs show it.

    ``colours`` (H, W, 3) by blend are linear, 0 where nothing is hit; ``face`` (H, W) is the face whose front is seen,
    -1 where none is; ``seen`` (H, W) are pixels whose point at least one fitted view sees. Elsewhere the colour is
    that of the fitted view that faces the point best, whatever hides it.
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
    blends: Sequence[Blend] = ("cosine",),
    oversampling: int = 1,
) -> ImageBased:
    """One view of one timestep from the photographs of the ``fitted`` cameras; no other images are read.

    All cameras are undistorted; ``vertices`` (V, 3) and ``faces`` (F, 3) are a mesh in the capture's world space. There
    are ``oversampling`` samples along each side of a pixel, which is the mean of those that hit, and has a face (that
    of one of them) or is seen where all of its samples do.
    """
    surface = trace_mesh(vertices, faces, camera, oversampling)
    face, wanted, count = surface.face, surface.view, len(surface.face)
    total = {blend: np.zeros((count, 3)) for blend in blends}
    weight = {blend: np.zeros(count) for blend in blends}
    spare, best = np.zeros((count, 3)), np.full(count, -np.inf)
    there = occluding_mesh(vertices, faces).scene
    normal = normalize(face_cross(vertices, faces)[face])
    point = interpolate(np.asarray(vertices, np.float64), faces, face, surface.weights)
    for view in fitted:
        frame = capture.frame(view.name, timestep)
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
        # At a flatter angle a pixel covers too much of the surface.
        visible = inside & (cosine > 0.15) & there.visible_from(point, view.position)
        for blend in blends:
            share = np.where(visible, _weight(blend, cosine, np.sum(towards * wanted, axis=1)), 0.0)
            if blend == "nearest":  # the largest takes all
                nearer = share > weight[blend]
                total[blend][nearer] = share[nearer, None] * colour[nearer]
                weight[blend] = np.maximum(weight[blend], share)
            else:
                total[blend] += share[:, None] * colour
                weight[blend] += share
    seen = next(iter(weight.values())) > 0
    colours = {}
    for blend in blends:
        found = np.where(seen[:, None], total[blend] / np.maximum(weight[blend], 1e-12)[:, None], spare)
        colours[blend] = surface.image(found)[..., :3]
    share = surface.image(seen[:, None].astype(np.float64))
    shown = np.full(camera.width * camera.height, -1, np.int32)
    shown[surface.pixel] = face
    whole = share[..., 1] == 1.0
    return ImageBased(colours, np.where(whole, shown.reshape(whole.shape), -1), whole & (share[..., 0] == 1.0))


def _weight(blend: Blend, cosine: NDArray, nearness: NDArray) -> NDArray[np.float64]:
    """Weight of a view, above 0: by the cosine at the surface, or that of the angle from the wanted view."""
    if blend == "cosine":
        return cosine**2
    if blend == "nearest":
        return 2.0 + nearness
    angle = np.arccos(np.clip(nearness, -1.0, 1.0))
    return (1.0 - angle / np.pi) / np.maximum(angle, 1e-3)
