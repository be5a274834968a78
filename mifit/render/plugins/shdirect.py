"""Closed-form shading of the first hit as a Mitsuba integrator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mifit.appearance.arrays import dr, mi
from mifit.core.arrays import Recent
from mifit.core.files import Document
from mifit.core.mesh import vertex_normals
from mifit.errors import InputError


def make() -> type:
    """Define the plugin class for the current variant."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    from mifit.appearance import kernels, models
    from mifit.appearance.arrays import aligned, rows_on_device, weighted_rows
    from mifit.appearance.formation import form_image
    from mifit.appearance.lobe import Lobe
    from mifit.appearance.occlusion import trace_transfer
    from mifit.render.first_hits import FirstHits, recording
    from mifit.render.gbuffer import MESH_FACES, MESH_POSITIONS, SurfaceScene

    class Nested(mi.TraversalCallback):
        """Collects what an object exposes: parameters and objects inside it."""

        def __init__(self) -> None:
            super().__init__()
            self.found: list[object] = []

        def put(self, name: str, value: object, flags: object) -> None:
            self.found.append(value)

    def at(values: mi.Float, index: mi.UInt32) -> mi.Float:
        """The entries of an array, whose only one may be that of all."""
        return values if dr.width(values) == 1 else dr.gather(type(values), values, index)

    class SHDirect(ADIntegrator):
        r"""
        Closed-form direct lighting (`shdirect`)
        ----------------------------------------

        Shades the first hit of `blinnphong` surfaces under one `shenv` in closed form, without sampling noise. Compact
        lights beside it, such as `directional` or a small `sphere` that emits, are shaded with shadows.

        - `model` (`paper`, `prefiltered`, `shadowed` or the name of another registered shading model, default
          `prefiltered`): how light becomes radiance, see below
        - `ambient` (float, default 0): $I_a$, added to every shaded point, linear radiance
        - `samples` (int, default 256): rays per vertex with which `shadowed` traces its transfer vectors
        - `bounce_albedo` (float, default 0): `shadowed` adds one diffuse interreflection with this albedo
        - `hide_emitters` (bool, default false): leave the background black

        With $E(n)$ the irradiance of the spherical harmonics, $v$ the view and $C_d, C_s, m$ from `blinnphong`:

        - `paper`: $I_a + C_d \frac{E(n)}{\pi} + C_s \frac{E(n)}{\pi\,(n \cdot d)} (n \cdot h)^m$ with the dominant
          direction $d$ of the lighting (Sloan 2008) and $h$ between $v$ and $d$. The quotient is guarded, see
          `mifit.appearance.models`. Always the plain lobe.
        - `prefiltered`: $I_a + C_d \frac{E(n)}{\pi} + C_s \sum_{lm} a\, c_l\, L_{lm} Y_{lm}(\bar r)$, the lobe
          convolved with the lighting about its mean direction $\bar r$; $a$ is its directional albedo and $c_l$ its
          Legendre factors for this angle and exponent. With `fresnel` those of the view along the normal, about the
          mirror direction, and $a$ rises as $1 + k\,(1 - n \cdot v)^5$.
        - `shadowed`: as before with transfer vectors per vertex that hold the scene's own shadows, traced once per
          geometry, and the lobe dimmed by the part of its light that they let through. Meshes only.

        Samples of a pixel lie on a fixed pattern, whatever the seed; one sample is the pixel's centre. Every parameter
        of `blinnphong` and `shenv`, and `ambient`, is differentiable; derivatives by geometry are those of the shading,
        without the motion of silhouettes and shadows. Clamped radiance is projected to two more bands.
        """

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.model = models.get(props.get("model", "prefiltered"))
            self.ambient = mi.Float(props.get("ambient", 0.0))
            self.samples = int(props.get("samples", 256))
            self.bounce_albedo = float(props.get("bounce_albedo", 0.0))
            self.hide = bool(props.get("hide_emitters", False))
            self._traced: Document = {}
            self._hits = FirstHits()
            self._lobes = Recent[kernels.PreparedLobe](8)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            if dr.is_jit_v(mi.Float):
                callback.put("ambient", self.ambient, mi.ParamFlags.Differentiable)

        def sample_rays(
            self, scene: mi.Scene, sensor: mi.Sensor, sampler: mi.Sampler
        ) -> tuple[mi.Ray3f, mi.Color3f, mi.Vector2f]:
            """Rays on a fixed pattern inside each pixel, the same for every pixel and seed."""
            film = sensor.film()
            size = film.crop_size()
            spp = sampler.sample_count()
            index = dr.arange(mi.UInt32, size[0] * size[1] * spp)
            pixel, k = index // dr.opaque(mi.UInt32, spp), mi.Float(index % dr.opaque(mi.UInt32, spp))
            corner = mi.Vector2f(pixel % size[0], pixel // size[0])
            shift = mi.Vector2f(0.5) + k * mi.Vector2f(0.7548776662466927, 0.5698402909980532)
            inside = shift - dr.floor(shift)
            with dr.resume_grad():
                ray, weight = sensor.sample_ray_differential(
                    time=sensor.shutter_open(),
                    sample1=0.5,
                    sample2=(corner + inside) / mi.Vector2f(size),
                    sample3=mi.Point2f(0.5),
                )
            self._hits.last = sensor, ray
            position = corner + mi.Vector2f(film.crop_offset())
            return ray, weight, position if film.rfilter().is_box_filter() else position + inside

        def render(
            self,
            scene: mi.Scene,
            sensor: mi.Sensor = 0,
            seed: mi.UInt32 = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> mi.TensorXf:
            """An image. Under a box filter each pixel is written once, which costs a fifth of adding samples to it."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            film = sensor.film()
            if not develop or not self._is_plain(film):
                return super().render(scene, sensor, seed, spp, develop, evaluate)
            with dr.suspend_grad():
                sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
                ray, weight, _ = self.sample_rays(scene, sensor, sampler)
                radiance, valid, _, _ = self.sample(dr.ADMode.Primal, scene, sampler, ray)
                channels = [*(radiance * weight), mi.Float(1.0)]
                if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
                    channels.insert(3, dr.select(valid, mi.Float(1.0), 0.0))
                width, height = film.crop_size()
                values = dr.zeros(mi.Float, width * height * len(channels))
                pixel = dr.arange(mi.UInt32, width * height) * len(channels)
                for k, channel in enumerate(channels):
                    mean = dr.block_sum(channel, spp) / spp if spp > 1 and dr.width(channel) > 1 else channel
                    dr.scatter(values, mean, pixel + k, mode=dr.ReduceMode.Permute)
                pixels = mi.TensorXf(values, (height, width, len(channels)))
                film.put_block(mi.ImageBlock(pixels, film.crop_offset(), film.rfilter()))
                return film.develop()

        def render_backward(
            self,
            scene: mi.Scene,
            params: mi.SceneParameters,
            grad_in: mi.TensorXf,
            sensor: mi.Sensor = 0,
            seed: mi.UInt32 = 0,
            spp: int = 0,
        ) -> None:
            """Gradients of all parameters, given those of the image.

            Under a box filter a pixel is the mean of its samples, so each sample's gradient is its pixel's, divided:
            the image itself, which Mitsuba's way forms once more, is not needed. Other filters go that way.
            """
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            film = sensor.film()
            if grad_in.shape[2] < 3 or not self._is_plain(film):
                super().render_backward(scene, params, grad_in, sensor, seed, spp)
                return
            with dr.suspend_grad():
                sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
                ray, weight, _ = self.sample_rays(scene, sensor, sampler)
                share = dr.opaque(mi.Float, 1.0 / spp)

                def given(samples: mi.UInt32) -> mi.Color3f:
                    """Gradients of samples."""
                    first = samples // dr.opaque(mi.UInt32, spp) * grad_in.shape[2]
                    entries = (dr.gather(mi.Float, grad_in.array, first + k) for k in range(3))
                    return mi.Color3f(*entries) * at(weight, samples) * share

                every = dr.arange(mi.UInt32, dr.width(ray))
                with dr.resume_grad():
                    index, value, behind, hit = self._seen(scene, ray, mi.Bool(True))
                    values = [(value, every if index is None else index)]
                    if behind is not None:
                        values.append((dr.select(hit, 0.0, behind), every))
                    values = [(value, samples) for value, samples in values if dr.grad_enabled(value)]
                    for value, samples in values:
                        dr.set_grad(value, given(samples))
                        dr.enqueue(dr.ADMode.Backward, value)
                    if values:
                        dr.traverse(dr.ADMode.Backward)
                dr.eval()

        def sample(
            self,
            mode: dr.ADMode,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.Ray3f,
            active: mi.Bool = True,
            **_: object,
        ) -> tuple[mi.Color3f, mi.Bool, list[mi.Float], None]:
            """Radiance along primary rays; plain automatic differentiation in every mode."""
            index, value, behind, hit = self._seen(scene, ray, active)
            if index is not None:
                radiance = dr.zeros(mi.Color3f, dr.width(hit))
                dr.scatter(radiance, value, index, mode=dr.ReduceMode.Permute)
                value = radiance
            if behind is not None:
                value = dr.select(hit, value, behind)
            return value, hit | (not self.hide), [], None

        def _is_plain(self, film: mi.Film) -> bool:
            """Is a pixel the mean of its own samples' radiance?"""
            special = dr.all(mi.has_flag(film.flags(), mi.FilmFlags.Special))
            return mi.is_rgb and not special and film.rfilter().is_box_filter()

        def _seen(
            self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool
        ) -> tuple[mi.UInt32 | None, mi.Color3f, mi.Color3f | None, mi.Bool]:
            """Numbers of the rays that meet something (None: one entry per ray), radiance there, behind, and which."""
            index, si = self._hits.find(scene, ray, active)
            behind = None if self.hide else self._emitters(scene)[0].radiance(ray.d, dr.width(ray))
            return index, self._shade(scene, si), behind, self._hits.hit(index, si, ray)

        def _shade(self, scene: mi.Scene, si: mi.SurfaceInteraction3f) -> mi.Color3f:
            """Radiance that leaves points of surfaces towards the camera; nothing where there is none."""
            emitter, compact = self._emitters(scene)
            flat = emitter.project()
            order = round((dr.width(flat) // 3) ** 0.5)
            coefficients = kernels.colours(flat, order, dr.width(si))
            hit, view = si.is_valid(), si.to_world(si.wi)
            radiance = mi.Color3f(0.0)
            traced = self._transfer(scene, si, hit, order) if self.model.needs_shadows else None
            for lobe, front, diffuse, specular, normal in self._surfaces(scene, si, hit, order):
                shaded = self.model.shade(normal, view, lobe, coefficients, traced)
                image = form_image(self.ambient, diffuse, shaded[0], specular, shaded[1])
                radiance = dr.select(front, image, radiance)
            for light in compact:
                radiance += self._direct(scene, light, si, hit)
            return radiance

        def _surfaces(
            self, scene: mi.Scene, si: mi.SurfaceInteraction3f, hit: mi.Bool, order: int
        ) -> Iterator[tuple[kernels.PreparedLobe, mi.Bool, mi.Color3f, mi.Color3f, mi.Vector3f]]:
            """Per lobe, the points that have it and face the viewer, their albedos, and their normals.

            Shading is most of a kernel, so that surfaces of the same lobe are shaded together.
            """
            lobes: dict[tuple[bool, bool, float | None], tuple] = {}
            pointers = si.bsdf()
            for bsdf, pointer, two_sided in self._bsdfs(scene):
                own = hit & (pointers == pointer)
                local = mi.SurfaceInteraction3f(si)
                flipped = own & (si.wi.z < 0.0) & two_sided
                local.wi.z = dr.select(flipped, -si.wi.z, si.wi.z)
                diffuse, specular, exponent, fresnel, n = bsdf.parameters(local, own)
                front, cosine = own & (local.wi.z > 0.0), dr.dot(local.wi, n)
                specular = mi.Color3f(dr.select(cosine > 0.0, specular, 0.0))
                if not self.model.normalized:
                    fresnel = None
                if fresnel is not None:
                    # The shading brings the Fresnel factor; here is only where it stops.
                    factor = kernels.fresnel_factor(cosine, fresnel)
                    specular = bsdf.at_angle(diffuse, specular, fresnel, cosine) / factor
                n.z = dr.select(flipped, -n.z, n.z)
                normal = mi.Vector3f(si.sh_frame.to_world(n))
                same = dr.width(exponent) == 1 and not dr.grad_enabled(exponent) and not recording()
                value = float(np.ravel(exponent)[0]) if same else None
                lobe = self.model.normalized and bsdf.normalized, fresnel is None, value
                found = front, diffuse, specular, normal, exponent, 0.0 if fresnel is None else fresnel
                if lobe in lobes:
                    found = dr.select(front, found, lobes[lobe])
                lobes[lobe] = found
            for (normalized, plain, value), (front, *albedos, normal, exponent, fresnel) in lobes.items():
                prepared = self._lobe(exponent, value, order, normalized)
                yield replace(prepared, fresnel=None if plain else fresnel), front, *albedos, normal

        def _lobe(self, exponent: mi.Float, value: float | None, order: int, normalized: bool) -> kernels.PreparedLobe:
            """The lobe of an exponent, prepared once where all points share its value."""
            if value is None:
                return kernels.prepare_exponent(exponent, order, normalized)
            return self._lobes.get(
                (value, order, normalized),
                lambda: kernels.prepare(Lobe(value, normalized=normalized), order),
            )

        def _emitters(self, scene: mi.Scene) -> tuple[mi.Emitter, list[mi.Emitter]]:
            """The scene's `shenv`, of which there is one, and its other emitters, none of them an environment."""
            emitters = scene.emitters()
            smooth = [e for e in emitters if type(e).__name__ == "SHEnvironment"]
            others = [e for e in emitters if type(e).__name__ != "SHEnvironment"]
            if len(smooth) != 1 or any(e.is_environment() for e in others):
                found = ", ".join(type(e).__name__ for e in emitters) or "none"
                raise InputError(
                    f"shdirect: found emitters {found}, expected exactly one shenv, and no other environment"
                )
            return smooth[0], others

        def _direct(
            self, scene: mi.Scene, light: mi.Emitter, si: mi.SurfaceInteraction3f, active: mi.Bool
        ) -> mi.Color3f:
            """What the points reflect of a compact light that they see, averaged over a fixed pattern on it."""
            context, bsdf = mi.BSDFContext(), si.bsdf()
            count = 1 if mi.has_flag(light.flags(), mi.EmitterFlags.Delta) else 16
            total = mi.Color3f(0.0)
            for k in range(count):
                at = mi.Point2f((k + 0.5) / count, (k * 0.6180339887498949 + 0.5) % 1.0)
                ds, weight = light.sample_direction(si, at, active)
                lit = active & (ds.pdf != 0.0)
                lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
                total += dr.select(lit, bsdf.eval(context, si, si.to_local(ds.d), lit) * weight, 0.0)
            return total / count

        def _bsdfs(self, scene: mi.Scene) -> list[tuple[mi.BSDF, mi.BSDFPtr, bool]]:
            """The scene's `blinnphong` objects, the pointers that surfaces carry, and whether they are two-sided."""
            result: dict[int, tuple[mi.BSDF, mi.BSDFPtr, bool]] = {}
            for shape in scene.shapes():
                outer = shape.bsdf()
                bsdf, two_sided = outer, False
                if outer.class_name() == "TwoSidedBRDF":
                    nested = Nested()
                    outer.traverse(nested)
                    bsdf = next(o for o in nested.found if isinstance(o, mi.BSDF))
                    two_sided = True
                if type(bsdf).__name__ != "BlinnPhong":
                    raise InputError(
                        f"shdirect: shape '{shape.id()}': found the BSDF {bsdf.class_name()}, expected blinnphong"
                    )
                result[id(outer)] = (bsdf, mi.BSDFPtr(outer), two_sided)
            return list(result.values())

        def _transfer(
            self, scene: mi.Scene, si: mi.SurfaceInteraction3f, active: mi.Bool, order: int
        ) -> list[mi.Float]:
            """Traced transfer vectors at the hits, interpolated between vertices."""
            traced, face = self._traced_scene(scene.shapes(), order), mi.UInt32(si.prim_index)
            for shape, first in zip(scene.shapes(), traced["first_faces"], strict=True):
                face[si.shape == mi.ShapePtr(shape)] += dr.opaque(mi.UInt32, first)
            with dr.suspend_grad():
                corners = dr.gather(mi.Vector3u, traced["faces"], face, active)
                p0, p1, p2 = (dr.gather(mi.Point3f, traced["points"], corner, active) for corner in corners)
                e1, e2, q = p1 - p0, p2 - p0, si.p - p0
                a, b, c = dr.dot(e1, e1), dr.dot(e1, e2), dr.dot(e2, e2)
                d, e = dr.dot(q, e1), dr.dot(q, e2)
                area = dr.maximum(a * c - b * b, 1e-30)
                b1, b2 = (c * d - b * e) / area, (a * e - b * d) / area
            return weighted_rows(traced["transfer"], corners, (1.0 - b1 - b2, b1, b2), order * order)

        def _traced_scene(self, shapes: list[mi.Shape], order: int) -> Document:
            """Transfer vectors per vertex, points and faces of all shapes in a row; traced again where points moved."""
            if any(not shape.is_mesh() for shape in shapes):
                raise InputError("shdirect: model 'shadowed': found a shape that isn't a mesh, expected meshes only")
            buffers = [mi.traverse(shape)[MESH_POSITIONS] for shape in shapes]
            key = (order, *(buffer.index for buffer in buffers))
            if self._traced.get("key") != key:
                vertices = [np.array(dr.detach(buffer)).reshape(-1, 3) for buffer in buffers]
                faces = [np.array(mi.traverse(shape)[MESH_FACES]).reshape(-1, 3) for shape in shapes]
                normals = [
                    np.array(shape.vertex_normals_buffer()).reshape(-1, 3)
                    if shape.has_vertex_normals()
                    else vertex_normals(v, f)
                    for shape, v, f in zip(shapes, vertices, faces, strict=True)
                ]
                starts = np.cumsum([0, *map(len, vertices)])
                everything = np.concatenate([f + s for f, s in zip(faces, starts[:-1], strict=True)])
                points = np.concatenate(vertices)
                traced = trace_transfer(
                    SurfaceScene(points, everything),
                    points,
                    np.concatenate(normals),
                    order,
                    self.samples,
                    0,
                    self.bounce_albedo or None,
                )
                # The buffers are kept: while they live, no other one can have their index.
                self._traced = {
                    "key": key,
                    "buffers": buffers,
                    "transfer": rows_on_device(traced),
                    "points": mi.Float(aligned(points).ravel()),
                    "faces": mi.UInt32(aligned(everything, np.uint32).ravel()),
                    "first_faces": np.cumsum([0, *map(len, faces[:-1])]).tolist(),
                }
            return self._traced

        def to_string(self) -> str:
            return f"SHDirect[model = {self.model.name}, ambient = {self.ambient}]"

    return SHDirect
