"""How far the light that is found is wrong, and so which texels' albedo it leaves open.

Maps are solved with the mesh's normals and a smooth lighting. What both miss ends in the diffuse map, the more the less
light there is: an error of the light moves the log albedo of a dim texel far.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate
from mifit.core.uv import TexelMap
from mifit.morphable import MorphableModel
from mifit.morphable.pigment import SPREAD
from mifit.sampling.visibility import DARKEST
from mifit.stages.reflectance.fill import BLEND

FEATURE = 0.06
"""Extent of the widest dark feature of a face, relative to the map: brows."""
BORDER = 0.03
"""Width of the border of a shadow, relative to the map."""


def light_level(brightness: NDArray[np.float32]) -> NDArray[np.float32]:
    """(S, S) how bright the light on texels is, from the brightness (S, S) of their images.

    Light changes over larger distances than brows and nostrils do: what is dark over less than `FEATURE` is itself dark
    in the light of its surroundings. Near the border of a shadow it is as dark as inside.
    """
    closed, inner = (
        np.ones((2 * round(0.5 * part * len(brightness)) + 1,) * 2, np.uint8) for part in (FEATURE, BORDER)
    )
    return np.asarray(cv2.erode(cv2.morphologyEx(brightness, cv2.MORPH_CLOSE, closed), inner), np.float32)


def light_error(model: MorphableModel, texels: TexelMap, maps: NDArray, confidence: NDArray, level: NDArray) -> float:
    """Error of the lighting, in the units of the (N,) ``level``: root of the mean square over dim texels.

    An error e of the light on a texel of level L moves its log albedo by e / L. It is measured where L is below half of
    the face's median, by how far the log albedo of ``maps`` (S, S, 4) deviates from the mean face's, skin's own
    `SPREAD` taken off.
    """
    sure = confidence > 0.5 * confidence.max(initial=0.0)
    if not sure.any():
        return 0.0
    middle = float(np.median(level[sure]))
    expected, found = interpolate(model.mean_albedo, model.faces, texels.face, texels.weights), texels.from_map(maps)
    deviation = np.log(np.maximum(found[:, :3], DARKEST) / np.maximum(expected, DARKEST)).mean(axis=1)
    deviation -= np.median(deviation[sure & (level >= middle)])
    dim = (confidence > BLEND) & (level > 0) & (level < 0.5 * middle)
    if not dim.any():
        return 0.0
    excess = np.clip(deviation[dim] ** 2 - SPREAD**2, 0.0, 1.0)
    return float(np.sqrt(np.mean(excess * level[dim] ** 2)))


def light_known(level: NDArray, error: float) -> NDArray:
    """(N,) share of the images in the albedo at a ``level`` of light (N,), from an ``error`` of it.

    It is 0 where the error changes an albedo by two standard deviations of skin, or more.
    """
    dark = error / (2.0 * SPREAD)
    return np.maximum(1.0 - (dark / np.maximum(level, 1e-12)) ** 2, 0.0)
