"""Image formation in float64, as plain as it can be written: what every fast form is tested against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.appearance.lobe import Lobe, normalization, tabulated_moments
from mifit.core.sh import SHLighting, bands, basis, cosine_coefficients, order_of

Array = NDArray[np.float64]


def specular_brdf(
    light: ArrayLike, view: ArrayLike, normal: ArrayLike, exponent: ArrayLike, normalized: bool = True
) -> Array:
    """``N(m) (n . h)^m`` for unit vectors (..., 3) away from the surface; zero below the horizon."""
    li, v, n = (np.asarray(x, dtype=np.float64) for x in (light, view, normal))
    h = li + v
    h = h / np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-300)
    above = ((li * n).sum(-1) > 0) & ((v * n).sum(-1) > 0)
    lobe = np.maximum((h * n).sum(-1), 0.0) ** np.asarray(exponent, dtype=np.float64)
    return np.where(above, normalization(exponent, normalized) * lobe, 0.0)


def carried_brdf(
    light: ArrayLike,
    view: ArrayLike,
    normal: ArrayLike,
    exponent: ArrayLike,
    fresnel: ArrayLike,
    normalized: bool = True,
) -> Array:
    """The lobe carried about the mirror direction, Fresnel factor included; zero below the horizon."""
    li, v, n = (np.asarray(x, dtype=np.float64) for x in (light, view, normal))
    nl, nv, lv = (li * n).sum(-1), (v * n).sum(-1), (li * v).sum(-1)
    c = np.clip(2.0 * nl * nv - lv, 0.0, 1.0)
    half = np.sqrt(np.maximum(0.5 * (1.0 + lv), 0.0))  # h.v
    factor = 1.0 + np.asarray(fresnel) * (1.0 - half) ** 5
    lobe = (0.5 * (1.0 + c)) ** (0.5 * np.asarray(exponent, dtype=np.float64)) * c
    value = normalization(exponent, normalized) * factor * lobe * 2.0 / np.maximum(nl + nv, 1e-300)
    return np.where((nl > 0) & (nv > 0), value, 0.0)


def paper_light(
    normals: ArrayLike, view: ArrayLike, radiance: ArrayLike, exponent: float, guard: float
) -> tuple[Array, Array]:
    """Diffuse and specular radiance (N, 3) of the paper's model at unit albedo (section 5), its quotient guarded.

    Parameters
    ----------
    normals, view : (N, 3)
        Unit vectors, view towards the camera.
    radiance : (B*B, 3)
    exponent : float
    guard : float
        ``1 / (n . d)`` is ``c / (c^2 + guard^2)`` with ``c = max(n . d, 0)``, see ``appearance.models``.
    """
    n, v = (np.asarray(x, dtype=np.float64) for x in (normals, view))
    light = SHLighting(np.asarray(radiance))
    d, diffuse = light.dominant_direction(), light.irradiance(n) / np.pi
    h = v + d
    h = h / np.maximum(np.linalg.norm(h, axis=1, keepdims=True), 1e-300)
    c = np.maximum(n @ d, 0.0)
    return diffuse, diffuse * (np.maximum((n * h).sum(1), 0.0) ** exponent * c / (c**2 + guard**2))[:, None]


def prefiltered_light(normals: ArrayLike, view: ArrayLike, radiance: ArrayLike, lobe: Lobe) -> tuple[Array, Array]:
    """Diffuse and specular radiance (N, 3) of the prefiltered model at unit albedo; parameters as in `paper_light`."""
    n, v = (np.asarray(x, dtype=np.float64) for x in (normals, view))
    order = order_of(radiance)
    axis, factors = lobe_about(n, v, lobe, order)
    specular = (factors[bands(order)].T * basis(axis, order)) @ np.asarray(radiance)
    return SHLighting(np.asarray(radiance)).irradiance(n) / np.pi, specular


def shadowed_light(
    normals: ArrayLike, view: ArrayLike, radiance: ArrayLike, lobe: Lobe, transfer: ArrayLike
) -> tuple[Array, Array]:
    """As `prefiltered_light`, with traced transfer vectors (N, B*B) and the lobe dimmed by what they let through."""
    n, v = (np.asarray(x, dtype=np.float64) for x in (normals, view))
    order, traced = order_of(radiance), np.asarray(transfer, dtype=np.float64)
    axis, _ = lobe_about(n, v, lobe, order)
    y = basis(axis, order)
    open_sky = (basis(n, order) * (cosine_coefficients(order)[bands(order)] / np.pi) * y).sum(1)
    passed = np.clip((traced * y).sum(1) / np.maximum(open_sky, 0.02), 0.0, 1.0)
    _, specular = prefiltered_light(n, v, radiance, lobe)
    return traced @ np.asarray(radiance), specular * passed[:, None]


def compact_light(
    normals: ArrayLike, view: ArrayLike, directions: ArrayLike, visible: ArrayLike, lobe: Lobe
) -> tuple[Array, Array]:
    """Diffuse and specular radiance (N,) at unit albedo per unit of irradiance of a light from directions (D, 3).

    ``visible`` (N, D) tells which of them each point sees.
    """
    n, v, d = (np.asarray(x, dtype=np.float64) for x in (normals, view, directions))
    open_sky = np.asarray(visible, dtype=np.float64)
    cosine = np.maximum(n @ d.T, 0.0)
    if lobe.fresnel is None:
        reflected = np.stack(
            [specular_brdf(np.broadcast_to(w, n.shape), v, n, lobe.exponent, lobe.normalized) for w in d], axis=1
        )
        reflected = reflected * cosine
    else:
        # What leaves towards the eye is the lobe about the mirror direction, as prefiltering takes it.
        along = (n * v).sum(1)[:, None]
        c = np.clip((2.0 * along * n - v) @ d.T, 0.0, 1.0)
        reflected = normalization(lobe.exponent, lobe.normalized) * (0.5 * (1.0 + c)) ** (0.5 * lobe.exponent) * c
        reflected = reflected * (1.0 + lobe.fresnel * (1.0 - np.clip(along, 0.0, 1.0)) ** 5)
    return (open_sky * cosine).mean(1) / np.pi, (open_sky * reflected).mean(1)


def lobe_about(normals: Array, view: Array, lobe: Lobe, order: int) -> tuple[Array, Array]:
    """Mean directions (N, 3) of the reflected lobe, and its albedo times the Legendre factors of the bands (B, N)."""
    cosine = (normals * view).sum(1)
    mirror = 2.0 * cosine[:, None] * normals - view
    if lobe.fresnel is None:
        moments = tabulated_moments(order, cosine, lobe.exponent)
        axis = mirror + moments[1][:, None] * (normals - mirror)
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        albedo = moments[0]
    else:
        moments = tabulated_moments(order, np.ones_like(cosine), lobe.exponent)
        axis, albedo = mirror, moments[0] * (1.0 + lobe.fresnel * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5)
    scale = normalization(lobe.exponent, lobe.normalized) / normalization(lobe.exponent)
    return axis, scale * albedo * np.concatenate([np.ones((1, len(normals))), moments[2:]])
