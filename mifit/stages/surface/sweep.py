"""Where the surface lies along its own normals: a sweep of offsets, each judged by how well the views then agree.

Every texel of the surface is moved by a few offsets along its normal; each view is sampled there, and windows of
texels are compared between views. Windows live on the surface, so that they are foreshortened in every image as the
surface is, and one score per cell and offset sums all pairs of views of all timesteps. A cell is two by two
texels: windows overlap so far that a score at every texel adds nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.image import box
from mifit.core.mesh import normalize
from mifit.core.metrics import INDEPENDENT, median_deviation
from mifit.core.process import threads
from mifit.core.uv import TexelMap
from mifit.stages.surface.band import FeatureImage

NOISE = 0.012
"""Standard deviation of a feature that is noise: windows with less contrast say nothing."""
FAR = 0.1
"""Correlation that the ends of the sweep must gain on its middle: little texture leaves the surface where it is."""
NEAR = 3
"""Side of the neighbourhood whose offsets are compared, cells; it and the next two: chosen on Emily, scan_city."""
FINEST = 0.3
"""Deviation of an offset at best, in steps of the sweep."""
GLARE = 0.1
"""Least difference in log brightness between two views at which a match counts a quarter."""
GLARE_DEVIATIONS = 3.5
"""The same in units of the differences' deviation over the face, where that is more; for views of one timestep."""
LEAST_APART, BEST_APART, FARTHEST_APART = 5.0, 25.0, 50.0
"""Angle between views of different timesteps that are compared, degrees."""
MOST_PAIRS = 6
"""Of views of different timesteps; chosen on scan_city."""
LEAST_SCORE = 0.4
"""Correlation below which a cell counts as not matched."""

View = tuple[int, int]


@dataclass(frozen=True)
class Posed:
    """The texels of one timestep and the views of it.

    Attributes
    ----------
    position, normal : (N, 3)
        World space.
    images : sequence of FeatureImage
    seen : (views, N) float32
        Cosine of the angle of view; 0 where hidden or grazing.
    shift : (views, N, 3), optional
        What moves by an offset of 1 in each view; by default the normal in all of them.
    """

    position: NDArray
    normal: NDArray
    images: Sequence[FeatureImage]
    seen: NDArray[np.float32]
    shift: NDArray | None = None


@dataclass(frozen=True)
class Found:
    """Offsets of cells along the normals.

    Attributes
    ----------
    offset : (N,) float64
        World units.
    precision : (N,) float64
        Inverse variance, 0 where nothing was found.
    score : (N,) float32
        Mean correlation at the offset.
    """

    offset: NDArray[np.float64]
    precision: NDArray[np.float64]
    score: NDArray[np.float32]


def sweep(
    texels: TexelMap,
    cells: TexelMap,
    steps: Sequence[Posed],
    offsets: NDArray,
    window: int,
    pairs: Sequence[tuple[View, View]],
) -> Found:
    """Find each cell's offset.

    Parameters
    ----------
    texels : TexelMap
        Where views are sampled.
    cells : TexelMap
        Map of half the side, whose offsets are found.
    steps : sequence of Posed
        At the texels.
    offsets : (K,)
        Evenly spaced, ascending, around 0, world units.
    window : int
        Cells along a side, odd.
    pairs : sequence of pairs of (int, int)
        Views to compare, each named by its step and its place in it.
    """
    count, layers = len(cells.index), len(offsets)
    total, weight = np.zeros((2, layers, count), np.float32)
    named = list(dict.fromkeys(view for pair in pairs for view in pair))
    with ThreadPoolExecutor(threads()) as pool:
        shown = dict(
            zip(named, pool.map(lambda view: _Shown.of(texels, steps[view[0]], view[1], offsets), named), strict=True)
        )

        def compared(pair: tuple[View, View]) -> tuple[NDArray, NDArray] | None:
            deviations = GLARE_DEVIATIONS if pair[0][0] == pair[1][0] else 0.0
            return _compared(cells, shown[pair[0]], shown[pair[1]], window, deviations)

        for scores in pool.map(compared, pairs):
            if scores is not None:
                total += scores[0]
                weight += scores[1]
    score = np.where(weight > 0, total / np.maximum(weight, 1e-6), np.float32(-1))
    step = float(offsets[1] - offsets[0])
    at, matched, top = _peak(score, weight)
    precision = _precision(cells, at, matched, step)
    return Found((at * step).astype(np.float64), precision.astype(np.float64), top)


@dataclass(frozen=True)
class _Shown:
    """One view of the texels, as maps.

    Attributes
    ----------
    feature : (K, S, S) float32
        At each offset; 0 where the image doesn't show it.
    valid : (K, S, S) float32
        1 where it does, else 0.
    bright : (S, S) float32
        Log brightness at the middle offset.
    seen : (S, S) float32
        `Posed.seen`.
    """

    feature: NDArray[np.float32]
    valid: NDArray[np.float32]
    bright: NDArray[np.float32]
    seen: NDArray[np.float32]

    @classmethod
    def of(cls, texels: TexelMap, step: Posed, view: int, offsets: NDArray) -> _Shown:
        """What a view shows of texels moved by offsets, of those that it sees."""
        way = step.normal if step.shift is None else step.shift[view]
        rows = np.flatnonzero(step.seen[view] > 0)
        size, layers = texels.size, len(offsets)
        still = not way[rows].any()  # a view whose texels stay shows the same at every offset
        at = step.images[view].sample(step.position[rows], way[rows], np.zeros(1) if still else offsets)  # (K, n, 3)
        maps, where = np.zeros((2, len(at), size * size), np.float32), texels.index[rows]
        for k, one in enumerate(at):
            known = one[:, 1] > 0.99
            maps[0, k, where], maps[1, k, where] = np.where(known, one[:, 0], 0.0), known
        bright, seen = np.zeros((2, size * size), np.float32)
        bright[where], seen[where] = at[len(at) // 2, :, 2], step.seen[view, rows]
        feature, valid = (np.broadcast_to(m.reshape(-1, size, size), (layers, size, size)) for m in maps)
        return cls(feature, valid, bright.reshape(size, size), seen.reshape(size, size))


def _compared(
    cells: TexelMap, one: _Shown, other: _Shown, window: int, deviations: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """(K, N) correlation of two views times its weight, and that (K, N); None where nothing is seen in both."""
    both = (one.seen > 0) & (other.seen > 0)
    if not both.any():
        return None
    part = _even(box(both, window))
    trust = np.sqrt(one.seen[part] * other.seen[part])
    middle = len(one.valid) // 2
    shown = (one.valid[middle][part] * other.valid[middle][part]) > 0
    trust *= _without_glare(one.bright[part] - other.bright[part], shown & (trust > 0), deviations)
    trust, size = _pooled(trust), cells.size
    scores, weights = np.zeros((2, len(one.feature), size, size), np.float32)
    cell = tuple(slice(side.start // 2, side.stop // 2) for side in part)
    for k in range(len(one.feature)):
        mask = one.valid[k][part] * other.valid[k][part]
        found, known = _correlate(mask, one.feature[k][part], other.feature[k][part], window)
        weights[k][cell] = np.where(known, trust, np.float32(0))
        scores[k][cell] = weights[k][cell] * found
    return tuple(m.reshape(len(m), -1)[:, cells.index] for m in (scores, weights))  # type: ignore[return-value]


def _even(part: tuple[slice, slice]) -> tuple[slice, slice]:
    """Rows and columns that hold whole cells."""
    rows, columns = (slice(side.start & ~1, (side.stop + 1) & ~1) for side in part)
    return rows, columns


def _pooled(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(S, S) texels as the means of (S / 2, S / 2) cells."""
    height, width = values.shape
    return np.asarray(cv2.resize(values, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.float32)


def across_time(steps: Sequence[Posed], rotation: NDArray) -> list[tuple[View, View]]:
    """Pairs of views of different timesteps that see a rigid head (T, 3, 3) from directions fairly apart.

    A head that turns shows each camera what two cameras show at once, and more: the flank of a nose that one of them
    never sees.
    """
    towards = {
        (k, i): normalize(image.camera.position - step.position.mean(axis=0)) @ rotation[k]
        for k, step in enumerate(steps)
        for i, image in enumerate(step.images)
    }
    angles = {
        (a, b): float(np.degrees(np.arccos(np.clip(towards[a] @ towards[b], -1.0, 1.0))))
        for a, b in combinations(towards, 2)
        if a[0] != b[0]
    }
    left = {pair: abs(angle - BEST_APART) for pair, angle in angles.items() if LEAST_APART <= angle <= FARTHEST_APART}
    chosen: list[tuple[View, View]] = []
    uses = dict.fromkeys(towards, 0)
    while left and len(chosen) < MOST_PAIRS:
        a, b = min(left, key=lambda pair: (uses[pair[0]] + uses[pair[1]], left[pair]))
        del left[a, b]
        chosen.append((a, b))
        uses[a] += 1
        uses[b] += 1
    return chosen


def _without_glare(difference: NDArray, valid: NDArray, deviations: float) -> NDArray[np.float32]:
    """How far texels look as bright in one view as in the other, 0..1, from differences of log brightness.

    What is painted on skin does; a highlight lies elsewhere on it in every view, and matches itself at the depth of
    what it mirrors. Light on a head that turns moves over its skin as a highlight does.
    """
    if not valid.any():
        return np.ones(difference.shape, np.float32)
    difference = difference - np.median(difference[valid])
    spread = median_deviation(difference[valid]) if deviations else 0.0
    return (1.0 / (1.0 + (difference / max(GLARE, deviations * spread)) ** 2) ** 2).astype(np.float32)


def _correlate(
    mask: NDArray[np.float32], a: NDArray[np.float32], b: NDArray[np.float32], window: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Correlation of two textures (S, S) in windows of cells, and where half of a window and of its cell is shown.

    Towards 0 where the contrast is noise.
    """
    x, y = a * mask, b * mask
    shown = _pooled(mask)
    inside = cv2.blur(shown, (window, window))
    n = np.maximum(inside, np.float32(1e-6))
    mx, my, xx, yy, xy = (cv2.blur(_pooled(v), (window, window)) / n for v in (x, y, x * x, y * y, x * y))
    vx, vy = np.maximum(xx - mx * mx, 0) + NOISE**2, np.maximum(yy - my * my, 0) + NOISE**2
    found: NDArray = (xy - mx * my) / np.sqrt(vx * vy)
    return found, (shown > 0.5) & (inside > 0.5)


def _peak(score: NDArray, weight: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """(N,) steps from the middle to the best offset, which texels match there, and their scores.

    By a parabola through the best layer and its neighbours.
    """
    layers, count = score.shape
    # Where all offsets match alike the middle is chosen.
    best = (score - (FAR * (np.linspace(-1.0, 1.0, layers) ** 2)).astype(np.float32)[:, None]).argmax(0)
    inner = np.clip(best, 1, layers - 2)
    column = np.arange(count)
    low, mid, high = score[inner - 1, column], score[inner, column], score[inner + 1, column]
    shift = np.clip(0.5 * (high - low) / np.maximum(2 * mid - low - high, 1e-6), -1.0, 1.0)
    top = mid + 0.25 * (high - low) * shift
    around = np.minimum(np.minimum(weight[inner - 1, column], weight[inner, column]), weight[inner + 1, column])
    matched = (best == inner) & (around > 0) & (top > LEAST_SCORE)
    return matched * (inner - (layers - 1) / 2 + shift).astype(np.float32), matched, top


def _precision(cells: TexelMap, steps: NDArray[np.float32], matched: NDArray[np.bool_], step: float) -> NDArray:
    """(N,) inverse variance of cells' offsets, so many steps of a length each; 0 where nothing matched.

    Offsets of windows that overlap are alike where they measure the surface, and scatter where they don't, however
    well each of them matches: their variance around a cell is the variance of its offset.
    """

    def near(values: NDArray) -> NDArray[np.float32]:
        """Mean over a cell's neighbourhood."""
        return cells.from_map(cv2.blur(cells.to_map(values), (NEAR, NEAR)))

    found = matched.astype(np.float32)
    count = np.maximum(near(found), np.float32(1e-6))
    mean = near(steps) / count
    scatter = np.maximum(near(steps**2) / count - mean**2, 0.0) + (steps - mean) ** 2
    share = count / np.maximum(near(np.ones_like(found)), np.float32(1e-6))
    return INDEPENDENT * found * share**2 / ((FINEST**2 + scatter) * step**2)
