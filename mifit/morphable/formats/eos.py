"""eos and Surrey Face Model ``.bin`` files (cereal, little-endian). Millimetres, eigenvalues are variances."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import read_bytes
from mifit.core.limits import MAX_FILE_BYTES
from mifit.errors import InputError
from mifit.morphable.assemble import ModelData, interleaved, single
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import oriented_outwards


class _Cursor:
    """Reads values in turn; a count is checked against what remains before anything is allocated."""

    def __init__(self, path: Path) -> None:
        self._path, self._data, self._at = path, read_bytes(path, MAX_FILE_BYTES, "eos model"), 0

    @property
    def remaining(self) -> int:
        return len(self._data) - self._at

    def take(self, size: int, what: str) -> bytes:
        if size < 0 or size > self.remaining:
            raise InputError(f"{self._path}: {what} claims {size} bytes at offset {self._at}, {self.remaining} remain")
        self._at += size
        return self._data[self._at - size : self._at]

    def number(self, code: str, what: str) -> int:
        return struct.unpack("<" + code, self.take(struct.calcsize("<" + code), what))[0]

    def array(self, dtype: str, count: int, what: str) -> NDArray:
        return np.frombuffer(self.take(count * np.dtype(dtype).itemsize, what), dtype)

    def matrix(self, what: str) -> NDArray:
        rows, columns = self.number("i", what), self.number("i", what)
        if rows < 0 or columns < 0:
            raise InputError(f"{self._path}: {what} claims shape ({rows}, {columns})")
        return self.array("<f4", rows * columns, what).reshape((rows, columns), order="F")


def looks_like_eos(path: Path) -> bool:
    """Whether a file begins with a version 1 to 4 and a mean of plausible size."""
    with path.open("rb") as f:
        head = f.read(12)
    if len(head) < 12:
        return False
    version, rows, columns = struct.unpack("<Iii", head)
    return 1 <= version <= 4 and rows >= 12 and rows % 3 == 0 and columns == 1


def load_eos(path: Path) -> MorphableModel:
    """Read a model of version 1 to 4; expressions also from ``expression_blendshapes*.bin`` beside it."""
    c = _Cursor(path)
    version = c.number("I", "version")
    mean, modes, sigma, faces = _pca(c, path, "shape")
    n = len(mean) // 3
    colour_mean, colour_modes, colour_sigma, _ = _pca(c, path, "colour", allow_empty=True)
    expression, bounds = np.zeros((3 * n, 0), dtype=np.float32), None
    names: tuple[str, ...] = ()
    if version >= 2:
        kind = c.number("i", "expression kind")
        if kind == 0:
            offset, basis, deviation, _ = _pca(c, path, "expression")
            if len(offset) != 3 * n:
                raise InputError(f"{path}: expression mean has {len(offset)} values, expected {3 * n}")
            mean, expression = mean + offset, basis * deviation
        elif kind == 1:
            expression, names, bounds = _blendshapes(c, path, n)
        else:
            raise InputError(f"{path}: expression kind {kind}, expected 0 (PCA) or 1 (blendshapes)")
    if version >= 3:
        for _ in range(c.number("Q", "landmark definitions")):
            c.take(c.number("Q", "landmark name"), "landmark name")
            c.number("i", "landmark vertex")
    count = c.number("Q", "texture coordinates")
    uv = c.array("<f8", 2 * count, "texture coordinates").reshape(-1, 2)
    faces_uv = faces
    if version >= 4:
        count = c.number("Q", "texture triangles")
        faces_uv = c.array("<i4", 3 * count, "texture triangles").reshape(-1, 3) if count else faces
    if c.remaining:
        raise InputError(f"{path}: {c.remaining} bytes after the end, expected none")
    beside = sorted(path.parent.glob("expression_blendshapes*.bin"))
    if beside and expression.shape[1] == 0:
        expression, names, bounds = _blendshapes(_Cursor(beside[0]), beside[0], n)
    if (faces_uv.shape != faces.shape) or (len(uv) and (faces_uv.min() < 0 or faces_uv.max() >= len(uv))):
        raise InputError(f"{path}: texture triangles {faces_uv.shape} don't fit {len(uv)} coordinates and the mesh")
    albedo = None
    if len(colour_mean) == 3 * n:
        albedo = (colour_mean.reshape(-1, 3), interleaved(colour_modes * colour_sigma))
    flipped = oriented_outwards(mean.reshape(-1, 3), faces)
    if len(uv) and not np.array_equal(flipped, faces):
        faces_uv = faces_uv[:, [1, 0, 2]]
    # eos stores v from the top
    return ModelData(
        f"eos:{path.stem}",
        single(mean).reshape(-1, 3),
        flipped,
        interleaved(modes * sigma),
        interleaved(expression),
        1.0,
        albedo=albedo,
        uv=(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1), faces_uv) if len(uv) else None,
        expression_names=names,
        expression_bounds=bounds,
        source=path,
    ).complete()


def _pca(c: _Cursor, path: Path, what: str, allow_empty: bool = False) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Mean (3V,), basis (3V, K), deviations (K,) and triangles of one statistical model."""
    mean = c.matrix(f"{what} mean").ravel()
    basis = c.matrix(f"{what} basis")
    variance = c.matrix(f"{what} eigenvalues").ravel()
    count = c.number("Q", f"{what} triangles")
    faces = c.array("<i4", 3 * count, f"{what} triangles").reshape(-1, 3)
    if mean.size == 0 and allow_empty:
        return mean, basis, variance, faces
    if len(mean) % 3 or basis.shape != (len(mean), len(variance)):
        raise InputError(
            f"{path}: {what} mean has {len(mean)} values, basis {basis.shape}, {len(variance)} eigenvalues; "
            "expected (3V,), (3V, K) and K"
        )
    if (variance < 0).any():
        raise InputError(f"{path}: {what} eigenvalues hold {variance.min()}, expected variances >= 0")
    if what == "shape" and (count == 0 or faces.min() < 0 or faces.max() >= len(mean) // 3):
        raise InputError(f"{path}: {what} triangles hold indices outside 0..{len(mean) // 3 - 1}")
    return mean, basis, np.sqrt(variance), faces.astype(np.int64)


def _blendshapes(c: _Cursor, path: Path, n: int) -> tuple[NDArray, tuple[str, ...], NDArray]:
    """Modes (3V, K) with one coefficient unit at a weight of 0.3, names, and bounds for weights 0..1."""
    names, columns = [], []
    for _ in range(c.number("Q", "blendshapes")):
        names.append(c.take(c.number("Q", "blendshape name"), "blendshape name").decode("utf-8", "replace"))
        column = c.matrix("blendshape").ravel()
        if len(column) != 3 * n:
            raise InputError(f"{path}: blendshape '{names[-1]}' has {len(column)} values, expected {3 * n}")
        columns.append(column)
    if not columns:
        return np.zeros((3 * n, 0), dtype=np.float32), (), np.zeros((0, 2), dtype=np.float32)
    bounds = np.tile(np.array([0.0, 1 / 0.3], dtype=np.float32), (len(columns), 1))
    return np.float32(0.3) * np.stack(columns, axis=1), tuple(names), bounds
