"""How an image is formed: a shading model, what lights the surface, its lobe, and what stands in the light's way.

The image of a point is ``ambient + albedo * diffuse + specular_albedo * specular``, with diffuse and specular radiance
at unit albedo from smooth and from compact lights. `form_image` is the only place that says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.appearance.arrays import (
    Jit,
    aligned,
    columns,
    dr,
    expect,
    mi,
    on_device,
    rows_on_device,
    stored,
    weighted_rows,
)
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.kernels import PreparedLobe, SmoothLight, constants, direct_light, light_transfer, prepare
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import Shade, ShadingModel
from mifit.appearance.occlusion import MeshPoints, OccludingMesh, Occlusion, VertexTransfer
from mifit.core.sh import turning
from mifit.errors import InputError

OPEN = Occlusion()


def form_image(ambient: Jit, albedo: Jit, diffuse: Jit, specular_albedo: Jit, specular: Jit) -> Jit:
    """The image of points, from diffuse and specular radiance at unit albedo; NumPy or Dr.Jit, shapes broadcast."""
    return ambient + albedo * diffuse + specular_albedo * specular


@dataclass(frozen=True)
class Appearance:
    """An image-formation model with all of its parameters but albedos."""

    model: ShadingModel
    illumination: Illumination
    lobe: Lobe

    @property
    def order(self) -> int:
        """Number of bands of the smooth light."""
        return self.illumination.order

    def trace(self, mesh: OccludingMesh, points: MeshPoints, seed: int = 0) -> Occlusion:
        """What of the mesh stands between points on it and the light, as far as this appearance asks."""
        return Occlusion.trace(mesh, points, self.illumination, seed, self.model.needs_shadows)

    def shade(
        self, normals: ArrayLike, view: ArrayLike, occlusion: Occlusion = OPEN
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (N, 3) of points at unit albedo, without ambient.

        ``normals`` and ``view`` (N, 3) are unit normals and unit directions towards the camera, world axes. Models that
        need no shadows and illumination without compact lights do without ``occlusion``. InputError for arrays of
        unequal lengths or wrong shapes, or shadows that are missing.
        """
        scene = _Scene(self, normals, view, occlusion)
        if not scene.count:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
        shade = scene.with_lights(lambda n, v: self.model.shade(n, v, scene.lobe, scene.coefficients, scene.shadowed))
        return scene.store(shade(scene.n, scene.v))

    def transfers(
        self, normals: ArrayLike, view: ArrayLike, occlusion: Occlusion = OPEN
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular transfer (N, K): radiance at unit albedo = matrix @ ``illumination.unknowns``.

        The first B*B columns belong to the SH coefficients, the others to the compact lights' colours. For models that
        turn with the lighting they are those of this illumination.
        """
        scene = _Scene(self, normals, view, occlusion)
        if not scene.count:
            empty = np.zeros((0, len(self.illumination.unknowns)), np.float32)
            return empty, empty
        found = self.model.transfer(scene.n, scene.v, scene.lobe, scene.coefficients, scene.shadowed)
        diffuse, specular = list(found.diffuse), [found.gain * t for t in found.specular]
        for light, visible in zip(self.illumination.lights, scene.visible, strict=True):
            d, s = scene.light(light, visible)(scene.n, scene.v)
            diffuse.append(d)
            specular.append(s)
        both = stored([*diffuse, *specular], scene.count)
        return both[:, : len(diffuse)], both[:, len(diffuse) :]

    def light_transfer(
        self, normals: ArrayLike, view: ArrayLike, directions: NDArray, visible: NDArray
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (M, N) at unit albedo per unit of irradiance from single directions.

        ``normals`` and ``view`` (N, 3) are as in `shade`, ``directions`` (M, 3) unit vectors; ``visible`` (M, N) bool
        says which of them each point sees.
        """
        dark = Appearance(self.model, Illumination.dark(1), self.lobe)
        scene = _Scene(dark, normals, view, Occlusion(), shadows=False)
        shape = len(directions), scene.count
        if not shape[0] * shape[1]:
            return np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        towards = mi.Float(aligned(directions).ravel())
        number = dr.arange(mi.UInt32, shape[0] * shape[1])
        count = dr.opaque(mi.UInt32, scene.count)
        light, point = number // count, number % count
        n, v = (dr.gather(mi.Vector3f, x, point) for x in (scene.n, scene.v))
        d = dr.gather(mi.Vector3f, towards, light)
        seen = mi.UInt(aligned(visible, np.uint32).ravel()) != 0
        reflected = direct_light(n, v, scene.lobe, d)
        both = stored([dr.select(seen, one, 0.0) for one in reflected], shape[0] * shape[1])
        return both[:, 0].reshape(shape), both[:, 1].reshape(shape)


def shade_bent(
    appearance: Appearance, base: ArrayLike, view: ArrayLike, occlusion: Occlusion, normals: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Diffuse and specular radiance (N, 3) at unit albedo of points whose normals are bent away from the mesh's.

    ``base`` (N, 3) are the mesh's unit normals, where shadows were traced, ``view`` (N, 3) unit directions towards the
    camera, ``normals`` (N, 3) the bent ones.
    """
    both = BentImage(appearance, base, view, occlusion)(normals)[0]
    return both[:, :3], both[:, 3:]


class BentImage:
    """The image of points by their normals, with all else held.

    ``base``, ``view`` and ``occlusion`` are as for `shade_bent`, ``albedos`` (N, 3) and (N,) diffuse and specular;
    without them an image has six channels, diffuse and specular radiance at unit albedo and without ambient.
    ``rotation`` (3, 3) takes the normals that are given later to world space.
    """

    def __init__(
        self,
        appearance: Appearance,
        base: ArrayLike,
        view: ArrayLike,
        occlusion: Occlusion,
        albedos: tuple[NDArray, NDArray] | None = None,
        rotation: ArrayLike = ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ) -> None:
        self._scene = _Scene(appearance, base, view, occlusion)
        self._shade = self._scene.shader() if self._scene.count else None
        self._albedos: tuple[Jit, Jit] | None = None
        if albedos is not None:
            albedo = on_device(mi.Color3f, expect(albedos[0], (self._scene.count, 3), "albedo"))
            self._albedos = albedo, mi.Float(aligned(expect(albedos[1], (self._scene.count,), "specular albedo")))
        self._rotation = [mi.Vector3f(*map(float, row)) for row in np.asarray(rotation)]
        self._ambient = dr.opaque(mi.Float, float(appearance.illumination.ambient))
        dr.make_opaque(self._rotation)

    def __call__(
        self, normals: ArrayLike, turns: Sequence[ArrayLike] = ()
    ) -> tuple[NDArray[np.float32], list[NDArray[np.float32]]]:
        """The image (N, channels), and its derivatives along each turn (N, 3) of the normals: all in one kernel."""
        count, channels = self._scene.count, 6 if self._albedos is None else 3
        if self._shade is None:
            return np.zeros((0, channels), np.float32), [np.zeros((0, channels), np.float32) for _ in turns]

        def world(vectors: ArrayLike, name: str) -> Jit:
            given = on_device(mi.Vector3f, expect(vectors, (count, 3), name))
            return mi.Vector3f(*(dr.dot(row, given) for row in self._rotation))

        n, angles = world(normals, "normals"), [dr.opaque(mi.Float, 0.0) for _ in turns]
        for angle, turn in zip(angles, turns, strict=True):
            dr.enable_grad(angle)
            n = n + angle * world(turn, "turn")
        image = self._image(n)
        values = list(dr.detach(image))
        for angle in angles:
            dr.set_grad(angle, 1.0)
            dr.enqueue(dr.ADMode.Forward, angle)
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior)
            values += dr.grad(image)
            dr.clear_grad(image)
        found = columns(values, count).reshape(-1, channels, count)
        return found[0].T, [slope.T for slope in found[1:]]

    def _image(self, n: Jit) -> list[Jit]:
        """The channels under normals."""
        assert self._shade is not None
        diffuse, specular = self._shade(n, self._scene.v)
        if self._albedos is None:
            return [*diffuse, *specular]
        return list(form_image(self._ambient, self._albedos[0], diffuse, self._albedos[1], specular))


class _Scene:
    """Points and an appearance on the device."""

    def __init__(
        self, appearance: Appearance, normals: ArrayLike, view: ArrayLike, occlusion: Occlusion, shadows: bool = True
    ) -> None:
        self.appearance, self.model = appearance, appearance.model
        illumination, order = appearance.illumination, appearance.order
        self.count = len(np.asarray(normals))
        shape = (self.count, 3)
        self.n, self.v = (
            on_device(mi.Vector3f, expect(x, shape, name)) for x, name in ((normals, "normals"), (view, "view"))
        )
        self.shadowed = None
        if shadows and self.count and self.model.needs_shadows:
            if occlusion.transfer is None:
                raise InputError(
                    f"shading model {self.model.name!r}: found no transfer vectors, expected those of trace_transfer"
                )
            self.shadowed = _read_transfer(occlusion.transfer, self.count, order)
        if len(occlusion.visible) != len(illumination.lights):
            raise InputError(
                f"compact lights: found visibility of {len(occlusion.visible)}, expected it of "
                f"{len(illumination.lights)}; trace it with Occlusion.trace"
            )
        self.visible = [mi.UInt(aligned(bits, np.uint32)) for bits in occlusion.visible]
        self.coefficients = constants(illumination.radiance)
        self.lobe: PreparedLobe = prepare(appearance.lobe, order)

    def shader(self) -> Shade:
        """Shading of bent normals, compact lights included."""
        turned = [constants(each) for each in turning(self.appearance.illumination.radiance)]
        light = SmoothLight(self.coefficients, turned)
        return self.with_lights(self.model.about(self.n, self.v, self.lobe, light, self.shadowed))

    def light(self, light: DistantLight, visible: Jit) -> Shade:
        """Radiance at unit albedo per unit of a light's colour, as a function of normal and view."""
        samples = light.samples()
        directions, count = mi.Float(aligned(samples).ravel()), dr.opaque(mi.UInt32, len(samples))
        return lambda n, v: light_transfer(n, v, self.lobe, directions, count, visible)

    def with_lights(self, smooth: Shade) -> Shade:
        """Add the compact lights to the shading by smooth light."""
        lights = self.appearance.illumination.lights
        if not lights:
            return smooth
        parts = [self.light(*pair) for pair in zip(lights, self.visible, strict=True)]
        colours = constants(np.array([light.colour for light in lights]))

        def shade(n: Jit, v: Jit) -> tuple[Jit, Jit]:
            diffuse, specular = smooth(n, v)
            for part, colour in zip(parts, colours, strict=True):
                d, s = part(n, v)
                diffuse, specular = diffuse + d * colour, specular + s * colour
            return diffuse, specular

        return shade

    def store(self, shaded: tuple[Jit, Jit]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Two colours -> two arrays (N, 3)."""
        d, s = (mi.Color3f(part) for part in shaded)
        both = stored([d.x, d.y, d.z, s.x, s.y, s.z], self.count)
        return both[:, :3], both[:, 3:]


def _read_transfer(transfer: VertexTransfer, count: int, order: int) -> list[Jit]:
    """B*B Floats of points."""
    size = order * order
    values = expect(transfer.values, (len(transfer.values), size), "shadowed transfer")
    weights = expect(transfer.weights, (count, 3), "shadowed transfer: weights")
    corners = [mi.UInt32(aligned(column, np.uint32)) for column in transfer.corners.T]
    return weighted_rows(rows_on_device(values), corners, [mi.Float(aligned(w)) for w in weights.T], size)
