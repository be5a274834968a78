"""Where the surface lies along its own normals: what one view shows of it is found again in another.

Every view is painted on the current surface. Two such textures differ by what the surface lacks, no longer by
perspective, and optical flow between them (dense inverse search, Kroeger et al. 2016) says where the second shows a
texel of the first. The point that moves along the first view's ray until the second shows it there gives an offset
along the normal. What then remains lies across the epipolar line: an error of the flow or of the cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.image import box
from mifit.core.mesh import dot, normalize
from mifit.core.metrics import INDEPENDENT, median_deviation
from mifit.core.process import threads
from mifit.core.uv import TexelMap
from mifit.stages.surface.band import FeatureImage, band_pass, look_up

CONTRAST = 400.0
"""Steps of an 8-bit texture per unit of a feature."""
PATCH, STRIDE, DESCENTS = 8, 4, 12
"""Side and spacing of the patches, texels, and their iterations."""
NOISE = 0.012
"""Standard deviation of a feature that is noise: patches with less contrast say nothing."""
CLOSED = 1.5
"""Texels by which flow there and back may miss its start. Chosen on scan_city, gloss and `ict_301`."""
ACROSS = 1.0
"""Pixels of the level by which a match may miss the epipolar line."""
FARTHEST = 6.0
"""Steps from the surface within which a match counts."""
NEAR = 3
"""Side of the neighbourhood whose offsets are compared, cells; it and the next two: chosen on Emily, scan_city."""
FINEST = 0.3
"""Deviation of an offset at best, steps."""
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
        Of the first view.
    offset : (n,)
        Along the normal, steps.
    information : (n,)
        Squared pixels by which the second view moves it per step.
    across : (n,)
        Pixels off the epipolar line.
    darker : (n,)
        Log brightness in the first view less that in the second.
    """

    texel: NDArray[np.intp]
    offset: NDArray[np.float32]
    information: NDArray[np.float32]
    across: NDArray[np.float32]
    darker: NDArray[np.float32]


def match(
    texels: TexelMap, cells: TexelMap, steps: Sequence[Posed], rotation: NDArray, step: float, pairs: Sequence[Pair]
) -> Found:
    """Find each cell's offset.

    Parameters
    ----------
    texels : TexelMap
        Where views are painted.
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
    for (k, i), (m, _), found in matches(texels, steps, rotation, step, pairs):
        at, offset = found.texel, found.offset
        good = (found.across < ACROSS) & (np.abs(offset) < FARTHEST)
        glare = _without_glare(found.darker, good, GLARE_DEVIATIONS if k == m else 0.0)
        weight = np.where(good, found.information * steps[k].seen[i][at], 0.0)
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


def matches(
    texels: TexelMap, steps: Sequence[Posed], rotation: NDArray, step: float, pairs: Sequence[Pair]
) -> Iterator[tuple[View, View, Matches]]:
    """What each view of a pair shows, found in the other one; parameters as for `match`."""
    number = np.full(texels.size**2, -1, np.intp)
    number[texels.index] = np.arange(len(texels.index))
    with ThreadPoolExecutor(threads()) as pool:
        named = list(dict.fromkeys(view for pair in pairs for view in pair))
        shown = dict(
            zip(named, pool.map(lambda view: _Painted.of(texels, steps[view[0]], view[1]), named), strict=True)
        )

        def both_ways(pair: Pair) -> list[tuple[View, View, Matches]]:
            one, other = (shown[view] for view in pair)
            both = (one.look[..., 0] > 0) & (other.look[..., 0] > 0)
            if not both.any():
                return []
            part = box(both, PATCH)
            rows = number.reshape(both.shape)[part]
            (one, first), (other, second) = one.beside(other, part), other.beside(one, part)
            textures = [np.clip(128.0 + CONTRAST * band, 0, 255).astype(np.uint8) for band in (first, second)]
            forth, back = _flow(*textures), _flow(*textures[::-1])
            turn = rotation[pair[0][0]] @ rotation[pair[1][0]].T  # of row vectors
            return [
                (*pair, _matches(one, other, rows, (forth, back), turn, step)),
                (*pair[::-1], _matches(other, one, rows, (back, forth), turn.T, step)),
            ]

        for found in pool.map(both_ways, pairs):
            yield from found


@dataclass(frozen=True)
class _Painted:
    """One view, painted on the surface.

    Attributes
    ----------
    image : FeatureImage
    log : (S, S) float32
        Logarithm of the image.
    position, normal : (S, S, 3) float32
        World space.
    pixel : (S, S, 2) float32
        Where the view shows it.
    look : (S, S, 2) float32
        1 where the view shows the surface, and contrast on it once it is compared, else 0; its log brightness.
    """

    image: FeatureImage
    log: NDArray[np.float32]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    pixel: NDArray[np.float32]
    look: NDArray[np.float32]

    @classmethod
    def of(cls, texels: TexelMap, step: Posed, view: int) -> _Painted:
        """A view of the texels."""
        image = step.images[view]
        pixel = image.place(step.position)
        _, valid, bright, log = look_up(image.values, pixel).T
        shown = (step.seen[view] > 0) & (valid > 0.99)
        look = texels.to_map(np.stack([shown, bright], axis=1).astype(np.float32))
        position, normal, pixel = (texels.to_map(x.astype(np.float32)) for x in (step.position, step.normal, pixel))
        return cls(image, texels.to_map(log), position, normal, pixel, look)

    def beside(self, other: _Painted, part: tuple[slice, slice]) -> tuple[_Painted, NDArray[np.float32]]:
        """A part of the maps, ``look`` only where there is contrast, and the band to compare with another view's.

        The band is that of what both views show. A nose hides one cheek from one of them and the other cheek from the
        other: averages that held those would differ on the nose itself, and move it.
        """
        maps = {name: getattr(self, name)[part] for name in ("log", "position", "normal", "pixel", "look")}
        both = (maps["look"][..., 0] > 0) & (other.look[part][..., 0] > 0)
        band = band_pass(maps["log"], both)
        mean, square = (cv2.blur(each, (PATCH, PATCH)) for each in (band, band**2))
        contrast = both & (square - mean**2 > NOISE**2)
        maps["look"] = np.stack([contrast.astype(np.float32), maps["look"][..., 1]], axis=-1)
        return replace(self, **maps), band


def _flow(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W, 2) way in texels from each texel of a texture to the same skin in another."""
    if min(one.shape) < 2 * PATCH:
        return np.full((*one.shape, 2), -4.0 * max(one.shape), np.float32)  # nowhere
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)
    search.setPatchSize(PATCH)
    search.setPatchStride(STRIDE)
    search.setGradientDescentIterations(DESCENTS)
    search.setVariationalRefinementIterations(0)
    return np.asarray(search.calc(np.ascontiguousarray(one), np.ascontiguousarray(other), None), np.float32)  # type: ignore[call-overload]


def _matches(
    one: _Painted, other: _Painted, rows: NDArray, ways: tuple[NDArray, NDArray], turn: NDArray, step: float
) -> Matches:
    """What one view shows, found in another: where flow there and back ends at its start.

    ``rows`` (H, W) are the numbers of the texels, ``turn`` takes directions of the first world to the second.
    """
    y, x = np.nonzero(one.look[..., 0] > 0)
    start = np.stack([x, y], axis=1)
    end = start + ways[0][y, x]
    look = look_up(other.look, end)
    missed = end + look_up(ways[1], end) - start
    used = (look[:, 0] > 0.99) & (np.hypot(*missed.T) < CLOSED)
    y, x, end, look = y[used], x[used], end[used], look[used]
    ray = one.position[y, x] - np.float32(one.image.camera.position)
    way = (ray * (np.float32(step) / dot(ray, one.normal[y, x]))[:, None]) @ np.float32(turn)
    here = other.pixel[y, x]
    slope, shift = other.image.place(other.position[y, x] + way) - here, look_up(other.pixel, end) - here
    (u, v), (du, dv) = slope.T, shift.T
    information = np.maximum(u * u + v * v, np.float32(1e-12))
    offset = (u * du + v * dv) / information
    across = np.hypot(du - u * offset, dv - v * offset)
    darker = one.look[y, x, 1] - look[:, 1]
    good = np.isfinite(across)
    return Matches(rows[y, x][good], offset[good], information[good], across[good], darker[good])


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
    across = [found.across for *_, found in matches(texels, steps, rotation, step, pairs)]
    every = np.concatenate([np.zeros(0), *across])
    return float(np.median(every)) if len(every) >= FEWEST else None


def likeness(step: Posed, pair: tuple[int, int]) -> float | None:
    """Correlation of the features that a pair of views shows on a surface; None where few texels face both."""
    first, second = (step.images[view].sample(step.position) for view in pair)
    used = (first[:, 1] > 0.99) & (second[:, 1] > 0.99) & (step.seen[list(pair)].min(axis=0) > FACING)
    both = np.stack([first[used, 0], second[used, 0]])
    if used.sum() < FEWEST or not both.std(axis=1).all():
        return None
    return float(np.corrcoef(both)[0, 1])


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
