"""Kernels stay the same wherever NumPy puts its arrays."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.appearance.arrays import ALIGNMENT, aligned


def shifted(count: int, offset: int) -> np.ndarray:
    """Float32 values that start a number of bytes behind a multiple of ALIGNMENT."""
    block = np.zeros(4 * count + 2 * ALIGNMENT, dtype=np.uint8)
    start = -block.ctypes.data % ALIGNMENT + offset
    out = block[start : start + 4 * count].view(np.float32)
    out[:] = np.arange(count)
    return out


@pytest.mark.parametrize("offset", [0, 4, 16])
def test_copies_are_aligned_and_equal(offset):
    source = shifted(6, offset).reshape(2, 3)
    out = aligned(source.T, np.uint32)
    assert out.ctypes.data % ALIGNMENT == 0 and out.flags.c_contiguous and out.dtype == np.uint32
    np.testing.assert_array_equal(out, [[0, 3], [1, 4], [2, 5]])


def test_empty_arrays_stay_empty():
    assert aligned(np.zeros((0, 3))).shape == (0, 3)


def test_shading_takes_one_kernel_for_all_addresses(variant):
    import drjit as dr

    from tests.shaded import shade_points

    normal = np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [0.6, 0.0, 0.8]], dtype=np.float32)
    radiance = np.linspace(0.1, 1.0, 27).reshape(9, 3)
    hashes = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for offset in (0, 4, 16, 48):
            gloss = shifted(3, offset)
            n = shifted(9, offset).reshape(3, 3)
            n[:] = normal
            dr.kernel_history_clear()
            shade_points(n, n, np.ones((3, 3), np.float32), gloss, radiance, 0.0, 20.0, "prefiltered")
            hashes.append([k["hash"] for k in dr.kernel_history() if "hash" in k])
    assert hashes[0] and all(found == hashes[0] for found in hashes)
