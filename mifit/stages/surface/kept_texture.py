"""The surface's texture at the fitted timesteps, to which a further timestep is aligned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.surface.align_timesteps import align_timesteps, looks_at
from mifit.stages.surface.sweep import Posed
from mifit.stages.surface.views import pose_texels, texels_of_pixels

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


LEVELS = (2, 1, 0)
"""Of the image pyramid, one after the other: landmarks that share a bias leave a face pixels from where its skin is."""


class KeptTexture:
    """What the views of the timesteps that ``geometry`` fits show of the surface; no other camera is read."""

    def __init__(
        self, capture: Capture, model: MorphableModel, geometry: GeometryEstimate, cameras: Sequence[str]
    ) -> None:
        self._capture, self._model, self._cameras = capture, model, tuple(cameras)
        views = [capture.camera(name) for name in cameras]
        vertices = geometry.vertices.astype(np.float64)
        self._texels, self._factor, _ = texels_of_pixels(model, vertices[0], views)
        steps = list(zip(geometry.timesteps, vertices, strict=True))
        self._looks = {level: looks_at(self._texels, [self._posed(*one, level) for one in steps]) for level in LEVELS}
        finest = self._looks[LEVELS[-1]]
        weight = np.stack([look.weight for look in finest])
        self._known = weight.sum(axis=0) > 0
        value = np.stack([look.value for look in finest])
        self._mean = (weight * value).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-6)

    def aligned(self, geometry: GeometryEstimate) -> GeometryEstimate:
        """Pose and expression of one timestep where its views agree best with those that are kept.

        ``geometry`` itself where they agree no better elsewhere, as when something hides most of the face.
        """
        model, texels, moved = self._model, self._texels, geometry
        timestep = geometry.timesteps[0]
        for level, looks in self._looks.items():
            posed = self._posed(timestep, moved.vertices[0].astype(np.float64), level)
            moved = align_timesteps(model, moved, texels, [posed], looks)
        posed = self._posed(timestep, geometry.vertices[0].astype(np.float64), LEVELS[-1])
        by = interpolate(moved.vertices[0] - geometry.vertices[0], model.faces, texels.face, texels.weights)
        apart, share = self._compared(replace(posed, position=posed.position + by))
        if not (apart < self._compared(posed)[0] and share > 0.5):
            return geometry
        names = ("rotation", "translation", "expression")
        return replace(moved, **{n: getattr(moved, n).astype(getattr(geometry, n).dtype) for n in names})

    def _compared(self, posed: Posed) -> tuple[float, float]:
        """Median difference of what a timestep's views show from what is kept, and how much of that they show.

        The share is 1 for the same texture and about 0 for another, however noisy; 0 where nothing is seen.
        """
        apart, shown, kept = [np.zeros(0)], 0.0, 0.0
        for look in looks_at(self._texels, [posed]):
            rows = (look.weight > 0) & self._known
            value, mean = look.value[rows], self._mean[rows]
            apart.append(np.abs(value - mean))
            shown, kept = shown + float(value @ mean), kept + float(mean @ mean)
        every = np.concatenate(apart)
        return float(np.median(every)) if len(every) else np.inf, shown / max(kept, 1e-12)

    def _posed(self, timestep: int, vertices: NDArray, level: int) -> Posed:
        scene = SurfaceScene(vertices, self._model.faces)
        given = scene, vertices, self._model.faces, self._texels, self._cameras, timestep, 0.5**level * self._factor
        return pose_texels(self._capture, *given)
