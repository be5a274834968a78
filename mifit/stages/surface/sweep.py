"""Where the surface lies along its own normals: a sweep of offsets, each judged by how well the views then agree.

Every texel of the surface is moved by a few offsets along its normal; each view is sampled there, and windows of
texels are compared between views. Windows live on the surface, so that they are foreshortened in every image as the
surface is, and one score per texel and offset sums all pairs of views of all timesteps.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import normalize
from mifit.core.metrics import median_deviation
from mifit.core.process import threads
from mifit.core.uv import TexelMap
from mifit.stages.surface.band import FeatureImage

NOISE = 0.012
"""Standard deviation of a feature that is noise: windows with less contrast say nothing."""
FAR = 0.1
"""Correlation that the ends of the sweep must gain on its middle: little texture leaves the surface where it is."""
NEAR = 7
"""Side of the neighbourhood whose offsets are compared, texels; it and the next two: chosen on Emily, scan_city."""
FINEST = 0.3
"""Deviation of an offset at best, in steps of the sweep."""
INDEPENDENT = 0.022
"""Part of the texels whose offsets count as measured on their own: windows overlap, and their errors are alike."""
GLARE = 0.1
"""Least difference in log brightness between two views at which a match counts a quarter."""
GLARE_DEVIATIONS = 3.5
"""The same in units of the differences' deviation over the face, where that is more; for views of one timestep."""
LEAST_APART, BEST_APART, FARTHEST_APART = 5.0, 25.0, 50.0
"""Angle between views of different timesteps that are compared, degrees."""
MOST_PAIRS = 12
"""Of views of different timesteps."""
ROWS = 32
"""Of a map that are worked on at a time: what they need stays in a core's cache."""
LEAST_SCORE = 0.4
"""Correlation below which a texel counts as not matched."""

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
    """Offsets along the normals.

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
    texels: TexelMap, steps: Sequence[Posed], offsets: NDArray, window: int, pairs: Sequence[tuple[View, View]]
) -> Found:
    """Find each texel's offset.

    Parameters
    ----------
    texels : TexelMap
    steps : sequence of Posed
    offsets : (K,)
        Evenly spaced, ascending, around 0, world units.
    window : int
        Texels along a side, odd.
    pairs : sequence of pairs of (int, int)
        Views to compare, each named by its step and its place in it.
    """
    count, layers = len(texels.index), len(offsets)
    total, weight = np.zeros((2, layers, count), np.float32)
    named = list(dict.fromkeys(view for pair in pairs for view in pair))
    with ThreadPoolExecutor(threads()) as pool:
        shown = dict(zip(named, pool.map(lambda view: _shown(steps[view[0]], view[1], offsets), named), strict=True))

        def compared(pair: tuple[View, View]) -> tuple[NDArray, NDArray] | None:
            seen = [steps[k].seen[i] for k, i in pair]
            deviations = GLARE_DEVIATIONS if pair[0][0] == pair[1][0] else 0.0
            return _compared(texels, [shown[view] for view in pair], np.sqrt(seen[0] * seen[1]), window, deviations)

        for scores in pool.map(compared, pairs):
            if scores is not None:
                total += scores[0]
                weight += scores[1]
    score = np.where(weight > 0, total / np.maximum(weight, 1e-6), np.float32(-1))
    step = float(offsets[1] - offsets[0])
    at, matched, top = _peak(score, weight)
    precision = _precision(texels, at, matched, step)
    return Found((at * step).astype(np.float64), precision.astype(np.float64), top)


@dataclass(frozen=True)
class _Shown:
    """One view of the texels: feature (K, N) at each offset, whether the image shows it, and log brightness (N,)."""

    feature: NDArray[np.float32]
    valid: NDArray[np.bool_]
    bright: NDArray[np.float32]


def _shown(step: Posed, view: int, offsets: NDArray) -> _Shown:
    """What a view shows of texels moved by offsets, of those that it sees."""
    way = step.normal if step.shift is None else step.shift[view]
    rows = np.flatnonzero(step.seen[view] > 0)
    if way[rows].any():
        at = step.images[view].sample(step.position[rows], way[rows], offsets)  # (K, n, 3)
    else:  # a view whose texels stay shows the same at every offset
        still = step.images[view].sample(step.position[rows], way[rows], np.zeros(1))
        at = np.broadcast_to(still, (len(offsets), *still.shape[1:]))
    feature = np.zeros((len(offsets), len(step.position)), np.float32)
    valid, bright = np.zeros(feature.shape, bool), np.zeros(feature.shape[1], np.float32)
    feature[:, rows], bright[rows] = at[..., 0], at[len(offsets) // 2, :, 2]
    valid[:, rows] = at[..., 1] > 0.99
    return _Shown(feature, valid, bright)


def _compared(
    texels: TexelMap, views: Sequence[_Shown], trust: NDArray, window: int, deviations: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """(K, N) correlation of two views times its weight, and that (K, N); None where nothing is seen in both."""
    one, other = views
    valid = one.valid & other.valid & (trust > 0)
    if not valid.any():
        return None
    trust = trust * _without_glare(one.bright - other.bright, valid[len(valid) // 2], deviations)
    scores, weights = np.zeros((2, *one.feature.shape), np.float32)
    for k, shown in enumerate(valid):
        if shown.any():
            mask = texels.to_map(shown.astype(np.float32))
            inside = cv2.blur(mask, (window, window))
            weights[k] = np.where(shown & (texels.from_map(inside) > 0.5), trust, np.float32(0))
            correlation = _correlate(texels, mask, inside, one.feature[k], other.feature[k], window)
            scores[k] = weights[k] * texels.from_map(correlation)
    return scores, weights


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
        return np.ones(len(difference), np.float32)
    difference = difference - np.median(difference[valid])
    spread = median_deviation(difference[valid]) if deviations else 0.0
    return (1.0 / (1.0 + (difference / max(GLARE, deviations * spread)) ** 2) ** 2).astype(np.float32)


def _correlate(
    texels: TexelMap, mask: NDArray, inside: NDArray, a: NDArray, b: NDArray, window: int
) -> NDArray[np.float32]:
    """Correlation of two textures in windows, towards 0 where the contrast is noise."""
    x, y = texels.to_map(a) * mask, texels.to_map(b) * mask
    sums = [cv2.blur(values, (window, window)) for values in (x, y, x * x, y * y, x * y)]
    out = np.empty_like(x)
    for start in range(0, len(x), ROWS):
        rows = slice(start, start + ROWS)
        n = np.maximum(inside[rows], np.float32(1e-6))
        mx, my, vx, vy, xy = (values[rows] / n for values in sums)
        vx -= mx * mx
        vy -= my * my
        for variance in (vx, vy):
            np.maximum(variance, 0, out=variance)
            variance += NOISE**2
        vx *= vy
        mx *= my
        xy -= mx
        np.divide(xy, np.sqrt(vx, out=vx), out=out[rows])
    return out


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


def _precision(texels: TexelMap, steps: NDArray[np.float32], matched: NDArray[np.bool_], step: float) -> NDArray:
    """(N,) inverse variance of offsets, so many steps of a length each; 0 where nothing matched.

    Offsets of windows that overlap are alike where they measure the surface, and scatter where they don't, however
    well each of them matches: their variance around a texel is the variance of its offset.
    """

    def near(values: NDArray) -> NDArray[np.float32]:
        """Mean over a texel's neighbourhood."""
        return texels.from_map(cv2.blur(texels.to_map(values), (NEAR, NEAR)))

    found = matched.astype(np.float32)
    count = np.maximum(near(found), np.float32(1e-6))
    mean = near(steps) / count
    scatter = np.maximum(near(steps**2) / count - mean**2, 0.0) + (steps - mean) ** 2
    share = count / np.maximum(near(np.ones_like(found)), np.float32(1e-6))
    return INDEPENDENT * found * share**2 / ((FINEST**2 + scatter) * step**2)
