"""The optimisation of stage 3: normals per texel against images, tied to their neighbours.

    E(x) = sum_images sum_texels w rho(|I - L(n(x))|) + w1 |Laplacian (n(x) - n0)|_1 + w2 |n(x) - n0 - aim|^2

over the tangent-plane offsets x of `core.bend`, by Gauss-Newton or by Adam. Shading is that of `appearance`;
derivatives are Dr.Jit's: forward mode for the two unknowns of a texel, reverse mode for Adam. All arrays stay with
Dr.Jit between iterations; the host reads one number per iteration, the energy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import aligned, vector
from mifit.appearance.image import Appearance, assemble
from mifit.appearance.occlusion import Occlusion
from mifit.progress import Progress, silent
from mifit.render.pairs import bend, bend_jacobian, conjugate_gradients, solve_blocks

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

    albedo, specular_albedo = vector(mi.Color3f, diffuse), mi.Float(aligned(specular))
    ambient = mi.Float(float(appearance.illumination.ambient))
    dr.make_opaque(ambient)
    shaders = [appearance.shader(view.normal, view.direction, occlusion, points) for view in views]

    def shade(n: Any, v: Any, view: int) -> Any:
        d, s = shaders[view](n, v)
        return assemble(ambient, albedo, d, specular_albedo, s)

    return shade


@dataclass(frozen=True)
class Refined:
    """Offsets (N, 2), how the solver ended, and energies per term before and after each iteration."""

    offsets: NDArray
    converged: bool
    energies: dict[str, list[float]] = field(default_factory=dict)

    @property
    def energy(self) -> float:
        """Total at the end."""
        return sum(values[-1] for values in self.energies.values())


class NormalProblem:
    """Normal refinement of N texels.

    Parameters
    ----------
    normals : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents in which corrections are smoothed and measured.
    neighbours : (N, 4)
        `core.bend.texel_neighbours`.
    views : sequence of NormalView
    shade : callable
        Shading of the texels' material.
    laplacian_weight, magnitude_weight : float
        w1, w2, for images in linear 0..1 and unit normals.
    huber : float
        Residual length from which the penalty grows linearly; infinite for plain least squares.
    aim : (N, 3), optional
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
        aim: NDArray | None = None,
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        self._count = len(normals)
        self._base = _frame(normals, tangents)
        self._near = [mi.UInt32(aligned(neighbours[:, i], np.uint32)) for i in range(4)]
        self._degree = sum(dr.select(n != dr.arange(mi.UInt32, self._count), mi.Float(1), 0) for n in self._near)
        self._views = [
            (
                vector(mi.Color3f, v.colour),
                mi.Float(aligned(v.weight)),
                vector(mi.Vector3f, v.direction),
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
        self._aim = vector(mi.Vector3f, np.zeros((self._count, 3)) if aim is None else aim)
        dr.eval(self._degree, self._aim)

    def energies(self, offsets: NDArray) -> dict[str, float]:
        """Energy per term at offsets (N, 2)."""
        return _totals(*self._terms(*self._load(offsets)))

    def normals(self, offsets: NDArray, view: int) -> NDArray[np.float32]:
        """(N, 3) refined normals in the frame of one view, world space."""
        return np.array(bend(self._views[view][3], *self._load(offsets))).T

    def gauss_newton(
        self,
        max_iterations: int = 20,
        tolerance: float = 1e-3,
        start: NDArray | None = None,
        progress: Progress = silent,
    ) -> Refined:
        """Minimise by Gauss-Newton with 2 x 2 blocks per texel.

        The L1 norm is replaced by its quadratic majorant at the current point (iteratively reweighted least squares);
        the joint system is solved by conjugate gradients with block-diagonal preconditioning. A step that raises the
        energy is taken back and damped (Levenberg-Marquardt). Ends when the energy falls by less than ``tolerance``,
        relative.
        """
        import drjit as dr

        a, b = self._facing(*self._load(None), *self._load(start))
        local, system = self._linearize(a, b)
        rough = self._rough(a, b)
        totals = _totals(local, rough)
        history = {name: [value] for name, value in totals.items()}
        damping, converged = self._zeros(), False
        for iteration in range(max_iterations):
            progress("normals", iteration, max_iterations)
            x, y = self._facing(a, b, *self._step(a, b, system, damping))
            found, new_system = self._linearize(x, y)
            # Data and magnitude are separable: a texel whose own energy rises stays, and steps shorter next time.
            worse = ~(sum(found.values()) <= 1.0001 * sum(local.values()) + 1e-9)  # also where it is NaN
            x, y = dr.select(worse, a, x), dr.select(worse, b, y)
            found = {name: dr.select(worse, local[name], value) for name, value in found.items()}
            new_rough = self._rough(x, y)
            after = _totals(found, new_rough)
            before = sum(totals.values())
            risen = sum(after.values()) > before
            damping = dr.select(worse | risen, dr.maximum(8.0 * damping, 0.05), 0.25 * damping)
            dr.eval(damping, x, y)
            if risen:
                continue
            system = tuple(dr.select(worse, old, new) for old, new in zip(system, new_system, strict=True))
            a, b, local, rough, totals = x, y, found, new_rough, after
            dr.eval(system, local)
            for name, value in totals.items():
                history[name].append(value)
            if before - sum(totals.values()) <= tolerance * before:
                converged = True
                break
        progress("normals", max_iterations, max_iterations)
        return Refined(_store(a, b), converged, history)

    def adam(
        self, iterations: int = 100, step: float = 0.01, start: NDArray | None = None, progress: Progress = silent
    ) -> Refined:
        """Minimise by Adam with learning rate ``step`` (radians): the paper's solver, on the same energy."""
        import drjit as dr
        import mitsuba as mi

        a, b = self._load(start)
        optimizer = mi.ad.Adam(lr=step, params={"a": a, "b": b})
        totals = []
        for iteration in range(iterations):
            x = optimizer["a"], optimizer["b"]
            total = dr.zeros(mi.Float, 1)
            for k in range(len(self._views)):  # one kernel, compiled once for all views
                total += _descend(self._data(*x, k))
                dr.eval(total, *(dr.grad(v) for v in x))
            total += _descend(self._magnitude(*x) + self._rough(*x))
            totals.append(total)
            optimizer.step()
            dr.eval(total, optimizer["a"], optimizer["b"])
            progress("normals (adam)", iteration + 1, iterations)
        a, b = self._facing(*self._load(None), dr.detach(optimizer["a"]), dr.detach(optimizer["b"]))
        found = _totals(*self._terms(a, b))
        history = {"total": [float(t[0]) for t in totals] + [sum(found.values())]}
        return Refined(_store(a, b), True, history)

    # Energy ---------------------------------------------------------------------------------------------------------

    def _terms(self, a: Any, b: Any) -> tuple[dict[str, Any], Any]:
        """Energy per texel: of the separable terms, and of the Laplacian's."""
        import drjit as dr
        import mitsuba as mi

        data = dr.zeros(mi.Float, self._count)
        for k in range(len(self._views)):
            data += self._data(a, b, k)
            dr.eval(data)
        return {"data": data, "magnitude": self._magnitude(a, b)}, self._rough(a, b)

    def _data(self, a: Any, b: Any, view: int) -> Any:
        """Energy of one view per texel."""
        import drjit as dr

        colour, weight, direction, frame = self._views[view]
        residual = colour - self._shade(bend(frame, a, b), direction, view)
        return self._penalty(weight, dr.squared_norm(residual))

    def _penalty(self, weight: Any, square: Any) -> Any:
        """Huber's penalty of a squared residual: r^2 up to k, 2 k r - k^2 beyond."""
        import drjit as dr

        if self._robust:
            length = dr.sqrt(dr.maximum(square, 1e-14))
            square = dr.select(length <= self._huber, square, self._huber * (2 * length - self._huber))
        return dr.select(weight > 0, weight * square, 0)

    def _magnitude(self, a: Any, b: Any) -> Any:
        import drjit as dr

        return self._w2 * dr.squared_norm(bend(self._base, a, b) - self._base[0] - self._aim)

    def _rough(self, a: Any, b: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        if not self._smooth:
            return dr.zeros(mi.Float, self._count)
        delta = bend(self._base, a, b) - self._base[0]
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

    def _linearize(self, a: Any, b: Any) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """Separable energies, and gradient (2) and Gauss-Newton Hessian (aa, ab, bb) of the data, per texel."""
        import drjit as dr
        import mitsuba as mi

        data, *out = (self._zeros() for _ in range(6))
        for k, (colour, weight, direction, frame) in enumerate(self._views):
            columns = []
            for i in range(2):
                x = [mi.Float(a), mi.Float(b)]
                dr.enable_grad(x[i])
                shading = self._shade(bend(frame, *x), direction, k)
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
        local = {"data": data, "magnitude": self._magnitude(a, b)}
        return local, tuple(out)

    def _step(self, a: Any, b: Any, system: tuple[Any, ...], damping: Any) -> tuple[Any, Any]:
        """Solve the linearised, majorised problem for a step of the offsets."""
        import drjit as dr

        ga, gb, haa, hab, hbb = system
        delta = bend(self._base, a, b) - self._base[0]
        ja, jb = bend_jacobian(self._base, a, b)
        # d/dx of w2 |delta - aim|^2
        pull = 2.0 * self._w2 * (delta - self._aim)
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

    def _facing(self, a: Any, b: Any, da: Any, db: Any) -> tuple[Any, Any]:
        """Take steps from offsets that face every camera that measures the texel, halved until the ends do too."""
        import drjit as dr

        finite = dr.isfinite(da) & dr.isfinite(db)
        da, db = dr.select(finite, da, 0), dr.select(finite, db, 0)
        for attempt in range(4):
            x, y = a + da, b + db
            good = x * x + y * y < 4.0  # a right angle
            for _, weight, direction, frame in self._views:
                good &= (weight <= 0) | (dr.dot(bend(frame, x, y), direction) >= FACING)
            factor = dr.select(good, 1.0, 0.5 if attempt < 3 else 0.0)
            da, db = da * factor, db * factor
        return a + da, b + db

    def _zeros(self) -> Any:
        """Zeros in memory: a literal would be folded into the kernel and make it another one to compile."""
        import drjit as dr
        import mitsuba as mi

        zeros = dr.zeros(mi.Float, self._count)
        dr.make_opaque(zeros)
        return zeros

    def _load(self, offsets: NDArray | None) -> tuple[Any, Any]:
        import mitsuba as mi

        if offsets is None:
            return self._zeros(), self._zeros()
        return tuple(mi.Float(aligned(offsets[:, i])) for i in range(2))  # type: ignore[return-value]


def residual_scale(views: Sequence[NormalView], shade: TexelShade) -> float:
    """Robust standard deviation of the residual's length at the base normals: 1.48 times the median."""
    import mitsuba as mi

    lengths = []
    for k, view in enumerate(views):
        shown = shade(vector(mi.Vector3f, view.normal), vector(mi.Vector3f, view.direction), k)
        residual = view.colour - np.array(mi.Color3f(shown)).T
        lengths.append(np.linalg.norm(residual, axis=1)[np.asarray(view.weight) > 0])
    every = np.concatenate(lengths) if lengths else np.zeros(0)
    return 1.48 * float(np.median(every)) if len(every) else 0.0


def _descend(energy: Any) -> Any:
    """Sum an energy and add its gradient to that of the variables it depends on."""
    import drjit as dr

    total = dr.sum(energy)
    dr.backward(total)
    return dr.detach(total)


def _totals(local: dict[str, Any], rough: Any) -> dict[str, float]:
    """Sums in double precision: millions of small terms, compared to a relative 1e-3 and less."""
    import drjit as dr

    terms = {**local, "laplacian": rough}
    dr.eval(terms)
    return {name: float(np.array(value, dtype=np.float64).sum()) for name, value in terms.items()}


def _frame(normals: NDArray, tangents: NDArray) -> tuple[Any, Any, Any]:
    import mitsuba as mi

    return tuple(vector(mi.Vector3f, v) for v in (normals, tangents[:, 0], tangents[:, 1]))  # type: ignore[return-value]


def _store(a: Any, b: Any) -> NDArray[np.float64]:
    return np.stack([np.array(a, dtype=np.float64), np.array(b, dtype=np.float64)], axis=1)
