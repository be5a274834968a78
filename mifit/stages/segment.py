"""What each image shows: skin, eyes, mouth, something in front of the face, or the background.

It starts from the fitted head under its light, shadows included. Every point of the face has one albedo, the median
over all images, and an image that contradicts it over an area shows something else there. What is added light alone,
such as a highlight, contradicts nothing, and neither does a shadow that the mesh throws nearby. What covers a point in
every image has a colour far from that of the face's skin. GrabCut (Rother et al. 2004), started inside what was found
and on the skin around it, one object at a time, then finds the objects' outlines.

No network is involved. A capture's own masks (``mask_path``) replace this for the images that have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.transforms import MIN_SIDE
from mifit.core.estimate import Label
from mifit.core.image import box, to_8_bit
from mifit.core.mesh import interpolate
from mifit.core.metrics import NORMAL, SURE
from mifit.core.process import on_all_cores
from mifit.core.uv import TexelMap
from mifit.morphable.topology import BROWS, EYES_AND_MOUTH
from mifit.sampling.visibility import DARKEST

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel
    from mifit.sampling.observations import Seen, Surface
    from mifit.stages.reflectance.forward import Forward

OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]])
"""Logarithms of colour to brightness and two differences, which shading changes little."""
FLOOR = np.array([0.12, 0.03, 0.03])
"""Least standard deviations of the three: texture that a fitted mesh shifts, and shading that no light explains."""
COVERED = (0.9, 0.45)
"""Difference in brightness and in chroma (logarithms) from the face's skin that no plain skin has."""
CLEAN = 1.0
"""Departure in standard deviations up to which a pixel is skin; `SURE` starts an object."""
BLUR = 0.003
"""Standard deviation of the blur against noise and shifted texture, as a part of the face's size in pixels."""
REACH = 0.015
"""Distance, as a part of the face's size, by which the mesh may be off: within it from the rim of the face nothing
starts, and in it about what was found lies its outline."""
WIDE = 4
"""The same of what covers the face in every image, in multiples: it is looked for beside the brows only."""
SMALLEST = 0.004
"""Part of the face that an object covers at the least."""
LARGE = 0.02
"""The same of one that covers it in every image: birthmarks are smaller."""
MARGIN = 0.08
"""Distance around eyes and brows, as a part of the distance between the eyes' outer corners, that is theirs."""
LONGEST = 640
"""Pixels along the longer side of a face at which it is looked at."""


@dataclass(frozen=True)
class Albedos:
    """Albedo maps that the images of a face have in common under a light, and what each departs from them.

    Attributes
    ----------
    colour : (S, S, 3) float32
        `OPPONENT` logarithms of the median albedo over the images.
    known : (S, S) float32
        1 where some image measures the texel.
    shading : tuple of (S, S, 3) float32
        `OPPONENT` logarithms of the diffuse light in each image.
    deviation : (3,) float64
        Robust standard deviations of what an image shows.
    skin : (3,) float64
        Median colour of the face.
    """

    colour: NDArray[np.float32]
    known: NDArray[np.float32]
    shading: tuple[NDArray[np.float32], ...]
    deviation: NDArray[np.float64]
    skin: NDArray[np.float64]


def common_albedos(surface: Surface, appearance: Forward, light: NDArray) -> Albedos:
    """What all images together say about the face's colours under a light (K, 3), per texel their weighted median."""
    texels, levels, shadings, weights = [], [], [], []
    for part in surface.chunks():
        rows = part[surface.facial[part]]
        seen = surface.observe(rows)
        texels.append(rows)
        levels.append(opponent(seen.colour))
        every = replace(seen, weight=np.ones_like(seen.weight))  # images are compared beside what they measure, too
        shadings.append(opponent(appearance.shade(every, light)[0]))
        weights.append(seen.measured)
    level, shading, weight = (np.concatenate(x) for x in (levels, shadings, weights))
    flat = level - shading
    centre = np.stack([_median(flat[..., c], weight) for c in range(3)], axis=1)
    known = (weight > 0).any(axis=1)
    skin = np.median(centre[known], axis=0).astype(np.float64) if known.any() else np.zeros(3)
    bare = known & ~no_skin(centre, skin)
    apart = np.abs(flat - centre[:, None])[(weight > 0) & bare[:, None]]
    deviation = np.maximum(NORMAL * np.median(apart, axis=0).astype(np.float64), FLOOR) if len(apart) else FLOOR
    rows, of = np.concatenate(texels)[known], surface.texels
    shown = TexelMap(of.size, of.index[rows], of.face[rows], of.weights[rows])
    maps = tuple(shown.to_map(shading[known, j]) for j in range(surface.image_count))
    return Albedos(shown.to_map(centre[known]), shown.mask.astype(np.float32), maps, deviation, skin)


def opponent(colour: NDArray) -> NDArray[np.float32]:
    """Logarithms of linear colour (..., 3): brightness and two differences, which light changes little."""
    return np.asarray(np.log(np.maximum(colour, DARKEST)) @ OPPONENT.T.astype(np.float32), np.float32)


def no_skin(flat: NDArray, skin: NDArray) -> NDArray[np.bool_]:
    """Colours without shading, (..., 3) `OPPONENT` logarithms, that are far from those of the face's skin."""
    unlike = flat - skin
    return np.asarray((unlike[..., 0] < -COVERED[0]) | (np.hypot(unlike[..., 1], unlike[..., 2]) > COVERED[1]))


def _median(values: NDArray, weights: NDArray) -> NDArray:
    """(N,) weighted median of the rows of (N, J) values."""
    order = np.argsort(values, axis=1)
    total = np.cumsum(np.take_along_axis(weights, order, axis=1) + 1e-12, axis=1)
    middle = (total >= 0.5 * total[:, -1:]).argmax(axis=1)
    return np.asarray(np.take_along_axis(values, order, axis=1)[np.arange(len(values)), middle])


def segment(
    surface: Surface, capture: Capture, model: MorphableModel, forward: Forward, light: NDArray
) -> tuple[NDArray[np.uint8], ...]:
    """(H, W) `Label` values for every image of a surface, in their order; ``light`` (K, 3) is what lights the face.

    Images of the ``capture`` with a mask of their own are labelled by it and the mesh alone.
    """
    albedos = common_albedos(surface, forward, light)

    def labelled(item: tuple[int, Seen]) -> NDArray[np.uint8]:
        number, view = item
        return _segment_image(view, albedos, albedos.shading[number], capture, model)

    return tuple(on_all_cores(labelled, list(enumerate(surface.views()))))


def _segment_image(
    view: Seen, albedos: Albedos, shading: NDArray, capture: Capture, model: MorphableModel
) -> NDArray[np.uint8]:
    frame = capture.frame(view.camera.name, view.timestep)
    number = np.asarray(np.isfinite(frame.image).all(axis=-1))
    image = np.where(number[..., None], frame.image, 0.0).astype(np.float32)
    hit = view.face >= 0
    labels = np.where(hit, np.uint8(Label.SKIN), np.uint8(Label.BACKGROUND))
    facial = hit & model.face_mask[np.maximum(view.face, 0)]
    marks = view.camera.project(view.vertices[model.landmarks])
    eyes, mouth = _polygons(hit.shape, marks, EYES_AND_MOUTH[:2]), _polygons(hit.shape, marks, EYES_AND_MOUTH[2:])
    if facial.any() and not frame.masked:
        usable = facial & frame.valid & number & ~eyes & ~mouth
        given = albedos, shading, model, facial, _plain(hit.shape, marks)
        labels[hit & _objects(view, image, usable, *given)] = Label.OCCLUDER
    for area, label in ((eyes, Label.EYES), (mouth, Label.MOUTH)):
        labels[area & (labels == Label.SKIN)] = label
    labels[~frame.valid] = Label.BACKGROUND
    return labels


def _objects(
    view: Seen,
    image: NDArray,
    usable: NDArray[np.bool_],
    albedos: Albedos,
    shading: NDArray,
    model: MorphableModel,
    facial: NDArray[np.bool_],
    plain: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Pixels of an image that show something in front of the face, found on a grid of at most `LONGEST` a side."""
    out, about = np.zeros(facial.shape, bool), box(facial)
    span = [part.stop - part.start for part in about]
    grid = tuple(slice(part.start, part.stop, -(-max(span) // LONGEST)) for part in about)
    face, weights, usable = np.maximum(view.face[grid], 0), view.weights[grid], usable[grid]
    facial, plain = facial[grid], plain[grid]
    size = float(np.sqrt(usable.sum()))
    if size < MIN_SIDE:
        return out
    image = cv2.resize(image[about], usable.shape[::-1], interpolation=cv2.INTER_AREA)
    blur = max(BLUR * size, 0.7)
    at, shape = (face.ravel(), weights.reshape(-1, 3)), face.shape
    uv = interpolate(model.uv, model.faces_uv, *at).reshape(*shape, 2)
    side = len(albedos.known)
    place = (uv[..., 0] * side - 0.5).astype(np.float32), ((1.0 - uv[..., 1]) * side - 0.5).astype(np.float32)
    known = cv2.remap(albedos.known, *place, cv2.INTER_LINEAR)
    share = np.maximum(known, 1e-3)[..., None]
    colour, shaded = (cv2.remap(each, *place, cv2.INTER_LINEAR) / share for each in (albedos.colour, shading))
    usable = usable & (known > 0.5)
    predicted = colour + shaded
    smooth = cv2.GaussianBlur(image, (0, 0), 0.5 * blur)
    level = opponent(smooth)
    # The mesh is a little off, so the edge of a shadow may lie anywhere about there.
    near = np.ones((2 * max(1, round(REACH * size)) + 1,) * 2, np.uint8)
    lit = np.clip(level - colour, cv2.erode(shaded, near), cv2.dilate(shaded, near))
    departure = np.sqrt((((level - colour - lit) / albedos.deviation) ** 2).mean(axis=-1))
    departure[~usable | _highlight(smooth, np.exp(predicted @ np.linalg.inv(OPPONENT).T))] = 0.0
    weight = cv2.GaussianBlur(usable.astype(np.float32), (0, 0), blur)
    departure = cv2.GaussianBlur(departure.astype(np.float32), (0, 0), blur) / np.maximum(weight, 1e-3)
    inner = cv2.distanceTransform(usable.astype(np.uint8), cv2.DIST_L2, 3) > REACH * size
    # What covers a point in most images needn't in this one, nor end in all of them at the same point.
    strange = no_skin(level - shaded, albedos.skin) & usable
    covered = no_skin(colour, albedos.skin) & strange
    picture = to_8_bit(image)
    started, clean = (departure > SURE) & inner, (departure < CLEAN) & usable
    found = _outlines(picture, started, departure > CLEAN, clean, facial, SMALLEST, size)
    started, clean = covered & plain & inner, ~strange & plain & usable
    found |= _outlines(picture, started, strange, clean, facial, LARGE, size, WIDE * REACH)
    out[about] = cv2.resize(found.astype(np.uint8), span[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return out


def _outlines(
    picture: NDArray[np.uint8],
    found: NDArray[np.bool_],
    likely: NDArray[np.bool_],
    clean: NDArray[np.bool_],
    facial: NDArray[np.bool_],
    smallest: float,
    size: float,
    reach: float = REACH,
) -> NDArray[np.bool_]:
    """GrabCut of each object that is large enough, about the pixels in which it was found."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(2, round(reach * size)) + 1,) * 2)
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, disc)
    _, pieces, figures, _ = cv2.connectedComponentsWithStats(opened)
    out = np.zeros(found.shape, bool)
    for piece in range(1, len(figures)):
        if figures[piece, cv2.CC_STAT_AREA] < smallest * size**2:
            continue
        core = (pieces == piece).astype(np.uint8)
        near = cv2.dilate(core, around).astype(bool) & facial
        state = np.full(found.shape, cv2.GC_BGD, np.uint8)
        state[near] = np.where(likely[near], cv2.GC_PR_FGD, cv2.GC_PR_BGD)
        state[cv2.erode(core, disc).astype(bool)] = cv2.GC_FGD
        state[near & clean] = cv2.GC_BGD
        state[~facial] = cv2.GC_BGD
        about = box(cv2.dilate(near.astype(np.uint8), around).astype(bool))
        part = np.ascontiguousarray(state[about])
        if min((part == cv2.GC_FGD).sum(), (part == cv2.GC_BGD).sum()) < MIN_SIDE:
            out |= core.astype(bool)
            continue
        cv2.setRNGSeed(0)
        image, models = np.ascontiguousarray(picture[about]), (np.zeros((1, 65)), np.zeros((1, 65)))
        cv2.grabCut(image, part, (0, 0, 0, 0), *models, 2, cv2.GC_INIT_WITH_MASK)
        out[about] |= np.isin(part, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return out


def _highlight(linear: NDArray, predicted: NDArray) -> NDArray[np.bool_]:
    """Pixels that show the predicted colour and light added to it."""
    added = linear - predicted
    return (added > 0).all(axis=-1) | (np.abs(added) < DARKEST).all(axis=-1)


def _plain(shape: tuple[int, ...], marks: NDArray) -> NDArray[np.bool_]:
    """Pixels of forehead and upper cheeks, where skin has no features and no beard."""
    area = np.zeros(shape, np.uint8)
    up = marks[27] - marks[8]
    if not np.isfinite(marks).all() or np.linalg.norm(up) < 1:
        return area > 0
    y, x = np.mgrid[: shape[0], : shape[1]]
    above = (x * up[0] + y * up[1]) > float(marks[29] @ up)
    for part in (*EYES_AND_MOUTH[:2], *BROWS):
        cv2.fillPoly(area, [cv2.convexHull(np.round(marks[part]).astype(np.int32))], 1)
    margin = max(1, round(MARGIN * float(np.linalg.norm(marks[45] - marks[36]))))
    features = cv2.dilate(area, np.ones((2 * margin + 1,) * 2, np.uint8)) > 0
    return above & ~features


def _polygons(shape: tuple[int, ...], marks: NDArray, parts: Sequence[range]) -> NDArray[np.bool_]:
    area = np.zeros(shape, np.uint8)
    for part in parts:
        if np.isfinite(marks[part]).all():
            cv2.fillPoly(area, [np.clip(np.round(marks[part]), -1e6, 1e6).astype(np.int32)], 1)
    return area > 0
