"""Which of several surfaces the fitted views speak for: each view is predicted from the others through every surface.

A point of the true surface has the same paint in all views; through a wrong one a view is predicted from the wrong
places of the others. No light, no albedo and no landmark enters, so that what was fitted to those can be judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.image import linear_to_srgb
from mifit.render.gbuffer import SurfaceScene
from mifit.render.image_based import image_based

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

EVERY = 2
"""Of the pixels along rows and columns one in so many is judged: their errors are alike in neighbours."""


def errors_between_views(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    surfaces: Sequence[NDArray],
) -> list[float]:
    """Root mean square error of each fitted view as the others show it, for each candidate surface.

    Parameters
    ----------
    capture, model
    cameras : sequence of str
        Fitted cameras, at least two; no other camera is touched.
    timesteps : sequence of int
    surfaces : sequence of (T, V, 3)
        Candidates: the model's vertices in world space at each timestep.

    Returns
    -------
    list of float
        sRGB-encoded values, 0..1, over pixels of the face area that every candidate predicts, so that all are judged
        on the same ones; infinite where there are none.
    """
    views = {name: capture.camera(name) for name in cameras}
    scenes = [SurfaceScene(surface[0], model.faces) for surface in surfaces]
    total, count = np.zeros(len(surfaces)), 0
    for k, timestep in enumerate(timesteps):
        for scene, surface in zip(scenes, surfaces, strict=True):
            if k:
                scene.update(surface[k])
        for name, view in views.items():
            others = [other for key, other in views.items() if key != name]
            frame = capture.frame(name, timestep)
            judged = (frame.valid & ~frame.clipped)[::EVERY, ::EVERY]
            some, predicted = every(view, EVERY), []
            for scene, surface in zip(scenes, surfaces, strict=True):
                shown = image_based(capture, others, some, timestep, surface[k], model.faces, scene)
                judged = judged & shown.seen & model.face_mask[shown.face]  # nothing is seen where no face is hit
                predicted.append(shown.colour)
            wanted = linear_to_srgb(frame.image[::EVERY, ::EVERY][judged])
            total += [float(((linear_to_srgb(colour[judged]) - wanted) ** 2).sum()) for colour in predicted]
            count += 3 * int(judged.sum())
    return [float(np.sqrt(each / count)) if count else np.inf for each in total]


def every(camera: Camera, step: int) -> Camera:
    """A camera whose pixels are every ``step``-th row and column of another's, from the first on."""
    shift = 0.5 * (step - 1)
    return replace(
        camera,
        width=-(-camera.width // step),
        height=-(-camera.height // step),
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx + shift) / step,
        cy=(camera.cy + shift) / step,
    )
