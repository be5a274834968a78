"""Timesteps as moving pictures: renders of a sequence, and renders over the input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import file_name, replacing
from mifit.core.image import to_8_bit
from mifit.core.quiet import decoding
from mifit.errors import InputError, MifitError
from mifit.output.deferred import shade_methods, visible_surface
from mifit.output.evaluate import as_photographed, rgba_8_bit
from mifit.output.figures import overlay
from mifit.output.gltf import write_glb
from mifit.output.turntable import on_backdrop, orbit_camera, write_animation
from mifit.progress import Progress, silent

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Method, Result

CODECS = ("vp09", "mp4v")
"""Video codecs by preference: browsers play VP9; every OpenCV can write MPEG-4."""


def write_sequence(
    reconstruction: Result,
    path: str | Path,
    start: float = 0.0,
    stop: float = 0.0,
    timesteps: Sequence[int] | None = None,
    methods: Sequence[Method] | None = None,
    fps: float = 12.0,
    progress: Progress = silent,
) -> None:
    """Animate the timesteps of a result, the face moving as it did while a camera turns about it.

    Parameters
    ----------
    reconstruction : Result
        Fitted, tracked or relit.
    path : path
        ``.mp4``, or ``.webp`` for an animated picture.
    start, stop : float
        Angles in degrees of the camera at the first and the last frame, as in a turntable around the first frame.
    timesteps : sequence of int, optional
        Default: all in order of time.
    methods : sequence of str, optional
        Shown side by side; default: the best that the result has.
    fps : float
        Frames per second.
    progress : Progress

    Raises
    ------
    InputError
        A timestep or method that the result lacks, another suffix, or no cameras.
    """
    path = Path(path)
    if path.suffix.lower() not in (".mp4", ".webp"):
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected '.mp4' or '.webp'")
    steps = sorted(reconstruction.timesteps) if timesteps is None else timesteps
    shown = tuple(reconstruction.methods[-1:] if methods is None else methods)
    for method in shown:
        if method not in reconstruction.methods:
            raise InputError(f"method {method!r}: found no such result, expected one of {reconstruction.methods}")
    angles = np.linspace(start, stop, len(steps))
    cameras = [orbit_camera(reconstruction, steps[0], float(angle)) for angle in angles]

    def frames() -> Iterable[NDArray]:
        for k, (timestep, camera) in enumerate(zip(steps, cameras, strict=True)):
            progress("sequence", k, len(steps))
            surface = visible_surface(reconstruction, camera, timestep)
            images = shade_methods(reconstruction, surface, timestep, shown)
            yield np.concatenate([images[m] for m in shown], axis=1)
        progress("sequence", len(steps), len(steps))

    if path.suffix.lower() == ".webp":
        write_animation(path, list(frames()), fps)
    else:
        write_video(path, (to_8_bit(on_backdrop(frame)) for frame in frames()), fps)


def write_overlay(
    reconstruction: Result,
    capture: Capture,
    camera: str,
    path: str | Path,
    fps: float = 12.0,
    progress: Progress = silent,
) -> None:
    """Write a video of one camera: the input, and beside it the input under the render.

    Parameters
    ----------
    reconstruction : Result
    capture : Capture
        Its images of ``camera``, at the timesteps of the result.
    camera : str
        Any camera of the capture.
    path : path
        ``.mp4``.
    fps : float
        Frames per second.
    progress : Progress

    Raises
    ------
    InputError
        The capture has no such camera, or not all timesteps.
    """
    capture = reconstruction.seen(capture)
    view, steps = capture.camera(camera), sorted(reconstruction.timesteps)

    def frames() -> Iterable[NDArray[np.uint8]]:
        for k, timestep in enumerate(steps):
            progress(f"overlay {camera}", k, len(steps))
            photograph = to_8_bit(capture.frame(camera, timestep).image)
            linear = reconstruction.render(view, timestep, reconstruction.methods[-1], samples=1)
            render = rgba_8_bit(as_photographed(reconstruction, linear, camera))
            yield np.concatenate([photograph, overlay(photograph, render)], axis=1)
        progress(f"overlay {camera}", len(steps), len(steps))

    write_video(path, frames(), fps)


def write_moving_pictures(
    folder: str | Path,
    reconstruction: Result,
    capture: Capture,
    cameras: Sequence[str] | None = None,
    fps: float = 12.0,
    progress: Progress = silent,
) -> list[Path]:
    """Write what shows a tracked sequence: ``overlay_CAMERA.mp4`` per camera and ``sequence.glb``.

    Cameras are those of the fit by default. Parameters as in `write_overlay`. Returns the files.
    """
    folder = Path(folder)
    names = [camera.name for camera in reconstruction.cameras] if cameras is None else cameras
    overlays = [folder / f"overlay_{file_name(name)}.mp4" for name in names]
    for name, path in zip(names, overlays, strict=True):
        write_overlay(reconstruction, capture, name, path, fps, progress)
    write_glb(reconstruction, folder / "sequence.glb", animate=sorted(reconstruction.timesteps), fps=fps)
    return [*overlays, folder / "sequence.glb"]


def write_video(path: str | Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write 8-bit RGB frames (H, W, 3) of one size as ``.mp4``, whole or not at all.

    Odd sizes lose their last row or column: video codecs halve the resolution of colour.

    Raises
    ------
    InputError
        A rate that isn't positive, another suffix, or no frame.
    MifitError
        OpenCV has no codec for it.
    """
    import cv2

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
    import cv2

    with decoding():
        reader = cv2.VideoCapture(str(path))
        try:
            return reader.isOpened() and all(reader.grab() for _ in range(count))
        finally:
            reader.release()
