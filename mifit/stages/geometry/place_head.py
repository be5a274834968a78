"""How far away a head is that the landmarks of one camera place: where the other views show it.

A head twice as large and twice as far away has the same landmarks in one camera. Where the detector finds nothing in
all others, as in full profiles, or something wrong, only the size of the model's mean would decide, and people differ
by a few per cent. Views that look at the head from elsewhere show it in another place for every distance: there its
outline stands out from what lies behind, and its skin is what the first view shows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera, rigid
from mifit.core.metrics import median_deviation
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.progress import Progress
from mifit.render.gbuffer import SurfaceScene
from mifit.sampling.visibility import DARKEST, EDGE_PIXELS, OUTLINE_MM
from mifit.stages.geometry.landmarks import LandmarkFit, LandmarkView, State, contradicts, world_vertices
from mifit.stages.geometry.parameters import Frames
from mifit.stages.surface.sweep import likeness
from mifit.stages.surface.views import LARGEST_TEXTURE, pixel_length, pose_views, texture_size

SIZES = np.exp(0.01 * np.arange(-40, 41))
"""Sizes of a head, as factors of the model's, in steps of a hundredth: units of files differ by more than people do."""
LEAST_EVIDENCE = 3.0
"""Deviations by which the best size stands out; with less the head keeps the model's. Chosen on scan_city and its scan
in profile: 4 to 10 where views show the head, 2 at the most where they show noise."""


def place_head(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timestep: int,
    start: LandmarkFit,
    fit: Callable[[tuple[LandmarkView, ...]], LandmarkFit],
    progress: Progress,
) -> tuple[LandmarkFit, tuple[str, ...]]:
    """The fit by landmarks where what all views show agrees, and the camera whose landmarks contradict it, if any.

    The fit as it is where the landmarks of cameras agree, where three or more have some, so that most decide, and where
    no view shows which size is right. ``start`` is by the landmarks of all cameras, ``fit`` makes one of the landmarks
    of some. The first timestep of the fit decides, since all share the size.
    """
    views = {name: tuple(view for view in start.views if view.camera.name == name) for name in cameras}
    marked = [name for name, own in views.items() if own]
    if len(cameras) == 1 or len(marked) > 2 or (len(marked) == 2 and not contradicts(start.state, start.views)):
        return start, ()
    best, most, left_out = start, LEAST_EVIDENCE, tuple[str, ...]()
    steps = {view.step for view in start.views}
    for name in (name for name in marked if {view.step for view in views[name]} == steps):
        alone = fit(views[name]) if len(marked) == 2 else start
        others = [other for other in cameras if other != name]
        state, evidence = _placed(capture, model, (name, *others), timestep, alone.state, progress)
        if evidence > most:
            best, most = replace(alone, state=state), evidence
            left_out = tuple(other for other in marked if other != name)
    return best, left_out


def _placed(
    capture: Capture, model: MorphableModel, names: Sequence[str], timestep: int, state: State, progress: Progress
) -> tuple[State, float]:
    """A state scaled about the first camera so that the other views agree best, and by how much that stands out."""
    centre, world = capture.camera(names[0]).position, world_vertices(model, state)[0]
    pixel = pixel_length([capture.camera(name) for name in names], world.mean(axis=0))
    factor = min(1.0, pixel * capture.unit_mm / OUTLINE_MM)
    side = texture_size(model, world, 0.5 * pixel / factor, LARGEST_TEXTURE)
    texels = rasterize_uv(model.uv, model.faces_uv, side, model.face_mask)
    scene = SurfaceScene(world, model.faces)
    views = [(capture.camera(name), capture.frame(name, timestep)) for name in names]
    small = [camera.resized(factor) for camera, _ in views[1:]]
    sizes = [(camera.width, camera.height) for camera in small]
    images = [cv2.resize(v[1].image, n, interpolation=cv2.INTER_AREA) for v, n in zip(views[1:], sizes, strict=True)]
    logs = [np.log(image + np.float32(DARKEST)) for image in images]

    def evidence(size: float) -> list[float]:
        """Of each other view how much its skin is the first view's, and how far the outline stands out.

        The head stays and the cameras are nearer to the first one instead, or farther: the images are the same, and
        what rays are traced against is built once.
        """
        posed = pose_views(
            scene, world, model.faces, texels, [(_nearer(c, centre, size), frame) for c, frame in views], factor
        )
        alike = [likeness(posed, (0, k)) for k in range(1, len(names))]
        edges = [
            outline_contrast(scene.gbuffer(_nearer(camera, centre, size)).mask, log)
            for camera, log in zip(small, logs, strict=True)
        ]
        return [np.nan if value is None else value for value in (*alike, *edges)]

    found = np.empty((len(SIZES), 2 * len(small)))
    for k, size in enumerate(SIZES):
        progress("Placing the head", k, len(SIZES))
        found[k] = evidence(size)
    found = found[:, np.isfinite(found).mean(axis=0) > 0.25]
    if not found.size:
        return state, 0.0
    spread = [max(median_deviation(column[np.isfinite(column)]), 1e-6) for column in found.T]
    total = np.nansum((found - np.nanmedian(found, axis=0)) / spread, axis=1) / np.sqrt(found.shape[1])
    best = int(np.argmax(total))
    low, peak, high = total[np.clip([best - 1, best, best + 1], 0, len(SIZES) - 1)]
    size = SIZES[best] * (SIZES[1] / SIZES[0]) ** (0.5 * (high - low) / max(2.0 * peak - low - high, 1e-6))
    return _scaled(state, float(size), centre), float(peak)


def _nearer(camera: Camera, centre: NDArray, factor: float) -> Camera:
    """The camera, its distance from a centre (3,) divided by a factor."""
    position = centre + (camera.position - centre) / factor
    return replace(camera, world_to_camera=rigid(camera.rotation, -camera.rotation @ position))


def outline_contrast(mask: NDArray[np.bool_], log: NDArray) -> float | None:
    """Mean difference of log colours (H, W, 3) between both sides of a mask's outline; None without an outline.

    Where the image ends there is none.
    """
    shown, wide = mask.astype(np.uint8), np.ones((2 * round(EDGE_PIXELS) + 1,) * 2, np.uint8)
    rings = [ring.astype(np.float32) for ring in (shown - cv2.erode(shown, wide), cv2.dilate(shown, wide) - shown)]
    weights = [cv2.GaussianBlur(ring, (0, 0), EDGE_PIXELS) for ring in rings]
    inside, outside = (
        cv2.GaussianBlur(log * ring[..., None], (0, 0), EDGE_PIXELS) / np.maximum(weight, 1e-6)[..., None]
        for ring, weight in zip(rings, weights, strict=True)
    )
    edge = (rings[0] + rings[1] > 0) & (np.minimum(*weights) > 0.05)
    return float(np.abs(inside - outside)[edge].mean()) if edge.any() else None


def _scaled(state: State, size: float, centre: NDArray) -> State:
    """The state with the head a factor larger, and as much farther from a centre (3,)."""
    x = state.x.copy()
    for k in range(state.layout.timesteps):
        at = state.layout.at("translation", k)
        x[at] = centre + size * (x[at] - centre)
    return replace(state, frames=Frames(state.frames.rotation, size * state.frames.scale), x=x)
