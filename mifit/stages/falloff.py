"""Darkening of images towards their corners, and contrast of cameras, told by two that see the same surface points at
different distances from the middles of their images.

Skin is no diffuse surface, and what its sheen adds to one camera more than to the other falls off across the face as
well. But sheen is added (Shafer's dichromatic reflection): it brightens dark colours and dark channels by the larger
part, while a lens darkens all of a pixel by one factor. So of the log ratios of two cameras at a point only what is
across the sheen's direction in colour space counts, whatever its amount there. Gains, falloff and contrast (log colours
of one camera that are proportional to another's) are found together, so that none is taken for another.

The direction needs the tint of the light that shines, which is known roughly and differs from side to side. What errors
of it would do to both is found by trying them, constant ones and ones that vary with the normal, and where sheen
is strong or light colourful that is more than any lens does: then nothing is taken. Contrast is relative to the first
camera's: two images of one exposure tell of no camera's own.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import GeometryConfig
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate
from mifit.core.sh import basis
from mifit.progress import Progress, silent
from mifit.stages.gains import estimate_gains
from mifit.stages.image_factors import DARKEST, FEWEST_POINTS, MAP_SIZE, mean_albedo, shared_points, usable
from mifit.stages.observations import Observations, Surface

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

Factors = dict[str, float]

POINTS = 4000
"""Points that several images see and that are compared."""
LEAST = 0.15
"""Logarithm by which corners are darker than the middle from which falloff matters."""
LENSES = 0.35
"""Standard deviation of lenses' falloff: most leave more than half of the light in the corners."""
MOST = 1.4
"""Falloff that leaves a quarter of the light; what is beyond it is no lens."""
TINT_SPREAD, TINT_BANDS = 0.18, 3
"""Standard deviation of the tint of sheen in red and in blue, logarithm, by each harmonic in the normals of some bands:
what sheen of lights with as many colours as directions does to the falloff of a lens that is bright all over."""
CONTRAST_SPREAD = 0.1
"""Standard deviation of the logarithm of contrasts between cameras whose images are sRGB by name."""
LEAST_CONTRAST, CONTRAST_SURE = 0.04, 2.5
"""Logarithm of contrast from which it matters, and deviations from which it is sure: equal cameras have shown up to
1.9 of them on heads."""
ALIKE = 0.05
"""Relative difference of focal lengths up to which cameras with images of one size have a lens of one kind."""
ROUNDS = 12
"""Of reweighted least squares."""


@dataclass(frozen=True)
class Pairs:
    """P points of one timestep each, seen by two cameras.

    Attributes
    ----------
    ratio, level : (P, 3)
        Difference and mean of the cameras' log colours.
    weight : (P,)
    normal : (P, 3)
    columns : (P, 3, U)
        Derivatives of the ratio by falloff of each lens, then gains and contrast of each camera but the first.
    """

    ratio: NDArray[np.float64]
    level: NDArray[np.float64]
    weight: NDArray[np.float64]
    normal: NDArray[np.float64]
    columns: NDArray[np.float64]


def find_falloff(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: GeometryConfig,
    seed: int = 0,
    progress: Progress = silent,
) -> GeometryEstimate:
    """The geometry with falloff and contrast of its cameras, where two and two timesteps or more tell of any.

    Gains are found anew where the contrast changes, which they were found without.
    """
    if len(cameras) == 1 or len(geometry.timesteps) == 1:
        return geometry
    began = time.perf_counter()
    progress("Falloff", 0, 1)
    surface = Surface(capture, model, geometry, cameras, MAP_SIZE)
    falloff, contrast = estimate_falloff(surface, geometry, [capture.camera(name) for name in cameras], seed)
    found = replace(geometry, falloff=falloff if config.falloff else {}, contrast=contrast if config.contrast else {})
    if found.contrast and config.camera_gains != "never":
        found = replace(found, gains={})
        corrected = capture.with_lenses(found.falloff, found.contrast)
        surface = Surface(corrected, model, found, cameras, MAP_SIZE)
        certain = config.camera_gains == "auto"
        found = replace(found, gains=estimate_gains(surface, found, cameras, seed, certain=certain))
    progress("Falloff", 1, 1)
    report = replace(geometry.report, seconds=geometry.report.seconds + time.perf_counter() - began)
    return replace(found, report=report)


def estimate_falloff(
    surface: Surface, geometry: GeometryEstimate, cameras: Sequence[Camera], seed: int = 0
) -> tuple[Factors, Factors]:
    """Logarithm by which the corners of each camera's images are darker than their middle, and its contrast.

    Parameters
    ----------
    surface : Surface
        Of the fitted geometry.
    geometry : GeometryEstimate
        Its albedo tells the tint of the light.
    cameras : sequence of Camera
        Cameras of the surface. Those with images of one size and about one focal length share a lens.
    seed : int
        Chooses the points.

    Returns
    -------
    falloff : dict of str to float
        For cameras whose lens surely darkens the corners. Empty where none does, or where too few points tell.
    contrast : dict of str to float
        Exponent of each camera's linear colours over the first camera's, where it surely isn't 1.
    """
    parts = [surface.observe(part) for part in surface.chunks()]
    seen = shared_points(parts, POINTS, np.random.default_rng(seed))
    lens = shared_lenses(cameras)
    lenses = max(lens) + 1
    pairs = _pairs(seen, cameras, lens)
    if len(pairs.ratio) < FEWEST_POINTS:
        return {}, {}
    found, deviation = _told(pairs, _tint(seen, mean_albedo(seen, geometry, surface.faces)))
    falling, spread = found[:lenses], deviation[:lenses]
    expected = falling / (1.0 + (spread / LENSES) ** 2)  # the mean beside the prior
    dark = (falling > spread) & (expected > LEAST) & (falling < MOST)
    falloff = {camera.name: float(expected[k]) for camera, k in zip(cameras, lens, strict=True) if dark[k]}
    at = lenses + 3 + 4 * np.arange(len(cameras) - 1)
    level, spread = found[at], deviation[at]
    sure = np.abs(level) > np.maximum(CONTRAST_SURE * spread, LEAST_CONTRAST)
    exponent = np.exp(level / (1.0 + (spread / CONTRAST_SPREAD) ** 2))
    return falloff, {c.name: float(e) for c, e, s in zip(cameras[1:], exponent, sure, strict=True) if s}


def shared_lenses(cameras: Sequence[Camera]) -> list[int]:
    """Number of each camera's lens."""
    kinds: list[Camera] = []
    found = []
    for camera in cameras:
        size = camera.width, camera.height
        alike = [
            k
            for k, kind in enumerate(kinds)
            if size == (kind.width, kind.height) and abs(camera.fx - kind.fx) <= ALIKE * kind.fx
        ]
        found.append(alike[0] if alike else len(kinds))
        kinds += [] if alike else [camera]
    return found


def _tint(seen: Observations, albedo: NDArray) -> NDArray[np.float64]:
    """(3,) of the light: what the surface's colours have beyond its albedo."""
    over = seen.colour / albedo[:, None]
    return np.asarray(np.median(over[usable(seen)], axis=0), dtype=np.float64)


def _pairs(seen: Observations, cameras: Sequence[Camera], lens: Sequence[int]) -> Pairs:
    measured = usable(seen)
    level = np.log(np.maximum(seen.colour, DARKEST)).astype(np.float64)
    lenses = max(lens) + 1
    unknowns = lenses + 4 * (len(cameras) - 1)
    found = [(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, unknowns)))]
    for i, j in combinations(range(len(seen.step)), 2):
        if seen.step[i] != seen.step[j]:
            continue
        rows = np.flatnonzero(measured[:, i] & measured[:, j])
        mean = (level[rows, j] + level[rows, i]) / 2
        columns = np.zeros((len(rows), 3, unknowns))
        for image, side in ((j, 1.0), (i, -1.0)):
            k, step = int(seen.camera[image]), seen.step[image]
            radius = cameras[k].corner_radius(cameras[k].project(seen.point[rows, step].astype(np.float64)))
            columns[:, :, lens[k]] -= side * radius[:, None] ** 2
            if k > 0:
                at = lenses + 4 * (k - 1)
                columns[:, :, at : at + 3] += side * np.eye(3)
                columns[:, :, at + 3] += side * mean
        weight = np.minimum(seen.weight[rows, i], seen.weight[rows, j])
        found.append((level[rows, j] - level[rows, i], mean, weight, seen.normal[rows, seen.step[i]], columns))
    return Pairs(*(np.concatenate(each).astype(np.float64) for each in zip(*found, strict=True)))


def _told(pairs: Pairs, tint: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The unknowns, and their standard deviations by what isn't known of the sheen's tint (3,)."""
    found = _solve(pairs, np.broadcast_to(tint, pairs.level.shape))
    harmonics = basis(pairs.normal, TINT_BANDS)
    harmonics = harmonics / np.sqrt((harmonics**2).mean(axis=0))
    change = [
        _solve(pairs, tint * np.exp(TINT_SPREAD * harmonic[:, None] * np.eye(3)[channel])) - found
        for harmonic in harmonics.T
        for channel in (0, 2)
    ]
    return found, np.sqrt(np.square(change).sum(axis=0))


def _solve(pairs: Pairs, tint: NDArray) -> NDArray[np.float64]:
    """The unknowns, robustly (Geman and McClure), across the directions of sheen of tints (P, 3)."""
    sheen = tint / np.exp(pairs.level)
    sheen /= np.linalg.norm(sheen, axis=1, keepdims=True)
    right = pairs.ratio - sheen * (sheen * pairs.ratio).sum(axis=1, keepdims=True)
    slope = pairs.columns - sheen[:, :, None] * np.einsum("pc,pcu->pu", sheen, pairs.columns)[:, None]
    weight = pairs.weight
    for _ in range(ROUNDS):
        by = slope * weight[:, None, None]
        system = np.tensordot(by, slope, axes=([0, 1], [0, 1]))
        floor = (1e-9 * np.trace(system) + 1e-12) * np.eye(len(system))
        found = np.linalg.solve(system + floor, np.tensordot(by, right, axes=([0, 1], [0, 1])))
        off = np.linalg.norm(right - slope @ found, axis=1)
        weight = pairs.weight / (1.0 + (off / (2.0 * np.median(off) + 1e-12)) ** 2) ** 2
    return np.asarray(found)
