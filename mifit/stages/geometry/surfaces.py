"""The model's surface beyond its span, and as rays meet it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene


def displaced(model: MorphableModel, geometry: GeometryEstimate) -> MorphableModel:
    """The model whose mean lies on the found surface: its coefficients add to that."""
    if geometry.displacement is None:
        return model
    return replace(model, mean=model.mean + geometry.displacement)


def moved_by(model: MorphableModel, geometry: GeometryEstimate, movement: NDArray) -> GeometryEstimate:
    """The fit with its neutral surface moved by (V, 3), object space; vertices follow at all timesteps."""
    before = 0.0 if geometry.displacement is None else geometry.displacement
    found = replace(geometry, displacement=(before + movement).astype(np.float32))
    objects = object_shapes(model, found)
    world = found.scale * objects @ found.rotation.transpose(0, 2, 1) + found.translation[:, None]
    return replace(found, vertices=world.astype(np.float32))


def object_shapes(model: MorphableModel, geometry: GeometryEstimate) -> NDArray[np.float64]:
    """(T, V, 3) vertices of each timestep in object space."""
    carried = displaced(model, geometry)
    return np.stack([carried.shape(geometry.identity, x) for x in geometry.expression]).astype(np.float64)


class Scenes:
    """Scenes of several timesteps, each built anew only where the surface has left the one that is kept.

    Building what rays are traced against costs as much as a sweep.

    Parameters
    ----------
    faces : (F, 3) int
    watched : (n,) int, optional
        Vertices whose movement counts; by default all.
    slack : float
        Movement up to which the scene that is kept serves, world length; 0: any counts.
    """

    def __init__(self, faces: NDArray, watched: NDArray | None = None, slack: float = 0.0) -> None:
        self._faces, self._watched, self._slack = faces, slice(None) if watched is None else watched, slack
        self._scenes: dict[int, SurfaceScene] = {}

    def at(self, timestep: int, vertices: NDArray) -> SurfaceScene:
        """The scene of a timestep whose vertices (V, 3) these are; its own ``vertices`` differ by the slack at most."""
        scene = self._scenes.get(timestep)
        if scene is None:
            scene = self._scenes[timestep] = SurfaceScene(vertices, self._faces)
        elif self._moved(scene.vertices, vertices):
            scene.update(vertices)
        return scene

    def last(self, timestep: int) -> SurfaceScene:
        """The scene of a timestep that `at` gave last."""
        return self._scenes[timestep]

    def _moved(self, before: NDArray, after: NDArray) -> bool:
        way = after[self._watched] - before[self._watched]
        return bool(np.einsum("vc,vc->v", way, way).max(initial=0.0) > self._slack**2)
