"""COLMAP models: ``cameras.txt`` and ``images.txt``, or ``cameras.bin`` and ``images.bin``.

COLMAP's pixels are ours (the first centre at 0.5, 0.5), its camera axes OpenCV's, its poses world to camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.capture.colmap_binary import CameraEntry, ImageEntry, read_binary_cameras, read_binary_images
from mifit.capture.photos import MAX_NUMBER, Photo, local, view_name
from mifit.capture.transforms import View
from mifit.core.camera import Camera
from mifit.core.files import read_text, write_text
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_PIXELS
from mifit.errors import InputError

_MODELS = {  # where fx, fy, cx, cy and OpenCV's distortion coefficients are among the parameters
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}


def read_colmap(folder: str | Path) -> tuple[Photo, ...]:
    """Read a text model, or where there is none a binary one.

    Each view is named after the image: its folder (``left/0000.png`` -> ``left``), or its stem when it has none.

    Raises
    ------
    InputError
        A missing or malformed file, an unknown camera model, or a pose that isn't one.
    """
    folder = Path(folder)
    if not (folder / "cameras.txt").exists() and (folder / "cameras.bin").exists():
        source = "cameras.bin"
        entries = read_binary_cameras(folder / "cameras.bin"), read_binary_images(folder / "images.bin")
    else:
        source = "cameras.txt"
        entries = _text_cameras(folder / "cameras.txt"), _text_images(folder / "images.txt")
    cameras = {key: _camera(where, model, numbers) for where, key, model, numbers in entries[0]}
    photos = []
    for where, pose, key, name in entries[1]:
        if key not in cameras:
            raise InputError(f"{where}: camera {key} is not in {source}")
        if not (np.isfinite(pose).all() and max(map(abs, pose)) < MAX_NUMBER):
            raise InputError(f"{where}: found a NaN or a number beyond {MAX_NUMBER:g}, expected a pose")
        length = float(np.linalg.norm(pose[:4]))
        if abs(length - 1.0) > 1e-3:
            raise InputError(f"{where}: found a quaternion of length {length:.4g}, expected 1")
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()
        matrix[:3, 3] = pose[4:]
        columns, rows, intrinsics, distortion = cameras[key]
        photos.append(Photo(name, View(view_name(name), columns, rows, intrinsics, distortion, matrix)))
    return local(photos, str(folder))


_Camera = tuple[int, int, tuple[float, float, float, float], tuple[float, ...]]


def _camera(where: str, model: str, numbers: tuple[float, ...]) -> _Camera:
    """Width, height, intrinsics and OpenCV's distortion of one camera entry: width, height and its parameters."""
    if model not in _MODELS:
        raise InputError(f"{where}: found camera model {model!r}, expected one of {', '.join(_MODELS)}")
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: found a NaN or infinite value, expected finite numbers")
    pinhole, lens = _MODELS[model]
    width, height, *parameters = numbers
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS and width % 1 == height % 1 == 0):
        raise InputError(
            f"{where}: found {width:g} x {height:g} pixels, expected whole numbers of at most "
            f"{MAX_PIXELS // 10**6} megapixels"
        )
    if len(parameters) != max((*pinhole, *lens)) + 1:
        raise InputError(
            f"{where}: found {len(parameters)} parameters, expected {max((*pinhole, *lens)) + 1} of {model}"
        )
    fx, fy, cx, cy = (parameters[i] for i in pinhole)
    if not (min(fx, fy) > 0):
        raise InputError(f"{where}: found focal length {min(fx, fy):g}, expected a positive one")
    distortion = tuple(parameters[i] for i in lens)
    if len(distortion) in (1, 2):
        distortion = (*distortion, 0.0, 0.0, 0.0)[:4]
    return int(width), int(height), (fx, fy, cx, cy), distortion if any(distortion) else ()


def _text_cameras(path: Path) -> Iterator[CameraEntry]:
    for where, words in _lines(path):
        if len(words) < 5:
            raise InputError(f"{where}: found {len(words)} fields, expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        if words[1] not in _MODELS:
            raise InputError(f"{where}: found camera model {words[1]!r}, expected one of {', '.join(_MODELS)}")
        yield where, words[0], words[1], _floats(words[2:], where)


def _text_images(path: Path) -> Iterator[ImageEntry]:
    for where, words in _lines(path, every=2):
        if len(words) < 10:
            raise InputError(f"{where}: found {len(words)} fields, expected ID, QW QX QY QZ, TX TY TZ, CAMERA_ID, NAME")
        yield where, _floats(words[1:8], where), words[8], " ".join(words[9:])


def write_colmap(folder: str | Path, cameras: Iterable[tuple[Camera, str]]) -> None:
    """Write a text model of cameras with the names of their images; one COLMAP camera per image."""
    folder = Path(folder)
    intrinsics, poses = [], []
    for i, (camera, name) in enumerate(cameras, start=1):
        model = "FULL_OPENCV" if len(camera.distortion) > 4 else "OPENCV" if any(camera.distortion) else "PINHOLE"
        lens = {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[model]
        coefficients = (*camera.distortion, *(0.0,) * 8)[:lens]
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *coefficients)
        intrinsics.append(f"{i} {model} {camera.width} {camera.height} {_text(numbers)}")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        poses.append(f"{i} {_text((w, x, y, z, *camera.translation))} {i} {name}\n")
    write_text(folder / "cameras.txt", "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "\n".join(intrinsics) + "\n")
    header = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    write_text(folder / "images.txt", header + "\n".join(poses) + "\n")
    write_text(folder / "points3D.txt", "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _lines(path: Path, every: int = 1) -> Iterator[tuple[str, list[str]]]:
    """Every N-th line that is no comment, with its place for messages; blank lines count where N > 1."""
    if not path.exists():
        raise InputError(
            f"{path}: no such file; expected a COLMAP text model (cameras.txt, images.txt) or a binary one"
        )
    text = read_text(path, MAX_DOCUMENT_BYTES, "text file")
    kept = [(i, line) for i, line in enumerate(text.splitlines(), start=1) if not line.startswith("#")]
    if every == 1:
        kept = [(i, line) for i, line in kept if line.strip()]
    for i, line in kept[::every]:
        if line.strip():
            yield f"{path}: line {i}", line.split()


def _floats(words: list[str], where: str) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in words)
    except ValueError:
        raise InputError(f"{where}: found {' '.join(words)!r}, expected numbers") from None
    if not np.isfinite(values).all():
        raise InputError(f"{where}: found a NaN or infinite value, expected finite numbers")
    return values
