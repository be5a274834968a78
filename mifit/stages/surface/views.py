"""What each view sees of the texels of the current surface, at one level of the image pyramid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross, interpolate, normalize, vertex_normals
from mifit.core.process import on_all_cores
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.render.gbuffer import SurfaceScene
from mifit.sampling.visibility import texel_area
from mifit.stages.surface.band import feature_image
from mifit.stages.surface.sweep import Posed

if TYPE_CHECKING:
    from mifit.capture import Capture, Frame
    from mifit.morphable import MorphableModel

GRAZING_COSINE = 0.2  # beyond about 78 degrees a pixel covers too much surface to compare it
OUTLINE_SCALE = 0.5  # outlines are found in images of this scale; chosen on all development heads
LONGEST_SIDE = 1000.0  # pixels of images whose texture is compared over time: larger ones are reduced
LARGEST_TEXTURE = 512  # texels along a side, of that


def pose_texels(
    capture: Capture,
    scene: SurfaceScene,
    vertices: NDArray,
    faces: NDArray,
    texels: TexelMap,
    cameras: Sequence[str],
    timestep: int,
    factor: float,
) -> Posed:
    """Texels of the surface with these world-space vertices (V, 3), which ``scene`` holds, and the views of them.

    ``factor`` is the level's pixels per pixel of the image.
    """
    views = [(capture.camera(name), capture.frame(name, timestep)) for name in cameras]
    return pose_views(scene, vertices, faces, texels, views, factor)


def pose_views(
    scene: SurfaceScene,
    vertices: NDArray,
    faces: NDArray,
    texels: TexelMap,
    views: Sequence[tuple[Camera, Frame]],
    factor: float,
) -> Posed:
    """`pose_texels` of cameras that may stand elsewhere than in the capture, and what they show."""
    position = interpolate(vertices, faces, texels.face, texels.weights)
    normal = normalize(interpolate(vertex_normals(vertices, faces), faces, texels.face, texels.weights))
    shown, seen = [], np.zeros((len(views), len(position)), np.float32)
    for row, (camera, frame) in enumerate(views):  # rays take all cores by themselves
        shown.append((camera, frame.image, frame.valid & ~frame.clipped & shows_surface(scene, camera)))
        cosine = (normalize(camera.position - position) * normal).sum(1)
        towards = np.flatnonzero(cosine > GRAZING_COSINE)
        towards = towards[scene.visible_from(position[towards], camera.position)]
        seen[row, towards] = cosine[towards]
    images = on_all_cores(lambda view: feature_image(*view, factor), shown)
    return Posed(position, normal, tuple(images), seen)


def shows_surface(scene: SurfaceScene, camera: Camera) -> NDArray[np.bool_]:
    """(H, W) pixels that show the surface, away from its outline against the background.

    Outlines against the surface itself stay: where a nose is too small, the missing skin shows beyond its outline.
    """
    mask = scene.gbuffer(camera.resized(OUTLINE_SCALE)).mask
    shown = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.resize(shown, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST) > 0


@dataclass(frozen=True)
class Resolution:
    """How finely the views see the face.

    Attributes
    ----------
    pixel : float
        Mean world length of a pixel at the face.
    parallax : float
        Mean shift between two views, in world lengths across the line of sight, per unit of depth.
    """

    pixel: float
    parallax: float

    @classmethod
    def of(cls, cameras: Sequence[Camera], centre: NDArray, pairs: Sequence[tuple[int, int]]) -> Resolution:
        """Of cameras that look at a point."""
        towards = normalize(np.array([camera.position - centre for camera in cameras]))
        angles = [np.arccos(np.clip(towards[a] @ towards[b], -1.0, 1.0)) for a, b in pairs]
        return cls(pixel_length(cameras, centre), float(np.mean(2.0 * np.sin(np.array(angles) / 2.0))))


def pixel_length(cameras: Sequence[Camera], centre: NDArray) -> float:
    """Mean world length of a pixel of cameras that look at a point (3,)."""
    return float(np.mean([np.linalg.norm(centre - c.position) / np.sqrt(c.fx * c.fy) for c in cameras]))


def texture_size(model: MorphableModel, vertices: NDArray, length: float, largest: int) -> int:
    """Side of the map whose texels are about as large as ``length`` on a surface with these vertices (V, 3)."""
    area = np.linalg.norm(face_cross(vertices, model.faces[model.face_mask]), axis=1).sum()
    covered = 2.0 * texel_area(model.uv, model.faces_uv[model.face_mask], 1).sum()
    return int(np.clip(np.sqrt(area / max(covered, 1e-12)) / length, 64, largest))


def texels_of_pixels(
    model: MorphableModel, vertices: NDArray, cameras: Sequence[Camera]
) -> tuple[TexelMap, float, float]:
    """Texels of the face at these vertices (V, 3) that are about as large as what pixels show of it.

    Returns
    -------
    texels, pixels per pixel of the images (1 but for large ones), world length of such a pixel at the face
    """
    factor = min(1.0, LONGEST_SIDE / max(max(view.width, view.height) for view in cameras))
    pixel = pixel_length(cameras, vertices.mean(axis=0)) / factor
    size = texture_size(model, vertices, pixel, LARGEST_TEXTURE)
    return rasterize_uv(model.uv, model.faces_uv, size, model.face_mask), factor, pixel
