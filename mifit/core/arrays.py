"""Arrays in files: guarded readers of NumPy's files and of meshes, and rows that lie in a mapped file.

Readers check every size before anything is allocated, and refuse objects. `Rows` have one per timestep, which for a
video are more than memory holds. Their file has no name, so nothing is left of it however the process ends.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import math
import os
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.lib import format as npy
from numpy.typing import DTypeLike, NDArray

from mifit.core.files import FULL, check_file, read_bytes, write_bytes
from mifit.core.image import to_8_bit
from mifit.core.limits import MAX_MODEL_BYTES, MAX_UNPACKING, UNPACKING_SLACK
from mifit.errors import InputError

T = TypeVar("T")
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, OSError, ValueError, EOFError, KeyError, struct.error,
    NotImplementedError, RuntimeError, SyntaxError, TypeError, MemoryError, tokenize.TokenError,
)  # fmt: skip


def npz_keys(path: Path) -> list[str] | None:
    """Names of the arrays in an ``.npz`` file, or None when the file is not a zip archive."""
    check_file(path, MAX_MODEL_BYTES)
    if not zipfile.is_zipfile(path):
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            return [n[:-4] for n in archive.namelist() if n.endswith(".npy")]
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise InputError(f"{path}: damaged zip archive: {error}") from None


def read_npz(path: str | Path, keys: Iterable[str] | None = None) -> dict[str, NDArray]:
    """Arrays of an ``.npz`` file, those of ``keys`` that are there, or all.

    InputError for what is no archive, truncated, an array whose header disagrees with its size, an object array (which
    could run code), or more data than a file of this size can honestly hold.
    """
    path = Path(path)
    wanted = None if keys is None else set(keys)
    out: dict[str, NDArray] = {}
    size = check_file(path, MAX_MODEL_BYTES)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {i.filename[:-4]: i for i in archive.infolist() if i.filename.endswith(".npy")}
            members = {k: i for k, i in members.items() if wanted is None or k in wanted}
            total = sum(i.file_size for i in members.values())
            limit = min(MAX_MODEL_BYTES, MAX_UNPACKING * size + UNPACKING_SLACK)
            if total > limit:
                raise InputError(
                    f"{path}: claims {total} bytes when unpacked, expected at most {limit} for a file of this size"
                )
            for key, info in members.items():
                with archive.open(info) as stream:
                    out[key] = _read_npy(stream, info.file_size, f"{path}: {key}")
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: damaged .npz file: {error}") from None
    return out


def _read_npy(stream, size: int, where: str) -> NDArray:
    """Read one array whose header must account for the member's size exactly."""
    version = npy.read_magic(stream)
    if version == (1, 0):
        shape, fortran, dtype = npy.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, fortran, dtype = npy.read_array_header_2_0(stream)
    else:
        raise InputError(f"{where}: .npy version {version}, expected (1, 0) or (2, 0)")
    if dtype.hasobject or dtype.kind not in "biufSU":
        kind = "Python objects" if dtype.hasobject else str(dtype)
        raise InputError(f"{where}: holds {kind}, which are refused; expected numbers or text")
    count = math.prod(shape)
    if any(n < 0 for n in shape) or count * dtype.itemsize > size:
        raise InputError(f"{where}: header claims shape {shape} of {dtype}, but the member has {size} bytes")
    data = stream.read(count * dtype.itemsize)
    if len(data) != count * dtype.itemsize:
        raise InputError(f"{where}: {len(data)} bytes of data, expected {count * dtype.itemsize}")
    array = np.frombuffer(data, dtype, count)
    return array.reshape(shape[::-1]).T if fortran else array.reshape(shape)


IN_MEMORY = 64 * 2**20
"""Bytes up to which rows are kept in memory."""


class Rows:
    """Rows of one shape that come one after the other, at most ``count``.

    InputError where the disk has no room; it is reserved at once, for all rows.
    """

    def __init__(self, count: int, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._array: NDArray = _reserved((count, *shape), np.dtype(dtype))
        self._used = 0

    def add(self, row: NDArray) -> NDArray:
        """Write the next row; returns a view of all rows so far. Earlier views stay as they were."""
        self._array[self._used] = row
        self._used += 1
        return self.all

    def extend(self, rows: Iterable[NDArray]) -> NDArray:
        """`add` several."""
        for row in rows:
            self.add(row)
        return self.all

    @property
    def all(self) -> NDArray:
        """A view of the rows so far."""
        return self._array[: self._used]


def _reserved(shape: tuple[int, ...], dtype: np.dtype) -> NDArray:
    size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
    if size <= IN_MEMORY:
        return np.empty(shape, dtype)
    folder = _folder()
    with tempfile.TemporaryFile(dir=folder) as file:
        try:
            if hasattr(os, "posix_fallocate"):  # a mapped page for which there is no room would end the process
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                for start in range(0, size, IN_MEMORY):
                    file.write(bytes(min(IN_MEMORY, size - start)))
                file.flush()
        except OSError as error:
            if error.errno not in FULL:
                raise
            raise InputError(
                f"{folder}: has no room for {size / 2**20:.0f} MiB of frames; free some, or set TMPDIR elsewhere"
            ) from None
        return np.asarray(np.memmap(file, dtype, "r+", shape=shape))


def _folder() -> str:
    """For large temporary files: what the user says, else where Unix keeps such on disk (``/tmp`` may be memory)."""
    large = "/var/tmp"
    if not os.environ.get("TMPDIR") and os.path.isdir(large) and os.access(large, os.W_OK):
        return large
    return tempfile.gettempdir()


_GROUPS = {"vertices": "xyz", "normals": ("nx", "ny", "nz"), "uv": "uv", "albedo": "rgb"}


def write_ply(
    path: str | Path,
    vertices: NDArray,
    faces: NDArray,
    normals: NDArray,
    uv: NDArray,
    albedo: NDArray,
    viewer_colours: bool = True,
) -> None:
    """Write a triangle mesh with normals (N, 3) and texture coordinates (N, 2), whole or not at all.

    Properties ``u v`` have v = 0 at the last row of a map. ``albedo`` (N, 3), linear reflectance 0..1, is ``r g b``,
    float32, what Mitsuba reads as ``vertex_color``; ``viewer_colours`` adds ``red green blue``, 8-bit sRGB, what mesh
    viewers show and Mitsuba warns of.
    """
    from trimesh import Trimesh
    from trimesh.exchange.ply import export_ply

    columns = {**dict(zip("uv", uv.T, strict=True)), **dict(zip("rgb", albedo.T, strict=True))}
    mesh = Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=to_8_bit(albedo) if viewer_colours else None,
        vertex_attributes={name: np.asarray(column, dtype=np.float32) for name, column in columns.items()},
        process=False,
    )
    write_bytes(path, export_ply(mesh, vertex_normal=True))


def read_ply(path: str | Path) -> dict[str, NDArray]:
    """``vertices``, ``normals``, ``albedo`` (N, 3), ``uv`` (N, 2) float32 and ``faces`` (F, 3) int32 of a file of
    `write_ply`.

    InputError where it is missing, cut short or of another layout.
    """
    from trimesh.exchange.ply import load_ply

    data = read_bytes(path, MAX_MODEL_BYTES, "mesh")
    try:
        stored = load_ply(io.BytesIO(data), fix_texture=False)
        table = stored["metadata"]["_ply_raw"]["vertex"]["data"]  # as it is stored: nothing merged or normalised
        out = {key: np.stack([table[n] for n in names], 1).astype("<f4") for key, names in _GROUPS.items()}
        faces = np.asarray(stored["faces"], dtype=np.int32).reshape(-1, 3)
    except Exception as error:  # whatever a damaged file makes the reader raise
        raise InputError(f"{path}: not a mesh that mifit wrote ({error}); fit again, or restore the file") from None
    return {**out, "faces": faces}


class Recent(Generic[T]):
    """The last few things that were made, by what they were made of."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: dict[Hashable, T] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """What was made of ``key`` before, if it is among the last, else what ``make`` returns."""
        found = self._kept.pop(key) if key in self._kept else make()
        self._kept[key] = found
        while len(self._kept) > self._count:
            del self._kept[next(iter(self._kept))]
        return found

    def clear(self) -> None:
        """Forget all."""
        self._kept.clear()


def content_key(*values: object) -> bytes:
    """Digest of arrays, by shape, type and content, and of plain values."""
    digest = hashlib.blake2b()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.shape}{value.dtype}".encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr(value).encode())
    return digest.digest()


def same(a: object, b: object) -> bool:
    """Whether two values are equal to the last bit: plain ones, arrays, and records, mappings and sequences of both."""
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        x, y = np.asarray(a), np.asarray(b)
        return x.shape == y.shape and x.dtype == y.dtype and bool(np.array_equal(x, y, equal_nan=x.dtype.kind == "f"))
    if type(a) is not type(b):
        return False
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a) if f.compare)
    return bool(a == b)
