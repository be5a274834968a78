"""Residual shading: relief and shadows that mesh and lighting can't explain, separated from the skin's albedo.

Maps are solved with the mesh's normals and a smooth lighting, so whatever both miss (pores and wrinkles under a grazing
lamp, the edge of a shadow) ends in the diffuse map. Under the light of the capture it belongs there; under another it
is dirt. Images of a head that turns little can't tell the two apart, but skin can: its luminance varies by no more than
so much over a face, and hardly at all between its two halves, where light from one side leaves most of its traces. Both
spreads are measured over the found map; where one is larger than skin's, the deviations are scaled down to it, and what
is taken away is kept as a factor of the diffuse light. Their product is the map that was found: under the capture's own
light nothing changes. Colour is left alone: true chroma instead of the found one gains nothing, true luminance 4 dB.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.mesh import interpolate
from mifit.core.uv import TexelMap, sample_map
from mifit.morphable import MorphableModel
from mifit.morphable.topology import EYES_AND_MOUTH
from mifit.sampling.visibility import DARKEST
from mifit.stages.reflectance.fill import BLEND, mirrored_coordinates

SYMMETRIC_SPREAD = 0.28
"""Standard deviation of the log luminance of skin over a face, brows and lips included, alike on both halves."""
SIDED_SPREAD = 0.09
"""The same of half of the difference between opposite points."""
WIDER = 1.6
"""How much wider than the landmarks around eyes and inner lips the ellipse is that isn't judged as skin."""
FADE = 0.08
"""Part of the face's width inside the border of the face area over which the correction fades in."""
SEEN = 0.3
"""Confidence from which a texel counts: outlines, seen at a grazing angle, are darker than skin is."""
FEATURE = 0.06
"""Extent of the widest dark feature of a face, relative to the map: brows."""
BORDER = 0.03
"""Width of the border of a shadow, relative to the map."""
FEW = 200
"""Texels below which a spread isn't measured."""


@dataclass(frozen=True)
class Decomposition:
    """An albedo map as skin and unexplained light.

    Attributes
    ----------
    skin : (S, S, 3) float32
        Diffuse albedo.
    residual_shading : (S, S) float32
        Factor of the diffuse light; ``skin * residual_shading[..., None]`` is the map that was found.
    symmetric, sided : float or None
        Measured spreads of log luminance; None where too little of the face was seen.
    """

    skin: NDArray[np.float32]
    residual_shading: NDArray[np.float32]
    symmetric: float | None
    sided: float | None


def separate_shading(
    model: MorphableModel, texels: TexelMap, diffuse: NDArray[np.float32], confidence: NDArray[np.float32]
) -> Decomposition:
    """Separate a found albedo map (S, S, 3) into skin and the light that it had taken in.

    Parameters
    ----------
    model : MorphableModel
        Its landmarks outline the face; without a symmetry both halves are judged together.
    texels : TexelMap
        Texels of the map.
    diffuse : (S, S, 3)
    confidence : (S, S)
        Texels below `SEEN` have no say in what is measured.
    """
    share = facial_share(model, texels)
    found = np.maximum(texels.from_map(diffuse), DARKEST).astype(np.float64)
    level = np.log(found).mean(axis=1)
    observed = (share > 0.99) & (texels.from_map(confidence) > SEEN) & (found > DARKEST).all(axis=1)
    if observed.sum() < FEW:
        return Decomposition(diffuse, np.ones(diffuse.shape[:2], np.float32), None, None)
    middle = float(np.median(level[observed]))
    even, odd, both = level - middle, np.zeros_like(level), observed
    if model.symmetry is not None:
        opposite, known = _opposite(texels, level, observed, mirrored_coordinates(model, texels))
        if (observed & known).sum() >= FEW:
            both = observed & known
            odd = np.where(known, 0.5 * (level - opposite), 0.0)
            even = level - middle - odd
    symmetric, sided = float(even[both].std()), float(odd[both].std())
    change = (even * _gain(symmetric, SYMMETRIC_SPREAD) + odd * _gain(sided, SIDED_SPREAD)) - (level - middle)
    # The level stays where the split between albedo and light put it.
    change -= np.log((found[observed] * np.exp(change[observed])[:, None]).mean() / found[observed].mean())
    change = np.minimum(change * share, -np.log(np.maximum(found.max(axis=1), DARKEST)))  # no albedo above 1
    skin, factor = texels.from_map(diffuse) * np.exp(change)[:, None], np.exp(-change)
    return Decomposition(
        texels.to_map(skin.astype(np.float32)),
        np.where(texels.mask, texels.to_map(factor.astype(np.float32)), np.float32(1.0)),
        symmetric,
        sided,
    )


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
    `SYMMETRIC_SPREAD` taken off.
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
    excess = np.clip(deviation[dim] ** 2 - SYMMETRIC_SPREAD**2, 0.0, 1.0)
    return float(np.sqrt(np.mean(excess * level[dim] ** 2)))


def light_known(level: NDArray, error: float) -> NDArray:
    """(N,) share of the images in the albedo at a ``level`` of light (N,), from an ``error`` of it.

    It is 0 where the error changes an albedo by two standard deviations of skin, or more.
    """
    dark = error / (2.0 * SYMMETRIC_SPREAD)
    return np.maximum(1.0 - (dark / np.maximum(level, 1e-12)) ** 2, 0.0)


def _gain(found: float, most: float) -> float:
    return min(1.0, most / max(found, 1e-9))


def _opposite(
    texels: TexelMap, values: NDArray, observed: NDArray[np.bool_], mirrored: NDArray
) -> tuple[NDArray, NDArray[np.bool_]]:
    """Values (N,) at the opposite points, and where they are known."""
    weight = sample_map(texels.to_map(observed.astype(np.float32)), mirrored)
    total = sample_map(texels.to_map((values * observed).astype(np.float32)), mirrored)
    return total / np.maximum(weight, 1e-6), weight > 0.5


def facial_share(model: MorphableModel, texels: TexelMap) -> NDArray[np.float64]:
    """(N,) how far a texel belongs to the skin of the face: 1 within the face area, 0 in eyes, mouth and beyond.

    Judged on the mean face, so that the layout of the maps doesn't matter.
    """
    point = interpolate(model.mean, model.faces, texels.face, texels.weights).astype(np.float64)
    marks = model.mean[model.landmarks].astype(np.float64)
    share = model.face_mask[texels.face].astype(np.float64)
    if not model.face_mask.all():
        border = cKDTree(model.mean[np.unique(model.faces[~model.face_mask])])
        share *= np.clip(border.query(point)[0] / (FADE * np.ptp(marks, axis=0).max()), 0.0, 1.0)
    for opening in EYES_AND_MOUTH:
        ring = marks[opening]
        along = np.linalg.svd(ring - ring.mean(axis=0))[2][:2].T
        reach = WIDER * np.abs((ring - ring.mean(axis=0)) @ along).max(axis=0)
        away = (point - ring.mean(axis=0)) @ along / np.maximum(reach, 0.3 * reach[0])
        share *= np.clip((np.linalg.norm(away, axis=1) - 1.0) / 0.2, 0.0, 1.0)
    return share
