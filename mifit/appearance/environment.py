"""A face under a whole environment map, without tracing paths.

What is far brighter than the mean, such as the sun or a lamp, is cut into a few dozen distant lights of equal power
(median cut, Debevec 2005), whose cosine, lobe and shadows each point has of its own. The rest is smooth: its spherical
harmonics make the specular reflection, and what a mesh's vertices see of it and of one another (`reception`) the
diffuse one, with two bounces. That is traced once per mesh and serves all lights and rotations.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import dr, mi, on_device, stored
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.kernels import diffuse_transfer, radiance
from mifit.appearance.occlusion import MeshPoints
from mifit.appearance.reception import reception
from mifit.core.image import reduced
from mifit.core.mesh import interpolate
from mifit.core.sh import LUMINANCE, SHLighting, latlong_directions, latlong_solid_angles

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

LAMPS = 32
"""Lights that the bright part is cut into."""
BRIGHT = 8.0
"""Radiance over its mean from which light counts as bright."""
SKY_ROWS = 64
"""Rows of the environment from which the smooth part is projected, and lights the mesh."""
BOUNCES = 2


def illumination_of(image: NDArray[np.float32], order: int) -> Illumination:
    """A lat-long environment of linear radiance (H, W, 3) as B bands of its smooth part and lamps."""
    soft = smooth_part(image)
    bright = image - soft
    lamps = zip(*cut(bright), strict=True) if bright.any() else ()
    lights = tuple(DistantLight(toward, 0.0, power) for toward, power in lamps)
    return Illumination(SHLighting.from_envmap(reduced(soft, SKY_ROWS), order).coefficients, lights)


def smooth_part(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W, 3) an environment without what is bright."""
    height, width = image.shape[:2]
    luminance = image @ LUMINANCE
    mean = float((luminance.mean(1) * np.ravel(latlong_solid_angles(height, width))).sum()) * width / (4.0 * np.pi)
    share = np.minimum(1.0, BRIGHT * mean / np.maximum(luminance, 1e-30))[..., None]
    return (image * share).astype(np.float32)


def cut(image: NDArray, count: int = LAMPS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cut a lat-long environment (H, W, 3) into at most ``count`` regions of equal power; fewer where all are pixels.

    ``image`` holds linear radiance, not negative, on the axes of ``core.sh.latlong_directions``. Returned are unit
    directions (R, 3) towards the middle of each region's power, and that power (R, 3), radiance times solid angle.
    """
    height, width = image.shape[:2]
    angles = np.broadcast_to(np.reshape(latlong_solid_angles(height, width), (height, -1)), (height, width))
    colour = image.astype(np.float64) * angles[..., None]
    weight = colour @ LUMINANCE + 1e-9 * float((colour @ LUMINANCE).mean())
    sums = np.pad(weight.cumsum(0).cumsum(1), ((1, 0), (1, 0)))

    def entry(top: int, bottom: int, left: int, right: int) -> tuple[float, int, int, int, int]:
        inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        whole = bottom - top == 1 and right - left == 1  # a single pixel can't be cut
        return (np.inf if whole else -float(inside), top, bottom, left, right)

    regions = [entry(0, height, 0, width)]
    while len(regions) < count and regions[0][0] < 0:  # the most powerful region that can be cut
        _, top, bottom, left, right = heapq.heappop(regions)
        tall, wide = bottom - top, (right - left) * np.cos(np.pi * (0.5 * (top + bottom) / height - 0.5))
        if right - left > 1 and (wide >= tall or tall == 1):
            middle = left + _halfway(sums[bottom, left : right + 1] - sums[top, left : right + 1])
            halves = entry(top, bottom, left, middle), entry(top, bottom, middle, right)
        else:
            middle = top + _halfway(sums[top : bottom + 1, right] - sums[top : bottom + 1, left])
            halves = entry(top, middle, left, right), entry(middle, bottom, left, right)
        for half in halves:
            heapq.heappush(regions, half)
    toward = latlong_directions(height, width)
    directions, power = np.empty((len(regions), 3)), np.empty((len(regions), 3))
    for i, (_, top, bottom, left, right) in enumerate(regions):
        part = np.s_[top:bottom, left:right]
        mean = np.tensordot(weight[part], toward[part], axes=2)
        directions[i] = mean / max(float(np.linalg.norm(mean)), 1e-300)
        power[i] = colour[part].sum((0, 1))
    return directions, power


def _halfway(along: NDArray) -> int:
    """Where a cumulative sum is nearest to half of its range, neither first nor last."""
    target = 0.5 * (along[0] + along[-1])
    return int(np.clip(np.abs(along - target).argmin(), 1, len(along) - 2))


def diffuse_light(
    image: NDArray[np.float32],
    rotation: NDArray,
    lamps: Sequence[DistantLight],
    scene: SurfaceScene,
    points: MeshPoints,
    normals: NDArray,
    albedo: NDArray,
) -> NDArray[np.float32]:
    """(N, 3) diffuse radiance at unit albedo of points on a mesh, but for what comes from the lamps directly.

    ``image`` (H, W, 3) is a lat-long environment of linear radiance; what came from d comes from R d with the rotation
    R (3, 3). ``lamps`` are its bright part, turned. Unit ``normals`` (N, 3) may be bent away from the mesh's, which
    changes what an open surface would receive: shadows belong to the mesh. ``albedo`` (V, 3) is that of its vertices.
    """
    mesh, soft = reception(scene), smooth_part(image)
    small = reduced(soft, SKY_ROWS)
    power = small * latlong_solid_angles(*small.shape[:2])[:, None, None]
    toward = latlong_directions(*small.shape[:2]).reshape(-1, 3)
    shaded = mesh.from_sky(toward @ rotation.T, power.reshape(-1, 3))
    direct = shaded + _from_lamps(lamps, scene, mesh.normals)
    bounced = np.zeros_like(direct)
    for _ in range(BOUNCES):
        bounced = np.asarray(mesh.exchange @ ((direct + bounced) * albedo / np.float32(np.pi)), dtype=np.float32)
    received = interpolate((shaded + bounced) / np.float32(np.pi), scene.faces, points.face, points.barycentric)
    open_sky = SHLighting.from_envmap(small, 3).rotate(rotation)
    received *= _bend(open_sky, normals, points.normal)
    return received


def _bend(light: SHLighting, normals: NDArray, base: NDArray) -> NDArray[np.float32]:
    """(N, 3) irradiance at bent normals over that at the mesh's."""
    rows = [mi.Color3f(*map(float, row)) for row in light.coefficients]
    dr.make_opaque(rows)
    bent, open_sky = (radiance(diffuse_transfer(on_device(mi.Vector3f, n), 3), rows) for n in (normals, base))
    ratio = bent / dr.maximum(open_sky, 1e-12)
    return stored([ratio.x, ratio.y, ratio.z], len(normals))


def _from_lamps(lamps: Sequence[DistantLight], scene: SurfaceScene, normals: NDArray) -> NDArray[np.float32]:
    """(V, 3) irradiance of the vertices by lamps, with its shadows."""
    if not lamps:
        return np.zeros((len(normals), 3), np.float32)
    directions, power = (np.stack([getattr(lamp, name) for lamp in lamps]) for name in ("direction", "colour"))
    bits = scene.open_towards(np.asarray(scene.vertices, dtype=np.float64), normals, directions)
    visible = (bits[:, None] >> np.arange(len(directions), dtype=np.uint32)) & 1
    return np.asarray((np.maximum(normals @ directions.T, 0.0) * visible) @ power, dtype=np.float32)
