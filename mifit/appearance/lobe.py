"""The specular lobe: its record, its normalisation, and the moments by which it is prefiltered (NumPy).

The BRDF is ``f = C_d / pi + C_s N(m) (n . h)^m`` with the half vector h of view and light. ``N(m)`` is either

- normalised: ``(m + 2)(m + 4) / (8 pi (m + 2^(-m/2)))``, so that the lobe alone reflects all light at normal
  incidence and less elsewhere, or
- plain: ``1 / pi``, which leaves the paper's ``C_s (n . h)^m`` in the units of the diffuse term.

Carried lobe
------------
Microfacet surfaces reflect about the mirror direction r(v) at every angle and more so at grazing ones, where the half
vector's lobe fades and leans towards the normal. With a Fresnel term the lobe that a view along the normal has is
therefore carried about r:
``f = C_s (1 + fresnel (1 - h.v)^5) N(m) ((1 + c) / 2)^(m/2) c * 2 / (n.l + n.v)`` with ``c = max(r.l, 0)``.
``r.l = 2 (n.v)(n.l) - v.l`` and ``h.v`` don't change when l and v change places, so f is reciprocal; at the mirror
direction h is n, so the Fresnel factor is that of ``1 + fresnel (1 - n.v)^5``. The last factor turns c, which is wanted
of the outgoing light ``f n.l``, into a reciprocal f: ``1 / n.l`` isn't symmetric, ``1 / max(n.l, n.v)`` loses 40 % at
grazing angles, and ``1 / sqrt(n.l n.v)`` has no bound there. With this one the lobe's albedo is at most 1 for every
exponent and angle, and for exponents of 50 and more at least 0.8.

Prefiltered form
----------------
Under smooth lighting only a few moments of the lobe matter. For a view at the cosine mu from the normal, the reflected
lobe ``N (n . h)^m (n . l)`` has a mass (its directional albedo), a mean direction between mirror direction and normal,
and about that direction a Legendre coefficient per band. Replacing the lobe by the zonal one with these moments gives
its transfer vector in closed form: ``albedo * factor_l * Y_lm(mean direction)``. ``lobe_moments`` has the numbers;
``lobe_table`` stores them as Chebyshev coefficients over mu and log m.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.errors import InputError

Array = NDArray[np.float64]

EXPONENT_MIN, EXPONENT_MAX = 1.0, 1e4

_DEGREE_COSINE, _DEGREE_EXPONENT = 7, 11


@dataclass(frozen=True)
class Lobe:
    """The Blinn-Phong lobe of a surface, with an exponent from 1 to 10000.

    ``fresnel`` is the strength of the lobe at grazing views over that of a view along the normal, less 1; None for
    plain Blinn-Phong, a number for the lobe carried about the mirror direction. ``normalized`` says which N(m), see
    above.
    """

    exponent: float
    fresnel: float | None = None
    normalized: bool = True

    @property
    def roughness(self) -> float:
        """Beckmann's alpha, and GGX's, of the microfacet lobe that is about as wide."""
        return math.sqrt(2.0 / (self.exponent + 2.0))

    @property
    def grazing(self) -> float:
        """Strength of the lobe at grazing views over that of a view along the normal."""
        return 1.0 + (self.fresnel or 0.0)

    def parameters(self) -> dict[str, float | bool]:
        """The lobe as parameters of the ``blinnphong`` plugin and as ``result.json`` has it."""
        fresnel = {} if self.fresnel is None else {"fresnel": float(self.fresnel)}
        return {"exponent": self.exponent, "normalized": self.normalized, **fresnel}

    def zonal(self, order: int, cosines: Array) -> tuple[Array, Array, Array]:
        """The lobe as few numbers, for a viewer.

        Returned are its albedo and tilt (see `lobe_moments`) for views at ``cosines`` from the normal, ascending to 1,
        and the Legendre factors (B,) of the bands, those of a middling view.
        """
        moments = tabulated_moments(order, cosines, self.exponent)
        albedo, tilt = moments[0], moments[1]
        middling = int(np.searchsorted(cosines, 0.7))
        if self.fresnel is not None:
            # The lobe of a view along the normal about the mirror direction, stronger towards grazing views.
            albedo, tilt = albedo[-1] * (1 + self.fresnel * (1 - cosines) ** 5), np.zeros_like(tilt)
            middling = -1
        return self.factor() * albedo, tilt, np.concatenate([[1.0], moments[2:, middling]])

    def factor(self) -> float:
        """Albedo of the lobe relative to that of the normalised one."""
        return float(normalization(self.exponent, self.normalized) / normalization(self.exponent))


def normalization(exponent: ArrayLike, normalized: bool = True) -> Array:
    """The lobe's factor N(m), for both kinds."""
    m = np.asarray(exponent, dtype=np.float64)
    if not normalized:
        return np.full_like(m, 1.0 / np.pi)
    return (m + 2.0) * (m + 4.0) / (8.0 * np.pi * (m + np.exp2(-0.5 * m)))


def lobe_samples(cosine: float, exponent: float) -> tuple[Array, Array]:
    """Quadrature of the normalised lobe seen at one angle.

    Returned are light directions (N, 3), in the frame with the normal along z and the view in the x-z plane, and
    weights (N,) ``f (n . l) dl``, whose sum is the directional albedo. The half vectors follow their own density, so
    that the same count serves exponents of 1 and of 10000.
    """
    count = 48
    x, w = np.polynomial.legendre.leggauss(count)
    u = 0.5 * (x + 1.0)
    # Substituting cos_h = u^(1/(m+1)) makes (n . h)^m d(cos_h) uniform, but steep at u = 0; squaring u smooths it.
    cos_h = (u * u) ** (1.0 / (exponent + 1.0))
    weight_h = 0.5 * w * 2.0 * u / (exponent + 1.0)
    phi = (np.arange(2 * count) + 0.5) * (np.pi / (2 * count))  # half the circle: the lobe is symmetric
    sin_h = np.sqrt(np.maximum(1.0 - cos_h**2, 0.0))
    h = np.stack(
        [np.outer(sin_h, np.cos(phi)), np.outer(sin_h, np.sin(phi)), np.outer(cos_h, np.ones_like(phi))], -1
    ).reshape(-1, 3)
    view = np.array([math.sqrt(max(1.0 - cosine * cosine, 0.0)), 0.0, cosine])
    vh = h @ view
    light = 2.0 * vh[:, None] * h - view
    area = np.repeat(weight_h, len(phi)) * (2.0 * np.pi / len(phi))
    inside = (vh > 0) & (light[:, 2] > 0)
    weight = np.where(inside, area * 4.0 * vh * light[:, 2], 0.0) * normalization(exponent)
    return light, weight


def lobe_moments(cosine: float, exponent: float, order: int) -> Array:
    """Moments (B + 1,) of the normalised lobe seen at the cosine mu from the normal.

    They are the directional albedo; the tilt t of the mean direction ``normalize((1 - t) r + t n)`` from the mirror
    direction r towards the normal n; and Legendre factors of the bands 1 .. B - 1 about the mean direction.
    """
    light, weight = lobe_samples(cosine, exponent)
    albedo = weight.sum()
    mean = weight @ light
    mean[1] = 0.0  # by symmetry; the samples cover one half
    mean /= np.linalg.norm(mean)
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    if sine < 1e-6:
        raise InputError("cosine: found 1, where the mirror direction is the normal and has no tilt")
    # mean = a r + b n with r = (-sine, 0, cosine): the tilt is b / (a + b).
    a = -mean[0] / sine
    b = mean[2] - a * cosine
    t = np.clip(light @ mean, -1.0, 1.0)
    legendre = [np.ones_like(t), t]
    for n in range(2, order):
        legendre.append(((2 * n - 1) * t * legendre[-1] - (n - 1) * legendre[-2]) / n)
    return np.array([albedo, b / (a + b), *(weight @ p / albedo for p in legendre[1:order])])


def tabulated_moments(order: int, cosine: ArrayLike, exponent: ArrayLike) -> Array:
    """All of `lobe_moments` at cosines and exponents (...) -> (B + 1, ...), read off `lobe_table`."""
    x = 2.0 * np.clip(np.asarray(cosine, dtype=np.float64), 0.0, 1.0) - 1.0
    m = np.clip(np.asarray(exponent, dtype=np.float64), EXPONENT_MIN, EXPONENT_MAX)
    y = 2.0 * np.log(m) / math.log(EXPONENT_MAX) - 1.0
    x, y = np.broadcast_arrays(x, y)
    return np.stack([np.polynomial.chebyshev.chebval2d(x, y, c) for c in lobe_table(order)])


@functools.lru_cache(maxsize=8)
def lobe_table(order: int) -> Array:
    """Chebyshev coefficients (B + 1, K, J) of `lobe_moments` over the cosine, 0..1, and the logarithm of the exponent.

    Axes are the moment, the degree in ``2 mu - 1`` and the degree in ``2 log(m) / log(10000) - 1``. Computed at first
    use, in a fraction of a second.
    """
    k, j = _DEGREE_COSINE + 1, _DEGREE_EXPONENT + 1
    x, y = (np.cos((np.arange(n) + 0.5) * np.pi / n) for n in (k, j))  # Chebyshev nodes
    values = np.array([[lobe_moments(0.5 * (a + 1.0), EXPONENT_MAX ** (0.5 * (b + 1.0)), order) for b in y] for a in x])
    to_x, to_y = (np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, len(nodes) - 1)) for nodes in (x, y))
    return np.einsum("ka,abq,jb->qkj", to_x, values, to_y)
