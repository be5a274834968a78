"""An environment emitter in spherical harmonics as a Mitsuba plugin."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mifit.appearance.arrays import dr, mi
from mifit.core.sh import LUMINANCE, basis, order_of, quadrature
from mifit.errors import InputError

ROWS, COLUMNS = 64, 128
"""Cells of the table for importance sampling: equal steps of height z and azimuth, so all have the same solid angle."""

UNIFORM_SHARE = 0.1
"""Part of the samples that is spread evenly, so that no light is missed that lies between the cells' centres."""

MAX_BANDS = 10
"""Bands that Dr.Jit's ``sh_eval`` goes up to."""

CLAMPED_BANDS = 2
"""Bands to add when clamped radiance, which is no longer band limited, is projected for closed-form shading."""


def read_coefficients(value: ArrayLike) -> np.ndarray:
    """Coefficients (B*B, 3) from an array, or from text with all numbers in rows; InputError for another count."""
    if isinstance(value, str):
        try:
            numbers = np.array([float(word) for word in value.replace(",", " ").split()])
        except ValueError as error:
            raise InputError(f"shenv: coefficients: {error}; expected numbers, three per function") from None
        if len(numbers) % 3:
            raise InputError(f"shenv: coefficients: found {len(numbers)} numbers, expected three per function")
        array = numbers.reshape(-1, 3)
    else:
        array = np.array(value, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"shenv: coefficients: found shape {array.shape}, expected (B*B, 3)")
    order_of(array)
    if len(array) > MAX_BANDS**2:
        raise InputError(
            f"shenv: coefficients: found {len(array)}, expected at most {MAX_BANDS**2} ({MAX_BANDS} bands)"
        )
    if not np.isfinite(array).all():
        raise InputError("shenv: coefficients: found values that are not finite")
    return array


def make() -> type:
    """Define the plugin class for the current variant."""
    from mifit.appearance import kernels

    class SHEnvironment(mi.Emitter):
        r"""
        Spherical-harmonics environment (`shenv`)
        -----------------------------------------

        Distant light from all directions $\omega$, given by real spherical harmonics of radiance:

        $$L(\omega) = \mathrm{scale} \cdot \max\Big(0, \sum_{l < B} \sum_{|m| \le l} L_{lm} Y_{lm}(\omega)\Big)$$

        - `coefficients` (tensor or text, $(B^2, 3)$): $L_{lm}$ in row $l^2 + l + m$, radiance, linear Rec. 709
        - `to_world` (transform): rotation of the lighting; by default the axes of the basis are the world's
        - `scale` (float, default 1): factor on the radiance
        - `radius` (float, default 10000): radius of a sphere about the origin that holds the scene, in its units;
          `mifit.load_scene` sets it

        The basis is Dr.Jit's (`dr.sh_eval`: orthonormal, with the Condon-Shortley phase), $B$ up to 10. In a dictionary
        the coefficients are a `mi.TensorXf`; in XML a string with three numbers per function. Where the expansion is
        negative no light comes from; the derivative there is zero, as it is for the clamped value.

        Directions are sampled from a table of the clamped luminance (64 x 128 cells of equal solid angle) mixed with
        10 % uniform ones, rebuilt whenever the parameters change. `coefficients` and `scale` are differentiable.

        The `radius` is needed because emitters written in Python don't get the scene. It only has to be large
        enough. RGB variants only.
        """

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            if not mi.is_rgb or mi.is_polarized:
                raise InputError(f"shenv: found the variant {mi.variant()}, expected an RGB one")
            if "coefficients" not in props:
                raise InputError("shenv: found no 'coefficients', expected B*B rows of three numbers")
            array = read_coefficients(props["coefficients"])
            self.coefficients = mi.TensorXf(array.astype(np.float32))
            self.scale = mi.Float(props.get("scale", 1.0))
            self.radius = mi.Float(props.get("radius", 1e4))
            # XML gives a transform in double precision, a dictionary one in single: go through the matrix.
            matrix = np.array(props.get("to_world", mi.ScalarAffineTransform4f()).matrix, dtype=np.float64)
            self.to_world = mi.AffineTransform4f(mi.ScalarAffineTransform4f(matrix.astype(np.float32)))
            self._rotation = matrix[:3, :3]
            if not np.allclose(self._rotation @ self._rotation.T, np.eye(3), atol=1e-4):
                raise InputError(
                    "shenv: to_world: found a scale or shear, expected a rotation (about an axis of unit length)"
                )
            self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
            z = -1.0 + (np.arange(ROWS) + 0.5) * (2.0 / ROWS)
            phi = (np.arange(COLUMNS) + 0.5) * (2.0 * np.pi / COLUMNS)
            r = np.sqrt(1.0 - z * z)
            height = np.broadcast_to(z[:, None], (ROWS, COLUMNS))
            cells = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), height], axis=-1)
            self._cell_basis = basis(cells.reshape(-1, 3), order_of(array))
            self._projections: dict[int, tuple[mi.Vector3f, mi.Float]] = {}
            self._rebuild()

        def _rebuild(self) -> None:
            """Tabulate the clamped luminance; on the host, where it takes a millisecond."""
            array = np.array(dr.detach(self.coefficients), dtype=np.float64)
            if array.shape != (self._cell_basis.shape[1], 3):
                raise InputError(
                    f"shenv: coefficients: found shape {array.shape}, "
                    f"expected ({self._cell_basis.shape[1]}, 3) as loaded"
                )
            radiance = self._cell_basis @ array
            self.clamps = bool(radiance.min() < 0.0)
            luminance = np.maximum(radiance, 0.0) @ LUMINANCE
            total = luminance.sum()
            even = np.full(len(luminance), 1.0 / len(luminance))
            if np.isfinite(total) and total > 0.0:
                even = UNIFORM_SHARE * even + (1.0 - UNIFORM_SHARE) * luminance / total
            self._table = mi.DiscreteDistribution(even.astype(np.float32))

        @property
        def order(self) -> int:
            """Number of bands B."""
            return order_of(self.coefficients)

        def traverse(self, callback: mi.TraversalCallback) -> None:
            super().traverse(callback)
            callback.put("coefficients", self.coefficients, mi.ParamFlags.Differentiable)
            if dr.is_jit_v(mi.Float):  # a Python float can't be written through the callback
                callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
                callback.put("radius", self.radius, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str]) -> None:
            if not keys or "coefficients" in keys:
                self._rebuild()

        def radiance(self, direction: mi.Vector3f, points: int | None = None) -> mi.Color3f:
            """Clamped radiance from world directions; ``points`` is their number, see `kernels.colours`."""
            basis_there = kernels.sh_basis(self._to_local(direction), self.order)
            total = kernels.radiance(basis_there, kernels.colours(self.coefficients.array, self.order, points))
            return mi.Color3f(dr.maximum(total * self.scale, 0.0))

        def _to_local(self, direction: mi.Vector3f) -> mi.Vector3f:
            return self.to_world.inverse() @ mi.Vector3f(direction)

        def project(self) -> mi.Float:
            """Coefficients of the clamped radiance in world axes, flat (K*K*3), differentiable.

            They are the emitter's own where nothing is clamped, rotated to the world; otherwise the projection of the
            clamped radiance to ``CLAMPED_BANDS`` more bands, as far as there are so many.
            """
            order = min(self.order + CLAMPED_BANDS, MAX_BANDS) if self.clamps else self.order
            if not self.clamps and np.array_equal(self._rotation, np.eye(3)):
                return self.coefficients.array * self.scale
            count = ROWS if self.clamps else order
            if count not in self._projections:
                d, w = quadrature(count)
                matrix = (w[:, None] * basis(d, order)).T
                self._projections[count] = (
                    mi.Vector3f(np.ascontiguousarray(d.T, dtype=np.float32)),
                    mi.Float(np.ascontiguousarray(matrix, dtype=np.float32).ravel()),
                )
            nodes, matrix = self._projections[count]
            size = dr.width(nodes)
            values = self.radiance(nodes, size)
            dr.eval(values)  # for all three sums at once
            node = dr.arange(mi.UInt32, order * order * size) % size
            sums = [dr.block_sum(matrix * dr.gather(mi.Float, values[c], node), size) for c in range(3)]
            flat = dr.zeros(mi.Float, 3 * order * order)
            for c in range(3):
                dr.scatter(flat, sums[c], 3 * dr.arange(mi.UInt32, order * order) + c)
            return flat

        def _sample(self, sample: mi.Point2f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Float]:
            """A world direction and its density."""
            index, x = self._table.sample_reuse(sample.x, active)
            z = -1.0 + (2.0 / ROWS) * (mi.Float(index // COLUMNS) + x)
            phi = (2.0 * np.pi / COLUMNS) * (mi.Float(index % COLUMNS) + sample.y)
            r = dr.safe_sqrt(1.0 - dr.square(z))
            sine, cosine = dr.sincos(phi)
            d = self.to_world @ mi.Vector3f(r * cosine, r * sine, z)
            # Looked up again, so that rounding at a cell's edge can't make it differ from pdf_direction.
            return d, self._density(d, active)

        def _density(self, direction: mi.Vector3f, active: mi.Bool) -> mi.Float:
            d = self._to_local(direction)
            row = dr.clip(mi.Int32(dr.floor((d.z + 1.0) * (0.5 * ROWS))), 0, ROWS - 1)
            turn = dr.atan2(d.y, d.x) * (0.5 / np.pi)
            column = dr.clip(mi.Int32(dr.floor((turn - dr.floor(turn)) * COLUMNS)), 0, COLUMNS - 1)
            pmf = self._table.eval_pmf_normalized(mi.UInt32(row * COLUMNS + column), active)
            return dr.select(active, pmf * (ROWS * COLUMNS / (4.0 * np.pi)), 0.0)

        def eval(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            return dr.select(active, self.radiance(-si.wi), 0.0)

        def sample_direction(
            self, it: mi.Interaction3f, sample: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
            d, pdf = self._sample(sample, active)
            reach = 2.0 * dr.maximum(self.radius, dr.norm(mi.Vector3f(it.p)))
            ds = mi.DirectionSample3f()
            ds.uv = mi.Point2f(0.0)
            ds.p = dr.fma(d, reach, it.p)
            ds.n = -d
            ds.time = it.time
            ds.pdf = dr.select(active, pdf, 0.0)
            ds.delta = False
            ds.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
            ds.d = d
            ds.dist = reach
            return ds, dr.select(active, self.radiance(d) / pdf, 0.0)

        def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Float:
            return self._density(ds.d, active)

        def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: mi.Bool = True) -> mi.Spectrum:
            return dr.select(active, self.radiance(ds.d), 0.0)

        def sample_ray(
            self, time: mi.Float, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f, active: mi.Bool = True
        ) -> tuple[mi.Ray3f, mi.Spectrum]:
            d, pdf = self._sample(sample3, active)
            disk = mi.warp.square_to_uniform_disk_concentric(sample2)
            origin = self.radius * (mi.Frame3f(d).to_world(mi.Vector3f(disk.x, disk.y, 0.0)) + d)
            ray = mi.Ray3f(mi.Point3f(origin), -d, time, [])
            return ray, dr.select(active, self.radiance(d) * (np.pi * dr.square(self.radius)) / pdf, 0.0)

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return mi.ScalarBoundingBox3f()  # an environment has no extent

        def to_string(self) -> str:
            return (
                "SHEnvironment[\n"
                f"  order = {self.order},\n  scale = {self.scale},\n  radius = {self.radius},\n"
                f"  rotation = {self._rotation.tolist()}\n]"
            )

    return SHEnvironment
