"""Folders of the NeRSemble data set, as released.

``PERSON/calibration/camera_params.json`` and ``PERSON/sequences/SEQUENCE/images/cam_SERIAL.mp4`` (or a folder of frames
``cam_SERIAL``). ``camera_params.json`` has one intrinsic matrix for all cameras, in pixels of
``width`` x ``height`` (2200 x 3208 where it doesn't say), and a pose per camera from the world, in metres, to OpenCV's
axes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mifit.capture.sources import ImageFiles, Source, Video
from mifit.capture.transforms import View, nearest_rotation
from mifit.core.files import read_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

VIDEOS = (".mp4", ".avi", ".mov", ".mkv")


@dataclass(frozen=True)
class Sequence:
    """One sequence: its cameras' images and their calibration."""

    sources: tuple[Source, ...]
    views: tuple[View, ...]


def read_nersemble(folder: str | Path) -> Sequence:
    """Find the images and the calibration of a sequence's folder.

    Raises
    ------
    InputError
        No images or no calibration where they are expected, or a calibration that isn't one.
    """
    folder = Path(folder)
    sources = _sources(folder)
    places = [folder, *folder.absolute().parents[:2]]
    choices = [place / part / "camera_params.json" for part in ("calibration", "") for place in places]
    file = next((choice for choice in choices if choice.is_file()), None)
    if file is None:
        raise InputError(f"{folder}: found no camera_params.json, expected {choices[2]}")
    poses, matrix, size = _parameters(file)
    views = []
    for source in sources:
        if source.name not in poses:
            raise InputError(
                f"{file}: world_2_cam: has cameras {', '.join(poses)}, expected one called {source.name!r}"
            )
        zoom = np.array(source.size) / size
        if abs(zoom[0] / zoom[1] - 1.0) > 0.01:
            raise InputError(
                f"{file}: calibrated for {size[0]} x {size[1]} pixels, but camera {source.name!r} has "
                f"{source.size[0]} x {source.size[1]}, expected the same shape"
            )
        fx, fy, cx, cy = (
            float(v) for v in np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]) * [*zoom, *zoom]
        )
        views.append(View(source.name, *source.size, (fx, fy, cx, cy), (), poses[source.name]))
    return Sequence(tuple(sources), tuple(views))


def _sources(folder: Path) -> list[Source]:
    images = folder / "images"
    if not images.is_dir():
        raise InputError(f"{images}: no such folder, expected cam_SERIAL.mp4 or folders cam_SERIAL in it")
    videos = sorted(p for p in images.iterdir() if p.suffix.lower() in VIDEOS and p.stem.startswith("cam_"))
    if videos:
        return [Video.open(path, path.stem.removeprefix("cam_")) for path in videos]
    folders = sorted(p for p in images.iterdir() if p.is_dir() and p.name.startswith("cam_"))
    if folders:
        return [ImageFiles.folder(path, path.name.removeprefix("cam_")) for path in folders]
    raise InputError(f"{images}: found no cam_SERIAL.mp4 and no folder cam_SERIAL")


def _parameters(file: Path) -> tuple[dict[str, np.ndarray], np.ndarray, tuple[int, int]]:
    try:
        document = json.loads(read_text(file, MAX_SETTINGS_BYTES, "calibration file"))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: not a readable JSON file: {error}") from None
    if not isinstance(document, dict) or not isinstance(document.get("world_2_cam"), dict):
        raise InputError(f"{file}: found no object world_2_cam, expected a pose per camera")
    matrix = _matrix(document.get("intrinsics"), (3, 3), f"{file}: intrinsics")
    if not min(matrix[0, 0], matrix[1, 1]) > 0:
        raise InputError(
            f"{file}: intrinsics: found focal lengths {matrix[0, 0]:g}, {matrix[1, 1]:g}, expected positive ones"
        )
    poses = {}
    for name, value in document["world_2_cam"].items():
        where = f"{file}: world_2_cam: {name}"
        pose = _matrix(value, (4, 4), where)
        pose[:3, :3] = nearest_rotation(pose[:3, :3], where)
        poses[str(name)] = pose
    size = tuple(document.get(key, default) for key, default in zip(("width", "height"), (2200, 3208), strict=True))
    if not all(isinstance(side, int) and 0 < side < 10**6 for side in size):
        raise InputError(f"{file}: width, height: found {size}, expected pixels")
    return poses, matrix, (int(size[0]), int(size[1]))


def _matrix(value: object, shape: tuple[int, int], where: str) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape != shape or not np.isfinite(matrix).all():
        raise InputError(f"{where}: expected {shape[0]} x {shape[1]} finite numbers")
    return matrix
