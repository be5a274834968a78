"""Whether two views show one surface: how far off one another's epipolar lines it lies, and how alike it looks.

Along its normal a texel is moved until the views agree; across the plane through it and both cameras no depth moves
it, so that a shift which remains there is no matter of the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mifit.core.camera import Camera
from mifit.core.mesh import normalize
from mifit.core.uv import TexelMap
from mifit.stages.surface.sweep import Posed, sweep

FARTHEST = 4
"""Pixels that are searched to either side."""
FEWEST = 200
"""Cells or points that must match for their residuals to say something."""
FACING = 0.4
"""Cosine of the angle of view above which two views are compared as they are."""


def epipolar_residual(
    texels: TexelMap,
    cells: TexelMap,
    steps: Sequence[Posed],
    cameras: Sequence[Camera],
    pair: tuple[int, int],
    pixel: float,
    window: int,
) -> float | None:
    """Median distance from the epipolar lines of a pair of views, pixels of the level.

    Parameters
    ----------
    texels, cells : TexelMap
    steps : sequence of Posed
        Texels where the views agree best, per timestep.
    cameras : sequence of Camera
    pair : (int, int)
    pixel : float
        World length of a pixel at the face.
    window : int
        As for `sweep`.

    Returns
    -------
    float or None
        None where too few cells match, or they do only beyond ``FARTHEST``.
    """
    a, b = pair
    moved = []
    for step in steps:
        across = np.cross(cameras[a].position - step.position, cameras[b].position - step.position)
        shift = np.zeros((len(cameras), *step.position.shape))
        shift[b] = normalize(across)
        moved.append(replace(step, shift=shift))
    pairs = [((k, pair[0]), (k, pair[1])) for k in range(len(moved))]
    found = sweep(texels, cells, moved, pixel * np.arange(-FARTHEST, FARTHEST + 1), window, pairs)
    used = found.precision > 0
    if used.sum() < FEWEST:
        return None
    distance, weight = np.abs(found.offset[used]) / pixel, found.precision[used]
    order = np.argsort(distance)
    total = np.cumsum(weight[order])
    return float(distance[order][np.searchsorted(total, 0.5 * total[-1])])


def likeness(step: Posed, pair: tuple[int, int]) -> float | None:
    """Correlation of the features that a pair of views shows on a surface; None where few texels face both."""
    first, second = (step.images[view].sample(step.position, step.normal, np.zeros(1))[0] for view in pair)
    used = (first[:, 1] > 0.99) & (second[:, 1] > 0.99) & (step.seen[list(pair)].min(axis=0) > FACING)
    both = np.stack([first[used, 0], second[used, 0]])
    if used.sum() < FEWEST or not both.std(axis=1).all():
        return None
    return float(np.corrcoef(both)[0, 1])
