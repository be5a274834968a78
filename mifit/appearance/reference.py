"""Image formation in float64, as plain as it can be written: what every fast form is tested against."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.appearance.lobe import normalization

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
