"""Which pixels show a mesh, how many of them a texel covers, and how likely a sample shows the point it is read at.

A fitted mesh is a few millimetres off. Seen head on that shifts a colour a little; near the outline of the mesh in an
image it puts the background, an ear or the far cheek where the point should be, in full sharpness and at any
brightness. So each sample has a prior probability of showing something else, which rises with the view angle and
towards the outline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross

if TYPE_CHECKING:
    from mifit.render.gbuffer import GBuffer

GRAZING = 0.15
"""Cosine between normal and view from which a surface is read, about 81 degrees: beyond, a pixel covers too much of it,
and interpolated normals mislead."""
EDGE_STEP = 0.01
"""Second difference of depth, relative to the diagonal of the mesh, that makes a pixel part of an occlusion edge."""
EDGE_PIXELS = 2.0
"""Distance to an occlusion edge within which pixels hold colours of both sides."""
OUTLINE_MM = 3.0
"""Distance inside the fitted outline over which the odds of seeing past the real one fall by e: fitted meshes lie 1 to
4 mm off real heads."""
OUTLIER = (0.01, 0.5)
"""Prior probability of showing something else: head on (hair, a strap, a stray hand), and at the outline."""
DARKEST = 0.004
"""Linear colour, of images or of albedo, below which ratios are noise: one step of 8-bit codes."""
ALIKE = 0.15
"""Part of its colour by which the background changes from the outline inwards."""


def facing(cosine: NDArray) -> NDArray:
    """Weight by the cosine between normal and view: 0 up to `GRAZING`, 1 from twice as much."""
    return np.clip(cosine / GRAZING - 1.0, 0.0, 1.0)


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


@dataclass(frozen=True)
class FacePixels:
    """Pixels (H, W) of an image by what they show of a mesh.

    Attributes
    ----------
    covered, facial : bool
        The front of faces with maps, and of the face area.
    edge : bool
        At an occlusion edge.
    outline : float32
        Pixels to the nearest outline; 0 where nothing is hit.
    """

    covered: NDArray[np.bool_]
    facial: NDArray[np.bool_]
    edge: NDArray[np.bool_]
    outline: NDArray[np.float32]

    @classmethod
    def of(
        cls, buffer: GBuffer, vertices: NDArray, faces: NDArray, camera: Camera, masks: tuple[NDArray, NDArray]
    ) -> FacePixels:
        """Those of a camera; ``masks`` (F,) are the faces with maps and those of the face area."""
        toward = camera.position - vertices[faces[:, 0]]
        front = np.sum(face_cross(vertices, faces) * toward, axis=1) > 0
        hit, face = buffer.face >= 0, np.maximum(buffer.face, 0)
        covered, facial = (hit & (front & mask)[face] for mask in masks)
        step = EDGE_STEP * float(np.linalg.norm(np.ptp(vertices, axis=0)))
        outline = outline_distance(np.where(hit & front[face], buffer.depth, np.inf), step)
        return cls(covered, facial, outline < EDGE_PIXELS, outline)


def outline_distance(depth: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Pixels from each pixel of a depth image to the nearest outline.

    Parameters
    ----------
    depth : (H, W)
        Distance along the camera's axis; infinite beside the mesh.
    step : float
        Second difference of depth, in its unit, that makes an outline: an oblique surface has none, however steep.

    Returns
    -------
    (H, W) float32
        0 at the outline and where nothing is hit.
    """
    hit = np.isfinite(depth)
    if not hit.any():
        return np.zeros(depth.shape, dtype=np.float32)
    far = np.where(hit, depth, float(depth[hit].max()) + 2.0 * step).astype(np.float32)
    second = np.array([[1.0, -2.0, 1.0]], dtype=np.float32)
    jump = np.maximum(*(np.abs(cv2.filter2D(far, -1, k)) for k in (second, second.T))) > step
    inside = (hit & ~jump).astype(np.uint8)
    # A camera that sees nothing but surface has no outline.
    if inside.all():
        return np.full(depth.shape, 1e6, dtype=np.float32)
    return np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5), dtype=np.float32)


def background(image: NDArray, hit: NDArray[np.bool_], kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels on a mesh that show what lies beside it: alike to the nearest pixels off the mesh and joined to them.

    Scalp and neck of a fitted head are the model's, not the person's, and may stand centimetres wide of theirs.

    Parameters
    ----------
    image : (H, W, 3)
        Linear colour.
    hit : (H, W) bool
        Pixels that the mesh covers.
    kept : (H, W) bool
        Pixels that are never background: the face area, whose outline is fitted.
    """
    around = np.ones((2 * round(EDGE_PIXELS) + 1,) * 2, np.uint8)
    off = ~cv2.dilate(hit.astype(np.uint8), around).astype(bool)
    if not off.any() or not hit.any():
        return np.zeros_like(hit)
    finite = np.nan_to_num(image, nan=0.0, posinf=1.0, neginf=0.0).astype(np.float32)
    smooth = cv2.GaussianBlur(finite, (0, 0), 1.5)
    alike, asked = np.zeros_like(hit), ~off & ~kept
    row, column = distance_transform_edt(~off, return_distances=False, return_indices=True)
    there = smooth[row[asked], column[asked]]
    alike[asked] = (np.abs(smooth[asked] - there) < ALIKE * there + 5.0 * DARKEST).all(axis=-1)
    count, piece = cv2.connectedComponents((alike | off).astype(np.uint8))
    joined = np.zeros(count, bool)
    joined[piece[off]] = True
    found = hit & alike & joined[piece]
    # Pixels along its outline mix both: they alone would colour all that nothing else shows.
    return hit & ~kept & cv2.dilate(found.astype(np.uint8), around).astype(bool)


def outlier_prior(cosine: NDArray, millimetres: NDArray) -> NDArray[np.float32]:
    """Probability that a sample shows something else than its point, before any colour is compared.

    Parameters
    ----------
    cosine : (...)
        Between surface normal and view.
    millimetres : (...)
        Distance to the outline in the image, measured at the point's depth.
    """
    angle = (1.0 - np.clip(cosine, 0.0, 1.0)) ** 2
    edge = np.exp(-np.maximum(millimetres, 0.0) / OUTLINE_MM)
    least, most = map(np.float32, OUTLIER)
    return least + (most - least) * np.maximum(angle, edge).astype(np.float32)
