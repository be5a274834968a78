"""What of the found albedo is light: relief and shadows that mesh and lighting can't explain, parted from the skin.

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

from mifit.core.mesh import interpolate
from mifit.core.uv import TexelMap, sample_map
from mifit.morphable import MorphableModel
from mifit.stages.reflectance.fill import mirrored_coordinates

SYMMETRIC_SPREAD = 0.28
"""Standard deviation of the log luminance of skin over a face, brows and lips included, alike on both halves."""
SIDED_SPREAD = 0.09
"""The same of half of the difference between opposite points."""
DARKEST = 1e-3
"""Albedo below which logarithms mean nothing."""
OPENINGS = ((36, 42, 1.6), (42, 48, 1.6), (60, 68, 1.6))
"""Landmarks around eyes and inner lips, and how much wider than them the part is that isn't judged as skin."""
NOSE = 30
"""Landmark at the tip of the nose."""
PLANE = 256
"""Pixels along the frontal plane in which the face is outlined."""
FADE = 0.08
"""Part of the face's width beyond its outline over which the correction fades out."""
SEEN = 0.3
"""Confidence from which a texel counts: outlines, seen at a grazing angle, are darker than skin is."""
FEW = 200
"""Texels below which a spread isn't measured."""


@dataclass(frozen=True)
class Parted:
    """An albedo map parted into skin and unexplained light.

    Attributes
    ----------
    skin : (S, S, 3) float32
        Diffuse albedo.
    relief : (S, S) float32
        Factor of the diffuse light; ``skin * relief[..., None]`` is the map that was parted.
    symmetric, sided : float or None
        Measured spreads of log luminance; None where too little of the face was seen.
    """

    skin: NDArray[np.float32]
    relief: NDArray[np.float32]
    symmetric: float | None
    sided: float | None


def part_relief(
    model: MorphableModel, texels: TexelMap, diffuse: NDArray[np.float32], confidence: NDArray[np.float32]
) -> Parted:
    """Part a found albedo map (S, S, 3) into skin and the light that it had taken in.

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
    told = (share > 0.99) & (texels.from_map(confidence) > SEEN) & (found > DARKEST).all(axis=1)
    if told.sum() < FEW:
        return Parted(diffuse, np.ones(diffuse.shape[:2], np.float32), None, None)
    middle = float(np.median(level[told]))
    even, odd, both = level - middle, np.zeros_like(level), told
    if model.symmetry is not None:
        opposite, known = _opposite(texels, level, told, mirrored_coordinates(model, texels))
        if (told & known).sum() >= FEW:
            both = told & known
            odd = np.where(known, 0.5 * (level - opposite), 0.0)
            even = level - middle - odd
    symmetric, sided = float(even[both].std()), float(odd[both].std())
    change = (even * _gain(symmetric, SYMMETRIC_SPREAD) + odd * _gain(sided, SIDED_SPREAD)) - (level - middle)
    # The level stays where the split between albedo and light put it.
    change -= np.log((found[told] * np.exp(change[told])[:, None]).mean() / found[told].mean())
    change = np.minimum(change * share, -np.log(np.maximum(found.max(axis=1), DARKEST)))  # no albedo above 1
    skin, relief = texels.from_map(diffuse) * np.exp(change)[:, None], np.exp(-change)
    return Parted(
        texels.to_map(skin.astype(np.float32)),
        np.where(texels.mask, texels.to_map(relief.astype(np.float32)), np.float32(1.0)),
        symmetric,
        sided,
    )


def _gain(found: float, most: float) -> float:
    return min(1.0, most / max(found, 1e-9))


def _opposite(
    texels: TexelMap, values: NDArray, told: NDArray[np.bool_], mirrored: NDArray
) -> tuple[NDArray, NDArray[np.bool_]]:
    """Values (N,) at the opposite points, and where they are known."""
    weight = sample_map(texels.to_map(told.astype(np.float32)), mirrored)
    total = sample_map(texels.to_map((values * told).astype(np.float32)), mirrored)
    return total / np.maximum(weight, 1e-6), weight > 0.5


def facial_share(model: MorphableModel, texels: TexelMap) -> NDArray[np.float64]:
    """(N,) how far a texel belongs to the skin of the face: 1 within the landmarks, 0 in eyes, mouth and beyond.

    Judged on the mean face, in the plane that its landmarks span best, so that the layout of the maps doesn't matter.
    """
    marks = model.mean[model.landmarks].astype(np.float64)
    centre = marks.mean(axis=0)
    axes = np.linalg.svd(marks - centre, full_matrices=False)[2]
    flat = (marks - centre) @ axes[:2].T
    point = interpolate(model.mean, model.faces, texels.face, texels.weights) - centre
    place = point @ axes[:2].T
    reach = np.abs(flat).max() * (1.0 + 4.0 * FADE)

    def pixels(p: NDArray) -> NDArray:
        return (p / reach + 1.0) * 0.5 * (PLANE - 1)

    inside = np.zeros((PLANE, PLANE), np.uint8)
    _fill(inside, pixels(flat), 1)
    away = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) / (PLANE * 0.5) * reach
    width = np.ptp(flat, axis=0).max()
    share = np.clip(1.0 - away / (FADE * width), 0.0, 1.0)
    openings = np.zeros((PLANE, PLANE), np.uint8)
    for first, last, wider in OPENINGS:
        ring = flat[first:last]
        _fill(openings, pixels(ring.mean(axis=0) + wider * (ring - ring.mean(axis=0))), 1)
    share *= 1.0 - cv2.GaussianBlur(openings.astype(np.float64), (0, 0), 0.006 * PLANE)
    column, row = np.clip(np.round(pixels(place)).astype(int), 0, PLANE - 1).T
    # The back of the head lies within the outline as well, but behind the rearmost landmark. The nose is in front.
    forward = axes[2] * np.sign((marks[NOSE] - centre) @ axes[2])
    behind = ((marks - centre) @ forward).min() - point @ forward
    front = np.clip(1.0 - behind / (FADE * width), 0.0, 1.0)
    return np.where((np.abs(place) < reach).all(axis=1), front * share[row, column], 0.0)


def _fill(image: NDArray[np.uint8], outline: NDArray, value: int) -> None:
    hull = cv2.convexHull(outline.astype(np.float32))
    cv2.fillConvexPoly(image, np.round(hull).astype(np.int32), value)
