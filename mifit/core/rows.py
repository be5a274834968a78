"""Arrays with a row per timestep, which for a video are larger than memory: these lie in a file that is mapped.

The file has no name, so nothing is left of it when the process ends, however it ends. What the machine holds of it in
memory it gives back when something else needs the room.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mifit.core.files import FULL
from mifit.errors import InputError

IN_MEMORY = 64 * 2**20
"""Bytes up to which rows are kept in memory."""


class Rows:
    """Rows of one shape that come one after the other.

    Parameters
    ----------
    count : int
        Number of rows there will be at most.
    shape : tuple of int
        Of one row.
    dtype : DTypeLike

    Raises
    ------
    InputError
        No room on the disk; it is reserved now, for all rows.
    """

    def __init__(self, count: int, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._array: NDArray[Any] = _reserved((count, *shape), np.dtype(dtype))
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
