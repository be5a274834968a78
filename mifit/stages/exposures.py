"""Exposure of every image relative to the first of its camera: phones change it as the head moves.

A turning head is shaded differently at every timestep, so colours of the same points don't stay. Lighting that is
fitted to all images together explains that, and what it leaves of an image as a whole is the image's factor
(`image_factors`). Where all cameras have changed alike one factor per timestep is found, which is known several times
better (1 to 2 per cent) than one per image (3 to 6 per cent): sheen that one camera sees and the other doesn't looks
like exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mifit.core.estimate import GeometryEstimate
from mifit.progress import Progress, silent
from mifit.stages.image_factors import (
    FEWEST_POINTS,
    ROUNDS,
    factors_by_lighting,
    gains_by_ratios,
    left_by_lighting,
    mean_albedo,
    shared_points,
    usable,
)
from mifit.stages.observations import Surface

Exposures = dict[str, tuple[float, ...]]

POINTS = 1500
"""Points that several images see and that the lighting is fitted to."""
LEFT_OF_EQUAL = 0.06
"""Spread of what lighting leaves of images of one exposure, logarithms: .02 to .055 on heads, a tenth more in one image
leaves .08 and more."""
ALIKE = 0.05
"""Log factor up to which timesteps count as exposed alike."""
ALIKE_IMAGES = 0.1
"""The same of single images, whose factors are known less well."""


def estimate_exposures(
    surface: Surface, geometry: GeometryEstimate, cameras: Sequence[str], seed: int = 0, progress: Progress = silent
) -> Exposures:
    """Factor of each image's linear colours over those of its camera's first timestep.

    Parameters
    ----------
    surface : Surface
        Of the fitted geometry.
    geometry : GeometryEstimate
        Its fitted albedo is where the lighting starts from.
    cameras : sequence of str
        Cameras of the surface.
    seed : int
        Chooses the points that the lighting is fitted to.
    progress : Progress

    Returns
    -------
    dict of str to (T,) factors
        One per timestep of the geometry, the first one 1. Empty where all images surely have one exposure, or where too
        few points are seen in several timesteps to tell.
    """
    steps = len(geometry.timesteps)
    if steps < 2:
        return {}
    parts = [surface.observe(part) for part in surface.chunks()]
    if sum(int((usable(part).sum(axis=1) >= 2).sum()) for part in parts) < FEWEST_POINTS:
        return {}
    seen = shared_points(parts, POINTS, np.random.default_rng(seed))
    told = usable(seen)
    if told.sum(axis=0).min() < FEWEST_POINTS:
        return {}
    # Gains stay over time and are found better elsewhere (`gains`), but rounds that start far off end far off.
    gain = np.exp(gains_by_ratios([seen], len(cameras))[0])[seen.camera]
    seen = replace(seen, colour=(seen.colour / gain).astype(np.float32))
    albedo = mean_albedo(seen, geometry, surface.faces)
    images = np.arange(len(seen.step))
    left = left_by_lighting(seen, images, albedo)
    by_image = np.zeros((len(cameras), steps))
    by_image[seen.camera, seen.step] = left.mean(axis=1)
    if np.ptp(by_image, axis=1).max() < LEFT_OF_EQUAL:
        return {}

    def turn(number: int) -> None:
        progress("Exposures", number, ROUNDS)

    each = factors_by_lighting(seen, images, albedo, left, range(len(images)), turn).mean(axis=1)
    by_image[seen.camera, seen.step] = each
    by_camera = by_image.mean(axis=1)  # gains, which stay over time, are found elsewhere
    own = by_image - by_camera[:, None]
    if np.ptp(own - own.mean(axis=0), axis=1).max() <= ALIKE_IMAGES:
        gain = np.exp(by_camera)[seen.camera].astype(np.float32)
        start = np.repeat((own.mean(axis=0) - own.mean(axis=0)[0])[:, None], 3, axis=1)
        alike = replace(seen, colour=seen.colour / gain[:, None])
        common = factors_by_lighting(alike, seen.step, albedo, start, range(steps), turn).mean(axis=1)
        if np.abs(common).max() <= ALIKE:
            return {}
        own = np.tile(common, (len(cameras), 1))
    own = own - own[:, :1]
    return {name: tuple(float(f) for f in np.exp(log)) for name, log in zip(cameras, own, strict=True)}
