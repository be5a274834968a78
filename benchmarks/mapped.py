"""Look-ups of maps at fixed points, with a gradient that gathers instead of scattering.

Differentiating a bilinear look-up scatters each point's gradient to four texels: random, contended additions that cost
more than the shading itself. Here the points are sorted once by the cell of four texels in which they lie. The gradient
of a cell is then a sum over consecutive points, and that of a texel the sum over its four cells: no atomics, and the
same result in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class MapSampler:
    """Bilinear look-ups of (S, S) maps at fixed UV coordinates, clamped at the border as in ``core.uv.sample_map``.

    Parameters
    ----------
    uv : (N, 2)
        Texture coordinates of the points.
    size : int
        S, at least 2.

    Attributes
    ----------
    order : (N,) int64
        The points in the order in which look-ups return them: sort everything else that is known per point by it.
    """

    def __init__(self, uv: NDArray, size: int) -> None:
        import mitsuba as mi

        x = np.clip(uv[:, 0] * size - 0.5, 0, size - 1)
        y = np.clip((1.0 - uv[:, 1]) * size - 0.5, 0, size - 1)
        column = np.minimum(x.astype(np.int64), size - 2)
        row = np.minimum(y.astype(np.int64), size - 2)
        cell = row * size + column
        self.size = size
        self.order = np.argsort(cell, kind="stable")
        cell = cell[self.order]
        self._cell = mi.UInt32(cell.astype(np.uint32))
        self._fx = mi.Float((x - column)[self.order].astype(np.float32))
        self._fy = mi.Float((y - row)[self.order].astype(np.float32))
        used, first, count = np.unique(cell, return_index=True, return_counts=True)
        self._used = mi.UInt32(used.astype(np.uint32))
        self._first = mi.UInt32(first.astype(np.uint32))
        self._end = mi.UInt32((first + count).astype(np.uint32))

    def __call__(self, maps: Sequence[Any]) -> list[Any]:
        """Look up flat maps (S*S each, row by row) at all points -> one Float (N,) each."""
        import drjit as dr

        return list(dr.custom(_operation(), self, list(maps)))

    def look_up(self, maps: Sequence[Any]) -> list[Any]:
        """The look-up itself, without derivatives."""
        import drjit as dr
        import mitsuba as mi

        c, s = self._cell, self.size
        out = []
        for m in maps:
            top0, top1 = dr.gather(mi.Float, m, c), dr.gather(mi.Float, m, c + 1)
            low0, low1 = dr.gather(mi.Float, m, c + s), dr.gather(mi.Float, m, c + (s + 1))
            top, low = dr.lerp(top0, top1, self._fx), dr.lerp(low0, low1, self._fx)
            out.append(dr.lerp(top, low, self._fy))
        return out

    def adjoint(self, gradients: Sequence[Any]) -> list[Any]:
        """Gradients (N,) of the looked-up values -> gradients (S*S,) of the maps."""
        import drjit as dr
        import mitsuba as mi

        count = len(gradients)
        dr.eval(*gradients)
        fx, fy = self._fx, self._fy

        def body(i: Any, sums: list[Any]) -> tuple[Any, list[Any]]:
            x, y = dr.gather(mi.Float, fx, i), dr.gather(mi.Float, fy, i)
            corners = ((1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y)
            out = []
            for k, gradient in enumerate(gradients):
                g = dr.gather(mi.Float, gradient, i)
                out.extend(dr.fma(w, g, sums[4 * k + j]) for j, w in enumerate(corners))
            return i + 1, out

        zero = [dr.zeros(mi.Float, dr.width(self._used)) for _ in range(4 * count)]
        _, sums = dr.while_loop(state=(mi.UInt32(self._first), zero), cond=lambda i, sums: i < self._end, body=body)
        # Cells are distinct, so these are plain stores.
        s = self.size
        cells = [dr.zeros(mi.Float, s * s) for _ in range(4 * count)]
        for target, value in zip(cells, sums, strict=True):
            dr.scatter(target, value, self._used)
        dr.eval(cells)
        texel = dr.arange(mi.UInt32, s * s)
        out = []
        for k in range(count):
            total = cells[4 * k]
            for j, shift in ((1, 1), (2, s), (3, s + 1)):
                total = total + dr.gather(mi.Float, cells[4 * k + j], texel - shift, texel >= shift)
            out.append(total)
        return out


_OPERATIONS: dict[str, type] = {}


def _operation() -> type:
    """The differentiable operation; its base belongs to Dr.Jit, which is imported late."""
    import drjit as dr

    if not _OPERATIONS:

        class LookUp(dr.CustomOp):
            """Bilinear look-up with the sorted gradient."""

            def eval(self, sampler: MapSampler, maps: list[Any]) -> list[Any]:
                self.sampler, self.count = sampler, len(maps)
                return sampler.look_up(maps)

            def forward(self) -> None:
                self.set_grad_out(self.sampler.look_up(self.grad_in("maps")))

            def backward(self) -> None:
                self.set_grad_in("maps", self.sampler.adjoint(self.grad_out()))

        _OPERATIONS["LookUp"] = LookUp
    return _OPERATIONS["LookUp"]
