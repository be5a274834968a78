"""Gaussian-process fields over a surface, as modes: squared-exponential kernels, low rank by Nyström's method.

A zero-mean Gaussian process with kernel k has, on the vertices, the covariance K. From a few inducing points Z
comes K ~ Phi Phi^T with Phi = K_xz K_zz^(-1/2), so the columns of Phi are modes with unit-variance
coefficients. Sums of processes concatenate their columns; ``compress`` turns the columns of a sum into the
leading principal modes of the same process (Lüthi et al., Gaussian Process Morphable Models).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.topology import farthest_points


def kernel(x: NDArray, y: NDArray, scale: float) -> NDArray:
    """exp(-|x - y|^2 / (2 scale^2)) for points (N, 3) and (M, 3) -> (N, M)."""
    squared = (x**2).sum(1)[:, None] + (y**2).sum(1) - 2.0 * x @ y.T
    return np.exp(np.maximum(squared, 0.0) / (-2.0 * scale**2))


def field_modes(
    points: NDArray, scale: float, count: int, parity: int = 0, where: NDArray | None = None
) -> NDArray[np.float32]:
    """Modes (V, <= count) of a scalar field of unit standard deviation with a squared-exponential kernel.

    ``scale`` is the correlation length, in units of the points (V, 3), ``count`` the number of inducing points, which
    are spread among the vertices ``where`` (V,), by default all. With a ``parity`` of 1 fields equal their mirror image
    in x -> -x, with -1 they change their sign; the pointwise deviation then is 1 or 0 on the mirror plane, 1/sqrt(2)
    far from it.
    """
    pool = points if where is None else points[where]
    if parity:
        pool = pool[pool[:, 0] >= 0]  # the other half's kernels are the same functions
    z = pool[farthest_points(pool, count)]

    def covariance(a: NDArray, b: NDArray) -> NDArray:
        k = kernel(a, b, scale)
        return k if parity == 0 else 0.5 * (k + parity * kernel(a, b * (-1.0, 1.0, 1.0), scale))

    values, vectors = np.linalg.eigh(covariance(z, z))
    keep = values > 1e-5 * values[-1]
    return (covariance(points, z) @ (vectors[:, keep] / np.sqrt(values[keep]))).astype(np.float32)


def compress(columns: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Leading principal modes (N, min(count, M)) of the process with the given columns (N, M).

    Columns have independent unit-variance coefficients and need not be orthogonal. The modes are, each as long as its
    standard deviation, longest first; the first large entry of each is positive.
    """
    modes = columns
    for sample in (columns[:: max(1, len(columns) // 30_000)], None):  # find the subspace fast, then its exact axes
        rows = modes if sample is None else sample
        vectors = np.linalg.eigh((rows.T @ rows).astype(np.float64))[1][:, ::-1][:, :count]
        modes = modes @ vectors.astype(np.float32)
    # the first large entry, not the largest: mirror-odd modes have two of those, with opposite signs
    size = np.abs(modes)
    first = (size > 0.5 * size.max(0)).argmax(0)
    return modes * np.where(modes[first, np.arange(modes.shape[1])] < 0, -1.0, 1.0).astype(np.float32)


DEFORMATIONS = {
    1: ((75.0, 24, (3.2, 3.2, 3.8)), (34.0, 70, (2.4, 2.5, 2.8)), (15.0, 190, (1.3, 1.3, 1.5))),
    -1: ((55.0, 24, (1.0, 0.9, 1.1)),),
}
"""Of the deformations of either parity: correlation length in mm, inducing points, and deviation in mm along x, y, z.

With these, lengths of the face deviate as people's do: its breadth by 7 mm, nasion to chin 7, nasion to the nose's base
4, the nose's protrusion 3, the mouth's width 4 (Zhuang and Bradtmiller, "Head-and-face anthropometric survey of U.S.
respirator users", 2005).
"""
STRETCH = 0.035
"""Deviation of the relative width, height and depth of the whole."""


def deformation_modes(points: NDArray, where: NDArray, count: int) -> NDArray[np.float32]:
    """Modes (V, 3, count) in mm of smooth random deformations of points (V, 3) in mm, left and right as x -> -x.

    ``where`` (V,) are vertices among which the process has its inducing points.
    """
    blocks: list[tuple[int, NDArray]] = []  # axis, modes (V, k); blocks are orthogonal to one another
    for parity, kernels in DEFORMATIONS.items():
        # a symmetric deformation has a mirror-odd x and mirror-even y and z
        fields_by_axis = {
            p: [field_modes(points, scale, inducing, p, where) for scale, inducing, _ in kernels] for p in (1, -1)
        }
        for axis in range(3):
            fields = fields_by_axis[-parity if axis == 0 else parity]
            columns = [np.float32(k[2][axis]) * f for k, f in zip(kernels, fields, strict=True)]
            if parity == 1:
                centre = 0.0 if axis == 0 else points[:, axis].mean()
                columns.append((STRETCH * (points[:, axis] - centre))[:, None].astype(np.float32))
            blocks.append((axis, compress(np.hstack(columns), count)))
    norms = np.concatenate([np.linalg.norm(block, axis=0) for _, block in blocks])
    axes = np.concatenate([np.full(block.shape[1], axis) for axis, block in blocks])
    order = np.argsort(-norms, kind="stable")[:count]
    out = np.zeros((len(points), 3, len(order)), dtype=np.float32)
    out[:, axes[order], np.arange(len(order))] = np.hstack([block for _, block in blocks])[:, order]
    return out
