"""Mitsuba and Dr.Jit, loaded late, and NumPy arrays in the form in which kernels stay the same from call to call."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from mifit.errors import InputError

ALIGNMENT = 64
OFFSET = 1e-3
"""Part of a mesh's diagonal by which rays start off its surface: facets don't shadow themselves."""
Jit: TypeAlias = Any
"""A Dr.Jit array, vector or colour: its class belongs to the active variant, so no type can name it."""


class _Late:
    """A module that is imported when it is first used: LLVM is chosen before that, and commands start without it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self._name), name)


if TYPE_CHECKING:
    import drjit as dr
    import mitsuba as mi
else:
    dr, mi = _Late("drjit"), _Late("mitsuba")


def aligned(values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray:
    """Copy values into contiguous memory that starts at a multiple of `ALIGNMENT` bytes.

    Dr.Jit reads NumPy's memory where it lies, and its LLVM backend writes the memory's alignment into the kernel. NumPy
    aligns to 16 bytes only: the same kernel would be compiled anew for each pattern of its inputs' addresses.
    """
    source = np.asarray(values)
    out_type = np.dtype(dtype)
    size = source.size * out_type.itemsize
    block = np.empty(size + ALIGNMENT, dtype=np.uint8)
    start = -block.ctypes.data % ALIGNMENT
    out = block[start : start + size].view(out_type).reshape(source.shape)
    out[...] = source
    return out


def on_device(kind: Jit, values: NDArray) -> Jit:
    """(N, 3) array -> Dr.Jit vector of a kind, such as ``mi.Vector3f``."""
    return kind(*map(aligned, np.asarray(values).T))


def columns(values: list[Jit], count: int) -> NDArray[np.float32]:
    """Floats, of width N or 1, computed in one kernel -> (number of values, N)."""
    if not count:
        return np.zeros((len(values), 0), np.float32)
    floats = [mi.Float(value) for value in values]
    dr.eval(floats)
    return np.stack([np.broadcast_to(np.array(f, dtype=np.float32), (count,)) for f in floats])


def stored(values: list[Jit], count: int) -> NDArray[np.float32]:
    """Floats, of width N or 1, computed in one kernel -> (N, number of values)."""
    return np.ascontiguousarray(columns(values, count).T)


def rows_on_device(values: NDArray) -> Jit:
    """(V, K) numbers -> one Float of their rows, filled up to whole packets of four."""
    return mi.Float(aligned(np.pad(values, ((0, 0), (0, -values.shape[1] % 4)))).ravel())


def weighted_rows(rows: Jit, corners: Sequence[Jit], weights: Sequence[Jit], size: int) -> list[Jit]:
    """Sum of the rows (`rows_on_device`) numbered ``corners`` by ``weights``: ``size`` Floats, not evaluated.

    Rows are read four numbers at a time: single reads would be most of what there is to compile.
    """
    packets, found = -(-size // 4), list[Jit]()
    for packet in range(packets):
        read = [dr.gather(mi.Vector4f, rows, corner * packets + packet) for corner in corners]
        for i in range(4):
            a, b, c = (weight * four[i] for weight, four in zip(weights, read, strict=True))
            found.append(a + b + c)
    return found[:size]


def expect(values: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """The values as float32; InputError names the shape found and the one expected."""
    array = np.asarray(values, dtype=np.float32)
    if array.shape != shape:
        raise InputError(f"{name}: found shape {array.shape}, expected {shape}")
    return array
