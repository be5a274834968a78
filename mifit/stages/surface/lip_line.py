"""Whether an image shows a closed mouth, and where its lip line runs.

The lips of a closed mouth meet in one thin line, darker and redder than they are. An open mouth shows a band instead
that is as high as the opening: teeth, which are less red than lips, or the dark inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from mifit.core.uv import bilinear

STEP_MM = 0.1
"""Distance of samples across the lips."""
BEYOND_MM = 4.0
"""How far past the modelled opening the line is looked for."""
NARROWEST_MM, WIDEST_MM, PART = 0.6, 1.2, 0.4
"""Distance from the line at which both sides are brighter, least, largest, and in parts of the modelled opening."""
BLUR_MM = 0.2
DARKER = 0.15
"""Least median depth of the line below both sides, log of linear green and blue."""
TEETH_MM, LESS_RED, TEETH = 1.0, 0.3, 0.25
"""Teeth: so near the line red over green falls by this (log) below the lips', in this part of the columns at least."""
FEWEST = 0.5
"""Part of the columns that an image must show to have a vote."""
BEND = 0.01
"""Price of a line's step of one sample from one column to the next, squared, in units of its depth."""
FAINT = 0.05
"""Depth below which a column says nothing of where the line is."""
DARKEST = 1e-3


@dataclass(frozen=True)
class LipLine:
    """What one image says of the mouth.

    Attributes
    ----------
    closed : bool or None
        None: it doesn't tell.
    height : (C,)
        Of the line above the middle between the modelled margins, mm along object space's y axis.
    weight : (C,)
        Trust in ``height``; 0 where the line isn't seen.
    """

    closed: bool | None
    height: NDArray[np.float64]
    weight: NDArray[np.float64]


def heights(opening_mm: float) -> NDArray[np.float64]:
    """(R,) heights at which images are sampled, mm, for a modelled opening."""
    reach = 0.5 * max(opening_mm, 0.0) + BEYOND_MM + WIDEST_MM
    return np.arange(-reach, reach + 0.5 * STEP_MM, STEP_MM)


def sample(image: NDArray, pixels: NDArray) -> NDArray[np.float64]:
    """Values (..., 3) of an image (H, W, 3) at pixel coordinates (..., 2)."""
    # Points behind a camera have no pixel; callers don't use what is read there.
    x, y = np.moveaxis(np.nan_to_num(np.asarray(pixels, dtype=np.float64)).reshape(-1, 2) - 0.5, -1, 0)
    return bilinear(np.asarray(image, dtype=np.float64), x, y).reshape(*pixels.shape[:-1], -1)


def read_strip(strip: NDArray, seen: NDArray, opening_mm: float, column_mm: float) -> LipLine:
    """The lip line in an image that was straightened along the lips.

    Parameters
    ----------
    strip : (C, R, 3)
        Linear colour in columns along the lips, at the `heights` of the opening.
    seen : (C,) bool
        Columns that the image shows.
    opening_mm : float
        Height of the modelled opening.
    column_mm : float
        Distance between columns.
    """
    height = heights(opening_mm)
    nothing = LipLine(None, np.zeros(len(strip)), np.zeros(len(strip)))
    if seen.mean() < FEWEST:
        return nothing
    colour = gaussian_filter(
        np.log(np.maximum(np.asarray(strip, dtype=np.float64), DARKEST)),
        (BLUR_MM / column_mm, BLUR_MM / STEP_MM, 0.0),
        mode="nearest",
    )
    dark, red = 0.5 * (colour[..., 1] + colour[..., 2]), colour[..., 0] - colour[..., 1]
    apart = round(float(np.clip(PART * opening_mm, NARROWEST_MM, WIDEST_MM)) / STEP_MM)
    depth = np.full(dark.shape, -np.inf)
    inner = slice(apart, dark.shape[1] - apart)
    sides = np.minimum(dark[:, 2 * apart :], dark[:, : dark.shape[1] - 2 * apart])
    depth[:, inner] = sides - dark[:, inner]
    depth[~seen] = np.minimum(depth[~seen], 0.0)
    row = _seam(np.maximum(depth, -1.0))
    columns = np.arange(len(row))
    found = np.where(seen, depth[columns, row], 0.0)
    if np.median(found[seen]) < DARKER:
        return nothing
    window = np.abs(np.arange(dark.shape[1])[None] - row[:, None]) <= round(TEETH_MM / STEP_MM)
    least = np.where(window, red, np.inf).min(axis=1)
    closed = float((least[seen] < np.median(red[seen]) - LESS_RED).mean()) < TEETH
    weight = np.where(found > FAINT, found, 0.0)
    clear = np.flatnonzero(weight)
    smooth = gaussian_filter1d(np.interp(columns, clear, height[row[clear]]), 1.5, mode="nearest")
    return LipLine(closed, smooth, weight)


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
