"""What each image sees of the current surface: found anew by Mitsuba at every outer step."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.core.mesh import face_cross, interpolate, normalize, vertex_normals
from mifit.core.process import on_all_cores
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import GBuffer, SurfaceScene
from mifit.stages.geometry.consistency import TextureView
from mifit.stages.geometry.images import DARKEST, SmoothImage, level, texture_level
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.rendering import PixelView
from mifit.stages.geometry.scenes import Scenes
from mifit.stages.geometry.start import State, object_vertices

GRAZING_COSINE = 0.25  # beyond about 75 degrees a pixel covers too much surface to place it well


@dataclass(frozen=True)
class SurfacePoints:
    """Points spread evenly over the facial surface.

    Attributes
    ----------
    face : (N,) int, weights : (N, 3) float32
    basis : PointBasis
    """

    face: NDArray
    weights: NDArray
    basis: PointBasis


def spread_points(model: MorphableModel, count: int, seed: int) -> SurfacePoints:
    """Stratified by area: the k-th point lies in the k-th part of the summed area, so that none cluster by face."""
    rng = np.random.default_rng(seed)
    area = np.linalg.norm(face_cross(model.mean.astype(np.float64), model.faces), axis=1) * model.face_mask
    cumulative = np.cumsum(area)
    target = (np.arange(count) + rng.random(count)) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, target, side="right"), len(area) - 1)
    uv = rng.random((count, 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1.0, 1.0 - uv, uv)
    weights = np.concatenate([1.0 - uv.sum(1, keepdims=True), uv], axis=1).astype(np.float32)
    return SurfacePoints(face, weights, PointBasis.on_faces(model, face, weights))


class Visibility:
    """Ray-traced views of the surface at a state."""

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        cameras: Sequence[str],
        timesteps: Sequence[int],
        scenes: Scenes | None = None,
    ) -> None:
        self._scenes = scenes or Scenes(model.faces)
        self.capture, self.model = capture, model
        self.cameras: list[Camera] = [capture.camera(name) for name in cameras]
        self.timesteps = tuple(timesteps)
        self._shown: dict[int, NDArray] = {}  # vertices that the buffers show
        self.warnings: list[Diagnostic] = []
        self.blind: set[tuple[str, int]] = set()  # images (camera, step) that showed nothing of the face once
        self._buffers: dict[tuple[int, str], GBuffer] = {}
        self._measured: dict[tuple[int, str], NDArray[np.bool_]] = {}
        self._levels: dict[tuple[int, str, float], SmoothImage] = {}

    def world(self, state: State) -> NDArray[np.float64]:
        """(T, V, 3) world-space vertices."""
        objects = object_vertices(self.model, state)
        return np.stack(
            [
                state.frames.pose(state.layout, state.x, k).apply(objects[k].astype(np.float64))
                for k in range(len(self.timesteps))
            ]
        )

    def _look(self, step: int, vertices: NDArray) -> SurfaceScene:
        """The surface of a timestep, and what every camera sees of it in ``_buffers``: anew where its scene is."""
        scene = self._scenes.at(self.timesteps[step], vertices)
        if self._shown.get(step) is not scene.vertices:
            self._shown[step] = scene.vertices
            for camera in self.cameras:
                self._buffers[step, camera.name] = scene.gbuffer(camera)
        return scene

    def _usable(self, step: int, camera: Camera, border: int) -> NDArray[np.bool_]:
        """Pixels on the model, not at its outline, measured, neither clipped nor black."""
        at = (step, camera.name)
        if at not in self._measured:
            frame = self.capture.frame(camera.name, self.timesteps[step])
            self._measured[at] = frame.valid & ~frame.clipped & (frame.image.max(axis=2) > DARKEST)
        on = (self._buffers[at].face >= 0).astype(np.uint8)
        if border:
            on = np.asarray(cv2.erode(on, np.ones((2 * border + 1,) * 2, np.uint8), borderValue=0), np.uint8)
        return (on > 0) & self._measured[at]

    def _level(self, step: int, camera: Camera, sigma: float) -> SmoothImage:
        """An image, blurred: the same in every round."""
        at = (step, camera.name, sigma)
        if at not in self._levels:
            frame = self.capture.frame(camera.name, self.timesteps[step])
            self._levels[at] = level(frame.image, frame.valid, sigma)
        return self._levels[at]

    def _warn_unusable(self, camera: Camera, step: int) -> None:
        self.blind.add((camera.name, step))
        text = (
            f"camera {camera.name}, timestep {self.timesteps[step]}: no pixel of the face can be used (out of view, "
            "masked, clipped or black); only landmarks count there"
        )
        self.warnings.append(Diagnostic("no-usable-pixels", text, camera=camera.name))

    def textures(self, state: State, points: SurfacePoints, sigma: float, window: float) -> tuple[TextureView, ...]:
        """Log-texture of every image and the points it sees."""
        looks, shown = [], []
        rows = points.basis
        for step, vertices in enumerate(self.world(state)):
            scene = self._look(step, vertices)
            position = interpolate(vertices, self.model.faces, points.face, points.weights)
            normal = interpolate(
                vertex_normals(vertices, self.model.faces), self.model.faces, points.face, points.weights
            )
            normal = normalize(normal)
            for camera in self.cameras:
                frame = self.capture.frame(camera.name, self.timesteps[step])
                usable = self._usable(step, camera, 1)
                cosine = (normalize(camera.position - position) * normal).sum(1)
                seen = np.flatnonzero((cosine > GRAZING_COSINE) & scene.visible_from(position, camera.position))
                if not len(seen) or not usable.any():
                    self._warn_unusable(camera, step)
                    continue
                pick = (3 * seen[:, None] + np.arange(3)).ravel()
                basis = PointBasis(rows.mean[pick], rows.identity[pick], rows.expression[pick])
                looks.append((step, camera, seen, cosine[seen], basis))
                shown.append((frame.image, usable))
        # Rays, above, take all cores by themselves.
        images = on_all_cores(lambda one: texture_level(*one, sigma, window), shown)
        return tuple(
            TextureView(step, camera, image, *seen) for (step, camera, *seen), image in zip(looks, images, strict=True)
        )

    def pixels(self, state: State, count: int, sigma: float, seed: int, anew: bool = True) -> tuple[PixelView, ...]:
        """Up to ``count`` facial pixels of every image, chosen evenly at random.

        ``anew=False`` takes the surface points from the last look at the surface, where there was one: enough to
        choose points whose position will be projected again.
        """
        rng = np.random.default_rng(seed)
        out = []
        for step, vertices in enumerate(self.world(state)):
            if anew or any((step, camera.name) not in self._buffers for camera in self.cameras):
                self._look(step, vertices)
            for camera in self.cameras:
                buffer = self._buffers[step, camera.name]
                usable = self._usable(step, camera, 2)
                facial = np.flatnonzero(usable & self.model.face_mask[np.maximum(buffer.face, 0)])
                if len(facial) > count:
                    facial = np.sort(rng.choice(facial, count, replace=False))
                if not len(facial):
                    self._warn_unusable(camera, step)
                    continue
                face, weights = buffer.face.reshape(-1)[facial], buffer.weights.reshape(-1, 3)[facial]
                out.append(PixelView(step, camera, self._level(step, camera, sigma), face, weights))
        return tuple(out)


def unseen_warnings(
    blind: Collection[tuple[str, int]], cameras: Sequence[str], steps: int, unit_mm: float
) -> list[Diagnostic]:
    """What to say of cameras that show nothing of the fitted face in any of the timesteps.

    Parameters
    ----------
    blind : collection of (camera, step)
        Images that showed nothing of the face.
    cameras, steps
        The cameras fitted, and the number of timesteps.
    unit_mm : float
        The capture's unit of length in millimetres.
    """
    return [
        Diagnostic(
            "face-unseen",
            f"camera {name} shows the front of the fitted face at no timestep. If its images do show the face: is the "
            f"unit of length right (found one of {unit_mm:g} mm), is the order of the landmarks (left taken for right "
            "turns a head around), are the cameras' poses?",
            camera=name,
        )
        for name in cameras
        if all((name, step) in blind for step in range(steps))
    ]
