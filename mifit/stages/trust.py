"""How likely an observation shows the surface point that it is read at, and not what lies beside or behind it.

A fitted mesh is a few millimetres off. Seen head on that shifts a colour a little; near the outline of the mesh in an
image it puts the background, an ear or the far cheek where the point should be, in full sharpness and at any
brightness. So each observation has a probability of showing something else, which rises with the view angle and
towards the outline, and cameras that see a point at the same time judge one another: where two disagree, the one that
was less likely to be right gives way. A colour that no other camera confirms keeps its own probability.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

OUTLINE_MM = 3.0
"""Distance inside the fitted outline over which the odds of seeing past the real one fall by e: fitted meshes lie 1 to
4 mm off real heads."""
AT_OUTLINE = 0.5
"""Probability of seeing something else at the outline, and at a right angle."""
LEAST = 0.01
"""Probability of it head on: hair, a strap, a stray hand."""
SPREAD = 0.2
"""Scale of log colour ratios of two cameras at one point: sheen and shifted texture. Cauchy's tails leave room for
highlights."""
RANGE = 4.0
"""Log colour ratios that something else may show, evenly."""
DARKEST = 0.004
"""Linear colour below which ratios are noise."""
ROUNDS = 4
BESIDE = 3
"""Pixels beside the fitted outline that are left out of the background."""
ALIKE = 0.15
"""Part of its colour by which the background changes from the outline inwards."""


def outline_distance(depth: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Pixels from each pixel of a depth image to the nearest outline.

    Parameters
    ----------
    depth : (H, W)
        Distance along the camera's axis; infinite beside the mesh.
    step : float
        Second difference of depth, in its unit, that makes an outline: an oblique surface has none, however steep.

    Returns
    -------
    (H, W) float32
        0 at the outline and where nothing is hit.
    """
    hit = np.isfinite(depth)
    if not hit.any():
        return np.zeros(depth.shape, dtype=np.float32)
    far = np.where(hit, depth, float(depth[hit].max()) + 2.0 * step).astype(np.float32)
    second = np.array([[1.0, -2.0, 1.0]], dtype=np.float32)
    jump = np.maximum(*(np.abs(cv2.filter2D(far, -1, k)) for k in (second, second.T))) > step
    inside = (hit & ~jump).astype(np.uint8)
    # A camera that sees nothing but surface has no outline.
    if inside.all():
        return np.full(depth.shape, 1e6, dtype=np.float32)
    return np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5), dtype=np.float32)


def background(image: NDArray, hit: NDArray[np.bool_], kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels on a mesh that show what lies beside it: alike to the nearest pixels off the mesh and joined to them.

    Scalp and neck of a fitted head are the model's, not the person's, and may stand centimetres wide of theirs.

    Parameters
    ----------
    image : (H, W, 3)
        Linear colour.
    hit : (H, W) bool
        Pixels that the mesh covers.
    kept : (H, W) bool
        Pixels that are never background: the face area, whose outline is fitted.
    """
    off = ~cv2.dilate(hit.astype(np.uint8), np.ones((2 * BESIDE + 1,) * 2, np.uint8)).astype(bool)
    if not off.any() or not hit.any():
        return np.zeros_like(hit)
    finite = np.nan_to_num(image, nan=0.0, posinf=1.0, neginf=0.0).astype(np.float32)
    smooth = cv2.GaussianBlur(finite, (0, 0), 1.5)
    row, column = distance_transform_edt(~off, return_distances=False, return_indices=True)
    there = smooth[row, column]
    alike = (np.abs(smooth - there) < ALIKE * there + 5.0 * DARKEST).all(axis=-1) & ~kept
    _, piece = cv2.connectedComponents((alike | off).astype(np.uint8))
    found = hit & alike & np.isin(piece, np.unique(piece[off]))
    # Pixels along its outline mix both: they alone would colour all that nothing else shows.
    return hit & ~kept & cv2.dilate(found.astype(np.uint8), np.ones((2 * BESIDE + 1,) * 2, np.uint8)).astype(bool)


def elsewhere(cosine: NDArray, millimetres: NDArray) -> NDArray[np.float32]:
    """Probability that an observation shows something else, before any colour is looked at.

    Parameters
    ----------
    cosine : (...)
        Between surface normal and view.
    millimetres : (...)
        Distance to the outline in the image, measured at the point's depth.
    """
    angle = (1.0 - np.clip(cosine, 0.0, 1.0)) ** 2
    edge = np.exp(-np.maximum(millimetres, 0.0) / OUTLINE_MM)
    return np.float32(LEAST) + np.float32(AT_OUTLINE - LEAST) * np.maximum(angle, edge).astype(np.float32)


def agreement(
    colour: NDArray, weight: NDArray, wrong: NDArray, clipped: NDArray, step: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Probability that each observation shows its point, given what others show at the same time.

    Parameters
    ----------
    colour : (N, J, 3)
        Linear.
    weight : (N, J)
        0 where not observed.
    wrong : (N, J)
        Probability of each to show something else (`elsewhere`).
    clipped : (N, J) bool
        Lower bounds: they neither judge nor are judged.
    step : (J,)
        Images of one step show the same pose and light, so a point's matt colour is the same in all of them.

    Returns
    -------
    (N, J) float32
        Posterior of a mixture of a Cauchy distribution about the consensus and an even one, per point and step.

    Notes
    -----
    The consensus starts at the colour of the observation with the largest weight times probability, so that of two
    that contradict each other the likelier one stands.
    """
    right = (1.0 - wrong).astype(np.float32)
    level = np.log(np.maximum(colour, DARKEST)).astype(np.float32)
    for s in np.unique(step):
        images = np.flatnonzero(step == s)
        use = (weight[:, images] > 0) & ~clipped[:, images]
        rows = np.flatnonzero(use.sum(axis=1) > 1)
        if not len(rows):
            continue
        here = np.ix_(rows, images)
        use, prior = use[rows], 1.0 - wrong[here]
        shown = [level[..., channel][here] for channel in range(3)]  # sums along three neighbours in memory are slow
        trust = np.where(use, weight[here] * prior, 0.0)
        best = trust.argmax(axis=1)
        centre = [channel[np.arange(len(rows)), best] for channel in shown]
        posterior = prior
        for _ in range(ROUNDS):
            red, green, blue = ((channel - c[:, None]) ** 2 for channel, c in zip(shown, centre, strict=True))
            departure = (red + green + blue) / np.float32(3)
            likely = prior / (np.pi * SPREAD * (1.0 + departure / SPREAD**2))
            posterior = likely / (likely + (1.0 - prior) / RANGE)
            share = trust * posterior
            total = share.sum(axis=1)
            centre = [(share * channel).sum(axis=1) / total for channel in shown]
        right[here] = np.where(use, posterior, right[here])
    return right
