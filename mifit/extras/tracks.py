"""Tracks of surface points through all images of a head, by optical flow in UV space.

Every image is unwrapped through the mesh that its landmarks gave, which takes most of pose and perspective out. What
remains, the mesh's errors among it, is found by dense inverse search (Kroeger et al., Fast optical flow using dense
inverse search, 2016) between unwrapped images, there and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture, Frame
from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, bilinear, rasterize_uv
from mifit.extras.bundle import Sightings
from mifit.morphable import MorphableModel
from mifit.progress import Progress, silent
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.surface.views import shows_surface, texture_size

FEWEST_IMAGES = 3
"""Images that must show a point: two can't contradict one another but across epipolar lines."""
MOST_SIGHTINGS = 20000
MATCH_SIDE = 680.0
"""Longer side of images that lengths in pixels are for; in proportion for larger ones."""


@dataclass(frozen=True)
class Unwrapped:
    """One image in UV space.

    ``detail`` (S, S) is local contrast, 128 where nothing is seen; ``seen`` (S, S) are texels that the image shows,
    away from outlines, and ``pixels`` (S, S, 2) where in the image each texel lies.
    """

    detail: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    pixels: NDArray[np.float32]


@dataclass(frozen=True)
class Tracks:
    """N surface points and M sightings of them in images.

    ``texel`` (N,) is the flat index of the texel that each started from. Of each sighting, ``point`` (M,) is the point,
    ascending, ``image`` (M,) the position among the unwrapped images, and ``pixels`` (M, 2) the place in it.
    """

    texel: NDArray[np.int64]
    point: NDArray[np.int64]
    image: NDArray[np.int64]
    pixels: NDArray[np.float64]


def unwrap_image(frame: Frame, camera: Camera, vertices: NDArray, faces: NDArray, texels: TexelMap) -> Unwrapped:
    """A frame of a camera in UV space, through a mesh (V, 3) in world space with faces (F, 3).

    Texels that are seen at a cosine below 0.25 count as hidden, as do those within two of others that are.
    """
    scene = SurfaceScene(vertices, faces)
    position = interpolate(vertices, faces, texels.face, texels.weights)
    normal = normalize(interpolate(vertex_normals(vertices, faces), faces, texels.face, texels.weights))
    at = np.nan_to_num(camera.project(position), nan=-1.0) - 0.5
    cosine = (normalize(camera.position - position) * normal).sum(1)
    seen = (cosine > 0.25) & scene.visible_from(position, camera.position)
    seen &= ((at > 0) & (at < (camera.width - 1, camera.height - 1))).all(axis=1)
    shown = (frame.valid & ~frame.clipped & shows_surface(scene, camera)).astype(np.float32)
    seen &= bilinear(shown, at[:, 0], at[:, 1]) > 0.99
    grey = frame.image.mean(axis=2)
    floor = 0.1 * float(np.median(grey[shown > 0])) if (shown > 0).any() else 1.0
    brightness = np.log(np.maximum(grey, 0.0) + max(floor, 1e-6)).astype(np.float32)
    mask = texels.to_map(seen)
    detail = _detail(texels.to_map(bilinear(brightness, at[:, 0], at[:, 1])), mask)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return Unwrapped(detail, inner, texels.to_map(at.astype(np.float32) + np.float32(0.5)))


def follow_head(
    capture: Capture,
    model: MorphableModel,
    views: Sequence[Camera],
    timesteps: Sequence[int],
    world: Sequence[NDArray],
    progress: Progress = silent,
) -> tuple[Tracks, TexelMap]:
    """Tracks through all views of a head, timestep by timestep, and the texels that they start from.

    ``world`` has the model's vertices (V, 3) at each timestep, in world space.
    """
    centre = world[0].mean(axis=0)
    pixel = min(float(np.linalg.norm(centre - view.position)) / view.fx for view in views)
    side = texture_size(model, world[0], pixel, 320)  # about what the images show
    texels = rasterize_uv(model.uv, model.faces_uv, side, model.face_mask)
    total = len(views) * len(timesteps) + 1
    unwrapped: list[Unwrapped] = []
    for vertices, timestep in zip(world, timesteps, strict=True):
        for view in views:
            progress("match views", len(unwrapped), total)
            frame = capture.frame(view.name, timestep)
            unwrapped.append(unwrap_image(frame, view, vertices, model.faces, texels))
    tracks = follow_points(unwrapped)
    progress("match views", total, total)
    return tracks, texels


def sightings_of(tracks: Tracks, views: Sequence[Camera]) -> Sightings:
    """What a bundle adjustment takes of the tracks of a head. A match errs by 0.3 pixels along an axis."""
    step, camera = np.divmod(tracks.image, len(views))
    focal, pixel = (np.array([value(v) for v in views]) for value in (focal_of, lambda v: (v.fx, v.fy)))
    centre = np.array([(view.cx, view.cy) for view in views])
    pixels = (tracks.pixels - centre[camera]) * (focal[:, None] / pixel)[camera]
    longest = max(max(view.width, view.height) for view in views)
    return Sightings(pixels, tracks.point, camera, step, 0.3 * max(longest / MATCH_SIDE, 1.0))


def points_of(
    tracks: Tracks, texels: TexelMap, model: MorphableModel, vertices: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where tracks (N,) start on a head with vertices (V, 3), and the model's expression modes (N, 3, K) there."""
    at = np.searchsorted(texels.index, tracks.texel)
    corners, weights = model.faces[texels.face[at]], texels.weights[at].astype(np.float64)
    modes = np.einsum("nc,ncik->nik", weights, model.expression[corners].astype(np.float64))
    return np.einsum("nc,nci->ni", weights, vertices[corners].astype(np.float64)), modes


def focal_of(view: Camera) -> float:
    """Focal length in pixels made square."""
    return math.sqrt(view.fx * view.fy)


def _detail(values: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Mean and contrast within about 6 texels divided out."""

    def blur(image: NDArray) -> NDArray:
        return cv2.GaussianBlur(image, (0, 0), 6.0)

    share = np.maximum(blur(mask.astype(np.float32)), 1e-3)
    beside = np.where(mask, values - blur(np.where(mask, values, 0.0)) / share, 0.0)
    contrast = np.sqrt(blur(beside**2) / share)
    return np.where(mask, np.clip(128.0 + 45.0 * beside / (contrast + 0.01), 0, 255), 128.0).astype(np.uint8)


def follow_points(images: Sequence[Unwrapped]) -> Tracks:
    """Points that `FEWEST_IMAGES` or more show; about 2000 starts from 8 images, at most `MOST_SIGHTINGS`."""
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow.setFinestScale(0)
    starts = np.unique(np.linspace(0, len(images) - 1, min(len(images), 8)).round().astype(int))
    covered = sum(int(images[a].seen.sum()) for a in starts)
    stride = max(1, int(np.sqrt(covered / 2000)))
    texel, sightings, count = [], [], 0
    for a in starts:
        one = images[a]
        row, column = np.nonzero(one.seen)
        some = ((row + 2 * a) % stride == 0) & ((column + a) % stride == 0)
        row, column = row[some], column[some]
        found = [(a, np.arange(len(row)), one.pixels[row, column])]
        for b, other in enumerate(images):
            if b != a:
                there, back = _flow(flow, one.detail, other.detail), _flow(flow, other.detail, one.detail)
                matched = _matched(one, other, there, back, row, column)
                moved = there[row[matched], column[matched]]
                x, y = column[matched] + moved[:, 0], row[matched] + moved[:, 1]
                found.append((b, matched, bilinear(other.pixels, x, y)))
        times = np.bincount(np.concatenate([which for _, which, _ in found]), minlength=len(row))
        kept = times >= FEWEST_IMAGES
        number = np.cumsum(kept) - 1 + count
        for b, which, pixels in found:
            use = kept[which]
            sightings.append((number[which[use]], np.full(int(use.sum()), b), pixels[use]))
        texel.append((row * one.seen.shape[1] + column)[kept])
        count += int(kept.sum())
    point, image, where = (np.concatenate(parts) for parts in zip(*sightings, strict=True))
    every = max(1, -(-len(point) // MOST_SIGHTINGS))
    kept = point % every == 0
    point, image, where = point[kept] // every, image[kept], where[kept]
    order = np.argsort(point, kind="stable")
    return Tracks(np.concatenate(texel)[::every], point[order], image[order], where[order].astype(np.float64))


def _flow(method: cv2.DISOpticalFlow, first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(S, S, 2) texels from each of the first to its counterpart in the second."""
    return np.asarray(method.calc(first, second, np.zeros((*first.shape, 2), np.float32)))


def _matched(
    one: Unwrapped, other: Unwrapped, there: NDArray, back: NDArray, row: NDArray, column: NDArray
) -> NDArray[np.intp]:
    """Texels that the other image shows: flow there and back ends within half a texel, windows of 11 agree by 0.8."""
    x, y = column + there[row, column, 0], row + there[row, column, 1]
    closed = np.abs(there[row, column] + bilinear(back, x, y)).max(axis=1) < 0.5
    closed &= bilinear(other.seen.astype(np.float32), x, y) > 0.99
    grid_y, grid_x = np.indices(one.seen.shape, dtype=np.float32)
    first = one.detail.astype(np.float32)
    second = cv2.remap(
        other.detail.astype(np.float32), grid_x + there[..., 0], grid_y + there[..., 1], cv2.INTER_LINEAR
    )

    def mean(image: NDArray) -> NDArray:
        return cv2.blur(image, (11, 11))

    a, b = mean(first), mean(second)
    spread = (mean(first * first) - a * a) * (mean(second * second) - b * b)
    correlation = (mean(first * second) - a * b) / np.sqrt(np.maximum(spread, 1.0))
    return np.flatnonzero(closed & (correlation[row, column] > 0.8))
