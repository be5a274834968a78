"""Guarded reading of NumPy's files: every size is checked before anything is allocated, objects are refused."""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mifit.core.files import check_file, opened
from mifit.core.limits import MAX_MODEL_BYTES, MAX_UNPACKING, UNPACKING_SLACK
from mifit.errors import InputError

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
    """Read arrays of an ``.npz`` file.

    Parameters
    ----------
    path : str or Path
        The file.
    keys : iterable of str, optional
        Arrays to read where present; all by default.

    Raises
    ------
    InputError
        Not an archive, truncated, an array's header disagrees with its size, an object array (which could
        run code), or more data than a file of this size can honestly hold.
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


def read_npy(path: str | Path, limit: int, what: str = "file") -> NDArray:
    """Read one array from an ``.npy`` file of at most ``limit`` bytes; InputError as `read_npz` raises it."""
    with opened(path, limit, what) as (stream, size):
        try:
            return _read_npy(stream, size, f"{path}: not a readable {what}")
        except InputError:
            raise
        except _DAMAGE as error:
            raise InputError(f"{path}: not a readable {what}: {' '.join(str(error).split())[:100]}") from None


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
