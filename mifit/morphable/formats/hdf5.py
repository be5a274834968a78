"""Bounded reading of HDF5 datasets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from mifit.core.files import check_file
from mifit.core.limits import MAX_MODEL_BYTES, MAX_UNPACKING, UNPACKING_SLACK
from mifit.errors import InputError


class Reader:
    """Reads datasets of one open file after checking their shapes and sizes."""

    def __init__(self, file: h5py.File, path: Path, size: int) -> None:
        self._file, self._path = file, path
        self._budget = min(MAX_MODEL_BYTES, MAX_UNPACKING * size + UNPACKING_SLACK)

    def has(self, key: str) -> bool:
        """Whether a dataset or group is present."""
        return key in self._file

    def dataset(self, key: str, optional: bool = False) -> Any:
        """The dataset itself, unread; None when it is optional and missing."""
        node = self._file.get(key)
        if node is None and optional:
            return None
        if not isinstance(node, h5py.Dataset):
            found = ", ".join(list(self._file)[:8])
            raise InputError(f"{self._path}: lacks dataset {key}; top level has {found}")
        if node.file != self._file or node.external or node.is_virtual:
            raise InputError(f"{self._path}: {key} lies in another file, which is refused; expected the data itself")
        return node

    def numbers(self, key: str, *shape: int | None) -> NDArray:
        """Read a numeric dataset whose shape must be ``shape`` (None: any)."""
        node = self.dataset(key)
        if node.dtype.kind not in "fiu":
            raise InputError(f"{self._path}: {key} has type {node.dtype}, expected numbers")
        if len(node.shape) != len(shape) or any(
            n is not None and n != m for n, m in zip(shape, node.shape, strict=True)
        ):
            want = str(tuple("any" if n is None else n for n in shape)).replace("'", "")
            raise InputError(f"{self._path}: {key} has shape {node.shape}, expected {want}")
        size = max(node.size, math.prod(node.chunks or ())) * node.dtype.itemsize
        if size > self._budget:
            raise InputError(f"{self._path}: {key} claims {size} bytes, expected at most {self._budget}")
        self._budget -= size
        return np.asarray(node[()])

    def whole(self, key: str) -> int:
        """Read one whole number, stored as a scalar or as an array of one value."""
        node = self.dataset(key)
        if node.size != 1 or node.dtype.kind not in "iu":
            raise InputError(f"{self._path}: {key} has shape {node.shape} of {node.dtype}, expected one whole number")
        return int(np.asarray(node[()]).ravel()[0])


@contextmanager
def open_h5(path: Path) -> Iterator[Reader]:
    """Open a file; whatever the library dislikes becomes an InputError."""
    size = check_file(path, MAX_MODEL_BYTES, "HDF5 file")
    try:
        with h5py.File(path, "r") as file:
            yield Reader(file, path, size)
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise InputError(f"{path}: damaged HDF5 file: {str(error)[:200]}") from None
