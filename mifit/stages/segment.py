"""What each image shows: skin, eyes, mouth, hair, cloth, something in front of the face, or the background.

It starts from the fitted head. Every point of the face has one colour, whatever image shows it, times a shading that
depends on its normal alone: both are found from all images together (`stages.consensus`), and an image that contradicts
them over an area shows something else there. What is added light alone, such as a highlight, contradicts nothing. What
covers a point in every image is told by its colour, far from that of the face's skin. GrabCut (Rother et al. 2004),
started inside what was found and on the skin around it, one object at a time, then finds the objects' outlines.

No network is involved. A capture's own masks (``mask_path``) replace this for the images that have one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import Label
from mifit.core.image import to_8_bit
from mifit.core.mesh import interpolate, normalize
from mifit.core.process import on_all_cores
from mifit.core.sh import basis
from mifit.stages.consensus import OPPONENT, Consensus, agreed_colour, consensus, no_skin
from mifit.stages.trust import DARKEST

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel
    from mifit.stages.observations import Seen, Surface


SURE, LIKELY, CLEAN = 4.0, 3.0, 1.0
"""Departures in standard deviations: of what starts an object, may belong to one, and is skin."""
BLUR = 0.003
"""Standard deviation of the blur against noise and shifted texture, as a part of the face's size in pixels."""
RIM = 0.012
"""Distance from the rim of the face, as a part of its size, within which nothing starts: the mesh is off by as much."""
REACH = 0.02
"""Distance around what was found in which its outline lies."""
WIDE = 4
"""The same of what covers the face in every image, in multiples: it is looked for beside the brows only."""
SMALLEST = 0.004
"""Part of the face that an object covers at the least."""
HIGHLIGHT = 0.5
"""Red over blue of what a highlight adds at the least: a window's is bluish."""
ABOVE = 0.1
"""Height above the brows, in multiples of that above the chin, from which on an object is hair."""
LARGE = 0.02
"""The same of one that covers it in every image: birthmarks are smaller."""
LEAST_SIZE = 16
"""Pixels: smaller faces and objects are left alone."""
EYES, INNER_LIPS = (slice(36, 42), slice(42, 48)), slice(60, 68)
"""iBUG points."""
BROWS = slice(17, 22), slice(22, 27)
MARGIN = 0.08
"""Distance around eyes and brows, as a part of the distance between the eyes' outer corners, that is theirs."""
LONGEST = 640
"""Pixels along the longer side of a face at which it is looked at."""


def segment(surface: Surface, capture: Capture, model: MorphableModel, seed: int = 0) -> tuple[NDArray[np.uint8], ...]:
    """A label image for every image of a surface.

    Parameters
    ----------
    surface : Surface
    capture : Capture
        Images are taken from it; those with a mask of their own are labelled by it and the mesh alone.
    model : MorphableModel
    seed : int

    Returns
    -------
    tuple of (H, W) uint8
        `Label` values, in the order of the surface's images.
    """
    agreed = consensus(surface, seed)

    def labelled(view: Seen) -> NDArray[np.uint8]:
        return _segment_image(view, agreed, capture, model)

    return tuple(on_all_cores(labelled, list(surface.views())))


def _segment_image(view: Seen, agreed: Consensus, capture: Capture, model: MorphableModel) -> NDArray[np.uint8]:
    frame = capture.frame(view.camera.name, view.timestep)
    number = np.asarray(np.isfinite(frame.image).all(axis=-1))
    image = np.where(number[..., None], frame.image, 0.0).astype(np.float32)
    hit = view.face >= 0
    labels = np.where(hit, np.uint8(Label.SKIN), np.uint8(Label.BACKGROUND))
    facial = hit & model.face_mask[np.maximum(view.face, 0)]
    marks = view.camera.project(view.vertices[model.landmarks])
    eyes, mouth = _polygons(hit.shape, marks, EYES), _polygons(hit.shape, marks, (INNER_LIPS,))
    if facial.any() and not frame.masked:
        usable = facial & frame.valid & number & ~eyes & ~mouth
        rows, columns = _box(facial)
        step = -(-max(rows.stop - rows.start, columns.stop - columns.start) // LONGEST)
        grid = slice(rows.start, rows.stop, step), slice(columns.start, columns.stop, step)
        objects = _objects(view, image[rows, columns], usable, grid, agreed, model, facial, _plain(hit.shape, marks))
        found = np.zeros(hit.shape, bool)
        shape = columns.stop - columns.start, rows.stop - rows.start
        found[rows, columns] = cv2.resize(objects.astype(np.uint8), shape, interpolation=cv2.INTER_NEAREST) > 0
        found &= hit
        labels[found] = _kinds(found, marks)[found]
    for area, label in ((eyes, Label.EYES), (mouth, Label.MOUTH)):
        labels[area & (labels == Label.SKIN)] = label
    labels[~frame.valid] = Label.BACKGROUND
    return labels


def _objects(
    view: Seen,
    image: NDArray,
    usable: NDArray[np.bool_],
    grid: tuple[slice, slice],
    agreed: Consensus,
    model: MorphableModel,
    facial: NDArray[np.bool_],
    plain: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Pixels of a grid in an image that show something in front of the face; ``image`` is the part that it spans."""
    face, weights, usable = np.maximum(view.face[grid], 0), view.weights[grid], usable[grid]
    facial, plain = facial[grid], plain[grid]
    size = float(np.sqrt(usable.sum()))
    if size < LEAST_SIZE:
        return np.zeros_like(usable)
    image = cv2.resize(image, usable.shape[::-1], interpolation=cv2.INTER_AREA)
    blur = max(BLUR * size, 0.7)
    at, shape = (face.ravel(), weights.reshape(-1, 3)), face.shape
    uv = interpolate(model.uv, model.faces_uv, *at).reshape(*shape, 2)
    normal = normalize(interpolate(view.normals, model.faces, *at)).reshape(*shape, 3)
    known, colour = agreed_colour(agreed, uv)
    usable = usable & (known > 0.5)
    predicted = colour + basis(normal, 3) @ agreed.shading
    smooth = cv2.GaussianBlur(image, (0, 0), 0.5 * blur)
    level = np.log(np.maximum(smooth, DARKEST)) @ OPPONENT.T
    departure = np.sqrt((((level - predicted) / agreed.deviation) ** 2).mean(axis=-1))
    departure[~usable | _highlight(smooth, np.exp(predicted @ np.linalg.inv(OPPONENT).T))] = 0.0
    weight = cv2.GaussianBlur(usable.astype(np.float32), (0, 0), blur)
    departure = cv2.GaussianBlur(departure.astype(np.float32), (0, 0), blur) / np.maximum(weight, 1e-3)
    inner = cv2.distanceTransform(usable.astype(np.uint8), cv2.DIST_L2, 3) > RIM * size
    # What covers a point in most images needn't in this one, nor end in all of them at the same point.
    strange = no_skin(level - basis(normal, 3) @ agreed.shading, agreed.skin) & usable
    covered = no_skin(colour, agreed.skin) & strange
    picture = to_8_bit(image)
    found = _outlines(
        picture,
        (departure > SURE) & inner,
        departure > LIKELY,
        (departure < CLEAN) & usable,
        facial,
        SMALLEST,
        size,
    )
    return found | _outlines(
        picture, covered & plain & inner, strange, ~strange & plain & usable, facial, LARGE, size, WIDE * REACH
    )


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
        box = _box(cv2.dilate(near.astype(np.uint8), around).astype(bool))
        part = np.ascontiguousarray(state[box])
        if min((part == cv2.GC_FGD).sum(), (part == cv2.GC_BGD).sum()) < LEAST_SIZE:
            out |= core.astype(bool)
            continue
        cv2.setRNGSeed(0)
        behind, before = np.zeros((1, 65)), np.zeros((1, 65))
        nowhere = (0, 0, 0, 0)
        cv2.grabCut(np.ascontiguousarray(picture[box]), part, nowhere, behind, before, 2, cv2.GC_INIT_WITH_MASK)
        out[box] |= np.isin(part, (cv2.GC_FGD, cv2.GC_PR_FGD))
    return out


def _highlight(linear: NDArray, predicted: NDArray) -> NDArray[np.bool_]:
    """Pixels that show the predicted colour and light added to it, no bluer than a lamp's."""
    added = linear - predicted
    return (added > 0).all(axis=-1) & (added[..., 0] > HIGHLIGHT * added[..., 2]) | (np.abs(added) < DARKEST).all(
        axis=-1
    )


def _kinds(found: NDArray[np.bool_], marks: NDArray) -> NDArray[np.uint8]:
    """Labels of objects: hair where one reaches well above the brows, cloth where it lies below the chin."""
    kinds = np.full(found.shape, np.uint8(Label.OCCLUDER))
    up = marks[27] - marks[8]  # bridge of the nose from the chin
    if not np.isfinite(marks[[8, 19, 24, 27]]).all():
        return kinds
    up = up / max(float(np.linalg.norm(up)), 1e-6)
    brows, chin = float((marks[[19, 24]] @ up).mean()), float(marks[8] @ up)
    _, pieces, figures, centres = cv2.connectedComponentsWithStats(found.astype(np.uint8))
    y, x = np.mgrid[: found.shape[0], : found.shape[1]]
    height = x * up[0] + y * up[1]
    for piece in range(1, len(figures)):
        inside = pieces == piece
        if float(height[inside].max()) > brows + ABOVE * (brows - chin):
            kinds[inside] = Label.HAIR
        elif float(centres[piece] @ up) < chin:
            kinds[inside] = Label.CLOTH
    return kinds


def _plain(shape: tuple[int, ...], marks: NDArray) -> NDArray[np.bool_]:
    """Pixels of forehead and upper cheeks, where skin has no features and no beard."""
    area = np.zeros(shape, np.uint8)
    up = marks[27] - marks[8]
    if not np.isfinite(marks).all() or np.linalg.norm(up) < 1:
        return area > 0
    y, x = np.mgrid[: shape[0], : shape[1]]
    above = (x * up[0] + y * up[1]) > float(marks[29] @ up)
    for part in (*EYES, *BROWS):
        cv2.fillPoly(area, [cv2.convexHull(np.round(marks[part]).astype(np.int32))], 1)
    margin = max(1, round(MARGIN * float(np.linalg.norm(marks[45] - marks[36]))))
    features = cv2.dilate(area, np.ones((2 * margin + 1,) * 2, np.uint8)) > 0
    return above & ~features


def _polygons(shape: tuple[int, ...], marks: NDArray, parts: Sequence[slice]) -> NDArray[np.bool_]:
    area = np.zeros(shape, np.uint8)
    for part in parts:
        if np.isfinite(marks[part]).all():
            cv2.fillPoly(area, [np.clip(np.round(marks[part]), -1e6, 1e6).astype(np.int32)], 1)
    return area > 0


def _box(area: NDArray[np.bool_]) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(area.any(axis=1)), np.flatnonzero(area.any(axis=0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
