"""A face under a whole environment map: nothing is band limited, so nothing rings and nothing is negative.

What is far brighter than the mean, such as the sun or a lamp, is cut into a few dozen distant lights of equal power
(median cut, Debevec 2005), whose cosine, lobe and shadows each point has of its own. The rest is soft:

*Diffuse*: what a mesh's vertices see of the sky and of one another (`reception`) is traced once per mesh and serves all
lights and rotations; points interpolate what the vertices receive.

*Specular*: a few directions of each point's lobe look up the environment blurred to the spacing of the directions
(filtered importance sampling, Křivánek and Colbert 2008). A direction that the mesh blocks shows the mesh.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import aligned, on_device, stored
from mifit.appearance.kernels import fresnel_factor, light_transfer, normalization, prepare_exponent
from mifit.appearance.lobe import Lobe
from mifit.appearance.reception import reception
from mifit.core.mesh import interpolate
from mifit.core.sh import LUMINANCE, latlong_directions, latlong_solid_angles

if TYPE_CHECKING:
    from mifit.appearance.occlusion import MeshPoints
    from mifit.render.gbuffer import SurfaceScene

LAMPS = 32
"""Lights that the bright part is cut into."""
SKY_ROWS = 64
"""Rows of the environment from which the soft part lights the mesh."""
BRIGHT = 8.0
"""Radiance over its mean from which light counts as bright."""
BOUNCES = 2
LOOKS = 16
"""Directions of the lobe."""
ROWS = 128
"""Rows of the environment that the lobe looks at."""
IRRADIANCE_ROWS = 32
"""Rows of the table of what normals receive."""
OFFSET = 1e-3
"""Distance by which rays start off the surface, relative to the mesh's diagonal."""


def cut(image: NDArray, count: int = LAMPS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cut a lat-long environment into regions of equal power.

    Parameters
    ----------
    image : (H, W, 3)
        Linear radiance, not negative; axes of ``core.sh.latlong_directions``.
    count : int
        Regions at the most; there are fewer where all are single pixels.

    Returns
    -------
    directions : (R, 3)
        Unit, towards the middle of each region's power.
    power : (R, 3)
        Radiance times solid angle.
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


class _Parts:
    """What no rotation changes of an environment, in the axes of its image."""

    def __init__(self, image: NDArray[np.float32]) -> None:
        self.image = image

    @cached_property
    def soft(self) -> NDArray[np.float32]:
        """(H, W, 3) the image without what is bright."""
        height, width = self.image.shape[:2]
        luminance = self.image @ LUMINANCE
        mean = float((luminance.mean(1) * np.ravel(latlong_solid_angles(height, width))).sum()) * width / (4.0 * np.pi)
        share = np.minimum(1.0, BRIGHT * mean / np.maximum(luminance, 1e-30))[..., None]
        return (self.image * share).astype(np.float32)

    @cached_property
    def lamps(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions and powers that stand for the rest; none where nothing is bright."""
        bright = self.image - self.soft
        return cut(bright, LAMPS) if bright.any() else (np.zeros((0, 3)), np.zeros((0, 3)))

    @cached_property
    def sky(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions and powers of the soft part."""
        return self._sampled(SKY_ROWS)

    @cached_property
    def irradiance(self) -> NDArray[np.float32]:
        """(H, W, 3) of a surface in each direction to which all of the soft part is open."""
        toward, power = self._sampled(IRRADIANCE_ROWS)
        table = np.maximum(toward @ toward.T, 0.0) @ power
        return table.reshape(IRRADIANCE_ROWS, 2 * IRRADIANCE_ROWS, 3).astype(np.float32)

    def _sampled(self, rows: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        small = cv2.resize(self.soft, (2 * rows, rows), interpolation=cv2.INTER_AREA).astype(np.float64)
        angles = np.reshape(latlong_solid_angles(rows, 2 * rows), (rows, -1))
        return latlong_directions(rows, 2 * rows).reshape(-1, 3), (small * angles[..., None]).reshape(-1, 3)


_last: list[_Parts] = []


def _parts(image: NDArray[np.float32]) -> _Parts:
    """Those of an image; kept until another one is asked for, since lights are turned one after the other."""
    if not _last or _last[0].image is not image:
        _last[:] = [_Parts(image)]
    return _last[0]


@dataclass(frozen=True)
class EnvironmentLight:
    """A lat-long environment turned by a rotation: what came from d comes from R d.

    Attributes
    ----------
    image : (H, W, 3)
        Linear radiance.
    rotation : (3, 3)
    """

    image: NDArray[np.float32]
    rotation: NDArray[np.float64]

    def at_vertices(self, scene: SurfaceScene, albedo: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(V, 3) irradiance at a mesh's vertices with its own shadows and what it throws on itself.

        Parameters
        ----------
        scene : SurfaceScene
        albedo : (V, 3)
            Of the vertices.

        Returns
        -------
        soft, whole : (V, 3)
            Without and with what comes from the bright part directly.
        """
        mesh = reception(scene)
        toward, power = _parts(self.image).sky
        shaded = mesh.from_sky(toward @ self.rotation.T, power)
        direct = shaded + self._from_lamps(scene, mesh.normals)
        bounced = np.zeros_like(direct)
        for _ in range(BOUNCES):
            bounced = mesh.from_mesh((direct + bounced) * albedo / np.float32(np.pi))
        return shaded + bounced, direct + bounced

    def _from_lamps(self, scene: SurfaceScene, normals: NDArray) -> NDArray[np.float32]:
        """(V, 3) irradiance of the vertices by the bright part, with its shadows."""
        directions, power = self._lights()
        if not len(directions):
            return np.zeros((len(normals), 3), np.float32)
        bits = scene.open_towards(np.asarray(scene.vertices, dtype=np.float64), normals, directions)
        seen = (bits[:, None] >> np.arange(len(directions), dtype=np.uint32)) & 1
        return np.asarray((np.maximum(normals @ directions.T, 0.0) * seen) @ power, dtype=np.float32)

    def _lights(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World directions and powers that stand for the bright part."""
        directions, power = _parts(self.image).lamps
        return directions @ self.rotation.T, power

    def lamps(
        self, scene: SurfaceScene, points: MeshPoints, normals: NDArray, view: NDArray, lobe: Lobe
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (N, 3) at unit albedo from the bright part; parameters as in `shade`."""
        import drjit as dr
        import mitsuba as mi

        directions, power = self._lights()
        count = len(normals)
        if not len(directions) or not count:
            return np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
        bits = mi.UInt(aligned(scene.open_towards(points.position, points.normal, directions), np.uint32))
        n, v = (on_device(mi.Vector3f, x) for x in (normals, view))
        exponent = mi.Float(aligned(np.broadcast_to(np.asarray(lobe.exponent, np.float32), (count,))))
        prepared = prepare_exponent(exponent, 1, lobe.normalized, lobe.fresnel)
        toward = [mi.Vector3f(*map(float, d)) for d in directions]
        colours = [mi.Color3f(*map(float, c)) for c in power]
        dr.make_opaque(toward, colours)
        matt, glossy = mi.Color3f(0.0), mi.Color3f(0.0)
        for number, (d, colour) in enumerate(zip(toward, colours, strict=True)):
            diffuse, specular = light_transfer(n, v, prepared, [d], (bits >> number) & 1)
            matt, glossy = matt + diffuse * colour, glossy + specular * colour
        both = stored([matt.x, matt.y, matt.z, glossy.x, glossy.y, glossy.z], count)
        return both[:, :3], both[:, 3:]

    def bend(self, normals: NDArray, base: NDArray) -> NDArray[np.float32]:
        """(N, 3) irradiance at normals (N, 3) over that at others, where all of the soft part is seen."""
        import mitsuba as mi

        sky = _Sky(_parts(self.image).irradiance, self.rotation)
        bent, flat = (sky.eval(on_device(mi.Vector3f, n), True) for n in (normals, base))
        return stored([a / (b + 1e-12) for a, b in zip(bent, flat, strict=True)], len(normals))

    def specular(
        self,
        image: NDArray,
        scene: SurfaceScene,
        points: MeshPoints,
        normals: NDArray,
        view: NDArray,
        lobe: Lobe,
        radiosity: NDArray,
        group: tuple[NDArray, int] | None = None,
    ) -> NDArray[np.float32]:
        """(N, 3) specular radiance at unit specular albedo from a part of the environment.

        Parameters
        ----------
        image : (H, W, 3)
            The part: the soft one where lamps are beside it. A lobe sharper than the lamps' distance looks at all.
        scene : SurfaceScene
        points : MeshPoints
        normals, view : (N, 3)
            Unit; the normals may be bent away from the mesh's.
        lobe : Lobe
            With a Fresnel factor: the lobe about the mirror direction.
        radiosity : (V, 3)
            Radiance that the mesh's vertices reflect, seen where it blocks the environment.
        group : (N,) int and int, optional
            Number of each point among so many neighbours that are averaged later: they share the looks of one.
        """
        import drjit as dr
        import mitsuba as mi

        count = len(normals)
        if not count:
            return np.zeros((0, 3), np.float32)
        spacing = 8.0 * np.pi / ((lobe.typical + 2.0) * LOOKS)  # solid angle of a look at the lobe's peak
        sky = _Sky(blurred(image, spacing), self.rotation)
        n, v, base = (on_device(mi.Vector3f, x) for x in (normals, view, points.normal))
        exponent = mi.Float(aligned(np.broadcast_to(np.asarray(lobe.exponent, np.float32), (count,))))
        # Opaque: the kernel is compiled once, not once for every mesh and every turn of the light.
        offset = dr.opaque(mi.Float, OFFSET * _diagonal(scene))
        origin = on_device(mi.Point3f, points.position) + offset * base
        cosine = dr.dot(n, v)
        mirror = dr.normalize(2.0 * cosine * n - v)
        frame = mi.Frame3f(mirror)
        peak = normalization(exponent) if lobe.normalized else mi.Float(1.0 / np.pi)
        colours, indices = mi.Float(aligned(radiosity).ravel()), mi.UInt(aligned(scene.faces, np.uint32).ravel())
        total = mi.Color3f(0.0)
        number, sharing = (mi.Float(0.0), 1) if group is None else (mi.Float(aligned(group[0])), min(group[1], LOOKS))
        number -= sharing * dr.floor(number / sharing)
        looks = LOOKS // sharing
        for k in range(looks):
            # The density ((1 + c) / 2)^(m / 2) about the mirror direction, inverted; a golden spiral around it.
            look = number + k * sharing
            c = 2.0 * dr.power((look + 0.5) / LOOKS, 2.0 / (exponent + 2.0)) - 1.0
            around_sine, around = dr.sincos(look * float(np.pi * (3.0 - np.sqrt(5.0))))
            sine = dr.safe_sqrt(1.0 - c * c)
            d = frame.to_world(mi.Vector3f(sine * around, sine * around_sine, c))
            above = (dr.dot(d, base) > 0.0) & (c > 0.0)
            hit = scene.rays.ray_intersect_preliminary(mi.Ray3f(origin, d), active=above)
            blocked = above & hit.is_valid()
            seen = dr.select(blocked, _interpolated(hit, indices, colours, blocked), sky.eval(d, above))
            total += dr.select(above, seen * dr.maximum(c, 0.0), 0.0)
        scale = peak * (8.0 * np.pi) / ((exponent + 2.0) * looks)
        if lobe.fresnel is not None:
            scale = scale * fresnel_factor(cosine, lobe.fresnel)
        total *= scale
        return stored([total.x, total.y, total.z], count)

    def shade(
        self,
        scene: SurfaceScene,
        points: MeshPoints,
        normals: NDArray,
        view: NDArray,
        lobe: Lobe,
        albedo: NDArray,
        group: tuple[NDArray, int] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (N, 3) of points at unit albedo; ``albedo`` (V, 3) is that of the vertices.

        Shadows belong to the mesh; bent normals change what an open surface would receive. ``group`` as in `specular`.
        """
        soft, whole = self.at_vertices(scene, albedo)
        diffuse = interpolate(soft, scene.faces, points.face, points.barycentric) / np.float32(np.pi)
        radiosity = whole * albedo / np.float32(np.pi)
        specular = self.specular(_parts(self.image).soft, scene, points, normals, view, lobe, radiosity, group)
        matt, glossy = self.lamps(scene, points, normals, view, lobe)
        specular += glossy
        return (diffuse * self.bend(normals, points.normal) + matt).astype(np.float32), specular


def blurred(image: NDArray, solid_angle: float) -> NDArray[np.float32]:
    """The environment at `ROWS` rows, each pixel the mean over a round spot of a solid angle."""
    rows = ROWS
    small = cv2.resize(image, (2 * rows, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
    angles = np.reshape(latlong_solid_angles(rows, 2 * rows), (rows, -1))[:, 0]
    deviation = np.sqrt(solid_angle / (4.0 * np.pi))  # of a Gaussian with that equivalent area, radians
    pixel = np.pi / rows
    # Along the rows at their own scale, then across; weights by solid angle keep the poles from counting twice.
    out = np.empty_like(small)
    for row in range(rows):
        sine = max(np.sin(np.pi * (row + 0.5) / rows), 0.5 * pixel)
        frequency = np.fft.rfftfreq(2 * rows) * 2.0 * np.pi
        damp = np.exp(-0.5 * (min(deviation / (pixel * sine), rows) * frequency) ** 2)
        out[row] = np.fft.irfft(np.fft.rfft(small[row], axis=0) * damp[:, None], 2 * rows, axis=0)
    whole = np.concatenate([np.roll(out[::-1], rows, axis=1), out, np.roll(out[::-1], rows, axis=1)])
    weight = np.tile(np.concatenate([angles[::-1], angles, angles[::-1]])[:, None, None], (1, 2 * rows, 1))
    size = 2 * int(np.ceil(3.0 * deviation / pixel)) + 1
    kernel = cv2.getGaussianKernel(min(size, 2 * rows - 1), deviation / pixel)
    top = cv2.sepFilter2D((whole * weight).astype(np.float32), -1, np.ones(1), kernel)
    bottom = cv2.sepFilter2D(weight.astype(np.float32), -1, np.ones(1), kernel)
    bottom = bottom.reshape(len(whole), 2 * rows, 1)
    return np.maximum((top / np.maximum(bottom, 1e-12))[rows : 2 * rows], 0.0).astype(np.float32)


class _Sky:
    """A lat-long table (H, W, 3) on the device, turned by a rotation."""

    def __init__(self, table: NDArray, rotation: NDArray) -> None:
        import drjit as dr
        import mitsuba as mi

        # The poles' rows are doubled: what wraps around the image's sides must not wrap over its top.
        padded = np.concatenate([table[:1], table, table[-1:]])
        self._share = float(len(table) / len(padded))
        self._texture = mi.Texture2f(
            mi.TensorXf(padded), wrap_mode=dr.WrapMode.Repeat, filter_mode=dr.FilterMode.Linear
        )
        # Opaque: the kernel is compiled once, not once for every turn of the light.
        self._back = [[dr.opaque(mi.Float, float(x)) for x in row] for row in rotation.T]

    def eval(self, d: Any, active: Any) -> Any:
        """Colours in world directions; axes of ``core.sh.latlong_directions``."""
        import drjit as dr
        import mitsuba as mi

        x, y, z = (row[0] * d.x + row[1] * d.y + row[2] * d.z for row in self._back)
        across = dr.atan2(x, -z) * float(0.5 / np.pi)
        down = (dr.safe_acos(y) * float(1.0 / np.pi) - 0.5) * self._share + 0.5
        return mi.Color3f(self._texture.eval(mi.Point2f(across - dr.floor(across), down), active)[:3])


def _diagonal(scene: SurfaceScene) -> float:
    return float(np.linalg.norm(np.ptp(np.asarray(scene.vertices), axis=0)))


def _interpolated(hit: Any, indices: Any, colours: Any, active: Any) -> Any:
    """Vertex colours at a hit."""
    import drjit as dr
    import mitsuba as mi

    weights = (1.0 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
    total = mi.Color3f(0.0)
    for k, w in enumerate(weights):
        corner = dr.gather(mi.UInt, indices, hit.prim_index * 3 + k, active)
        total += w * mi.Color3f(*(dr.gather(mi.Float, colours, 3 * corner + c, active) for c in range(3)))
    return total
