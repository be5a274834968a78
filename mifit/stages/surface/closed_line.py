"""Whether an image shows a closed mouth or eye, and where the line runs in which lips or lids meet.

The lips of a closed mouth meet in one thin line, darker and redder than they are. An open mouth shows a band instead
that is as high as the opening: teeth, which are less red than lips, or the dark inside. Closed lids meet in such a line
too, under their lashes; between the margins of an open eye lies what is less red than skin, the white, or far darker,
iris and pupil.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from mifit.core.uv import bilinear
from mifit.sampling.visibility import DARKEST

STEP_MM = 0.1
"""Distance of samples across the lips."""
BEYOND_MM = 4.0
"""How far past the modelled opening the line is looked for."""
LINE_MM = 1.0
"""Distance from the line at which lips and lids are bright on both sides, and teeth pale between lips."""
CONTRAST = 0.15
"""Difference of logarithms of colour that shows something: the line below both sides, red over green of the white of an
eye below that of skin."""
LESS_RED = 0.3
"""Teeth: near the line red over green falls by this (log) below the lips'."""
DARK = 1.2
"""An eye is open where it is pale, or colours fall by this (log) as those of iris and pupil."""
OPEN = 0.45
"""Part of columns or pixels from which teeth show that a mouth, and white or iris that eyes are open, mean over the
views and over both eyes. Closed eyes of scan_city have 0.33 at the most, open ones of emily and gloss 0.78 at least."""
MARGINAL = 0.2
"""Part of an eye along either lid and at either corner that doesn't tell: lashes and the corner's tissue show there."""
BEND = 0.01
"""Price of a line's step of one sample from one column to the next, squared, in units of its depth."""


@dataclass(frozen=True)
class ClosedLine:
    """What one image says of a mouth or an eye.

    Attributes
    ----------
    inside : float or None
        Part that shows what lies inside; above `OPEN` it is open. None: the image doesn't tell.
    height : (C,)
        Of the line above the middle between the modelled margins, mm along object space's y axis.
    weight : (C,)
        Trust in ``height``; 0 where the line isn't seen.
    """

    inside: float | None
    height: NDArray[np.float64]
    weight: NDArray[np.float64]


def heights(opening_mm: float) -> NDArray[np.float64]:
    """(R,) heights at which images are sampled, mm, for a modelled opening."""
    reach = 0.5 * max(opening_mm, 0.0) + BEYOND_MM + LINE_MM
    return np.arange(-reach, reach + 0.5 * STEP_MM, STEP_MM)


def sample(image: NDArray, pixels: NDArray) -> NDArray[np.float64]:
    """Values (..., 3) of an image (H, W, 3) at pixel coordinates (..., 2)."""
    # Points behind a camera have no pixel; callers don't use what is read there.
    x, y = np.moveaxis(np.nan_to_num(np.asarray(pixels, dtype=np.float64)).reshape(-1, 2) - 0.5, -1, 0)
    return bilinear(np.asarray(image, dtype=np.float64), x, y).reshape(*pixels.shape[:-1], -1)


@dataclass(frozen=True)
class Strip:
    """An image that was straightened along the opening and blurred.

    Attributes
    ----------
    dark, red : (C, R)
        Logs of green and blue, their mean, and of red over green, in columns at the `heights` of the opening.
    seen : (C,) bool
        Columns that the image shows.
    row : (C,)
        Of the darkest line along the opening.
    opening_mm : (C,)
        Height of the modelled opening.
    """

    dark: NDArray[np.float64]
    red: NDArray[np.float64]
    seen: NDArray[np.bool_]
    row: NDArray[np.intp]
    opening_mm: NDArray[np.float64]


def teeth(strip: Strip) -> float:
    """Part of the columns in which the line runs along teeth rather than between lips."""
    red, seen = strip.red, strip.seen
    window = np.abs(np.arange(red.shape[1])[None] - strip.row[:, None]) <= round(LINE_MM / STEP_MM)
    least = np.where(window, red, np.inf).min(axis=1)
    return float((least[seen] < np.median(red[seen]) - LESS_RED).mean())


def eyeball(strip: Strip) -> float:
    """Part of what lies between the modelled lids that is white, iris or pupil."""
    count = len(strip.seen)
    inner = np.abs(np.arange(count) / (count - 1) - 0.5) < 0.5 - MARGINAL
    columns = np.flatnonzero(strip.seen & inner)
    if not len(columns):
        columns = np.flatnonzero(strip.seen)
    off = np.abs(heights(float(np.median(strip.opening_mm))))[None] - 0.5 * strip.opening_mm[columns, None]
    within = off < -MARGINAL * strip.opening_mm[columns, None]
    beside = np.where((off > LINE_MM) & (off < BEYOND_MM), 1.0, np.nan)
    dark, red = strip.dark[columns], strip.red[columns]
    pale = red < np.nanmedian(beside * red) - CONTRAST
    black = dark < np.nanmedian(beside * dark, axis=1, keepdims=True) - DARK  # shading changes along the eye
    return float((pale | black)[within].mean()) if within.any() else 1.0


def read_strip(
    strip: NDArray,
    seen: NDArray,
    opening_mm: NDArray,
    column_mm: float,
    inside: Callable[[Strip], float] = teeth,
) -> ClosedLine:
    """The line in which lips or lids meet, in an image that was straightened along them.

    Parameters
    ----------
    strip : (C, R, 3)
        Linear colour in columns along the lips, at the `heights` of the median opening.
    seen : (C,) bool
        Columns that the image shows.
    opening_mm : (C,)
        Height of the modelled opening.
    column_mm : float
        Distance between columns.
    inside : callable
        Part of a strip that shows what lies inside.
    """
    opening = float(np.median(opening_mm))
    height = heights(opening)
    nothing = ClosedLine(None, np.zeros(len(strip)), np.zeros(len(strip)))
    if seen.mean() < 0.5:
        return nothing
    log = np.log(np.maximum(np.asarray(strip, dtype=np.float64), DARKEST))
    colour = gaussian_filter(log, (STEP_MM / column_mm, 1.0, 0.0), mode="nearest")
    dark, red = 0.5 * (colour[..., 1] + colour[..., 2]), colour[..., 0] - colour[..., 1]
    apart = round(LINE_MM / STEP_MM)
    depth = np.full(dark.shape, -np.inf)
    inner = slice(apart, dark.shape[1] - apart)
    sides = np.minimum(dark[:, 2 * apart :], dark[:, : dark.shape[1] - 2 * apart])
    depth[:, inner] = sides - dark[:, inner]
    depth[~seen] = np.minimum(depth[~seen], 0.0)
    row = _seam(np.maximum(depth, -1.0))
    columns = np.arange(len(row))
    found = np.where(seen, depth[columns, row], 0.0)
    if np.median(found[seen]) < CONTRAST:
        return nothing
    part = inside(Strip(dark, red, seen, row, np.minimum(opening_mm, opening + BEYOND_MM)))
    weight = np.maximum(found, 0.0)
    clear = np.flatnonzero(weight)
    smooth = gaussian_filter1d(np.interp(columns, clear, height[row[clear]]), 1.5, mode="nearest")
    return ClosedLine(part, smooth, weight)


def _seam(value: NDArray) -> NDArray[np.intp]:
    """(C,) rows of the path through (C, R) that collects most, less ``BEND`` times its squared steps."""
    count = value.shape[1]
    step = np.arange(count)
    price = BEND * (step[:, None] - step[None]) ** 2
    total, came = value[0], []
    for column in value[1:]:
        through = total[None] - price
        came.append(through.argmax(axis=1))
        total = column + through.max(axis=1)
    path = [int(total.argmax())]
    for back in reversed(came):
        path.append(int(back[path[-1]]))
    return np.array(path[::-1])
