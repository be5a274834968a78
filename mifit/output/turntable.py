"""Novel views: a camera that circles the head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.files import replacing
from mifit.core.image import to_8_bit, write_image
from mifit.core.mesh import normalize
from mifit.errors import InputError
from mifit.output.deferred import shade_methods, visible_surface
from mifit.progress import Progress, silent

if TYPE_CHECKING:
    from mifit.result import Method, Result

BACKDROP = 0.35
"""Linear grey behind the head on sheets and in animations."""


def orbit_camera(
    reconstruction: Result, timestep: int, degrees: float, pitch: float = 0.0, distance: float | None = None
) -> Camera:
    """A camera that looks at the face from an angle about the vertical; 0 is straight from the front.

    Image size, focal length and distance are those of the fitted cameras; positive angles move the camera to
    its right, so that it sees the head's left side, and a positive ``pitch`` upwards. The vertical is the fitted
    cameras' mean up axis.

    Raises
    ------
    InputError
        The result has no cameras, or ``distance`` isn't positive.
    """
    if not reconstruction.cameras:
        raise InputError("this result has no cameras, so there is no image size to render at; give one to render()")
    model, i = reconstruction.model, reconstruction.index(timestep)
    first = reconstruction.cameras[0]
    vertices = reconstruction.geometry.vertices[i][np.unique(model.faces[model.face_mask])]
    centre = 0.5 * (vertices.min(0) + vertices.max(0)).astype(np.float64)
    up = normalize(-np.mean([c.rotation[1] for c in reconstruction.cameras], axis=0))
    front = reconstruction.geometry.rotation[i][:, 2]
    front = normalize(front - (front @ up) * up)
    reach = float(np.mean([np.linalg.norm(c.position - centre) for c in reconstruction.cameras]))
    facing = Camera.look_at(centre + reach * front, centre, up)
    cx, cy = first.width / 2, first.height / 2
    camera = replace(first, world_to_camera=facing.world_to_camera, distortion=(), cx=cx, cy=cy)
    name = f"orbit{degrees:+g}" + (f"{pitch:+g}" if pitch else "")
    return camera.orbit(degrees, pitch, centre, up, distance, name)


def write_turntable(
    reconstruction: Result,
    folder: str | Path,
    start: float = -35.0,
    stop: float = 35.0,
    steps: int = 7,
    timestep: int | None = None,
    progress: Progress = silent,
) -> None:
    """Write views about the vertical axis with and without specular, as in the paper's figure of novel views.

    Writes ``full_NN.png`` and ``diffuse_NN.png`` (RGBA) per step, ``turntable.png`` with one row per method, and
    ``turntable.webp``, an animation. A result of stage 1 alone gives ``pca_NN.png``.

    Parameters
    ----------
    reconstruction : Result
    folder : path
        Made when it is missing.
    start, stop : float
        First and last angle in degrees.
    steps : int
        Number of views.
    timestep : int, optional
        Default: the first that was fitted.
    progress : Progress
    """
    folder = Path(folder)
    timestep = reconstruction.timesteps[0] if timestep is None else timestep
    methods: tuple[Method, ...] = ("full", "diffuse") if reconstruction.reflectance is not None else ("pca",)
    rows: dict[Method, list[NDArray]] = {m: [] for m in methods}
    angles = np.linspace(start, stop, steps)
    progress("Turntable", 0, steps)
    for k, angle in enumerate(angles):
        surface = visible_surface(reconstruction, orbit_camera(reconstruction, timestep, float(angle)), timestep)
        for method, image in shade_methods(reconstruction, surface, timestep, methods).items():
            write_image(folder / f"{method}_{k:02d}.png", image)
            rows[method].append(image)
        progress("Turntable", k + 1, steps)
    write_image(folder / "turntable.png", sheet([rows[m] for m in methods]))
    write_animation(folder / "turntable.webp", rows[methods[0]] + rows[methods[0]][-2:0:-1], 12)


def on_backdrop(image: NDArray) -> NDArray:
    """Lay a linear image with coverage on grey."""
    return image[..., :3] * image[..., 3:] + BACKDROP * (1 - image[..., 3:])


def sheet(rows: Sequence[Sequence[NDArray]]) -> NDArray:
    """Images with coverage in rows, cropped to what any of them covers, on grey."""
    covered = np.any([image[..., 3] > 0 for row in rows for image in row], axis=0)
    used_rows, used_columns = np.flatnonzero(covered.any(1)), np.flatnonzero(covered.any(0))
    if not len(used_rows):
        raise InputError("no view shows the head; choose angles or a camera from which it is visible")
    box = slice(used_rows[0], used_rows[-1] + 1), slice(used_columns[0], used_columns[-1] + 1)
    return np.concatenate([np.concatenate([on_backdrop(image[box]) for image in row], axis=1) for row in rows])


def write_animation(path: str | Path, frames: Sequence[NDArray], fps: float) -> None:
    """Write linear images with coverage, on grey, as an animated WebP that loops."""
    from PIL import Image

    pictures = [Image.fromarray(to_8_bit(on_backdrop(frame))) for frame in frames]
    with replacing(path) as temporary:
        pictures[0].save(
            temporary,
            format="WEBP",
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 / fps),
            loop=0,
            quality=85,
        )
