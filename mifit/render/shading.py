"""The shading models as Dr.Jit functions: written once, called by the plugins and by the optimisers.

Everything that is linear in the lighting is a transfer vector: a list of B*B numbers per point whose dot product with
the SH coefficients of radiance (conventions of ``core.sh``) is the reflected radiance per unit of albedo.

Models
------
``paper``
    Ambient, SH irradiance, and the plain lobe ``(n . h)^m`` under one light in the dominant direction d of the
    lighting. Its strength is the local irradiance undone of its cosine, ``L(p) = shading(n) / (n . d)``, as in the
    paper, with the quotient replaced by ``shading * c / (c^2 + GUARD^2)`` with ``c = max(n . d, 0)``: equal to within
    4 % where n . d > 0.5, zero at the terminator instead of infinite, with a derivative below ``1 / GUARD^2``.
``prefiltered``
    The lobe convolved with the lighting, see ``core.blinn_phong``: no single light direction is needed.
``shadowed``
    Diffuse transfer vectors that were traced (``render.transfer``) instead of the unshadowed ones, and the
    prefiltered lobe dimmed by how much of the light from its direction the traced vector lets through.

All functions need an active variant; ``n`` and ``v`` are unit vectors, v towards the viewer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mifit.core import blinn_phong
from mifit.core.sh import bands, cosine_coefficients
from mifit.errors import InputError

MODELS = ("paper", "prefiltered", "shadowed")

GUARD = 0.1
"""Cosine between normal and dominant direction below which the paper's L(p) is faded out."""


def check_model(model: str) -> None:
    """Raise InputError unless the model is one of ``MODELS``."""
    if model not in MODELS:
        raise InputError(f"shading model: found {model!r}, expected one of {', '.join(MODELS)}")


def sh_basis(d: Any, order: int) -> list[Any]:
    """The basis functions at unit directions, B*B of them."""
    import drjit as dr

    return dr.sh_eval(d, order - 1)


def colours(flat: Any, order: int, width: int = 1) -> list[Any]:
    """Flat coefficients (B*B*3) -> B*B colours, repeated for ``width`` points.

    Repeated ones have the same values but a cheaper gradient: the sums over all points are taken in the kernel that
    shades, in copies per thread, whereas the gradient of values of width one is a kernel per number, each of which
    shades everything again.
    """
    import drjit as dr
    import mitsuba as mi

    if not dr.is_jit_v(mi.Float):
        return [mi.Color3f(*(flat[3 * k + c] for c in range(3))) for k in range(order * order)]

    def entry(index: int) -> Any:
        return dr.gather(mi.Float, flat, dr.full(mi.UInt32, index, width), mode=dr.ReduceMode.Expand)

    return [mi.Color3f(*(entry(3 * k + c) for c in range(3))) for k in range(order * order)]


def radiance(transfer: Sequence[Any], coefficients: Sequence[Any]) -> Any:
    """Dot product of a transfer vector with SH coefficients (B*B colours)."""
    total = transfer[0] * coefficients[0]
    for t, c in zip(transfer[1:], coefficients[1:], strict=True):
        total = total + t * c
    return total


def diffuse_transfer(n: Any, order: int) -> list[Any]:
    """Transfer vector of a white Lambertian point: ``A_l / pi * Y_lm(n)``."""
    factors = cosine_coefficients(order)[bands(order)] / np.pi
    return [float(f) * y for f, y in zip(factors, sh_basis(n, order), strict=True)]


@dataclass(frozen=True)
class Lobe:
    """The Blinn-Phong lobe of one exponent, or of one per point, ready to be prefiltered.

    Attributes
    ----------
    order : int
        Number of bands.
    polynomials : list of list
        Per moment of ``core.blinn_phong.lobe_moments`` its Chebyshev coefficients in ``2 n.v - 1``.
    scale : float or Float
        Factor on the albedo: 1 for the normalised lobe.
    exponent, peak : float or Float
        ``N (n . h)^m`` has the exponent m and the peak N.
    fresnel : float, Float or None
        None: Blinn-Phong as it is. A number: the lobe that a view along the normal has, carried about the mirror
        direction whatever the view, and rising as ``1 + fresnel (1 - n.v)^5``: what microfacet surfaces do.
    """

    order: int
    polynomials: list[list[Any]]
    scale: Any
    exponent: Any
    peak: Any
    fresnel: Any = None


def lobe(exponent: Any, order: int, normalized: bool = True, fresnel: Any = None) -> Lobe:
    """Prepare the lobe of an exponent: a Python float, or a Dr.Jit one (differentiable, of any width)."""
    import drjit as dr
    import mitsuba as mi

    table = blinn_phong.lobe_table(order).coefficients
    if isinstance(exponent, (int, float)):
        y = 2.0 * np.log(_clamped(exponent)) / np.log(blinn_phong.EXPONENT_MAX) - 1.0
        values = table @ np.polynomial.chebyshev.chebvander(y, table.shape[2] - 1).ravel()
        # Opaque: a kernel is compiled once, not once per exponent.
        polynomials = [[dr.opaque(mi.Float, float(a)) for a in row] for row in values]
        ratio = blinn_phong.normalization(exponent, normalized) / blinn_phong.normalization(exponent)
        peak = float(blinn_phong.normalization(exponent, normalized))
        own = (dr.opaque(mi.Float, float(value)) for value in (ratio, exponent, peak))
        return Lobe(order, polynomials, *own, fresnel)
    m = dr.clip(exponent, blinn_phong.EXPONENT_MIN, blinn_phong.EXPONENT_MAX)
    y = dr.log(m) * (2.0 / float(np.log(blinn_phong.EXPONENT_MAX))) - 1.0
    t = _chebyshev(y, table.shape[2])
    polynomials = [[_dot(row, t) for row in moment] for moment in table]
    if dr.width(exponent) == 1 and not dr.grad_enabled(exponent):
        dr.eval(polynomials)  # computed once; with a gradient it is cheaper per point, with one sum at the end
    peak = normalization(exponent)
    if normalized:
        return Lobe(order, polynomials, 1.0, exponent, peak, fresnel)
    return Lobe(order, polynomials, 1.0 / (dr.pi * peak), exponent, 1.0 / dr.pi, fresnel)


def _clamped(exponent: float) -> float:
    if not exponent > 0:
        raise InputError(f"exponent: found {exponent!r}, expected a number from 1 to 10000")
    return min(max(float(exponent), blinn_phong.EXPONENT_MIN), blinn_phong.EXPONENT_MAX)


def _chebyshev(x: Any, count: int) -> list[Any]:
    """T_0 .. T_(count - 1) at x."""
    t = [1.0, x]
    for _ in range(2, count):
        t.append(2.0 * x * t[-1] - t[-2])
    return t[:count]


def _dot(a: Sequence[Any], t: Sequence[Any]) -> Any:
    total = _scalar(a[0]) * t[0] + _scalar(a[1]) * t[1]
    for ai, ti in zip(a[2:], t[2:], strict=True):
        total = total + _scalar(ai) * ti
    return total


def _scalar(value: Any) -> Any:
    return float(value) if isinstance(value, np.floating) else value


def normalization(exponent: Any) -> Any:
    """The normalised lobe's factor N(m), see ``core.blinn_phong.normalization``."""
    import drjit as dr

    return (exponent + 2.0) * (exponent + 4.0) / (8.0 * dr.pi * (exponent + dr.exp2(-0.5 * exponent)))


def fresnel_rise(cosine: Any, fresnel: Any) -> Any:
    """Factor by which the specular albedo rises towards grazing angles, Schlick's ``1 + fresnel (1 - cosine)^5``."""
    import drjit as dr

    return 1.0 + fresnel * (1.0 - dr.clip(cosine, 0.0, 1.0)) ** 5


def carried_lobe(wi: Any, wo: Any, n: Any, exponent: Any) -> tuple[Any, Any]:
    """The lobe about the mirror direction for single directions, see ``core.blinn_phong``.

    Returns
    -------
    value, density
        ``f / (C_s N(m) rise)``, and the density of wo when ``((1 + r.wo) / 2)^(m/2)`` is sampled.
    """
    import drjit as dr

    cos_i, cos_o = dr.dot(wi, n), dr.dot(wo, n)
    c = 2.0 * cos_i * cos_o - dr.dot(wi, wo)
    # The power of a floor instead of zero: its logarithm, and so the derivative by the exponent, stays finite.
    power = dr.power(dr.clip(0.5 + 0.5 * c, 1e-8, 1.0), 0.5 * exponent)
    value = power * dr.clip(c, 0.0, 1.0) * 2.0 / dr.maximum(cos_i + cos_o, 1e-6)
    return value, power * (exponent + 2.0) * (0.125 / float(np.pi))


def specular_transfer(n: Any, v: Any, lobe: Lobe) -> list[Any]:
    """Transfer vector of the lobe with unit specular albedo, prefiltered about its mean direction."""
    return _lobe_transfer(lobe, *lobe_axis(n, v, lobe))


def lobe_axis(n: Any, v: Any, lobe: Lobe) -> tuple[Any, list[Any]]:
    """Mean direction of the reflected lobe, and the lobe's moments."""
    import drjit as dr

    cosine = dr.dot(n, v)
    mirror = 2.0 * cosine * n - v
    if lobe.fresnel is not None:
        moments = [sum(row[1:], row[0]) for row in lobe.polynomials]  # the polynomials at n.v = 1
        moments[0] = moments[0] * fresnel_rise(cosine, lobe.fresnel)
        return mirror, moments
    t = _chebyshev(2.0 * dr.clip(cosine, 0.0, 1.0) - 1.0, len(lobe.polynomials[0]))
    moments = [_dot(row, t) for row in lobe.polynomials]
    axis = mirror + moments[1] * (n - mirror)
    return axis * dr.rsqrt(dr.maximum(dr.squared_norm(axis), 1e-12)), moments


def _lobe_transfer(lobe: Lobe, axis: Any, moments: list[Any]) -> list[Any]:
    albedo = moments[0] * lobe.scale
    factors = [albedo, *(albedo * c for c in moments[2:])]
    return [factors[band] * y for band, y in zip(bands(lobe.order), sh_basis(axis, lobe.order), strict=True)]


def dominant_direction(coefficients: Sequence[Any]) -> Any:
    """Unit direction towards the brightest side, from the linear band (Sloan 2008).

    Lighting without a linear band has none: the result is (0, 0, 1) there, with finite derivatives.
    """
    import drjit as dr
    import mitsuba as mi

    if len(coefficients) < 4:
        return mi.Vector3f(0.0, 0.0, 1.0)
    y, z, x = (mi.luminance(mi.Color3f(c)) for c in coefficients[1:4])
    d = mi.Vector3f(-x, -y, z)
    length = dr.squared_norm(d)
    floor = 1e-10 * dr.square(dr.detach(mi.luminance(mi.Color3f(coefficients[0])))) + 1e-20
    return dr.select(length > floor, d * dr.rsqrt(dr.maximum(length, floor)), mi.Vector3f(0.0, 0.0, 1.0))


def paper_specular(n: Any, v: Any, direction: Any, exponent: Any) -> Any:
    """Factor by which the paper's specular term scales the shading: ``(n . h)^m / (n . d)``, guarded."""
    import drjit as dr

    c = dr.maximum(dr.dot(n, direction), 0.0)
    h = v + direction
    cos_h = dr.dot(n, h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-8)))
    # The power of a floor instead of zero: its logarithm, and so the derivative by the exponent, stays finite.
    power = dr.select(cos_h > 0.0, dr.power(dr.clip(cos_h, 1e-4, 1.0), exponent), 0.0)
    return power * c / (dr.square(c) + GUARD * GUARD)


def shade(
    n: Any,
    v: Any,
    coefficients: Sequence[Any],
    exponent: Any,
    model: str,
    normalized: bool = True,
    traced: Sequence[Any] | None = None,
    fresnel: Any = None,
) -> tuple[Any, Any]:
    """Radiance of a white diffuse and of a fully specular point under SH lighting.

    Parameters
    ----------
    n, v : Vector3f
        Unit normal, and unit direction towards the viewer.
    coefficients : B*B colours
        Radiance.
    exponent : float, Float or Lobe
        A prepared ``Lobe`` saves work where it is shared by calls (not for ``paper``).
    model : str
        One of ``MODELS``.
    normalized : bool
        Kind of lobe of the prefiltered models; ``paper`` always has the plain one.
    traced : B*B Floats, optional
        Shadowed diffuse transfer vectors; ``shadowed`` needs them.
    fresnel : float or Float, optional
        See ``Lobe``; not for ``paper``, nor where a prepared lobe is given.

    Returns
    -------
    diffuse, specular : Color3f
        To be multiplied by the albedos and added.
    """
    order = round(len(coefficients) ** 0.5)
    if model == "paper":
        shading = radiance(diffuse_transfer(n, order), coefficients)
        return shading, shading * paper_specular(n, v, dominant_direction(coefficients), exponent)
    prepared = exponent if isinstance(exponent, Lobe) else lobe(exponent, order, normalized, fresnel)
    axis, moments = lobe_axis(n, v, prepared)
    specular = radiance(_lobe_transfer(prepared, axis, moments), coefficients)
    if model == "prefiltered":
        return radiance(diffuse_transfer(n, order), coefficients), specular
    if traced is None:
        raise InputError("shading model 'shadowed': found no transfer vectors, expected those of trace_transfer")
    return radiance(traced, coefficients), specular * unoccluded(n, axis, traced, order)


def key_transfer(n: Any, v: Any, lobe: Lobe, directions: Sequence[Any], seen: Any) -> tuple[Any, Any]:
    """Radiance of a white diffuse and of a fully specular point per unit of a compact light's irradiance.

    Nothing is band limited here: cosine and lobe are those of the light's own directions, and shadows are traced.

    Parameters
    ----------
    n, v : Vector3f
    lobe : Lobe
    directions : sequence of Vector3f
        Directions that stand for the light's disc (``core.keylight``).
    seen : UInt
        Bit d tells whether direction d is visible (``SurfaceScene.open_towards``).

    Returns
    -------
    diffuse, specular : Float
    """
    import drjit as dr

    cosine_view = dr.dot(n, v)
    mirror = 2.0 * cosine_view * n - v
    peak, rise = lobe.peak, 1.0
    if lobe.fresnel is not None:
        rise = fresnel_rise(cosine_view, lobe.fresnel)
    diffuse, specular = 0.0, 0.0
    for number, d in enumerate(directions):
        visible = (seen & (1 << number)) != 0
        cosine = dr.maximum(dr.dot(n, d), 0.0)
        if lobe.fresnel is not None:
            # About the mirror direction: the half vector's cosine of a view along the normal is that of half the angle.
            off = dr.dot(mirror, d)
            falloff = dr.maximum(off, 0.0) * dr.power(dr.clip(0.5 + 0.5 * off, 1e-6, 1.0), 0.5 * lobe.exponent)
        else:
            h = v + d
            cos_h = dr.dot(n, h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-8)))
            falloff = cosine * dr.power(dr.clip(cos_h, 1e-4, 1.0), lobe.exponent)
        diffuse = diffuse + dr.select(visible, cosine, 0.0)
        specular = specular + dr.select(visible, falloff, 0.0)
    share = 1.0 / len(directions)
    return diffuse * (share / np.pi), specular * (share * peak * rise)


def unoccluded(n: Any, axis: Any, traced: Sequence[Any], order: int) -> Any:
    """Part of the light from around an axis that shadows let through, 0..1, read off a traced transfer vector.

    The traced vector holds the product of visibility and cosine. Its value at the axis, relative to that of
    the unshadowed vector, tells the visibility there as sharply as B bands can.
    """
    import drjit as dr

    y = sh_basis(axis, order)
    open_sky = radiance(diffuse_transfer(n, order), y)
    return dr.clip(radiance(traced, y) / dr.maximum(open_sky, 0.02), 0.0, 1.0)
