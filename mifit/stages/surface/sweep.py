"""Where the surface lies along its own normals: there, two views show the same skin.

A plane sweep around the current surface. A texel is moved along the ray of one view, by steps to both sides, and
another view is read at each place. Around a place on the true surface both differ by a constant at most, of exposure or
shading: the variance, in a small window of texels, of the difference of their logarithms is least there, compared with
the variance of both. Windows lie on the surface, so perspective costs nothing, and hold only what both views see.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import dot, normalize
from mifit.core.metrics import INDEPENDENT, median_deviation
from mifit.core.process import threads
from mifit.core.uv import TexelMap
from mifit.stages.surface.band import FeatureImage

FARTHEST = 4
"""Steps to both sides at which the surface is looked for; it and the next: chosen on all development heads."""
WINDOW = 2.0
"""Standard deviation of the windows, texels."""
NOISE = 0.012
"""Standard deviation of a logarithm that is noise: windows with less contrast show nothing."""
SAME = 0.3
"""Variance of the difference of two windows, of the sum of their variances, below which they show the same skin."""
BESIDE = 4
"""Pixels to both sides of an epipolar line where points are looked for, to tell cameras off their calibration."""
NEAR = 3
"""Side of the neighbourhood whose offsets are compared, cells; chosen on Emily, scan_city."""
FINEST = 0.2
"""Deviation of an offset at best, steps; chosen on all development heads."""
GLARE = 0.1
"""Least difference in log brightness between two views at which a match counts a quarter."""
GLARE_DEVIATIONS = 3.5
"""The same in units of the differences' deviation over the face, where that is more; for views of one timestep."""
LEAST_APART, BEST_APART, FARTHEST_APART = 5.0, 25.0, 50.0
"""Angle between views of different timesteps that are compared, degrees."""
MOST_PAIRS = 6
"""Of views of different timesteps; chosen on scan_city."""
FACING = 0.4
"""Cosine of the angle of view above which two views are compared as they are."""
FEWEST = 200
"""Texels or points that must match for their residuals to say something."""

VALID_AND_LOG = [1, 2]
"""Channels of a feature image."""
MARGIN, OUTSIDE, UNSEEN, BLIND = 5, -10.0, 9.0, -1e9
"""Texels that windows reach, chosen on gloss, Emily c3,c4, scan_city; a pixel that no image has; more than windows can
be unlike; a logarithm of no colour."""

T = TypeVar("T")
View = tuple[int, int]
Pair = tuple[View, View]


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
    """

    position: NDArray
    normal: NDArray
    images: Sequence[FeatureImage]
    seen: NDArray[np.float32]


@dataclass(frozen=True)
class Found:
    """Offsets of cells along the normals, (N,) world units, and their inverse variance, 0 where nothing was found."""

    offset: NDArray[np.float64]
    precision: NDArray[np.float64]


@dataclass(frozen=True)
class Matches:
    """What one view shows, found in another.

    Attributes
    ----------
    texel : (n,) int
    offset : (n,)
        Along the normal, steps.
    information : (n,)
        Squared pixels by which the second view moves it per step.
    darker : (n,)
        Log brightness in the first view less that in the second.
    """

    texel: NDArray[np.intp]
    offset: NDArray[np.float32]
    information: NDArray[np.float32]
    darker: NDArray[np.float32]


def match(
    texels: TexelMap, cells: TexelMap, steps: Sequence[Posed], rotation: NDArray, step: float, pairs: Sequence[Pair]
) -> Found:
    """Find each cell's offset.

    Parameters
    ----------
    texels : TexelMap
        Where views are compared.
    cells : TexelMap
        Map of half the side, whose offsets are found.
    steps : sequence of Posed
        At the texels.
    rotation : (T, 3, 3)
        Of the head, per step.
    step : float
        World length that moves the surface by a good half of a pixel in one view against another.
    pairs : sequence of pairs of (int, int)
        Views to compare, each named by its step and its place in it.
    """
    # Per texel: weight, and weighted glare, offset and its square.
    sums = np.zeros((4, len(texels.index)))
    for (k, i), (m, _), swept in _swept(texels, steps, rotation, step, pairs, _Sweep.matches):
        at, offset = swept.texel, swept.offset
        glare = _without_glare(swept.darker, GLARE_DEVIATIONS if k == m else 0.0)
        weight = swept.information * steps[k].seen[i][at]
        for one, value in zip(sums, (np.ones_like(glare), glare, glare * offset, glare * offset**2), strict=True):
            one[at] += weight * value
    sums[0] = sums[1] / np.maximum(sums[0], 1e-9)  # a cell of which one texel matches is worth a quarter
    maps, side = (texels.to_map(one.astype(np.float32)) for one in sums), (cells.size, cells.size)
    trust, weight, first, second = (cells.from_map(cv2.resize(one, side, interpolation=cv2.INTER_AREA)) for one in maps)
    there = weight > 1e-6
    mean = np.where(there, first / np.maximum(weight, 1e-9), np.float32(0))
    within = np.where(there, np.maximum(second / np.maximum(weight, 1e-9) - mean**2, 0), np.float32(0))
    precision = trust * _precision(cells, mean, there, within, step)
    return Found((mean * step).astype(np.float64), precision.astype(np.float64))


def _swept(
    texels: TexelMap,
    steps: Sequence[Posed],
    rotation: NDArray,
    step: float,
    pairs: Sequence[Pair],
    what: Callable[[_Sweep], T],
) -> Iterator[tuple[View, View, T]]:
    """What the sweeps of a pair tell, of each view against the other; parameters as for `match`."""
    ways = [way for one, other in pairs for way in ((one, other), (other, one))]

    def swept(way: Pair) -> T | None:
        (k, i), (m, j) = way
        turn = rotation[k] @ rotation[m].T  # of row vectors
        sweep = _Sweep.of(texels, (steps[k], i), (steps[m], j), turn, step)
        return None if sweep is None else what(sweep)

    with ThreadPoolExecutor(threads()) as pool:
        for (one, other), found in zip(ways, pool.map(swept, ways), strict=True):
            if found is not None:
                yield one, other, found


@dataclass(frozen=True)
class _Sweep:
    """Texels that two views see, in the first view and where the second one shows them as they move.

    Attributes
    ----------
    texel, at : (n,) int
        Numbers of the texels, and of their places in the maps, which are a part of those of all texels.
    first : (h, w) float32
        The first view's logarithm.
    second : (H, W) float32
        The second view's logarithm, `BLIND` where it isn't measured.
    place, slope : (h, w, 2) float32
        Its pixels that show the texels, and how far a step along the first view's rays moves them.
    """

    texel: NDArray[np.intp]
    at: NDArray[np.intp]
    first: NDArray[np.float32]
    second: NDArray[np.float32]
    place: NDArray[np.float32]
    slope: NDArray[np.float32]

    @classmethod
    def of(
        cls, texels: TexelMap, one: tuple[Posed, int], other: tuple[Posed, int], turn: NDArray, step: float
    ) -> _Sweep | None:
        """Of two views, each a step and the view's place in it; None where nothing is seen by both.

        ``turn`` takes directions of the first one's world to the second's.
        """
        (first, i), (second, j) = one, other
        image, shows = first.images[i], second.images[j]
        both = np.flatnonzero((first.seen[i] > 0) & (second.seen[j] > 0))
        valid, log = image.sample(first.position[both])[:, VALID_AND_LOG].T
        both, log = both[valid > 0.99], log[valid > 0.99]
        if not len(both):
            return None
        position = first.position[both]
        ray = position - image.camera.position
        way = (ray * (step * FARTHEST / dot(ray, first.normal[both]))[:, None]) @ turn
        near, far = (shows.place(second.position[both] + sign * way) for sign in (-1.0, 1.0))
        y, x = np.divmod(texels.index[both], texels.size)
        y, x = y - y.min() + MARGIN, x - x.min() + MARGIN
        size = int(y.max()) + MARGIN + 1, int(x.max()) + MARGIN + 1
        at = y * size[1] + x

        def spread(values: NDArray, fill: float = 0.0) -> NDArray[np.float32]:
            """A map of the texels' values."""
            out = np.full((size[0] * size[1], *values.shape[1:]), fill, np.float32)
            out[at] = values
            return out.reshape(*size, *values.shape[1:])

        place, slope = spread(0.5 * (near + far), OUTSIDE), spread((far - near) / (2.0 * FARTHEST))
        valid, seen = (shows.values[..., k] for k in VALID_AND_LOG)
        return cls(both, at, spread(log), np.where(valid > 0.99, seen, np.float32(BLIND)), place, slope)

    def compare(self, offset: float, beside: float = 0.0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(n,) how unlike the windows of both views are, and how much brighter the first one is.

        Texels are moved by an offset, and pixels ``beside`` their epipolar lines.
        """
        place = self.place + np.float32(offset) * self.slope
        if beside:
            along = self.slope / np.maximum(np.linalg.norm(self.slope, axis=-1, keepdims=True), np.float32(1e-9))
            place += along[..., ::-1] * np.array([-beside, beside], np.float32)
        log = cv2.remap(self.second, place, None, cv2.INTER_LINEAR, borderValue=BLIND)  # type: ignore[call-overload]
        known = (log > 1e-8 * BLIND).astype(np.float32)
        a, b = known * self.first, known * log
        maps = known, a, b, a * a + b * b, a * b
        weight, *sums = (np.take(cv2.GaussianBlur(one, (2 * MARGIN + 1,) * 2, WINDOW), self.at) for one in maps)
        a, b, squares, product = (one / np.maximum(weight, np.float32(1e-3)) for one in sums)
        variance = np.maximum(squares - a * a - b * b, 0)
        of_difference = np.maximum(variance - 2 * (product - a * b), 0)
        noise = np.float32(NOISE**2)
        unlike = np.log((of_difference + noise) / (variance + 2 * noise))
        shown = (np.take(known, self.at) > 0) & (variance > 2 * noise)
        return np.where(shown, unlike, np.float32(UNSEEN)), a - b

    def matches(self) -> Matches:
        """The offsets at which windows are least unlike."""
        offsets = range(-FARTHEST, FARTHEST + 1)
        unlike, darker = (np.stack(each) for each in zip(*map(self.compare, offsets), strict=True))
        row, between, _ = _lowest(unlike)
        found = np.flatnonzero(np.isfinite(between))
        offset = between[found] - np.float32(FARTHEST)
        information = (self.slope.reshape(-1, 2)[self.at[found]] ** 2).sum(axis=1)
        return Matches(self.texel[found], offset, information, darker[row[found], found])

    def beside(self) -> NDArray[np.float32]:
        """(n,) pixels from the epipolar lines at which windows are least unlike, where they are alike."""
        unlike = np.stack([self.compare(0.0, way)[0] for way in range(-BESIDE, BESIDE + 1)])
        _, between, least = _lowest(unlike)
        return np.abs(between - BESIDE)[np.isfinite(between) & (least < np.log(SAME))]


def _lowest(values: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Where samples (K, n) are least: the row, the place between rows, and the value there.

    The place is NaN at either end and beside what is unseen.
    """
    row = values.argmin(axis=0)
    inner = np.clip(row, 1, len(values) - 2)
    low, middle, high = np.take_along_axis(values, np.stack([inner - 1, inner, inner + 1]), axis=0)
    known = (row == inner) & (np.maximum(low, high) < UNSEEN)
    low, high = (np.where(known, one - middle, np.float32(0)) for one in (low, high))
    bend = low + high
    aside = np.where(bend > 0, np.float32(0.5) * (low - high) / np.maximum(bend, np.float32(1e-9)), np.float32(np.nan))
    return row, inner + aside, middle


def across_time(steps: Sequence[Posed], rotation: NDArray) -> list[Pair]:
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
    chosen: list[Pair] = []
    uses = dict.fromkeys(towards, 0)
    while left and len(chosen) < MOST_PAIRS:
        a, b = min(left, key=lambda pair: (uses[pair[0]] + uses[pair[1]], left[pair]))
        del left[a, b]
        chosen.append((a, b))
        uses[a] += 1
        uses[b] += 1
    return chosen


def epipolar_residual(
    texels: TexelMap, steps: Sequence[Posed], rotation: NDArray, step: float, pair: tuple[int, int]
) -> float | None:
    """Median distance from the epipolar lines of a pair of views, pixels of the level; None where too few match.

    No depth explains it. Parameters as for `match`; the pair is compared at each of the steps.
    """
    pairs = [((k, pair[0]), (k, pair[1])) for k in range(len(steps))]
    found = [beside for *_, beside in _swept(texels, steps, rotation, step, pairs, _Sweep.beside)]
    every = np.concatenate([np.zeros(0), *found])
    return float(np.median(every)) if len(every) >= FEWEST else None


def likeness(step: Posed, pair: tuple[int, int]) -> float | None:
    """Correlation of the features that a pair of views shows on a surface; None where few texels face both."""
    first, second = (step.images[view].sample(step.position) for view in pair)
    used = (first[:, 1] > 0.99) & (second[:, 1] > 0.99) & (step.seen[list(pair)].min(axis=0) > FACING)
    both = np.stack([first[used, 0], second[used, 0]])
    if used.sum() < FEWEST or not both.std(axis=1).all():
        return None
    return float(np.corrcoef(both)[0, 1])


def _without_glare(darker: NDArray, deviations: float) -> NDArray[np.float32]:
    """How far texels look as bright in one view as in the other, 0..1, from differences of log brightness.

    What is painted on skin does; a highlight lies elsewhere on it in every view, and matches itself at the depth of
    what it mirrors. Light on a head that turns moves over its skin as a highlight does.
    """
    if not len(darker):
        return np.ones(0, np.float32)
    darker = darker - np.median(darker)
    spread = median_deviation(darker) if deviations else 0.0
    return (1.0 / (1.0 + (darker / max(GLARE, deviations * spread)) ** 2) ** 2).astype(np.float32)


def _precision(cells: TexelMap, offset: NDArray, there: NDArray, within: NDArray, step: float) -> NDArray[np.float64]:
    """(N,) inverse variance of cells' offsets in steps, 0 where there are none.

    Offsets of neighbours are alike where they measure the surface, and scatter where they don't: their variance around
    a cell is the variance of its offset, beside that ``within`` the cell.
    """

    def near(values: NDArray) -> NDArray[np.float32]:
        """Mean over a cell's neighbourhood."""
        return cells.from_map(cv2.blur(cells.to_map(values.astype(np.float32)), (NEAR, NEAR)))

    found = there.astype(np.float32)
    count = np.maximum(near(found), np.float32(1e-6))
    mean = near(offset * found) / count
    scatter = np.maximum(near(offset**2 * found) / count - mean**2, 0.0) + (offset - mean) ** 2 + within
    share = count / np.maximum(near(np.ones_like(found)), np.float32(1e-6))
    return INDEPENDENT * found * share**2 / ((FINEST**2 + scatter) * step**2)
