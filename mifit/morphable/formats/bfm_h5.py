"""Basel Face Models 2017 and 2019 (statismo ``.h5``) and AlbedoMM. Millimetres, colours 0..1."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from mifit.core.files import check_file
from mifit.core.limits import MAX_MODEL_BYTES, MAX_UNPACKING, UNPACKING_SLACK
from mifit.errors import InputError
from mifit.morphable.assemble import ModelData, interleaved, single, srgb_albedo
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import oriented_outwards


def load_bfm_h5(path: Path) -> MorphableModel:
    """Read a statismo face model; an AlbedoMM file beside it or within it gives linear albedo instead of colour.

    ``pcaVariance`` holds variances. The basis is orthonormal from version 0.9 on and already scaled in 0.8; the
    expression mean is added to the shape. AlbedoMM (``albedoModel*.h5`` in the same folder, made for the same mesh)
    is used when its vertex count fits.
    """
    with open_h5(path) as h5:
        if not h5.has("shape/model/mean"):
            raise InputError(f"{path}: HDF5 file without shape/model/mean, expected a statismo face model")
        scaled = _already_scaled(h5)
        mean, identity = _pca(h5, "shape", scaled)
        n = len(mean)
        expression = np.zeros((n, 3, 0), dtype=np.float32)
        if h5.has("expression/model/mean"):
            offset, expression = _pca(h5, "expression", scaled, n)
            mean = mean + offset
        albedo = None
        if h5.has("diffuseAlbedo/model/mean"):
            albedo = _pca(h5, "diffuseAlbedo", False, n)
        elif h5.has("color/model/mean"):
            albedo = srgb_albedo(*_pca(h5, "color", scaled, n))
        faces = _cells(h5, path, n)
    for beside in sorted(path.parent.glob("albedoModel*.h5")):
        if beside != path:
            with open_h5(beside) as h5:
                if h5.dataset("diffuseAlbedo/model/mean").size == 3 * n:
                    albedo = _pca(h5, "diffuseAlbedo", False, n)
    return ModelData(
        f"bfm:{path.stem}",
        single(mean),
        oriented_outwards(mean, faces),
        identity,
        expression,
        1.0,
        albedo=albedo,
        source=path,
    ).complete()


def _already_scaled(h5: Reader) -> bool:
    """Whether the file is of version 0.8, whose basis is premultiplied by the deviations."""
    if not (h5.has("version/majorVersion") and h5.has("version/minorVersion")):
        return False
    major, minor = (h5.whole(f"version/{k}") for k in ("majorVersion", "minorVersion"))
    return (major, minor) < (0, 9)


def _pca(h5: Reader, group: str, scaled: bool, n: int | None = None) -> tuple[NDArray, NDArray[np.float32]]:
    """Mean (V, 3) and premultiplied modes (V, 3, K) of one statistical model."""
    mean = h5.numbers(f"{group}/model/mean", None if n is None else 3 * n)
    if len(mean) % 3:
        raise InputError(f"{group}/model/mean has {len(mean)} values, expected a multiple of 3")
    variance = h5.numbers(f"{group}/model/pcaVariance", None)
    basis = h5.numbers(f"{group}/model/pcaBasis", len(mean), len(variance))
    if (variance < 0).any():
        raise InputError(f"{group}/model/pcaVariance holds {variance.min()}, expected variances >= 0")
    modes = interleaved(basis)
    if not scaled:
        modes = modes * np.sqrt(variance).astype(np.float32)
    return mean.reshape(-1, 3), modes


def _cells(h5: Reader, path: Path, n: int) -> NDArray:
    group = "shape" if h5.has("shape/representer/cells") else "diffuseAlbedo"
    cells = h5.numbers(f"{group}/representer/cells", None, None)
    if 3 not in cells.shape:
        raise InputError(f"{path}: cells have shape {cells.shape}, expected (3, triangles)")
    faces = (cells.T if cells.shape[0] == 3 else cells).astype(np.int64)
    if faces.size == 0 or faces.min() < 0 or faces.max() >= n:
        raise InputError(f"{path}: cells hold indices outside 0..{n - 1}")
    return faces


class Reader:
    """Reads datasets of one open file after checking their shapes and sizes."""

    def __init__(self, file: h5py.File, path: Path, size: int) -> None:
        self._file, self._path = file, path
        self._budget = min(MAX_MODEL_BYTES, MAX_UNPACKING * size + UNPACKING_SLACK)

    def has(self, key: str) -> bool:
        """Whether a dataset or group is present."""
        return key in self._file

    def dataset(self, key: str) -> h5py.Dataset:
        """The dataset itself, unread."""
        node = self._file.get(key)
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
