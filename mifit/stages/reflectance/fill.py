"""Skin where no image looked, no light came or the albedo found is no skin's: like the other half of the face, or the
mean face in proportion.

Maps are solved with the mesh's normals and the light found. What both miss ends in the diffuse map, the more the less
light there is: an error of the light moves the log albedo of a dim texel far.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate
from mifit.core.mesh_solve import membrane
from mifit.core.uv import TexelMap, sample_map
from mifit.morphable import MorphableModel
from mifit.morphable.openings import skin_faces
from mifit.morphable.pigment import HAEMOGLOBIN, MELANIN, SPREAD
from mifit.sampling.visibility import DARKEST
from mifit.stages.geometry.points import corner_matrix

BLEND = 0.05
"""Confidence at which a texel's own estimate counts as much as its surroundings'."""
ALIKE = 0.02
"""Distance over which skin is alike around a place and on both halves of a face, relative to the map: chosen on
scan_city, gloss and the first heads of Table 1; half and twice as much change little."""
CONTRAST = 0.15
"""Contrast of skin in the logarithm beside what pigments make: what differs by more is hardly skin. Chosen on
scan_city, gloss and the first heads of Table 1; 0.1 to 0.2 are alike."""
TYPICAL = 1.5e-3
"""Weight of the typical value of skin beside that of a texel of confidence 1: it decides far from what was seen."""
STIFFNESS = 0.1
"""Of the membrane, beside texels of confidence 1: chosen as `ALIKE` is; three times as much, and as much more of
`TYPICAL`, gains 0.1 dB of the albedo there."""
FEATURE = 0.06
"""Extent of the widest dark feature of a face, relative to the map: brows."""
BORDER = 0.03
"""Width of the border of a shadow, relative to the map."""
UNLIKE = 2.0 * SPREAD
"""Difference of log albedo that no skin has: two standard deviations. Hair is as much darker than the face, or more."""


@dataclass(frozen=True)
class Filled:
    """Maps without gaps, and how far they are what images told.

    Attributes
    ----------
    diffuse : (S, S, 3), specular : (S, S) float32
    confidence, specular_confidence : (S, S) float32
        Of the diffuse and of the specular map. They count what was seen, not what was filled in.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    confidence: NDArray[np.float32]
    specular_confidence: NDArray[np.float32]


def blend_unseen(
    model: MorphableModel,
    texels: TexelMap,
    maps: NDArray,
    confidence: NDArray,
    observability: NDArray,
    lit: NDArray | None = None,
) -> Filled:
    """Replace texels that were hardly seen by the mean face's albedo times a factor that continues the seen ones.

    The factor's logarithm, like the specular albedo itself, is first taken from the opposite half of the face, where
    that was seen. Elsewhere it is a membrane over the mesh (`core.mesh_solve`), so that it crosses the atlas's seams.

    Parameters
    ----------
    model : MorphableModel
    texels : TexelMap
    maps : (S, S, 4)
        Diffuse and specular albedo from the images.
    confidence : (N,)
        How often and how well each texel was seen, 0..1.
    observability : (N,)
        How far images determine the specular albedo, 0..1: not at all for a well visible texel in deep shade, or where
        no lobe points at a light.
    lit : (N,), optional
        Share of the images in the diffuse albedo where visibility is full (`light_known`). With it the
        albedo is skin's under any light: what no pigment makes (`pigment_weight`) is filled too, and both halves share
        what they show (`bilateral_change`). Without it the albedo stays as the capture's own light shows it.
    """
    expected = np.maximum(interpolate(model.mean_albedo, model.faces, texels.face, texels.weights), DARKEST)
    found = texels.from_map(maps).astype(np.float64)
    found[:, :3] = np.log(np.maximum(found[:, :3], DARKEST) / expected)
    confidence = np.asarray(confidence, dtype=np.float64)
    # Eyes are no skin: their light is as it is found, and neither is like the other.
    skin = skin_faces(model)[texels.face]
    light = np.ones_like(confidence) if lit is None else np.where(skin, lit, 1.0)
    known = compared = _weight(confidence, light)
    if lit is not None:
        natural = pigment_weight(texels, expected * np.exp(found[:, :3]), expected, skin * known)
        natural = np.where(skin, natural, 1.0)
        # What isn't skin's is filled as where light is dim; between the halves it counts in proportion.
        known, compared = _weight(confidence, light * natural), known * natural
    confidence = confidence * light
    if model.symmetry is not None:
        opposite = mirrored_coordinates(model, texels)
        if lit is not None:
            found[:, :3] += skin[:, None] * bilateral_change(texels, found[:, :3], skin * compared, opposite)
        there, values = (_across(texels, of, opposite) for of in (known, found * known[:, None]))
        taken = there * (1.0 - np.clip(known / BLEND, 0.0, 1.0))
        total = np.maximum(known + taken, 1e-12)[:, None]
        found = (known[:, None] * found + (taken / np.maximum(there, 1e-12))[:, None] * values) / total
        known = known + taken
    certain = known > 0.5 * known.max(initial=0.0)
    typical = np.median(found[certain], axis=0) if certain.any() else np.zeros(4)
    sheet = (known[:, None] * found + TYPICAL * typical) / (known + TYPICAL)[:, None]
    smooth = continued(model, texels, sheet, known + TYPICAL, STIFFNESS)
    share = (known / (known + BLEND))[:, None]
    blended = share * found + (1.0 - share) * smooth
    blended[:, :3] = expected * np.exp(blended[:, :3])
    image = texels.to_map(np.clip(blended, 0.0, 1.0).astype(np.float32))
    both = (texels.to_map(np.asarray(x, np.float32)) for x in (confidence, confidence * observability))
    return Filled(image[..., :3], image[..., 3], *both)


def _weight(confidence: NDArray, share: NDArray) -> NDArray[np.float64]:
    """(N,) weight of texels' own albedo, from confidence (N,) and the ``share`` (N,) of images in it.

    Variances add: that of visibility, and that of the light, both in units of `BLEND`'s texel.
    """
    variance = 1.0 / np.maximum(confidence, 1e-9) + (1.0 / np.maximum(share, 1e-9) - 1.0) / BLEND
    return np.where(confidence * share > 0, 1.0 / variance, 0.0)


def continued(
    model: MorphableModel, texels: TexelMap, values: NDArray, weight: NDArray, stiffness: float
) -> NDArray[np.float64]:
    """(N, C) values of texels, each known with a weight (N,), as a sheet over the mesh (`core.mesh_solve.membrane`)."""
    where = corner_matrix(model.faces, texels.face, texels.weights, model.n_vertices)
    return where @ membrane(model.mean, model.faces, where, weight, stiffness)(values)


def _blurred(texels: TexelMap, values: NDArray, deviation: float) -> NDArray[np.float32]:
    """Values (N, ...) of texels, blurred by a deviation relative to the map; 0 counts beside them."""
    image = texels.to_map(values.astype(np.float32))
    return texels.from_map(cv2.GaussianBlur(image, (0, 0), deviation * texels.size))


def pigment_weight(texels: TexelMap, albedo: NDArray, expected: NDArray, known: NDArray) -> NDArray[np.float64]:
    """(N,) how far diffuse albedos (N, 3) are skin's own, 0..1: what pigments make of the skin around them.

    Sheen, misplaced shadows and light from other skin end in the albedo too, and have other colours. ``expected``
    (N, 3) is the mean face's albedo, ``known`` (N,) the weight of each texel.
    """
    unlike = np.full(len(albedo), np.inf)
    for like in (expected, np.ones_like(expected)):  # what the mean face or the skin around explains is skin
        factor, weight = np.log(np.maximum(albedo, DARKEST) / like), known
        for _ in range(3):
            count = np.maximum(_blurred(texels, weight, ALIKE), 1e-9)[:, None]
            around = _blurred(texels, weight[:, None] * factor, ALIKE) / count
            weight = known / (1.0 + ((factor - around).mean(axis=1) / CONTRAST) ** 2)
        unlike = np.minimum(unlike, beyond_pigments(factor - around))
    return np.asarray(1.0 / (1.0 + unlike / CONTRAST**2))


def beyond_pigments(change: NDArray) -> NDArray[np.float64]:
    """(N,) squared distance of changes (N, 3) of log albedo from those that more pigment makes.

    Pigments are melanin, haemoglobin, and hair's, which darkens all channels alike.
    """
    least = (change**2).sum(axis=1)
    for count in (1, 2, 3):
        for chosen in combinations((MELANIN, HAEMOGLOBIN, np.ones(3)), count):
            axes = np.stack(chosen, axis=1)
            amount = -change @ np.linalg.pinv(axes).T
            beyond = ((change + amount @ axes.T) ** 2).sum(axis=1)
            least = np.where((amount >= 0).all(axis=1), np.minimum(least, beyond), least)
    return least


def bilateral_change(texels: TexelMap, values: NDArray, known: NDArray, opposite: NDArray) -> NDArray[np.float64]:
    """(N, C) what takes values of texels to the mean of both halves, each as far as it is ``known`` (N,).

    Skin is alike on both over distances of `ALIKE` and more, while light comes from one side; finer marks stay.
    ``opposite`` are the `mirrored_coordinates`.
    """
    density, total = (_blurred(texels, of, ALIKE) for of in (known, known[:, None] * values))
    there, beyond = (_across(texels, of, opposite) for of in (density, total))
    both = (total + beyond) / np.maximum(density + there, 1e-12)[:, None]
    return np.asarray(np.where((density > 1e-9)[:, None], both - total / np.maximum(density, 1e-12)[:, None], 0.0))


def mirrored_coordinates(model: MorphableModel, texels: TexelMap) -> NDArray[np.float64]:
    """(N, 2) texture coordinates of the point opposite to each texel on the other half of the face; NaN outside it.

    The model has to say which vertices are opposite to one another.
    """
    inside = model.face_mask
    of_vertex = np.full((len(model.mean), 2), np.nan)
    of_vertex[model.faces[inside].ravel()] = model.uv[model.faces_uv[inside].ravel()]
    return interpolate(of_vertex[model.symmetry], model.faces, texels.face, texels.weights)


def _across(texels: TexelMap, values: NDArray, opposite: NDArray) -> NDArray[np.float64]:
    """Values (N, ...) at the opposite points of texels; 0 where there are none."""
    there = np.isfinite(opposite).all(axis=1)
    out = np.zeros(values.shape)
    out[there] = sample_map(texels.to_map(values.astype(np.float32)), opposite[there])
    return out


# How far the light that is found is wrong, and so which texels' albedo it leaves open
# ----------------------------------------------------------------------------------------------------------------------


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

    It is 0 where the error changes an albedo by `UNLIKE` or more.
    """
    dark = error / UNLIKE
    return np.maximum(1.0 - (dark / np.maximum(level, 1e-12)) ** 2, 0.0)
