"""Hair on the head: where images show it, the scalp gets one flat colour in place of skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.mesh import interpolate
from mifit.core.uv import TexelMap
from mifit.morphable import MorphableModel
from mifit.morphable.topology import scalp_depth
from mifit.sampling.visibility import DARKEST
from mifit.stages.reflectance.fill import BLEND, UNLIKE, Filled, continued, light_known

SHARE = 0.15
"""Dark part of what was seen of either side of the scalp, where there is hair: chosen between 0.35 and more on emily
c3,c4 and 0.03 and less on scan_city and gloss."""
SEEN = 0.01
"""Part of a side of the scalp that must be seen for that side to count."""
MARGIN = 0.25
"""How far before `scalp_depth`'s hairline images may show hair, in thirds of a face: chosen on emily c3,c4."""
SOFT = 1e-5
"""Stiffness of the border, per texel: it is about a centimetre wide where images don't show it."""


@dataclass(frozen=True)
class Hair:
    """Hair on a scalp: its ``colour`` (3,), and the ``share`` (N,) of it in each texel, 0..1."""

    colour: NDArray[np.float64]
    share: NDArray[np.float64]


def find_hair(
    model: MorphableModel,
    texels: TexelMap,
    maps: NDArray,
    confidence: NDArray,
    brightness: NDArray,
    error: float,
) -> Hair | None:
    """Hair that images show on the scalp; None where they show none.

    Hair is much darker than the face's own skin in the light that falls there, which is the brightness of images over
    the albedo. An ``error`` of that light (`light_error`) must not explain it, and it must be there on either side that
    was seen: a shadow falls on one. The hairline is where images show it, elsewhere that of `scalp_depth`.

    Parameters
    ----------
    model : MorphableModel
    texels : TexelMap
    maps : (S, S, 4)
        Diffuse and specular albedo from the images.
    confidence, brightness : (N,)
        How often and how well each texel was seen, 0..1, and how bright.
    error : float
    """
    at = texels.face, texels.weights
    behind, above = (
        interpolate(depth[:, None], model.faces, *at)[:, 0] for depth in scalp_depth(model.mean, model.landmarks)
    )
    side = interpolate(model.mean, model.faces, *at)[:, 0]
    albedo = np.maximum(texels.from_map(maps)[:, :3].astype(np.float64), DARKEST)
    face = model.face_mask[texels.face] & (behind < -MARGIN) & (confidence > 0.5 * confidence.max(initial=0.0))
    if not face.any():
        return None
    skin = np.median(albedo[face], axis=0)
    known = confidence * light_known(brightness * skin.mean() / albedo.mean(axis=1), error)
    depth = -np.log(albedo / skin).mean(axis=1)
    dark, scalp = depth > UNLIKE, (behind > 0) & (above > 0)
    halves = [scalp & half for half in (side < 0, side > 0)]
    seen = [half for half in halves if (known[half] > BLEND).sum() > SEEN * half.sum()]
    if not seen or min(known[half & dark].sum() / known[half].sum() for half in seen) < SHARE:
        return None
    reach = (behind > -MARGIN) & (above > 0)
    # Most of it is mixed with skin: at the hairline, and by the smoothness of maps where there is little light.
    colour = np.percentile(albedo[reach & dark & (known > BLEND)], 10, axis=0)
    step = np.clip(2.0 * depth / UNLIKE - 1.0, 0.0, 1.0)
    weight = known + BLEND
    value = np.where(reach, (known * step + BLEND * scalp) / weight, 0.0)
    smooth = continued(model, texels, value[:, None], weight, SOFT * len(weight))[:, 0]
    # Exactly none and exactly all away from the border.
    return Hair(colour, np.clip(1.25 * smooth - 0.125, 0.0, 1.0))


def paint(texels: TexelMap, filled: Filled, hair: Hair, share: NDArray | float = 1.0) -> Filled:
    """Maps with hair in a ``share`` (N,) of what it covers: one colour, without a gloss of its own.

    Confidence stays as it is: as everywhere, it counts what was seen, not what was filled in.
    """
    part = texels.to_map((hair.share * share).astype(np.float32))
    diffuse = filled.diffuse + part[..., None] * (hair.colour.astype(np.float32) - filled.diffuse)
    return replace(filled, diffuse=diffuse, specular=np.asarray(filled.specular * (1.0 - part), np.float32))
