"""A bounded reader of numeric arrays in MATLAB version-5 files: no size is believed before it is checked.

SciPy's own reader looks up data types without a check of bounds and ends the process on damaged files (a type of 19, 20
or 1000, SciPy 1.17), so it can't be used on files from elsewhere.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import opened
from mifit.core.limits import MAX_MODEL_BYTES, MAX_UNPACKING, UNPACKING_SLACK
from mifit.errors import InputError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}


def is_mat5(path: Path) -> bool:
    """Whether a file begins like a MATLAB version-5 file."""
    try:
        with path.open("rb") as f:
            head = f.read(128)
    except OSError:
        return False
    return len(head) == 128 and head[:6] == b"MATLAB" and head[126:128] in (b"IM", b"MI")


def mat_names(path: Path) -> list[str]:
    """Names of the numeric arrays in the file."""
    return [name for name, _ in _matrices(path)]


def read_mat(path: Path, keys: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, NDArray]:
    """Read the named numeric arrays.

    InputError where a key is missing, an array is not a real numeric one, sizes disagree, or the file is truncated or
    packed beyond any honest ratio.
    """
    present = dict(_matrices(path, wanted=(*keys, *optional)))
    out = {name: array for name, array in present.items() if array is not None}
    missing = [k for k in keys if k not in out]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}; found {', '.join([*present][:12]) or 'no arrays'}")
    return out


def _matrices(path: Path, wanted: tuple[str, ...] = ()) -> Iterator[tuple[str, NDArray | None]]:
    """Yield (name, array) of each numeric matrix; the array is None when it isn't wanted."""
    with opened(path, MAX_MODEL_BYTES, "MATLAB file") as (f, size):
        budget = min(MAX_MODEL_BYTES, MAX_UNPACKING * size + UNPACKING_SLACK)
        head = f.read(128)
        if head[126:128] != b"IM":
            raise InputError(f"{path}: big-endian MATLAB file, expected little-endian")
        while tag := f.read(8):
            if len(tag) < 8:
                raise InputError(f"{path}: truncated MATLAB file")
            kind, length = struct.unpack("<II", tag)
            if length > size - f.tell():
                raise InputError(f"{path}: an element claims {length} bytes, {size - f.tell()} remain; truncated?")
            start = f.tell()
            if kind == 15:  # compressed
                raw = f.read(length)
                body = _inflate(path, raw, 4096)
                header = _header(path, body[8:]) if len(body) >= 8 else None
                if header and header[0] in wanted:
                    need = 8 + struct.unpack("<I", body[4:8])[0]
                    if need > budget:
                        raise InputError(f"{path}: {header[0]} claims {need} bytes unpacked, expected at most {budget}")
                    budget -= need
                    yield header[0], _array(path, _inflate(path, raw, need)[8:], header)
                elif header:
                    yield header[0], None
            elif kind == 14:  # a matrix
                body = f.read(min(length, 4096))
                header = _header(path, body)
                if header and header[0] in wanted:
                    yield header[0], _array(path, body + f.read(length - len(body)), header)
                elif header:
                    yield header[0], None
            f.seek(start + length)


def _inflate(path: Path, raw: bytes, limit: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(raw, limit)
    except zlib.error as error:
        raise InputError(f"{path}: damaged compressed element: {error}") from None


def _element(body: bytes, offset: int) -> tuple[int, int, int, int]:
    """Type, length, start of the data and offset of the next element."""
    word, length = struct.unpack_from("<II", body, offset)
    if word >> 16:  # small element: length and type share a word
        return word & 0xFFFF, word >> 16, offset + 4, offset + 8
    return word, length, offset + 8, offset + 8 + (length + 7) // 8 * 8


def _header(path: Path, body: bytes) -> tuple[str, int, tuple[int, ...], bool, int] | None:
    """Name, class, dimensions, whether complex, and offset of the data; None for what is not numeric."""
    try:
        _, _, start, offset = _element(body, 0)
        flags = struct.unpack_from("<I", body, start)[0]
        _, length, start, offset = _element(body, offset)
        if length > 128:
            raise InputError(f"{path}: an array claims {length // 4} dimensions")
        dimensions = struct.unpack_from(f"<{length // 4}i", body, start)
        _, length, start, offset = _element(body, offset)
        name = body[start : start + min(length, 63)].decode("latin1")
    except struct.error:
        raise InputError(f"{path}: truncated MATLAB file") from None
    if flags & 0xFF not in _CLASSES:
        return None
    return name, flags & 0xFF, dimensions, bool(flags & 0x800), offset


def _array(path: Path, body: bytes, header: tuple[str, int, tuple[int, ...], bool, int]) -> NDArray:
    name, kind, dimensions, is_complex, offset = header
    if is_complex:
        raise InputError(f"{path}: {name} is complex, expected real numbers")
    try:
        stored, length, start, _ = _element(body, offset)
    except struct.error:
        raise InputError(f"{path}: {name} is truncated") from None
    if stored not in _TYPES:
        raise InputError(f"{path}: {name} has data type {stored}, expected numbers")
    dtype = np.dtype("<" + _TYPES[stored])
    count = math.prod(dimensions)
    if any(d < 0 for d in dimensions) or count * dtype.itemsize != length or start + length > len(body):
        raise InputError(f"{path}: {name} claims shape {dimensions}, but holds {min(length, len(body) - start)} bytes")
    array = np.frombuffer(body, dtype, count, start).reshape(dimensions, order="F")
    return array.astype(_CLASSES[kind], copy=False)
