"""A pinhole camera with a focal length along each axis as a Mitsuba plugin."""

from __future__ import annotations

from mifit.appearance.arrays import dr, mi
from mifit.errors import InputError


def make() -> type:
    """Define the plugin class for the current variant."""

    class Pinhole(mi.Sensor):
        r"""
        Pinhole camera (`pinhole`)
        --------------------------

        A calibrated camera whose pixels need not be square, which Mitsuba's `perspective` can't be. Through pixel
        $(x, y)$, counted from the film's top-left corner, goes the ray with direction

        $$d = \Big(-\frac{x - c_x}{f_x},\; -\frac{y - c_y}{f_y},\; 1\Big)$$

        in Mitsuba's camera axes (x left, y up, z forward).

        - `fx`, `fy` (float): focal lengths in pixels
        - `cx`, `cy` (float): principal point in pixels; the first pixel's centre is at 0.5
        - `to_world` (transform): camera axes to the world
        - `near_clip`, `far_clip` (float, defaults 0.01 and 10000): distances along z between which surfaces are seen

        The four numbers are differentiable as far as an integrator differentiates by its rays. With `fx` = `fy` the
        image is that of a `perspective`. Integrators that trace light towards the camera (`ptracer`) and those
        that sample its silhouettes (`prb_projective`) want a `perspective`.
        """

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            for name in ("fx", "fy", "cx", "cy"):
                if name not in props:
                    raise InputError(f"pinhole: found no '{name}', expected a number in pixels")
                setattr(self, name, mi.Float(float(props[name])))
            if min(float(props["fx"]), float(props["fy"])) <= 0.0:
                raise InputError(
                    f"pinhole: found focal lengths {props['fx']:g} and {props['fy']:g}, expected positive ones"
                )
            self.near = float(props.get("near_clip", 1e-2))
            self.far = float(props.get("far_clip", 1e4))

        def traverse(self, callback: mi.TraversalCallback) -> None:
            super().traverse(callback)
            if dr.is_jit_v(mi.Float):
                for name in ("fx", "fy", "cx", "cy"):
                    callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def sample_ray(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.Ray3f, mi.Color3f]:
            film = self.film()
            pixel = sample2 * mi.Vector2f(film.crop_size()) + mi.Vector2f(film.crop_offset())
            local = dr.normalize(mi.Vector3f((self.cx - pixel.x) / self.fx, (self.cy - pixel.y) / self.fy, 1.0))
            to_world = self.world_transform()
            d = to_world @ local
            ray = mi.Ray3f(to_world @ mi.Point3f(0.0) + d * (self.near / local.z), d, time, [])
            ray.maxt = (self.far - self.near) / local.z
            return ray, mi.Color3f(1.0)

        def sample_ray_differential(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.RayDifferential3f, mi.Color3f]:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            differential = mi.RayDifferential3f(ray)
            size = mi.Vector2f(self.film().crop_size())
            for axis, step in (("x", mi.Vector2f(1.0, 0.0)), ("y", mi.Vector2f(0.0, 1.0))):
                beside, _ = self.sample_ray(time, sample1, sample2 + step / size, sample3, active)
                setattr(differential, f"o_{axis}", beside.o)
                setattr(differential, f"d_{axis}", beside.d)
            differential.has_differentials = True
            return differential, weight

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f()  # a point that no scene has to hold

        def to_string(self) -> str:
            return f"Pinhole[fx = {self.fx}, fy = {self.fy}, cx = {self.cx}, cy = {self.cy}]"

    return Pinhole
