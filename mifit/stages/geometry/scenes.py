"""The surface of each timestep as rays meet it, kept from one look to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.render.gbuffer import SurfaceScene


class Scenes:
    """Scenes of several timesteps, each built anew only where the surface has left the one that is kept.

    Building what rays are traced against costs as much as a sweep's look at an image.

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

    def _moved(self, before: NDArray, after: NDArray) -> bool:
        way = after[self._watched] - before[self._watched]
        return bool(np.einsum("vc,vc->v", way, way).max(initial=0.0) > self._slack**2)
