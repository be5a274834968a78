"""Lips and lids that touch where the images show a closed mouth or closed eyes.

Detectors place the points of the inner lips and of the lids with a bias, and windows that span mouth or eye measure
nothing in between: a fit leaves a slit, through which the inside of the mouth shows, or an eye that stares. Where the
fitted images show either closed (`closed_line`), both margins move onto the line in which they meet.

What the closed timesteps have in common moves the neutral surface; what remains goes into their expressions, and the
expressions of the other timesteps undo the movement there, so that what is open stays as open as it was found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.geometry.surfaces import moved_by, object_shapes
from mifit.stages.surface.closed_line import (
    BEYOND_MM,
    OPEN,
    STEP_MM,
    Strip,
    eyeball,
    heights,
    read_strip,
    sample,
    teeth,
)
from mifit.stages.surface.margins import UP, Gap, Margins, Region

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

SMALLEST_PIXELS = 4.5
"""Opening up to which margins stay: the line and margins that are a little apart look alike in so few pixels."""
DEPTH_MM = 0.5
"""Standard deviation of the line's depth about the middle between the margins."""
FORWARD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Opening:
    """What may be closed.

    Attributes
    ----------
    name : str
    marks : slice
        iBUG points along its margins.
    widest_mm : float
        Height above which it is open without a look: no detector is that wrong.
    apart_mm : float
        What is left between its margins.
    blinks : bool
        Whether it opens and closes with the others that do: what all of them show decides. Where other timesteps
        show it open it closes by expression alone: expressions that undo a movement of the neutral surface leave a
        part of it, and a blink shouldn't make all others squint.
    inside : callable
        Part of a strip of an image that shows what lies inside.
    """

    name: str
    marks: slice
    widest_mm: float
    apart_mm: float
    blinks: bool
    inside: Callable[[Strip], float]


LIPS = (Opening("mouth", slice(60, 68), 6.0, 0.08, False, teeth),)
LIDS = tuple(
    Opening(name, slice(first, first + 6), np.inf, 0.04, True, eyeball)
    for name, first in (("right eye", 36), ("left eye", 42))
)


def close_openings(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    openings: Sequence[Opening] = LIPS + LIDS,
) -> tuple[GeometryEstimate, dict]:
    """Close mouth and eyes in the timesteps whose images show them closed.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Fit, with or without displacement.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    openings : sequence of Opening

    Returns
    -------
    geometry : GeometryEstimate
        With ``displacement``, ``expression`` and ``vertices`` changed where there was something to close; otherwise
        the input.
    details : dict
        By opening, those that the model has: ``closed`` and ``opening_mm``, timesteps seen closed, and the median
        opening of each timestep before.
    """
    known = [(opening, margins) for opening in openings if (margins := Margins.of(model, opening.marks)) is not None]
    if not known:
        return geometry, {}
    shapes = object_shapes(model, geometry)
    scene = SurfaceScene(geometry.vertices[0].astype(np.float64), model.faces)
    looks: list[list[_Look]] = []  # by timestep and opening
    for k, shape in enumerate(shapes):
        if k:
            scene.update(geometry.vertices[k].astype(np.float64))
        looks.append(
            [
                _look(capture, scene, geometry, k, Gap.of(shape, margins), cameras, opening, model.unit_mm)
                for opening, margins in known
            ]
        )
    details = {}
    for n, (opening, margins) in enumerate(known):
        lines = {}
        together = [m for m, (other, _) in enumerate(known) if m == n or (opening.blinks and other.blinks)]
        for k, row in enumerate(looks):
            parts = [part for m in together for part in row[m].inside]
            line = row[n].line
            if line is not None and np.mean(parts) < OPEN:
                lines[k] = line
        details[opening.name] = {
            "closed": [int(geometry.timesteps[k]) for k in lines],
            "opening_mm": {str(t): row[n].height_mm for t, row in zip(geometry.timesteps, looks, strict=True)},
        }
        pixel = min(row[n].pixel for row in looks)
        if lines and np.mean([looks[k][n].height_mm for k in lines]) >= SMALLEST_PIXELS * pixel:
            geometry = _closed(model, geometry, margins, lines, opening)
    return geometry, details


def close_again(
    model: MorphableModel, geometry: GeometryEstimate, details: Mapping[str, Any], openings: Sequence[Opening]
) -> GeometryEstimate:
    """Margins that `close_openings` has closed, and that have moved a little since, on the middle between them."""
    for opening in openings:
        steps = [geometry.index(t) for t in details.get(opening.name, {}).get("closed", ())]
        margins = Margins.of(model, opening.marks) if steps else None
        if margins is not None:
            shapes = object_shapes(model, geometry)
            lines = {k: Gap.of(shapes[k], margins).middle for k in steps}
            geometry = _closed(model, geometry, margins, lines, opening)
    return geometry


@dataclass(frozen=True)
class _Look:
    """What the images of one timestep show of an opening.

    Attributes
    ----------
    height_mm : float
        Of the modelled opening.
    inside : list of float
        By view that tells, the part that shows what lies inside.
    line : (C, 3) or None
        Where its margins meet if it is closed, object space.
    pixel : float
        Size of the smallest pixel there, mm.
    """

    height_mm: float
    inside: list[float]
    line: NDArray[np.float64] | None
    pixel: float


def _closed(
    model: MorphableModel, geometry: GeometryEstimate, margins: Margins, lines: dict[int, NDArray], opening: Opening
) -> GeometryEstimate:
    """The surface with margins that lie on lines, in the timesteps that have one."""
    shapes = object_shapes(model, geometry)
    region = Region.of(np.mean([shapes[k] for k in lines], axis=0), model, margins)
    apart = 0.5 * opening.apart_mm / model.unit_mm
    wanted = {k: region.movement(shapes[k], Gap.of(shapes[k], margins), line, apart) for k, line in lines.items()}
    mean = np.mean(list(wanted.values()), axis=0) * (len(lines) == len(shapes) or not opening.blinks)
    shared = region.fade(mean)
    expression = geometry.expression.copy()
    for k in range(len(shapes)):
        rest = region.fade(wanted[k] - mean) if k in wanted else -shared
        expression[k] = region.adjusted(expression[k], rest)
    return moved_by(model, replace(geometry, expression=expression), shared)


def _look(
    capture: Capture,
    scene: SurfaceScene,
    geometry: GeometryEstimate,
    k: int,
    gap: Gap,
    cameras: Sequence[str],
    opening: Opening,
    unit_mm: float,
) -> _Look:
    """What all views of a timestep show of an opening."""
    rotation, middle = geometry.rotation[k], gap.middle
    median = gap.height(unit_mm)
    if median > opening.widest_mm:
        return _Look(median, [1.0], None, np.inf)
    height = heights(median) / unit_mm

    def world(points: NDArray) -> NDArray:
        return geometry.scale * points @ rotation.T + geometry.translation[k]

    column_mm = float(np.linalg.norm(np.diff(middle, axis=0), axis=1).mean()) * unit_mm
    points = world(middle[:, None] + height[None, :, None] * UP)
    front = world(middle + BEYOND_MM / unit_mm * FORWARD)  # seen where lips and lids don't hide it
    opening_mm = (gap.upper - gap.lower) @ UP * unit_mm
    inside, rows, pixel = [], [], np.inf
    for name in cameras:
        camera, frame = capture.camera(name), capture.frame(name, geometry.timesteps[k])
        pixels = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
        spacing = float(np.median(np.linalg.norm(np.diff(pixels, axis=1), axis=2)))
        pixel = min(pixel, (height[1] - height[0]) * unit_mm / max(spacing, 1e-9))
        x, y = pixels[..., 0], pixels[..., 1]
        framed = np.all((x > 1) & (x < camera.width - 1) & (y > 1) & (y < camera.height - 1), axis=1)
        seen = framed & scene.visible_from(front, camera.position)
        good = (frame.valid & ~frame.clipped).astype(np.float32)[..., None].repeat(3, axis=2)
        seen &= sample(good, np.where(framed[:, None, None], pixels, 1.0))[..., 0].mean(axis=1) > 0.5
        read = read_strip(sample(frame.image, pixels), seen, opening_mm, column_mm, opening.inside)
        if read.inside is None:
            continue
        inside.append(read.inside)
        # Depth moves what a view shows at a height: by how much, across the line.
        at, up, deep = (camera.project(world(middle + d * STEP_MM / unit_mm)) for d in (0.0 * UP, UP, FORWARD))
        tangent = np.gradient(at, axis=0)
        across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        rows.append((read.height, read.weight, ((deep - at) * across).sum(1) / ((up - at) * across).sum(1)))
    if not rows:
        return _Look(median, inside, None, pixel)
    h, weight, slope = (np.stack(part) for part in zip(*rows, strict=True))
    precision = weight / weight.max() / STEP_MM**2
    a, b, c = (precision.sum(0) + 1e-6, (precision * slope).sum(0), (precision * slope**2).sum(0) + DEPTH_MM**-2.0)
    p, q = (precision * h).sum(0), (precision * slope * h).sum(0)
    determinant = a * c - b**2
    up, deep = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    clear = np.flatnonzero(precision.sum(0) > 0)
    up, deep = (np.interp(np.arange(len(v)), clear, v[clear]) / unit_mm for v in (up, deep))
    return _Look(median, inside, middle + up[:, None] * UP + deep[:, None] * FORWARD, pixel)
