"""COLMAP models: ``cameras.txt`` and ``images.txt``, or ``cameras.bin`` and ``images.bin``.

COLMAP's pixels are ours (the first centre at 0.5, 0.5), its camera axes OpenCV's, its poses world to camera. Binary
files are little-endian: a count (uint64), then per camera id, model (int32), width, height (uint64) and parameters
(float64); per image id (int32), quaternion w x y z and translation (float64), camera's id (int32), a name ended by a
zero, and a count (uint64) of points of 24 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.capture.transforms import View
from mifit.core.files import opened, read_text
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_MODEL_BYTES, MAX_PIXELS
from mifit.errors import InputError
from mifit.extras.photos import MAX_NUMBER, Photo, local, view_name

_MODELS = {  # COLMAP's number; where fx, fy, cx, cy and OpenCV's distortion coefficients are among the parameters
    "SIMPLE_PINHOLE": (0, (0, 0, 1, 2), ()),
    "PINHOLE": (1, (0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": (2, (0, 0, 1, 2), (3,)),
    "RADIAL": (3, (0, 0, 1, 2), (3, 4)),
    "OPENCV": (4, (0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": (6, (0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}

_Camera = tuple[int, int, tuple[float, float, float, float], tuple[float, ...]]
_CameraEntry = tuple[str, str, str, tuple[float, ...]]
"""Place for messages, id, model, and width, height and parameters."""
_ImageEntry = tuple[str, tuple[float, ...], str, str]
"""Place for messages, quaternion w x y z and translation, id of the camera, name."""


def read_colmap(folder: str | Path) -> tuple[Photo, ...]:
    """Read a text model, or where there is none a binary one.

    Each view is named after the image: its folder (``left/0000.png`` -> ``left``), or its stem when it has none.

    Raises
    ------
    InputError
        A missing or malformed file, an unknown camera model, or a pose that isn't one.
    """
    folder = Path(folder)
    text = (folder / "cameras.txt").exists() or not (folder / "cameras.bin").exists()
    source, images = (folder / f"{name}.{'txt' if text else 'bin'}" for name in ("cameras", "images"))
    entries = (_text_cameras if text else _binary_cameras)(source)
    cameras = {key: _camera(where, model, numbers) for where, key, model, numbers in entries}
    photos = []
    for where, pose, key, name in (_text_images if text else _binary_images)(images):
        if key not in cameras:
            raise InputError(f"{where}: camera {key} is not in {source.name}")
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


def _camera(where: str, model: str, numbers: tuple[float, ...]) -> _Camera:
    """Width, height, intrinsics and OpenCV's distortion of one camera entry: width, height and its parameters."""
    if not np.isfinite(numbers).all():
        raise InputError(f"{where}: found a NaN or infinite value, expected finite numbers")
    _, pinhole, lens = _MODELS[model]
    width, height, *parameters = numbers
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS and width % 1 == height % 1 == 0):
        raise InputError(
            f"{where}: found {width:g} x {height:g} pixels, expected whole numbers of at most "
            f"{MAX_PIXELS // 10**6} megapixels"
        )
    if len(parameters) != _count(model):
        raise InputError(f"{where}: found {len(parameters)} parameters, expected {_count(model)} of {model}")
    fx, fy, cx, cy = (parameters[i] for i in pinhole)
    if not (min(fx, fy) > 0):
        raise InputError(f"{where}: found focal length {min(fx, fy):g}, expected a positive one")
    distortion = tuple(parameters[i] for i in lens)
    if len(distortion) in (1, 2):
        distortion = (*distortion, 0.0, 0.0, 0.0)[:4]
    return int(width), int(height), (fx, fy, cx, cy), distortion if any(distortion) else ()


def _count(model: str) -> int:
    """Number of a model's parameters."""
    _, pinhole, lens = _MODELS[model]
    return max(*pinhole, *lens) + 1


def _unknown(where: str, model: object) -> InputError:
    return InputError(f"{where}: found camera model {model!r}, expected one of {', '.join(_MODELS)}")


def _text_cameras(path: Path) -> Iterator[_CameraEntry]:
    for where, words in _lines(path):
        if len(words) < 5:
            raise InputError(f"{where}: found {len(words)} fields, expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        if words[1] not in _MODELS:
            raise _unknown(where, words[1])
        yield where, words[0], words[1], _floats(words[2:], where)


def _text_images(path: Path) -> Iterator[_ImageEntry]:
    for where, words in _lines(path, every=2):
        if len(words) < 10:
            raise InputError(f"{where}: found {len(words)} fields, expected ID, QW QX QY QZ, TX TY TZ, CAMERA_ID, NAME")
        yield where, _floats(words[1:8], where), words[8], " ".join(words[9:])


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


def _binary_cameras(path: Path) -> Iterator[_CameraEntry]:
    models = {number: name for name, (number, *_) in _MODELS.items()}
    with opened(path, MAX_DOCUMENT_BYTES, "COLMAP model") as (stream, size):
        for where in _entries(stream, size, path, "camera", 24):
            key, number, width, height = _take(stream, "<iiQQ", path)
            if number not in models:
                raise _unknown(where, number)
            parameters = _take(stream, f"<{_count(models[number])}d", path)
            yield where, str(key), models[number], (float(width), float(height), *parameters)


def _binary_images(path: Path) -> Iterator[_ImageEntry]:
    with opened(path, MAX_MODEL_BYTES, "COLMAP model") as (stream, size):
        for where in _entries(stream, size, path, "image", 73):
            _, *pose, key = _take(stream, "<i7di", path)
            name = b""
            while not name.endswith(b"\0"):
                character = stream.read(1)
                if not character or len(name) > 4096:
                    raise InputError(f"{where}: found no end of its name, expected at most 4096 bytes")
                name += character
            try:
                text = name[:-1].decode("utf-8")
            except UnicodeDecodeError:
                raise InputError(f"{where}: its name is no UTF-8 text") from None
            (points,) = _take(stream, "<Q", path)
            if points * 24 > size - stream.tell():
                raise InputError(f"{where}: claims {points} points, more than the file holds: truncated or damaged")
            stream.seek(points * 24, 1)
            yield where, tuple(map(float, pose)), str(key), text


def _entries(stream: BinaryIO, size: int, path: Path, kind: str, least: int) -> Iterator[str]:
    """A place for messages per entry of a binary file, whose entries have ``least`` bytes or more."""
    (count,) = _take(stream, "<Q", path)
    if count * least > size:
        raise InputError(f"{path}: claims {count} entries in {size} bytes, expected a COLMAP model")
    return (f"{path}: {kind} {i}" for i in range(count))


def _take(stream: BinaryIO, layout: str, path: Path) -> tuple:
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise InputError(f"{path}: ends early, expected a whole COLMAP model; copy it again")
    return struct.unpack(layout, data)
