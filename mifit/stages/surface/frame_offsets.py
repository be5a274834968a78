"""How far apart in time the frames of two cameras are, in parts of a frame, by a head that moves.

A camera whose frames come d later than another's shows each point of the head d v away, with v the way that the point
goes in a frame. Within the plane through the point and both cameras that looks like another depth. Across it nothing
but time explains a shift that comes and goes with the movement; a calibration that is off shifts all frames alike:

    s = c + d (v . a)

over texels and frames, with s the shift by which the views agree best along the direction a across the plane.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.surface.sweep import sweep
from mifit.stages.surface.views import pose_texels, texels_of_pixels

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.core.camera import Camera
    from mifit.morphable import MorphableModel

MOST_FRAMES = 12
"""Frames that are looked at: those in which the head moves most across the planes."""
FEWEST_FRAMES = 3
FARTHEST = 4
"""Pixels that are searched to either side."""
WINDOW = 11
"""Side of the windows that are compared, texels."""
FEWEST_TEXELS = 200
LEAST_PIXELS = 0.3
"""Movement across the planes in a frame, root mean square over the frames, below which nothing is told."""
OUT_OF_STEP = "camera-out-of-step"
WORTH_A_WARNING, CERTAIN = 0.15, 3.0
"""Part of a frame, and number of deviations, beyond which cameras count as out of step."""


@dataclass(frozen=True)
class FrameOffset:
    """How much later a camera's frames are than the first one's.

    Attributes
    ----------
    frames : float
        In frames; negative where they are earlier.
    deviation : float
        Standard deviation of it, from leaving out one frame at a time.
    """

    frames: float
    deviation: float


@dataclass(frozen=True)
class _Sums:
    """Of a frame's matches: weights, movement, shift and their products."""

    weight: float
    movement: float
    shift: float
    squared: float
    product: float

    @classmethod
    def of(cls, weight: NDArray, movement: NDArray, shift: NDArray) -> _Sums:
        total = float(weight.sum())
        return cls(
            1.0,  # each frame counts alike: its matches share the errors of its pose
            float(weight @ movement) / total,
            float(weight @ shift) / total,
            float(weight @ movement**2) / total,
            float(weight @ (movement * shift)) / total,
        )


@one_blas_thread()
def frame_offsets(
    capture: Capture, model: MorphableModel, geometry: GeometryEstimate, cameras: Sequence[str]
) -> dict[str, FrameOffset]:
    """Offsets in time of all cameras but the first.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        With runs of consecutive timesteps, fitted or tracked.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.

    Returns
    -------
    dict of str to FrameOffset
        By camera. Those whose plane with the first camera the head hardly leaves are missing: a head that only turns to
        the side before cameras side by side tells nothing.
    """
    known = set(geometry.timesteps)
    inner = [t for t in sorted(known) if t - 1 in known and t + 1 in known]
    views = [capture.camera(name) for name in cameras]
    if len(inner) < FEWEST_FRAMES or len(views) < 2:
        return {}
    texels, factor, pixel = texels_of_pixels(model, geometry.vertices[0].astype(np.float64), views)
    found = {}
    for name, view in zip(cameras[1:], views[1:], strict=True):
        pair = [cameras[0], name]
        way = [_across(geometry, t, views[0], view) for t in inner]
        most = np.sort(np.argsort([-np.mean(w**2) for w in way])[:MOST_FRAMES])
        if np.sqrt(np.mean([np.mean(way[k] ** 2) for k in most])) < LEAST_PIXELS * pixel:
            continue
        sums = [_matched(capture, model, geometry, inner[k], pair, texels, pixel, factor) for k in most]
        offset = _offset([s for s in sums if s is not None])
        if offset is not None:
            found[name] = offset
    return found


def frame_offset_warnings(offsets: Mapping[str, FrameOffset], first: str) -> list[Diagnostic]:
    """What to say of cameras whose frames are certainly out of step with those of the first."""
    return [
        Diagnostic(
            OUT_OF_STEP,
            f"camera {name}: its frames come {abs(o.frames):.2f} of a frame "
            f"{'later' if o.frames > 0 else 'earlier'} than those of {first} (+- {o.deviation:.2f}): where the face "
            "moves the views don't agree",
            camera=name,
        )
        for name, o in offsets.items()
        if abs(o.frames) > max(WORTH_A_WARNING, CERTAIN * o.deviation)
    ]


def _movement(geometry: GeometryEstimate, timestep: int) -> NDArray[np.float64]:
    """(V, 3) world way of the vertices in a frame, by the frames before and after."""
    before, after = (geometry.vertices[geometry.index(timestep + k)].astype(np.float64) for k in (-1, 1))
    return 0.5 * (after - before)


def _direction(one: Camera, other: Camera, points: NDArray) -> NDArray[np.float64]:
    """(N, 3) unit vectors across the planes through points and both cameras."""
    across: NDArray[np.float64] = normalize(np.cross(one.position - points, other.position - points))
    return across


def _across(geometry: GeometryEstimate, timestep: int, one: Camera, other: Camera) -> NDArray[np.float64]:
    """(V,) part of the vertices' way in a frame that leaves the planes through them and two cameras."""
    points = geometry.vertices[geometry.index(timestep)].astype(np.float64)
    return np.asarray((_movement(geometry, timestep) * _direction(one, other, points)).sum(axis=1))


def _matched(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    timestep: int,
    pair: Sequence[str],
    texels: TexelMap,
    pixel: float,
    factor: float,
) -> _Sums | None:
    """What the two views of a timestep say; None where too few texels match."""
    vertices = geometry.vertices[geometry.index(timestep)].astype(np.float64)
    scene = SurfaceScene(vertices, model.faces)
    posed = pose_texels(capture, scene, vertices, model.faces, texels, pair, timestep, factor)
    across = _direction(capture.camera(pair[0]), capture.camera(pair[1]), posed.position)
    shift = np.stack([np.zeros_like(across), across])
    offsets = pixel * np.arange(-FARTHEST, FARTHEST + 1)
    found = sweep(texels, [replace(posed, shift=shift)], offsets, WINDOW, [((0, 0), (0, 1))])
    used = np.flatnonzero(found.precision > 0)
    if len(used) < FEWEST_TEXELS:
        return None
    way = interpolate(_movement(geometry, timestep), model.faces, texels.face[used], texels.weights[used])
    return _Sums.of(found.precision[used], (way * across[used]).sum(axis=1), found.offset[used])


def _offset(sums: Sequence[_Sums]) -> FrameOffset | None:
    """Slope of the shift over the movement; None where too few frames tell."""
    if len(sums) < FEWEST_FRAMES:
        return None
    table = np.array([(s.weight, s.movement, s.shift, s.squared, s.product) for s in sums])

    def slope(rows: NDArray) -> float:
        count, movement, shift, squared, product = rows.sum(axis=0)
        return float((count * product - movement * shift) / max(count * squared - movement**2, 1e-12))

    left_out = np.array([slope(np.delete(table, k, axis=0)) for k in range(len(table))])
    spread = np.sqrt((len(table) - 1) * np.mean((left_out - left_out.mean()) ** 2))
    return FrameOffset(slope(table), float(spread))
