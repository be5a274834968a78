"""The albedo of eyes beneath what mirrors itself in them.

A film of tears mirrors lamps and windows as points far brighter than all beneath them (`appearance.cornea`), and where
on the eye that is no fit knows: real eyes aren't quite balls. Such a highlight only adds, and it moves over the eye
from view to view, so each texel's albedo is one of the lower ones among those that its views would have, and saturated
pixels say nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.cornea import REFLECTANCE
from mifit.core.sh import LUMINANCE
from mifit.stages.observations import Surface
from mifit.stages.reflectance.forward import Forward

LOWER = 0.4
"""Rank of the view that is taken, as a part of all: the darker one of two, the third of eight. The darkest of many
would paint an iris wherever the eye has ever looked."""


def beneath_the_film(
    surface: Surface, eye: NDArray[np.int64], forward: Forward, light: NDArray, ambient: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Texels (n,) of eyes that some view measures, as positions in the `TexelMap`, and their diffuse albedo (n, 3).

    Parameters
    ----------
    surface : Surface
    eye : (N,) int
        Texels of eyes, as positions in the `TexelMap`.
    forward : Forward
        Shading model, and which lights there are.
    light : (K, 3), ambient : float
        What they send.
    """
    seen = surface.observe(eye)
    albedo, known = lower(seen.colour - np.float32(ambient), forward.shade(seen, light)[0], seen.measured)
    return seen.texel[known], albedo[known]


def lower(colour: NDArray, white: NDArray, weight: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Diffuse albedo 0..1 (N, 3) beneath a film, and for which texels (N,) there is any.

    What the film mirrors of even surroundings is in all views, and is what a white diffuser would reflect times its
    reflectance.

    Parameters
    ----------
    colour, white : (N, J, 3)
        What images show, and what they would show of white.
    weight : (N, J)
        0 where an image doesn't measure.
    """
    usable = (weight > 0) & (white @ LUMINANCE > 1e-6)
    ratio = np.where(usable, (colour @ LUMINANCE) / np.maximum(white @ LUMINANCE, 1e-6), np.inf)
    count = usable.sum(axis=1)
    rank = np.floor(LOWER * np.maximum(count - 1, 0)).astype(int)
    rows = np.arange(len(ratio))
    view = np.argsort(ratio, axis=1)[rows, rank]
    albedo = colour[rows, view] / np.maximum(white[rows, view], 1e-6) - np.float32(REFLECTANCE)
    return np.clip(albedo, 0.0, 1.0).astype(np.float32), count > 0
