"""COLMAP's binary models: ``cameras.bin`` and ``images.bin``, little-endian, as its documentation describes them.

``cameras.bin``: a count (uint64), then per camera id (int32), model (int32), width and height (uint64) and the model's
parameters (float64). ``images.bin``: a count, then per image id (int32), the pose as quaternion w x y z and translation
(float64), camera id (int32), name ended by a zero, and a count of points (uint64) of 24 bytes each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mifit.core.files import opened
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_MODEL_BYTES
from mifit.errors import InputError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""COLMAP's numbers of camera models: name and count of parameters."""
MAX_NAME = 4096
POINT_BYTES = 24

CameraEntry = tuple[str, str, str, tuple[float, ...]]
"""Place for messages, id, model, and width, height and parameters."""
ImageEntry = tuple[str, tuple[float, ...], str, str]
"""Place for messages, quaternion w x y z and translation, id of the camera, name."""


def read_binary_cameras(path: Path) -> Iterator[CameraEntry]:
    """Entries of ``cameras.bin``; InputError for a file that is truncated or names an unknown model."""
    with opened(path, MAX_DOCUMENT_BYTES, "COLMAP model") as (stream, size):
        (count,) = _take(stream, "<Q", path)
        for i in range(_checked(count, 24, size, path)):
            where = f"{path}: camera {i}"
            key, number, width, height = _take(stream, "<iiQQ", path)
            if number not in MODELS:
                raise InputError(f"{where}: found camera model {number}, expected 0 to {max(MODELS)}")
            model, parameters = MODELS[number]
            yield where, str(key), model, (float(width), float(height), *_take(stream, f"<{parameters}d", path))


def read_binary_images(path: Path) -> Iterator[ImageEntry]:
    """Entries of ``images.bin`` without their points; InputError for a file that is truncated or no such file."""
    with opened(path, MAX_MODEL_BYTES, "COLMAP model") as (stream, size):
        (count,) = _take(stream, "<Q", path)
        for i in range(_checked(count, 73, size, path)):
            where = f"{path}: image {i}"
            _, *pose, key = _take(stream, "<i7di", path)
            name = b""
            while not name.endswith(b"\0"):
                character = stream.read(1)
                if not character or len(name) > MAX_NAME:
                    raise InputError(f"{where}: found no end of its name, expected at most {MAX_NAME} bytes")
                name += character
            try:
                text = name[:-1].decode("utf-8")
            except UnicodeDecodeError:
                raise InputError(f"{where}: its name is no UTF-8 text") from None
            (points,) = _take(stream, "<Q", path)
            if points * POINT_BYTES > size - stream.tell():
                raise InputError(f"{where}: claims {points} points, more than the file holds: truncated or damaged")
            stream.seek(points * POINT_BYTES, 1)
            yield where, tuple(map(float, pose)), str(key), text


def _take(stream: BinaryIO, layout: str, path: Path) -> tuple:
    data = stream.read(struct.calcsize(layout))
    if len(data) < struct.calcsize(layout):
        raise InputError(f"{path}: ends early, expected a whole COLMAP model; copy it again")
    return struct.unpack(layout, data)


def _checked(count: int, least: int, size: int, path: Path) -> int:
    """A count of entries that the file can hold."""
    if count * least > size:
        raise InputError(f"{path}: claims {count} entries in {size} bytes, expected a COLMAP model")
    return count
