"""Novel views of a result, still and moving: turntables, sequences of timesteps, renders over the input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera
from mifit.core.files import file_name, replacing
from mifit.core.image import box, to_8_bit, write_image
from mifit.core.mesh import normalize
from mifit.core.process import decoding
from mifit.errors import InputError, MifitError
from mifit.output.deferred import shade_methods, visible_surface
from mifit.output.evaluate import rgba_8_bit
from mifit.output.figures import overlay
from mifit.output.gltf import write_glb
from mifit.output.scene import render_view
from mifit.progress import Progress, silent
from mifit.result import Method, Reconstruction

CODECS = ("vp09", "mp4v")
"""Video codecs by preference: browsers play VP9; every OpenCV can write MPEG-4."""


def orbit_camera(
    result: Reconstruction, timestep: int, degrees: float, pitch: float = 0.0, distance: float | None = None
) -> Camera:
    """A camera that looks at the face from an angle about the vertical; see `Reconstruction.orbit`.

    The vertical is the fitted cameras' mean up axis.
    """
    if not result.cameras:
        raise InputError("this result has no cameras, so there is no image size to render at; give one to render()")
    i = result.index(timestep)
    first = result.cameras[0]
    centre, up = face_middle(result, i), vertical(result)
    front = result.geometry.rotation[i][:, 2]
    front = normalize(front - (front @ up) * up)
    reach = float(np.mean([np.linalg.norm(c.position - centre) for c in result.cameras]))
    facing = Camera.look_at(centre + reach * front, centre, up)
    cx, cy = first.width / 2, first.height / 2
    camera = replace(first, world_to_camera=facing.world_to_camera, distortion=(), cx=cx, cy=cy)
    name = f"orbit{degrees:+g}" + (f"{pitch:+g}" if pitch else "")
    return camera.orbit(degrees, pitch, centre, up, distance, name)


def vertical(result: Reconstruction) -> NDArray[np.float64]:
    """(3,) unit vector: up in the mean of the fitted cameras."""
    return normalize(-np.mean([c.rotation[1] for c in result.cameras], axis=0))


def face_middle(result: Reconstruction, index: int) -> NDArray[np.float64]:
    """(3,) middle of the face area's box at a position among the timesteps, world space."""
    model = result.model
    vertices = result.geometry.vertices[index][np.unique(model.faces[model.face_mask])]
    return 0.5 * (vertices.min(0) + vertices.max(0)).astype(np.float64)


def write_turntable(
    result: Reconstruction,
    folder: str | Path,
    start: float = -35.0,
    stop: float = 35.0,
    steps: int = 7,
    progress: Progress = silent,
) -> None:
    """Write views about the vertical axis with and without specular, as in the paper's figure of novel views.

    ``full_NN.png`` and ``diffuse_NN.png`` (RGBA) per step between the angles in degrees, ``turntable.png`` with one
    row per method, and ``turntable.webp``, an animation. A result of stage 1 alone gives ``pca_NN.png``.
    """
    folder = Path(folder)
    timestep = result.timesteps[0]
    methods: tuple[Method, ...] = ("full", "diffuse") if result.reflectance is not None else ("pca",)
    rows: dict[Method, list[NDArray]] = {m: [] for m in methods}
    angles = np.linspace(start, stop, steps)
    progress("Turntable", 0, steps)
    for k, angle in enumerate(angles):
        surface = visible_surface(result, orbit_camera(result, timestep, float(angle)), timestep)
        for method, image in shade_methods(result, surface, timestep, methods).items():
            write_image(folder / f"{method}_{k:02d}.png", image)
            rows[method].append(image)
        progress("Turntable", k + 1, steps)
    write_image(folder / "turntable.png", sheet([rows[m] for m in methods]))
    write_moving(folder / "turntable.webp", rows[methods[0]] + rows[methods[0]][-2:0:-1], 12)


def write_overlay(
    result: Reconstruction,
    capture: Capture,
    camera: str,
    path: str | Path,
    fps: float = 12.0,
    progress: Progress = silent,
) -> None:
    """Write ``.mp4`` of one camera at the timesteps of a result: the input, and beside it the input under the render.

    InputError where the capture has no such camera, or not all timesteps.
    """
    capture = result.seen(capture)
    view, steps = capture.camera(camera), sorted(result.timesteps)

    def frames() -> Iterable[NDArray[np.uint8]]:
        for k, timestep in enumerate(steps):
            progress(f"overlay {camera}", k, len(steps))
            yield beside(result, capture, view, timestep)
        progress(f"overlay {camera}", len(steps), len(steps))

    write_video(path, frames(), fps)


def beside(result: Reconstruction, capture: Capture, camera: Camera, timestep: int) -> NDArray[np.uint8]:
    """(H, 2 W, 3) a photograph, and beside it the same one under the render."""
    photograph = to_8_bit(capture.frame(camera.name, timestep).image)
    linear = render_view(result, camera, timestep, result.methods[-1], samples=1)
    return np.concatenate([photograph, overlay(photograph, rgba_8_bit(linear))], axis=1)


def write_moving_pictures(
    folder: str | Path,
    result: Reconstruction,
    capture: Capture,
    cameras: Sequence[str] | None = None,
    fps: float = 12.0,
    progress: Progress = silent,
) -> None:
    """Write what shows a tracked sequence: ``overlay_CAMERA.mp4`` per camera and ``sequence.glb``.

    Cameras are those of the fit by default. Parameters as in `write_overlay`.
    """
    folder = Path(folder)
    for name in [camera.name for camera in result.cameras] if cameras is None else cameras:
        write_overlay(result, capture, name, folder / f"overlay_{file_name(name)}.mp4", fps, progress)
    write_glb(result, folder / "sequence.glb", animate=sorted(result.timesteps), fps=fps)


def on_backdrop(image: NDArray) -> NDArray:
    """A linear image with coverage, on grey of 0.35."""
    return image[..., :3] * image[..., 3:] + 0.35 * (1 - image[..., 3:])


def sheet(rows: Sequence[Sequence[NDArray]]) -> NDArray:
    """Images with coverage in rows, cropped to what any of them covers, on grey."""
    covered = np.any([image[..., 3] > 0 for row in rows for image in row], axis=0)
    if not covered.any():
        raise InputError("no view shows the head; choose angles or a camera from which it is visible")
    shown = box(covered)
    return np.concatenate([np.concatenate([on_backdrop(image[shown]) for image in row], axis=1) for row in rows])


def check_moving(path: str | Path) -> None:
    """InputError for the name of a moving picture that is neither ``.mp4`` nor ``.webp``."""
    if Path(path).suffix.lower() not in (".mp4", ".webp"):
        raise InputError(f"{path}: found suffix {Path(path).suffix!r}, expected '.mp4' or '.webp'")


def write_moving(path: str | Path, frames: Iterable[NDArray], fps: float) -> None:
    """Write linear images with coverage, on grey, as ``.mp4``, or as an animated ``.webp`` that loops."""
    check_moving(path)
    codes = (to_8_bit(on_backdrop(frame)) for frame in frames)
    if Path(path).suffix.lower() == ".mp4":
        write_video(path, codes, fps)
        return
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in codes)
    with replacing(path) as temporary:
        duration = round(1000 / fps)
        first.save(temporary, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=85)


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write 8-bit RGB frames (H, W, 3) of one size as ``.mp4``, whole or not at all.

    Odd sizes lose their last row or column: video codecs halve the resolution of colour. InputError for a rate that
    isn't positive, another suffix or no frame; MifitError where OpenCV has no codec.
    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected '.mp4'")
    if not 0 < fps < float("inf"):
        raise InputError(f"fps: found {fps}, expected a number of frames per second above 0")
    with replacing(path) as temporary:
        writer, size, count = None, (0, 0), 0
        try:
            for frame in frames:
                if writer is None:
                    size = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
                    writers = (
                        cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*codec), fps, size[::-1])  # type: ignore[attr-defined]
                        for codec in CODECS
                    )
                    writer = next((w for w in writers if w.isOpened()), None)
                    if writer is None:
                        raise MifitError(f"{path}: OpenCV can write none of {', '.join(CODECS)}; install its FFmpeg")
                writer.write(np.ascontiguousarray(frame[: size[0], : size[1], ::-1]))
                count += 1
        finally:
            if writer is not None:
                writer.release()
        if writer is None:
            raise InputError(f"{path}: found no frame to write, expected one or more timesteps")
        if not _is_playable(temporary, count):  # FFmpeg doesn't say when a disk is full
            raise InputError(f"{path}: can't be written whole, is the disk full?; what was there is unchanged")


def _is_playable(path: Path, count: int) -> bool:
    """Whether a video holds ``count`` frames that can be read back."""
    with decoding():
        reader = cv2.VideoCapture(str(path))
        try:
            return reader.isOpened() and all(reader.grab() for _ in range(count))
        finally:
            reader.release()
