"""Where the outline of the head lies in an image, along the silhouettes of the fitted surface.

Matching says least where a surface turns away from a view, and nothing where only one view sees it; there the outline
tells. Across the silhouette of the fitted surface the image shows skin on one side and what lies behind on the other.
Every position of the border is judged by how well the pixels before it are explained by the colours deeper inside
and those beyond it by the colours farther outside, and neighbours along the silhouette agree (a hidden Markov chain,
solved exactly by one pass in either direction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.metrics import INDEPENDENT
from mifit.core.process import on_all_cores
from mifit.render.gbuffer import GBuffer, SurfaceScene
from mifit.sampling.visibility import DARKEST
from mifit.stages.surface.band import look_up

if TYPE_CHECKING:
    from mifit.capture import Capture, Frame

REACH = 8
"""Farthest that the border is looked for to either side of the fitted silhouette, pixels of the level; strips as wide
beyond it tell the colours of either side."""
ALONG = 25
"""Pixels along the silhouette that share their colours."""
SPREAD = 0.06
"""Least deviation of the logarithm of a colour within a strip."""
STRAY = 2e-4
"""Density of colours that neither side explains, per cube of logarithms: 5 % over a range of 6 in each channel."""
EVIDENCE = 0.3
"""Weight of a pixel's evidence: neighbours err alike."""
BLUR = 0.5
"""Least deviation of a border, and of its change from one pixel of the silhouette to the next, pixels: borders are
soft, and a silhouette of the mesh is known to half a pixel."""
EDGE_ON = 0.5
"""Cosine between normal and line of sight above which the mesh ends there, as at the neck, rather than turns away."""


@dataclass(frozen=True)
class Borders:
    """Points of the fitted surface on its silhouette in one view, and where the image has them.

    Attributes
    ----------
    face : (N,) int
    weights : (N, 3)
        Barycentric.
    position, normal : (N, 3)
        World space; the normal is across the line of sight.
    offset : (N,)
        Of the border along the normal, world length.
    precision : (N,)
        Inverse variance of it.
    """

    face: NDArray[np.intp]
    weights: NDArray[np.float64]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    offset: NDArray[np.float64]
    precision: NDArray[np.float64]

    def turned(self, rotation: NDArray) -> Borders:
        """With normals in the object space that a rotation (3, 3) takes to world space."""
        return replace(self, normal=self.normal @ rotation)

    def moved(self, faces: NDArray, way: NDArray) -> Borders:
        """Of a surface whose vertices have moved by (V, 3) since, world length."""
        along = (interpolate(way, faces, self.face, self.weights) * self.normal).sum(axis=1)
        return replace(self, offset=self.offset - along)


def find_borders(capture: Capture, scene: SurfaceScene, names: Sequence[str], timestep: int, factor: float) -> Borders:
    """Borders of the surface that ``scene`` holds, world space, in the images of some cameras at one timestep.

    ``factor`` is the level's pixels per pixel of the image, at most 1.
    """
    normals = vertex_normals(scene.vertices, scene.faces)
    views = [(capture.camera(name).resized(factor), capture.frame(name, timestep)) for name in names]
    # Rays take all cores by themselves.
    seen = [(camera, frame, scene.gbuffer(camera)) for camera, frame in views]
    return joined(on_all_cores(lambda view: _borders(*view, scene, normals), seen))


def _borders(camera: Camera, frame: Frame, buffer: GBuffer, scene: SurfaceScene, normals: NDArray) -> Borders:
    """Borders in one image, from what a camera at the level's resolution sees of the surface."""
    image, valid = (
        cv2.resize(values.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        for values in (frame.image, frame.valid)
    )
    log = np.log(image + np.float32(DARKEST))
    vertices, faces = scene.vertices, scene.faces
    found = []
    for pixels in _pieces(buffer.mask):
        at = pixels[:, 1], pixels[:, 0]
        face, weights = buffer.face[at], buffer.weights[at].astype(np.float64)
        position = interpolate(vertices, faces, face, weights)
        ray = normalize(position - camera.position)
        normal = normalize(interpolate(normals, faces, face, weights))
        turned = np.abs((normal * ray).sum(1)) < EDGE_ON
        normal = normalize(normal - (normal * ray).sum(1, keepdims=True) * ray)
        across = normal @ camera.rotation.T
        length = np.linalg.norm(across[:, :2], axis=1)
        way = across[:, :2] / np.maximum(length, 1e-9)[:, None]
        shift, deviation = _border(log, valid, buffer.mask, pixels, way)
        pixel = buffer.depth[at].astype(np.float64) / (np.sqrt(camera.fx * camera.fy) * np.maximum(length, 0.5))
        # A border that may be anywhere within the reach has a deviation of 0.58 of it.
        known = turned & (2.0 * deviation < REACH) & (length > 0.5)
        precision = INDEPENDENT / ((deviation**2 + BLUR**2) * pixel**2)
        every = face, weights, position, normal, shift * pixel, precision
        found.append(Borders(*(values[known] for values in every)))
    return joined(found)


def joined(parts: list[Borders]) -> Borders:
    """All of several in one."""
    if not parts:
        none = np.zeros((0, 3))
        return Borders(np.zeros(0, np.intp), none, none, none, np.zeros(0), np.zeros(0))
    return Borders(*(np.concatenate([getattr(p, f) for p in parts]) for f in Borders.__dataclass_fields__))


def _pieces(mask: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """(N, 2) pixels x, y along the outer outline of a mask, in order, inside the image."""
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pieces = []
    height, width = mask.shape
    for line in lines:
        line = line[:, 0]
        good = (line > 0).all(1) & (line[:, 0] < width - 1) & (line[:, 1] < height - 1)
        if not good.all():  # begin at a gap, so that no piece is cut
            start = int(np.flatnonzero(~good)[0])
            line, good = np.roll(line, -start, axis=0), np.roll(good, -start)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
        pieces += [line[a:b].astype(np.intp) for a, b in edges.reshape(-1, 2)]
    return pieces


def _border(
    log: NDArray, valid: NDArray, mask: NDArray[np.bool_], pixels: NDArray, way: NDArray
) -> tuple[NDArray, NDArray]:
    """Offset of the border from the silhouette and its deviation, pixels, for each of (N, 2) silhouette pixels.

    From logarithms of colours (H, W, 3), the part of each pixel that is valid, the pixels that show the surface and
    the ways (N, 2) out of it in the image.
    """
    steps = np.arange(-2 * REACH, 2 * REACH, dtype=np.float64) + 0.5  # centres of pixels across
    # The silhouette passes half a pixel outside the last pixel that shows the surface.
    at = (pixels[:, None] + (0.5 + steps)[:, None] * way[:, None]).reshape(-1, 2)
    sides = np.stack([valid, mask], axis=-1).astype(np.float32)
    colour, both = (look_up(layer, at).reshape(len(pixels), len(steps), -1) for layer in (log, sides))
    shown, surface = both[..., 0], both[..., 1]
    usable, covered = shown > 0.99, surface > 0.5  # 0 outside the image
    inside = usable & covered & (steps < -REACH)
    outside = usable & ~covered & (steps > REACH)
    evidence = np.where(usable, _likelihood(colour, inside) - _likelihood(colour, outside), 0.0)
    # Border at position j: pixels before it are skin, those from it on are not.
    some = evidence[:, REACH:-REACH]
    score = EVIDENCE * np.concatenate([np.zeros((len(some), 1)), np.cumsum(some, axis=1)], axis=1)
    position = np.arange(-REACH, REACH + 1, dtype=np.float64)
    belief = _chain(score, position)
    mean = belief @ position
    deviation = np.sqrt(np.maximum(belief @ position**2 - mean**2, 0.0))
    told = (inside.sum(1) > REACH / 2) & (outside.sum(1) > REACH / 2)
    return mean, np.where(told, deviation, np.inf)


def _likelihood(colour: NDArray, strip: NDArray[np.bool_]) -> NDArray:
    """(N, S) log density of colours (N, S, 3) under a normal of those of a strip and its neighbours' along the line."""
    weight = strip.sum(1).astype(np.float64)

    def along(values: NDArray) -> NDArray:
        return uniform_filter1d(values, ALONG, axis=0, mode="nearest")

    count = np.maximum(along(weight), 1e-6)
    shown = np.where(strip[..., None], colour, 0.0)
    mean = along(shown.sum(1)) / count[:, None]
    second = along(np.einsum("nsi,nsj->nij", shown, shown)) / count[:, None, None]
    covariance = second - mean[:, :, None] * mean[:, None, :] + SPREAD**2 * np.eye(3)
    difference = colour - mean[:, None]
    distance = np.einsum("nsi,nij,nsj->ns", difference, np.linalg.inv(covariance), difference)
    density = np.exp(-0.5 * distance) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(covariance))[:, None]
    return np.log(density + STRAY)


def _chain(score: NDArray, position: NDArray) -> NDArray:
    """(N, K) posterior of N neighbours' positions from log evidence (N, K), by the forward-backward recursion."""
    move = np.exp(-0.5 * ((position[:, None] - position) / BLUR) ** 2)
    move /= move.sum(1, keepdims=True)
    local = np.exp(score - score.max(1, keepdims=True))
    forward, backward = np.empty_like(local), np.ones_like(local)
    forward[0] = local[0] / local[0].sum()
    for i in range(1, len(local)):
        now = local[i] * (forward[i - 1] @ move)
        forward[i] = now / max(now.sum(), 1e-300)
    for i in range(len(local) - 2, -1, -1):
        now = move @ (local[i + 1] * backward[i + 1])
        backward[i] = now / max(now.sum(), 1e-300)
    belief = forward * backward
    return belief / np.maximum(belief.sum(1, keepdims=True), 1e-300)
