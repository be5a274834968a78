"""The building blocks of the shading models as Dr.Jit functions, called by plugins and optimisers alike.

Everything that is linear in the lighting is a transfer vector: a list of B*B numbers per point whose dot product with
the SH coefficients of radiance (conventions of ``core.sh``) is the reflected radiance per unit of albedo.

All functions need an active variant; ``n`` and ``v`` are unit vectors, v towards the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import Jit, dr, mi
from mifit.appearance.lobe import EXPONENT_MAX, EXPONENT_MIN, Lobe, lobe_table
from mifit.core.sh import bands, cosine_coefficients
from mifit.errors import InputError


def sh_basis(d: Jit, order: int) -> list[Jit]:
    """The basis functions at unit directions, B*B of them."""
    return dr.sh_eval(d, order - 1)


def colours(flat: Jit, order: int, points: int | None = None) -> list[Jit]:
    """Flat coefficients (B*B*3) -> B*B colours for a number of ``points``, or inside a Dr.Jit loop (None).

    For points they are read four at a time, which compiles much faster. Those with a gradient are repeated for every
    point. Their values are the same, but the kernel that shades then sums the gradient over the points; values of width
    one take a kernel per number, each of which shades everything again.
    """
    size = 3 * order * order
    if not dr.is_jit_v(mi.Float):
        numbers = [flat[k] for k in range(size)]
    else:
        width = points if points and dr.grad_enabled(flat) else 1

        def read(kind: Jit, values: Jit, index: int) -> Jit:
            return dr.gather(kind, values, dr.full(mi.UInt32, index, width), mode=dr.ReduceMode.Expand)

        if points is None:
            numbers = [read(mi.Float, flat, k) for k in range(size)]
        else:
            filled = dr.concat((flat, dr.zeros(mi.Float, 4 - size % 4)))
            numbers = [x for k in range(-(-size // 4)) for x in read(mi.Vector4f, filled, k)]
    return [mi.Color3f(*numbers[k : k + 3]) for k in range(0, size, 3)]


def radiance(transfer: Sequence[Jit], coefficients: Sequence[Jit]) -> Jit:
    """Dot product of a transfer vector with SH coefficients (B*B colours)."""
    total = transfer[0] * coefficients[0]
    for t, c in zip(transfer[1:], coefficients[1:], strict=True):
        total = total + t * c
    return total


def diffuse_transfer(n: Jit, order: int) -> list[Jit]:
    """Transfer vector of a white Lambertian point: ``A_l / pi * Y_lm(n)``."""
    factors = cosine_coefficients(order)[bands(order)] / np.pi
    return [float(f) * y for f, y in zip(factors, sh_basis(n, order), strict=True)]


@dataclass(frozen=True)
class PreparedLobe:
    """A lobe on the device, ready to be prefiltered to ``order`` bands.

    ``polynomials`` has per moment of ``lobe.lobe_moments`` its Chebyshev coefficients in ``2 n.v - 1``; ``scale`` is a
    factor on the albedo, 1 for the normalised lobe. ``N (n . h)^m`` has the ``exponent`` m and the ``peak`` N. Without
    ``fresnel`` it is Blinn-Phong's; with a number it is the lobe that a view along the normal has, carried about the
    mirror direction whatever the view, times ``1 + fresnel (1 - n.v)^5``: what microfacet surfaces do.
    """

    order: int
    polynomials: list[list[Jit]]
    scale: Jit
    exponent: Jit
    peak: Jit
    fresnel: Jit = None


def prepare(lobe: Lobe, order: int) -> PreparedLobe:
    """Load a lobe."""
    if not lobe.exponent > 0:
        raise InputError(f"exponent: found {float(lobe.exponent)}, expected a number from 1 to 10000")
    y = 2.0 * np.log(np.clip(lobe.exponent, EXPONENT_MIN, EXPONENT_MAX)) / np.log(EXPONENT_MAX) - 1.0
    rows = np.polynomial.chebyshev.chebval(y, lobe_table(order).transpose(2, 0, 1))
    polynomials, exponent = [list(map(mi.Float, row)) for row in rows.tolist()], mi.Float(float(lobe.exponent))
    dr.make_opaque(polynomials, exponent)  # a kernel is compiled once, not once per exponent
    return _with_peak(order, polynomials, exponent, lobe.normalized, lobe.fresnel)


def prepare_exponent(exponent: Jit, order: int, normalized: bool = True, fresnel: Jit = None) -> PreparedLobe:
    """Prepare the lobe of a Dr.Jit exponent, differentiable and of any width."""
    table = lobe_table(order).tolist()
    m = dr.clip(exponent, EXPONENT_MIN, EXPONENT_MAX)
    t = _chebyshev(dr.log(m) * (2.0 / float(np.log(EXPONENT_MAX))) - 1.0, len(table[0][0]))
    polynomials = [[radiance(row, t) for row in moment] for moment in table]
    return _with_peak(order, polynomials, exponent, normalized, fresnel)


def _with_peak(order: int, polynomials: list[list[Jit]], exponent: Jit, normalized: bool, fresnel: Jit) -> PreparedLobe:
    peak = normalization(exponent)
    if normalized:
        return PreparedLobe(order, polynomials, 1.0, exponent, peak, fresnel)
    return PreparedLobe(order, polynomials, 1.0 / (dr.pi * peak), exponent, 1.0 / dr.pi, fresnel)


def _chebyshev(x: Jit, count: int) -> list[Jit]:
    """T_0 .. T_(count - 1) at x."""
    t = [1.0, x]
    for _ in range(2, count):
        t.append(2.0 * x * t[-1] - t[-2])
    return t[:count]


def normalization(exponent: Jit) -> Jit:
    """The normalised lobe's factor N(m), see ``lobe.normalization``."""
    return (exponent + 2.0) * (exponent + 4.0) / (8.0 * dr.pi * (exponent + dr.exp2(-0.5 * exponent)))


def fresnel_factor(cosine: Jit, fresnel: Jit) -> Jit:
    """Factor on the specular albedo towards grazing angles, Schlick's ``1 + fresnel (1 - cosine)^5``."""
    return 1.0 + fresnel * (1.0 - dr.clip(cosine, 0.0, 1.0)) ** 5


def carried_lobe(wi: Jit, wo: Jit, n: Jit, exponent: Jit) -> tuple[Jit, Jit]:
    """The lobe about the mirror direction for single directions, see ``appearance.lobe``.

    Returned are ``f / (C_s N(m))`` without the Fresnel factor, and the density of wo when ``((1 + r.wo) / 2)^(m/2)`` is
    sampled.
    """
    cos_i, cos_o = dr.dot(wi, n), dr.dot(wo, n)
    c = 2.0 * cos_i * cos_o - dr.dot(wi, wo)
    # The power of a floor instead of zero: its logarithm, and so the derivative by the exponent, stays finite.
    power = dr.power(dr.clip(0.5 + 0.5 * c, 1e-8, 1.0), 0.5 * exponent)
    value = power * dr.clip(c, 0.0, 1.0) * 2.0 / dr.maximum(cos_i + cos_o, 1e-6)
    return value, power * (exponent + 2.0) * (0.125 / float(np.pi))


def specular_transfer(n: Jit, v: Jit, lobe: PreparedLobe) -> list[Jit]:
    """Transfer vector of the lobe with unit specular albedo, prefiltered about its mean direction."""
    return lobe_transfer(lobe, *lobe_axis(n, v, lobe))


def lobe_axis(n: Jit, v: Jit, lobe: PreparedLobe) -> tuple[Jit, list[Jit]]:
    """Mean direction of the reflected lobe, and the lobe's moments."""
    cosine = dr.dot(n, v)
    mirror = 2.0 * cosine * n - v
    if lobe.fresnel is not None:
        moments = [sum(row[1:], row[0]) for row in lobe.polynomials]  # the polynomials at n.v = 1
        moments[0] = moments[0] * fresnel_factor(cosine, lobe.fresnel)
        return mirror, moments
    t = _chebyshev(2.0 * dr.clip(cosine, 0.0, 1.0) - 1.0, len(lobe.polynomials[0]))
    moments = [radiance(row, t) for row in lobe.polynomials]
    axis = mirror + moments[1] * (n - mirror)
    return axis * dr.rsqrt(dr.maximum(dr.squared_norm(axis), 1e-12)), moments


def lobe_transfer(lobe: PreparedLobe, axis: Jit, moments: list[Jit]) -> list[Jit]:
    """Transfer vector of the zonal lobe with these moments about an axis, see `lobe_axis`."""
    factors = lobe_factors(lobe, moments)
    return [factors[band] * y for band, y in zip(bands(lobe.order), sh_basis(axis, lobe.order), strict=True)]


def lobe_factors(lobe: PreparedLobe, moments: list[Jit]) -> list[Jit]:
    """Factors of the bands by which a lobe with these moments smooths light, see `lobe_axis`."""
    albedo = moments[0] * lobe.scale
    return [albedo, *(albedo * c for c in moments[2:])]


def constants(values: NDArray) -> list[Jit]:
    """Colours (K, 3) as inputs of kernels instead of constants in them, so that these are compiled once."""
    found = [mi.Color3f(*row) for row in values.tolist()]
    dr.make_opaque(found)
    return found


@dataclass(frozen=True)
class SmoothLight:
    """SH coefficients of radiance on the device, and how they change as directions turn, for its slopes.

    ``coefficients`` are B*B colours; ``turning`` has as many for each of three axes, see ``core.sh.turning``.
    """

    coefficients: list[Jit]
    turning: list[list[Jit]]

    def convolved(self, axis: Jit, factors: Sequence[Jit]) -> Jit:
        """Radiance (Color3f) about unit directions, convolved with the zonal kernel whose bands have these factors.

        Its gradient is that by the factors, and by the axis along the sphere: in closed form, from the same basis
        functions as the value.
        """
        at = dr.detach(axis)
        basis = sh_basis(at, len(factors))
        parts = [slice(band * band, (band + 1) ** 2) for band in range(len(factors))]
        light = radiance(factors, [radiance(basis[part], self.coefficients[part]) for part in parts])
        if dr.grad_enabled(axis):
            smoothed = [dr.detach(factor) * y for factor, part in zip(factors, parts, strict=True) for y in basis[part]]
            torque = [radiance(smoothed, each) for each in self.turning]
            for channel in range(3):
                slope = dr.cross(mi.Vector3f(*(each[channel] for each in torque)), at)
                light[channel] += dr.replace_grad(mi.Float(0.0), dr.dot(slope, axis))
        return light


def dominant_direction(coefficients: Sequence[Jit]) -> Jit:
    """Unit direction towards the brightest side, from the linear band (Sloan 2008).

    Lighting without a linear band has none: the result is (0, 0, 1) there, with finite derivatives.
    """
    if len(coefficients) < 4:
        return mi.Vector3f(0.0, 0.0, 1.0)
    y, z, x = (mi.luminance(mi.Color3f(c)) for c in coefficients[1:4])
    d = mi.Vector3f(-x, -y, z)
    length = dr.squared_norm(d)
    floor = 1e-10 * dr.square(dr.detach(mi.luminance(mi.Color3f(coefficients[0])))) + 1e-20
    return dr.select(length > floor, d * dr.rsqrt(dr.maximum(length, floor)), mi.Vector3f(0.0, 0.0, 1.0))


def direct_light(n: Jit, v: Jit, lobe: PreparedLobe, d: Jit) -> tuple[Jit, Jit]:
    """Radiance of a white diffuse and of a fully specular point under unit irradiance from a direction ``d``."""
    cosine, cosine_view = dr.maximum(dr.dot(n, d), 0.0), dr.dot(n, v)
    if lobe.fresnel is not None:
        # About the mirror direction: the half vector's cosine of a view along the normal is that of half the angle.
        off = dr.dot(2.0 * cosine_view * n - v, d)
        falloff = dr.maximum(off, 0.0) * dr.power(dr.clip(0.5 + 0.5 * off, 1e-6, 1.0), 0.5 * lobe.exponent)
        falloff *= fresnel_factor(cosine_view, lobe.fresnel)
    else:
        h = v + d
        cos_h = dr.dot(n, h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-8)))
        falloff = cosine * dr.power(dr.clip(cos_h, 1e-4, 1.0), lobe.exponent)
    return cosine / dr.pi, falloff * lobe.peak


def light_transfer(n: Jit, v: Jit, lobe: PreparedLobe, directions: Jit, count: Jit, visible: Jit) -> tuple[Jit, Jit]:
    """Radiance of a white diffuse and of a fully specular point per unit of a compact light's colour.

    Nothing here is band limited: cosine and lobe are those of the light's own directions, and shadows are traced.

    ``directions`` (3 * count, flat) stand for the light's extent; there are ``count`` (UInt32) of them, at most 32
    (``DistantLight.samples``). Bit d of ``visible`` is 1 where direction d is visible. A loop goes through them: a
    kernel with a copy of the lobe for each takes long to compile. It sums gradients by the normal too, where these are
    wanted; there is none by anything else.
    """
    sloped, at = dr.grad_enabled(n), dr.detach(n)

    def add(k: Jit, sums: list[Jit], slopes: list[Jit]) -> tuple[Jit, list[Jit], list[Jit]]:
        normal = mi.Vector3f(at)
        if sloped:
            dr.enable_grad(normal)
        seen, slopes = (visible >> k) & 1 != 0, list(slopes)
        reflected = direct_light(normal, v, lobe, dr.gather(mi.Vector3f, directions, k))
        for i, part in enumerate(reflected):
            if sloped:
                dr.set_grad(part, 1.0)
                dr.enqueue(dr.ADMode.Backward, part)
                dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearInput | dr.ADFlag.ClearInterior)
                slopes[i] = slopes[i] + dr.select(seen, dr.grad(normal), 0.0)
                dr.clear_grad(normal)
        sums = [total + dr.select(seen, dr.detach(part), 0.0) for total, part in zip(sums, reflected, strict=True)]
        return k + 1, sums, slopes

    start = mi.UInt32(0), [mi.Float(0.0), mi.Float(0.0)], [mi.Vector3f(0.0), mi.Vector3f(0.0)] if sloped else []
    _, sums, slopes = dr.while_loop(start, lambda k, *_: k < count, add, label="light")
    if sloped:
        sums = [dr.replace_grad(total, dr.dot(slope, n)) for total, slope in zip(sums, slopes, strict=True)]
    return sums[0] / count, sums[1] / count


def unoccluded(n: Jit, axis: Jit, traced: Sequence[Jit], order: int) -> Jit:
    """Part of the light from around an axis that shadows let through, 0..1, read off a traced transfer vector.

    The traced vector holds the product of visibility and cosine. Its value at the axis, relative to that of
    the unshadowed vector, is the visibility there as sharply as B bands can.
    """
    # By the addition theorem the unshadowed vector's value depends on the angle between normal and axis alone.
    legendre = np.polynomial.legendre.leg2poly(
        (2.0 * np.arange(order) + 1.0) / (4.0 * np.pi**2) * cosine_coefficients(order)
    )
    x, open_sky = dr.dot(n, axis), 0.0
    for factor in legendre[::-1].tolist():
        open_sky = open_sky * x + factor
    return dr.clip(radiance(traced, sh_basis(axis, order)) / dr.maximum(open_sky, 0.02), 0.0, 1.0)
