"""Identity modes of the built-in head: a Gaussian process of smooth, mostly symmetric deformations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.builtin import sculpt
from mifit.morphable.builtin.template import EYEBALL, Template
from mifit.morphable.gaussian_process import compress, field_modes

# correlation length in mm, inducing points, deviation in mm along x, y, z, of both parities
_SYMMETRIC = ((75.0, 24, (2.8, 3.0, 3.6)), (34.0, 70, (1.5, 1.9, 2.2)), (15.0, 190, (0.6, 0.8, 1.1)))
_ASYMMETRIC = ((55.0, 24, (0.7, 0.6, 0.8)),)


def deformation_modes(
    points: NDArray,
    where: NDArray | None,
    count: int,
    symmetric: tuple = _SYMMETRIC,
    asymmetric: tuple = _ASYMMETRIC,
    stretch: tuple[float, float, float] = (0.03, 0.03, 0.03),
) -> NDArray[np.float32]:
    """Modes (V, 3, count) in mm of smooth random deformations of points (V, 3) in mm.

    Parameters
    ----------
    points : (V, 3) float
        Vertices, left and right as x -> -x.
    where : (V,) bool or None
        Vertices among which the process has its inducing points.
    count : int
    symmetric, asymmetric : tuple of (scale, inducing points, (sx, sy, sz))
        Kernels: correlation length and deviations, in mm.
    stretch : tuple of float
        Deviation of the relative width, height and depth of the whole.
    """
    blocks: list[tuple[int, NDArray]] = []  # axis, modes (V, k); blocks are orthogonal to one another
    for parity, kernels in ((1, symmetric), (-1, asymmetric)):
        # a symmetric deformation has a mirror-odd x and mirror-even y and z
        fields_by_axis = {
            p: [field_modes(points, scale, inducing, p, where) for scale, inducing, _ in kernels] for p in (1, -1)
        }
        for axis in range(3):
            fields = fields_by_axis[-parity if axis == 0 else parity]
            columns = [np.float32(k[2][axis]) * f for k, f in zip(kernels, fields, strict=True)]
            if not kernels:
                continue
            if parity == 1:
                centre = 0.0 if axis == 0 else points[:, axis].mean()
                columns.append((stretch[axis] * (points[:, axis] - centre))[:, None].astype(np.float32))
            blocks.append((axis, compress(np.hstack(columns), count)))
    norms = np.concatenate([np.linalg.norm(block, axis=0) for _, block in blocks])
    axes = np.concatenate([np.full(block.shape[1], axis) for axis, block in blocks])
    order = np.argsort(-norms, kind="stable")[:count]
    out = np.zeros((len(points), 3, len(order)), dtype=np.float32)
    out[:, axes[order], np.arange(len(order))] = np.hstack([block for _, block in blocks])[:, order]
    return out


def identity_modes(template: Template, count: int) -> NDArray[np.float32]:
    """Identity modes (V, 3, count) in mm; eyeballs move as wholes so that they stay round."""
    v = template.vertices
    modes = deformation_modes(v, (v[:, 2] > -30.0) & (v[:, 1] > -125.0), count)
    for sign in (-1, 1):
        ball = (template.part == EYEBALL) & (np.sign(v[:, 0]) == sign)
        rim = np.linalg.norm(v[:, :2] - sculpt.EYE[:2] * (sign, 1), axis=1)
        lids = (template.part != EYEBALL) & (rim < 16.0) & (v[:, 2] > 60.0)
        modes[ball] = modes[lids].mean(0)
    return modes
