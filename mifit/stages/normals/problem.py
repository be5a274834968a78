"""The energy of stage 3: normals per texel against images, tied to their neighbours.

    E(x) = sum_images sum_texels w rho(|I - L(n(x))|) + w1 |Laplacian (n(x) - n0)|_1 + w2 |n(x) - n0 - prior|^2

over the tangent-plane offsets x of `core.uv`, with its linearisation. Shading is that of `appearance`; derivatives
are Dr.Jit's in forward mode, for the two unknowns of a texel. All arrays stay with Dr.Jit; the algebra of two unknowns
per texel (the chart of bent normals, 2 x 2 blocks, conjugate gradients) stands at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import aligned, on_device, stored
from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.occlusion import Occlusion

L1_FLOOR = 1e-4
"""Radians below which the L1 norm is rounded off: sqrt(c^2 + floor^2); its reweighting stays finite."""
FACING = 0.05
"""Smallest cosine between a refined normal and the direction to a camera that measures it."""


TexelShade = Callable[[Any, Any, int], Any]
"""Normals, view directions (Dr.Jit vectors), number of the view -> radiance (Color3f) of the texels."""


@dataclass(frozen=True)
class NormalView:
    """What one image says about N texels.

    Attributes
    ----------
    colour : (N, 3)
        Linear image colour.
    weight : (N,)
        Weight of the squared residual; 0 where the image doesn't measure the texel.
    direction : (N, 3)
        Unit vectors towards the camera.
    normal : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents when the image was taken, world space.
    """

    colour: NDArray
    weight: NDArray
    direction: NDArray
    normal: NDArray
    tangents: NDArray


def texel_shade(
    appearance: Appearance,
    diffuse: NDArray,
    specular: NDArray,
    views: Sequence[NormalView],
    occlusion: Occlusion,
    points: NDArray,
) -> TexelShade:
    """Shading of texels with albedos (N, 3) and (N,) by the model that stage 2 estimated them with.

    ``occlusion`` and ``points`` (N, 3) are those of the base normals, the same for all views.
    """
    import drjit as dr
    import mitsuba as mi

    albedo, specular_albedo = on_device(mi.Color3f, diffuse), mi.Float(aligned(specular))
    ambient = mi.Float(float(appearance.illumination.ambient))
    dr.make_opaque(ambient)
    shaders = [appearance.shader(view.normal, view.direction, occlusion, points) for view in views]

    def shade(n: Any, v: Any, view: int) -> Any:
        d, s = shaders[view](n, v)
        return form_image(ambient, albedo, d, specular_albedo, s)

    return shade


class NormalProblem:
    """Normal refinement of N texels.

    Parameters
    ----------
    normals : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents in which corrections are smoothed and measured.
    neighbours : (N, 4)
        `core.uv.texel_neighbours`.
    views : sequence of NormalView
    shade : callable
        Shading of the texels' material.
    laplacian_weight, magnitude_weight : float
        w1, w2, for images in linear 0..1 and unit normals.
    huber : float
        Residual length from which the penalty grows linearly; infinite for plain least squares.
    prior : (N, 3), optional
        Correction that the magnitude term pulls to; zero by default.
    """

    def __init__(
        self,
        normals: NDArray,
        tangents: NDArray,
        neighbours: NDArray,
        views: Sequence[NormalView],
        shade: TexelShade,
        laplacian_weight: float,
        magnitude_weight: float,
        huber: float = float("inf"),
        prior: NDArray | None = None,
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        self._count = len(normals)
        self._base = _frame(normals, tangents)
        self._near = [mi.UInt32(aligned(neighbours[:, i], np.uint32)) for i in range(4)]
        self._degree = sum(dr.select(n != dr.arange(mi.UInt32, self._count), mi.Float(1), 0) for n in self._near)
        self.views = [
            (
                on_device(mi.Color3f, v.colour),
                mi.Float(aligned(v.weight)),
                on_device(mi.Vector3f, v.direction),
                _frame(v.normal, v.tangents),
            )
            for v in views
        ]
        self._shade = shade
        self._smooth, self._robust = laplacian_weight > 0, huber < float("inf")
        # Opaque: kernels are compiled once, not once per value.
        self._w1 = dr.opaque(mi.Float, float(laplacian_weight))
        self._w2 = dr.opaque(mi.Float, float(magnitude_weight))
        self._huber = dr.opaque(mi.Float, float(huber))
        self._prior = on_device(mi.Vector3f, np.zeros((self._count, 3)) if prior is None else prior)
        dr.eval(self._degree, self._prior)

    def energies(self, offsets: NDArray) -> dict[str, float]:
        """Energy per term at offsets (N, 2)."""
        return term_totals(*self.terms(*self.load(offsets)))

    def normals(self, offsets: NDArray, view: int) -> NDArray[np.float32]:
        """(N, 3) refined normals in the frame of one view, world space."""
        return np.array(bent_normal(self.views[view][3], *self.load(offsets))).T

    # Energy ---------------------------------------------------------------------------------------------------------

    def terms(self, a: Any, b: Any) -> tuple[dict[str, Any], Any]:
        """Energy per texel: of the separable terms, and of the Laplacian's."""
        import drjit as dr
        import mitsuba as mi

        data = dr.zeros(mi.Float, self._count)
        for k in range(len(self.views)):
            data += self.data(a, b, k)
            dr.eval(data)
        return {"data": data, "magnitude": self.magnitude(a, b)}, self.roughness(a, b)

    def data(self, a: Any, b: Any, view: int) -> Any:
        """Energy of one view per texel."""
        import drjit as dr

        colour, weight, direction, frame = self.views[view]
        residual = colour - self._shade(bent_normal(frame, a, b), direction, view)
        return self._penalty(weight, dr.squared_norm(residual))

    def _penalty(self, weight: Any, square: Any) -> Any:
        """Huber's penalty of a squared residual: r^2 up to k, 2 k r - k^2 beyond."""
        import drjit as dr

        if self._robust:
            length = dr.sqrt(dr.maximum(square, 1e-14))
            square = dr.select(length <= self._huber, square, self._huber * (2 * length - self._huber))
        return dr.select(weight > 0, weight * square, 0)

    def magnitude(self, a: Any, b: Any) -> Any:
        """Energy of the corrections' length per texel."""
        import drjit as dr

        return self._w2 * dr.squared_norm(bent_normal(self._base, a, b) - self._base[0] - self._prior)

    def roughness(self, a: Any, b: Any) -> Any:
        """Energy of the corrections' Laplacian per texel."""
        import drjit as dr
        import mitsuba as mi

        if not self._smooth:
            return dr.zeros(mi.Float, self._count)
        delta = bent_normal(self._base, a, b) - self._base[0]
        dr.eval(delta)
        return self._w1 * dr.sum(dr.sqrt(dr.square(self._laplacian(delta)) + L1_FLOOR**2))

    def _laplacian(self, field_: Any) -> Any:
        """Graph Laplacian (degree minus adjacency) of a vector per texel; symmetric."""
        import drjit as dr

        out = 4.0 * field_
        for index in self._near:
            out -= dr.gather(type(field_), field_, index)
        return out

    # Gauss-Newton ---------------------------------------------------------------------------------------------------

    def linearize(self, a: Any, b: Any) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """Separable energies, and gradient (2) and Gauss-Newton Hessian (aa, ab, bb) of the data, per texel."""
        import drjit as dr
        import mitsuba as mi

        data, *out = (self.zeros() for _ in range(6))
        for k, (colour, weight, direction, frame) in enumerate(self.views):
            columns = []
            for i in range(2):
                x = [mi.Float(a), mi.Float(b)]
                dr.enable_grad(x[i])
                shading = self._shade(bent_normal(frame, *x), direction, k)
                dr.set_grad(x[i], 1.0)
                dr.enqueue(dr.ADMode.Forward, x[i])
                dr.traverse(dr.ADMode.Forward)
                columns.append(mi.Color3f(dr.grad(shading)))
            residual = colour - dr.detach(shading)
            square = dr.squared_norm(residual)
            data += self._penalty(weight, square)
            scale = 2.0 * weight
            if self._robust:
                scale *= dr.minimum(1.0, self._huber * dr.rsqrt(dr.maximum(square, 1e-14)))
            seen = weight > 0
            products = (
                -dr.dot(columns[0], residual),
                -dr.dot(columns[1], residual),
                dr.dot(columns[0], columns[0]),
                dr.dot(columns[0], columns[1]),
                dr.dot(columns[1], columns[1]),
            )
            for i, value in enumerate(products):
                out[i] += dr.select(seen, scale * value, 0)
            dr.eval(data, out)  # one kernel, compiled once for all views
        local = {"data": data, "magnitude": self.magnitude(a, b)}
        return local, tuple(out)

    def step(self, a: Any, b: Any, system: tuple[Any, ...], damping: Any) -> tuple[Any, Any]:
        """Solve the linearised, majorised problem for a step of the offsets."""
        import drjit as dr

        ga, gb, haa, hab, hbb = system
        delta = bent_normal(self._base, a, b) - self._base[0]
        ja, jb = bent_normal_jacobian(self._base, a, b)
        # d/dx of w2 |delta - prior|^2
        pull = 2.0 * self._w2 * (delta - self._prior)
        irls = None
        if self._smooth:
            # w |c| <= w / 2 (c^2 / |c0| + |c0|): the majorant's Hessian is w / |c0|.
            curvature = self._laplacian(delta)
            irls = self._w1 * dr.rsqrt(dr.square(curvature) + L1_FLOOR**2)
            tension = irls * curvature
            dr.eval(irls, tension)
            pull += self._laplacian(tension)
        ra, rb = -(ga + dr.dot(ja, pull)), -(gb + dr.dot(jb, pull))
        block = [
            haa + 2.0 * self._w2 * dr.dot(ja, ja),
            hab + 2.0 * self._w2 * dr.dot(ja, jb),
            hbb + 2.0 * self._w2 * dr.dot(jb, jb),
        ]
        lift = damping * (block[0] + block[2]) + 1e-12
        block[0] += lift
        block[2] += lift
        if irls is None:
            step = solve_blocks(block, ra, rb)
            dr.eval(step)
            return step
        diagonal = dr.square(self._degree) * irls
        for index in self._near:
            # Texels without a neighbour point to themselves; their share is already in the degree.
            other = dr.gather(type(irls), irls, index)
            diagonal += dr.select(index != dr.arange(type(index), self._count), other, 0)
        preconditioner = [
            block[0] + dr.dot(ja, diagonal * ja),
            block[1] + dr.dot(ja, diagonal * jb),
            block[2] + dr.dot(jb, diagonal * jb),
        ]
        dr.eval(ra, rb, block, preconditioner, ja, jb)

        def apply(sa: Any, sb: Any) -> tuple[Any, Any]:
            moved = ja * sa + jb * sb
            dr.eval(moved)
            tension = irls * self._laplacian(moved)
            dr.eval(tension)
            smooth = self._laplacian(tension)
            return (
                block[0] * sa + block[1] * sb + dr.dot(ja, smooth),
                block[1] * sa + block[2] * sb + dr.dot(jb, smooth),
            )

        return conjugate_gradients(apply, (ra, rb), lambda r: solve_blocks(preconditioner, *r))

    def facing(self, a: Any, b: Any, da: Any, db: Any) -> tuple[Any, Any]:
        """Take steps from offsets that face every camera that measures the texel, halved until the ends do too."""
        import drjit as dr

        finite = dr.isfinite(da) & dr.isfinite(db)
        da, db = dr.select(finite, da, 0), dr.select(finite, db, 0)
        for attempt in range(4):
            x, y = a + da, b + db
            good = x * x + y * y < 4.0  # a right angle
            for _, weight, direction, frame in self.views:
                good &= (weight <= 0) | (dr.dot(bent_normal(frame, x, y), direction) >= FACING)
            factor = dr.select(good, 1.0, 0.5 if attempt < 3 else 0.0)
            da, db = da * factor, db * factor
        return a + da, b + db

    def zeros(self) -> Any:
        """Zeros in memory: a literal would be folded into the kernel and make it another one to compile."""
        import drjit as dr
        import mitsuba as mi

        zeros = dr.zeros(mi.Float, self._count)
        dr.make_opaque(zeros)
        return zeros

    def load(self, offsets: NDArray | None) -> tuple[Any, Any]:
        """Offsets (N, 2), or zeros, on the device."""
        import mitsuba as mi

        if offsets is None:
            return self.zeros(), self.zeros()
        return tuple(mi.Float(aligned(offsets[:, i])) for i in range(2))  # type: ignore[return-value]


def residual_scale(views: Sequence[NormalView], shade: TexelShade) -> float:
    """Robust standard deviation of the residual's length at the base normals: 1.48 times the median."""
    import mitsuba as mi

    lengths = []
    for k, view in enumerate(views):
        shown = mi.Color3f(shade(on_device(mi.Vector3f, view.normal), on_device(mi.Vector3f, view.direction), k))
        residual = view.colour - stored([shown.x, shown.y, shown.z], len(view.colour))
        lengths.append(np.linalg.norm(residual, axis=1)[np.asarray(view.weight) > 0])
    every = np.concatenate(lengths) if lengths else np.zeros(0)
    return 1.48 * float(np.median(every)) if len(every) else 0.0


def term_totals(local: dict[str, Any], rough: Any) -> dict[str, float]:
    """Energy per term: sums in double precision: millions of small terms, compared to a relative 1e-3 and less."""
    import drjit as dr

    terms = {**local, "laplacian": rough}
    dr.eval(terms)
    return {name: float(np.array(value, dtype=np.float64).sum()) for name, value in terms.items()}


def _frame(normals: NDArray, tangents: NDArray) -> tuple[Any, Any, Any]:
    import mitsuba as mi

    return tuple(on_device(mi.Vector3f, v) for v in (normals, tangents[:, 0], tangents[:, 1]))  # type: ignore[return-value]


def stored_offsets(a: Any, b: Any) -> NDArray[np.float64]:
    """Offsets (N, 2) from the device."""
    return np.stack([np.array(a, dtype=np.float64), np.array(b, dtype=np.float64)], axis=1)


# Two unknowns per texel ---------------------------------------------------------------------------------------------


def bent_normal(frame: tuple[Any, Any, Any], a: Any, b: Any) -> Any:
    """The chart of `core.uv.bend`."""
    n, t1, t2 = frame
    p, q = 0.5 * a, 0.5 * b
    square = p * p + q * q
    return (t1 * (2.0 * p) + t2 * (2.0 * q) + n * (1.0 - square)) / (1.0 + square)


def bent_normal_jacobian(frame: tuple[Any, Any, Any], a: Any, b: Any) -> tuple[Any, Any]:
    """Derivatives of `bent_normal` by a and b."""
    n, t1, t2 = frame
    p, q = 0.5 * a, 0.5 * b
    scale = 1.0 / (1.0 + p * p + q * q)
    total = n + bent_normal(frame, a, b)
    return (t1 - total * p) * scale, (t2 - total * q) * scale


def solve_blocks(block: Sequence[Any], ra: Any, rb: Any) -> tuple[Any, Any]:
    """Solve symmetric 2 x 2 systems (aa, ab, bb)."""
    import drjit as dr

    scale = 1.0 / dr.maximum(block[0] * block[2] - block[1] * block[1], 1e-30)
    return (block[2] * ra - block[1] * rb) * scale, (block[0] * rb - block[1] * ra) * scale


def conjugate_gradients(
    apply: Callable[..., tuple[Any, Any]],
    right: tuple[Any, Any],
    precondition: Callable[[tuple[Any, Any]], tuple[Any, Any]],
    tolerance: float = 0.03,
    max_iterations: int = 60,
) -> tuple[Any, Any]:
    """Preconditioned conjugate gradients to a relative residual."""
    import drjit as dr

    def inner(p: tuple[Any, Any], q: tuple[Any, Any]) -> Any:
        return dr.sum(p[0] * q[0] + p[1] * q[1])

    x = (dr.zeros(type(right[0]), len(right[0])), dr.zeros(type(right[0]), len(right[0])))
    r, z = right, precondition(right)
    p, rz = z, inner(right, z)
    dr.eval(p, rz)
    goal = tolerance**2 * float(rz[0])
    for _ in range(max_iterations):
        q = apply(*p)
        alpha = rz / dr.maximum(inner(p, q), 1e-30)
        x = (x[0] + alpha * p[0], x[1] + alpha * p[1])
        r = (r[0] - alpha * q[0], r[1] - alpha * q[1])
        z = precondition(r)
        before, rz = rz, inner(r, z)
        beta = rz / dr.maximum(before, 1e-30)
        p = (z[0] + beta * p[0], z[1] + beta * p[1])
        dr.eval(x, r, p, rz)
        if float(rz[0]) <= goal:
            break
    return x
