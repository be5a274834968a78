"""What a landmark detector makes of a synthetic head: noise, a bias per landmark and head, and what it sees.

Detectors put a landmark where annotators would, not where a model's vertex is: MediaPipe's points on renders of scanned
heads lie about 5 pixels, at a width of 680, from the points that fit all views, the same way in every image of a head.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.capture.landmark_files import COUNT, Landmarks
from mifit.core.camera import Camera
from mifit.core.mesh import vertex_normals
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene

NOISE = 0.8
"""Pixels of landmark error at a width of 680; proportional to the width."""


def draw_bias(seed: int, deviation: float) -> NDArray[np.float64]:
    """(68, 3) displacement of each landmark in object space, the same in all images of a head.

    Parameters
    ----------
    seed : int
    deviation : float
        Standard deviation of each coordinate; a frontal view shows 1.25 times it on average.
    """
    return deviation * np.random.default_rng([seed, 15]).standard_normal((COUNT, 3))


def mark(
    model: MorphableModel,
    world: NDArray,
    camera: Camera,
    scene: SurfaceScene,
    rng: np.random.Generator,
    bias: NDArray | None = None,
) -> Landmarks:
    """Landmarks of one image as a detector would find them, knowing which are hidden.

    Parameters
    ----------
    model : MorphableModel
    world : (V, 3)
        Vertices in world space.
    camera : Camera
    scene : SurfaceScene
        The head at these vertices.
    rng : numpy Generator
        Of the noise.
    bias : (68, 3), optional
        Displacement in world space.
    """
    points = world[model.landmarks]
    normals = vertex_normals(world, model.faces)[model.landmarks]
    facing = np.einsum("nk,nk->n", normals, camera.position - points) > 0
    pixels = camera.project(points if bias is None else points + bias)
    inside = (pixels > 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    noise = NOISE * camera.width / 680 * rng.standard_normal(pixels.shape)
    return Landmarks(pixels + noise, facing & inside & scene.visible_from(points, camera.position))
