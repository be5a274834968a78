"""What each pixel of an image shows of a mesh, and how many pixels a texel covers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross
from mifit.stages.trust import outline_distance

if TYPE_CHECKING:
    from mifit.render.gbuffer import GBuffer

EDGE_STEP = 0.01
"""Second difference of depth, relative to the diagonal of the mesh, that makes a pixel part of an occlusion edge."""
EDGE_PIXELS = 2.0
"""Distance to an occlusion edge within which pixels hold colours of both sides."""


def texel_area(uv: NDArray, faces_uv: NDArray, size: int) -> NDArray[np.float64]:
    """(F,) area of each face in texels."""
    a, b, c = (uv[faces_uv[:, i]].astype(np.float64) * size for i in range(3))
    return 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def footprint(vertices: NDArray, faces: NDArray, camera: Camera, texels: NDArray) -> NDArray[np.float32]:
    """(F,) pixels that a texel of each face covers; 0 for faces that face away or lie behind the camera.

    ``texels`` (F,) is the area of each face in texels.
    """
    pixel = camera.project(vertices)[faces]
    a, b, c = (pixel[:, i] for i in range(3))
    # Image rows run down, so a face that shows its front has a negative area here.
    area = -0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    area = np.where(np.isfinite(area), np.maximum(area, 0.0), 0.0)
    return (area / np.maximum(texels, 1e-9)).astype(np.float32)


def face_pixels(
    buffer: GBuffer, vertices: NDArray, faces: NDArray, shown: NDArray, camera: Camera, facial: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Pixels that show the front of the faces (F,) ``shown``, pixels at occlusion edges, pixels to the outline, and
    pixels that show the front of the faces ``facial``."""
    face = buffer.face
    toward = camera.position - vertices[faces[:, 0]]
    front = np.sum(face_cross(vertices, faces) * toward, axis=1) > 0
    covered, facial_pixels = ((face >= 0) & (front & some)[np.maximum(face, 0)] for some in (shown, facial))
    step = EDGE_STEP * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    outline = outline_distance(np.where((face >= 0) & front[np.maximum(face, 0)], buffer.depth, np.inf), step)
    return covered, outline < EDGE_PIXELS, outline, facial_pixels
