"""One image, read at points of the surface that it shows: which of them it does, and in what colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import normalize
from mifit.core.uv import bilinear
from mifit.stages.trust import elsewhere

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

GRAZING = (0.1, 0.3)
"""Cosines between which the weight of an observation fades in: below, interpolated normals and footprints mislead."""


@dataclass(frozen=True)
class SurfaceImage:
    """One image with what is needed to read it at surface points."""

    step: int
    camera_index: int
    camera: Camera
    colour: NDArray[np.float32]  # 0 where unusable
    unusable: NDArray[np.float32]  # 1 where invalid, not the face area, or at an occlusion edge
    clipped: NDArray[np.float32]
    footprint: NDArray[np.float32]  # (F,) pixels per texel, 0 for faces that face away
    outline: NDArray[np.float32]  # (H, W) pixels to the nearest outline times millimetres per unit of length


@dataclass(frozen=True)
class Placed:
    """Surface points (N,) in one image.

    Attributes
    ----------
    image : SurfaceImage
    point : (N, 3) float64, view : (N, 3)
        World position and unit vector towards the camera.
    cosine, weight : (N,)
        As in `Observations`, of all points.
    rows : (M,) int
        Points that the image may show.
    x, y, share : (M,)
        Where it does, and the part of usable pixels there.
    """

    image: SurfaceImage
    point: NDArray[np.float64]
    view: NDArray
    cosine: NDArray
    weight: NDArray[np.float32]
    rows: NDArray[np.intp]
    x: NDArray
    y: NDArray
    share: NDArray

    @classmethod
    def of(cls, image: SurfaceImage, point: NDArray[np.float64], normal: NDArray, face: NDArray) -> Placed:
        """Points that face the camera within the image, in front of usable pixels."""
        camera = image.camera
        view = normalize(camera.position - point).astype(np.float32)
        pixel = np.nan_to_num(camera.project(point), nan=-1e6)
        inside = (pixel >= 0.5).all(-1) & (pixel[:, 0] <= camera.width - 0.5) & (pixel[:, 1] <= camera.height - 0.5)
        cosine = np.sum(normal * view, axis=-1)
        fade = np.clip((cosine - GRAZING[0]) / (GRAZING[1] - GRAZING[0]), 0.0, 1.0)
        weight = (image.footprint[face] * fade * inside).astype(np.float32)
        rows = np.flatnonzero(weight > 0)
        x, y = pixel[rows, 0] - 0.5, pixel[rows, 1] - 0.5
        share = 1.0 - bilinear(image.unusable, x, y)
        usable = share > 0.5
        weight[rows[~usable]] = 0.0
        return cls(image, point, view, cosine, weight, rows[usable], x[usable], y[usable], share[usable])

    def seen(self, scene: SurfaceScene) -> Placed:
        """Those that nothing of the mesh hides."""
        usable = scene.visible_from(self.point[self.rows], self.image.camera.position)
        weight = self.weight.copy()
        weight[self.rows[~usable]] = 0.0
        kept = {name: getattr(self, name)[usable] for name in ("rows", "x", "y", "share")}
        return replace(self, weight=weight, **kept)

    def read(self, trust: bool, colour: NDArray, weight: NDArray, clipped: NDArray, wrong: NDArray) -> None:
        """Fill in colour (N, 3), weight, clipping and probability of showing something else (N,), zero before."""
        image, rows, x, y, camera = self.image, self.rows, self.x, self.y, self.image.camera
        weight[:] = self.weight
        colour[rows] = bilinear(image.colour, x, y) / self.share[:, None]  # of the usable pixels alone
        clipped[rows] = bilinear(image.clipped, x, y) > 0.0
        if trust:
            depth = np.sum((self.point[rows] - camera.position) * camera.rotation[2], axis=1)
            wrong[rows] = elsewhere(self.cosine[rows], bilinear(image.outline, x, y) * depth / camera.fx)
