"""Whether two views show one surface: how far off one another's epipolar lines it lies, and how alike it looks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mifit.core.uv import TexelMap
from mifit.stages.surface.flow import FEWEST, Posed, matches

FACING = 0.4
"""Cosine of the angle of view above which two views are compared as they are."""


def epipolar_residual(
    texels: TexelMap, steps: Sequence[Posed], rotation: NDArray, step: float, pair: tuple[int, int]
) -> float | None:
    """Median distance from the epipolar lines of a pair of views, pixels of the level; None where too few match.

    No depth explains it. Parameters as for `flow.match`; the pair is compared at each of the steps.
    """
    pairs = [((k, pair[0]), (k, pair[1])) for k in range(len(steps))]
    across = [found.across for *_, found in matches(texels, steps, rotation, step, pairs)]
    every = np.concatenate([np.zeros(0), *across])
    return float(np.median(every)) if len(every) >= FEWEST else None


def likeness(step: Posed, pair: tuple[int, int]) -> float | None:
    """Correlation of the features that a pair of views shows on a surface; None where few texels face both."""
    first, second = (step.images[view].sample(step.position, step.normal, np.zeros(1))[0] for view in pair)
    used = (first[:, 1] > 0.99) & (second[:, 1] > 0.99) & (step.seen[list(pair)].min(axis=0) > FACING)
    both = np.stack([first[used, 0], second[used, 0]])
    if used.sum() < FEWEST or not both.std(axis=1).all():
        return None
    return float(np.corrcoef(both)[0, 1])
