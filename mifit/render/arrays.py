"""NumPy arrays in the form in which Dr.Jit's kernels stay the same from call to call."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

ALIGNMENT = 64


def aligned(values: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[Any]:
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
