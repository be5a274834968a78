"""Real spherical harmonics, float64, any order: the toolkit of the lighting.

Conventions, the same everywhere in this project
------------------------------------------------
Basis: real, orthonormal over the sphere, with the Condon-Shortley phase, exactly as ``drjit.sh_eval``: for a unit
direction (x, y, z), ``Y_1,-1 = -k y``, ``Y_1,0 = k z``, ``Y_1,1 = -k x`` with ``k = sqrt(3 / (4 pi))``.
Index: ``l * l + l + m``. Order: the number of bands B, so l = 0 .. B - 1 and B * B functions; the paper has B = 3.
Axes: those of the directions that are passed in, without permutation; lighting lives in world axes.
Coefficients: (B * B, 3), of incident radiance, linear Rec. 709.
Lat-long images: Mitsuba's ``envmap`` without ``to_world``: the middle column is +z, the top row +y; the centre of pixel
(row, column) lies at phi = 2 pi (column + 0.5) / W, theta = pi (row + 0.5) / H and looks along
(sin phi sin theta, cos theta, -cos phi sin theta).

Sources: Ramamoorthi and Hanrahan 2001 (irradiance); Sloan, "Stupid Spherical Harmonics Tricks", 2008 (dominant
direction, optimal linear light).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.calls import whole
from mifit.core.limits import MAX_PIXELS
from mifit.errors import InputError

Array = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 for one value per coefficient."""


def basis(directions: ArrayLike, order: int) -> Array:
    """Evaluate the basis at unit directions (..., 3) -> (..., B*B)."""
    return _evaluate(directions, order, gradient=False)[0]


def basis_gradient(directions: ArrayLike, order: int) -> tuple[Array, Array]:
    """The basis (..., B*B) and its gradient (..., B*B, 3) at unit directions.

    Derivatives are those by x, y, z of the polynomials that ``drjit.sh_eval`` computes. Only the part along the sphere
    has a meaning; project it where the direction is a normalised vector.
    """
    values, gradient = _evaluate(directions, order, gradient=True)
    assert gradient is not None
    return values, gradient


def _evaluate(directions: ArrayLike, order: int, gradient: bool) -> tuple[Array, Array | None]:
    """Y = Q_lm(z) Re or Im (x + iy)^m, with the normalised recursion over l for the polynomials Q."""
    d = np.asarray(directions, dtype=np.float64)
    if d.shape[-1:] != (3,):
        raise InputError(f"directions: found shape {d.shape}, expected (..., 3)")
    check_order(order)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    out = np.empty((order * order, *d.shape[:-1]))  # one after the other: written apart from one another they take long
    grad = np.zeros((*d.shape[:-1], order * order, 3)) if gradient else None
    re, im = np.ones_like(z), np.zeros_like(z)
    re_below, im_below = np.zeros_like(z), np.zeros_like(z)  # (x + iy)^(m-1)
    q_mm = math.sqrt(1.0 / (4.0 * math.pi))
    for m in range(order):
        scale = 1.0 if m == 0 else math.sqrt(2.0)
        q, q_below = np.full_like(z, q_mm), np.zeros_like(z)
        dq, dq_below = np.zeros_like(z), np.zeros_like(z)
        for degree in range(m, order):
            centre = degree * degree + degree
            out[centre + m] = scale * q * re
            if m:
                out[centre - m] = scale * q * im
            if grad is not None:
                grad[..., centre + m, 0] = scale * q * m * re_below
                grad[..., centre + m, 1] = -scale * q * m * im_below
                grad[..., centre + m, 2] = scale * dq * re
                if m:
                    grad[..., centre - m, 0] = scale * q * m * im_below
                    grad[..., centre - m, 1] = scale * q * m * re_below
                    grad[..., centre - m, 2] = scale * dq * im
            n = degree + 1
            a = math.sqrt((4.0 * n * n - 1.0) / (n * n - m * m))
            b = math.sqrt((degree * degree - m * m) / (4.0 * degree * degree - 1.0)) if degree > m else 0.0
            if grad is not None:
                dq, dq_below = a * (q + z * dq - b * dq_below), dq
            q, q_below = a * (z * q - b * q_below), q
        re_below, im_below = re, im
        re, im = x * re - y * im, x * im + y * re
        q_mm *= -math.sqrt((2.0 * m + 3.0) / (2.0 * m + 2.0))
    return np.moveaxis(out, 0, -1), grad


def check_order(order: int) -> None:
    """Raise InputError unless the number of bands is a whole number from 1."""
    if not isinstance(order, (int, np.integer)) or order < 1:
        raise InputError(f"order: found {order!r}, expected the number of bands, 1 or more")


def order_of(coefficients: ArrayLike) -> int:
    """Number of bands B of coefficients whose first axis is B*B long; InputError for another length."""
    count = np.shape(coefficients)[0] if np.ndim(coefficients) else 0
    order = math.isqrt(count)
    if order < 1 or order * order != count:
        raise InputError(f"coefficients: found {count} of them, expected a square number: 1, 4, 9 (3 bands), 16 ...")
    return order


def bands(order: int) -> NDArray[np.int64]:
    """(B*B,) band l of each coefficient."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


def quadrature(order: int) -> tuple[Array, Array]:
    """Directions (N, 3) and weights (N,) that integrate products of two expansions of this order exactly."""
    z, w = np.polynomial.legendre.leggauss(order)
    count = 2 * order
    phi = (np.arange(count) + 0.5) * (2.0 * np.pi / count)
    r = np.sqrt(1.0 - z * z)
    shape = (order, count)
    d = np.stack([np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi)), np.broadcast_to(z[:, None], shape)], -1)
    return d.reshape(-1, 3), np.repeat(w * (2.0 * np.pi / count), count)


def cosine_coefficients(order: int) -> Array:
    """(B,) factors A_l by which the clamped cosine scales each band: pi, 2 pi / 3, pi / 4, 0, -pi / 24 ..."""
    check_order(order)
    out = np.zeros(order)
    for n in range(order):
        if n == 1:
            out[n] = 2.0 * np.pi / 3.0
        elif n % 2 == 0:
            half = n // 2
            out[n] = (-1.0) ** (half + 1) * (2.0 * np.pi / ((n + 2.0) * (n - 1.0))) * math.comb(n, half) / 2.0**n
    return out


def radiance_of_shading(shading: ArrayLike) -> Array:
    """(9, 3) radiance under which a white Lambertian surface has a shading: the paper's l_k to incident light."""
    return np.asarray(shading, dtype=np.float64) * (np.pi / cosine_coefficients(3)[bands(3)])[:, None]


def rotation_matrix(rotation: ArrayLike, order: int) -> Array:
    """(B*B, B*B) matrix that rotates coefficients: the rotated field at ``R d`` is the old one at ``d``."""
    r = np.asarray(rotation, dtype=np.float64)
    if r.shape != (3, 3) or not np.allclose(r @ r.T, np.eye(3), atol=1e-5) or np.linalg.det(r) < 0:
        raise InputError("rotation: found a matrix that isn't a (3, 3) rotation, expected R R^T = 1 and det R = 1")
    d, w = quadrature(order)
    matrix = basis(d, order).T @ (w[:, None] * basis(d @ r, order))
    band = bands(order)
    return np.where(band[:, None] == band[None, :], matrix, 0.0)


def turning(coefficients: Array) -> Array:
    """(3, B*B, K) change of a field with coefficients (B*B, K) as its argument d turns about x, y, z: d + t e x d."""
    order = order_of(coefficients)
    d, w = quadrature(order)
    values, gradient = basis_gradient(d, order)
    slopes = coefficients.T @ gradient  # (N, K, 3)
    return np.stack([values.T @ (w[:, None] * (slopes @ np.cross(e, d)[..., None])[..., 0]) for e in np.eye(3)])


def latlong_directions(height: int, width: int) -> Array:
    """(H, W, 3) world directions of the pixel centres of a lat-long image."""
    theta = (np.arange(height) + 0.5) * (np.pi / height)
    phi = (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    s = np.sin(theta)
    up = np.broadcast_to(np.cos(theta)[:, None], (height, width))
    return np.stack([np.outer(s, np.sin(phi)), up, -np.outer(s, np.cos(phi))], axis=-1)


def latlong_solid_angles(height: int, width: int) -> Array:
    """(H,) solid angle of a pixel in each row; they add up to 4 pi over the image."""
    edges = np.cos(np.arange(height + 1) * (np.pi / height))
    return (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)


def project_latlong(image: ArrayLike, order: int) -> Array:
    """Project a lat-long radiance image (H, W, 3) onto the basis -> (B*B, 3)."""
    check_order(order)
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or min(pixels.shape[:2]) < 2:
        raise InputError(f"environment map: found shape {pixels.shape}, expected (height, width, 3)")
    if not np.isfinite(pixels).all():
        raise InputError("environment map: found pixels that are not finite, expected linear radiance")
    height, width = pixels.shape[:2]
    if height < 2 * order:
        raise InputError(f"environment map: found {height} rows, expected {2 * order} or more for {order} bands")
    directions = latlong_directions(height, width)
    angles = latlong_solid_angles(height, width)
    out = np.zeros((order * order, 3))
    for row in range(0, height, 32):  # a few rows at a time: the whole basis would take gigabytes
        part = slice(row, row + 32)
        weighted = pixels[part].astype(np.float64) * angles[part, None, None]
        out += basis(directions[part], order).reshape(-1, order * order).T @ weighted.reshape(-1, 3)
    return out


@dataclass(frozen=True)
class SHLighting:
    """Distant lighting as real spherical harmonics of radiance, world axes (conventions at the top of this module).

    ``coefficients`` (B*B, 3) are linear Rec. 709; InputError for another shape, or values that are not finite.

    Examples
    --------
    A white sky all around: its irradiance is pi everywhere.

    >>> sky = SHLighting.from_envmap(np.ones((32, 64, 3)), order=3)
    >>> sky.irradiance([0.0, 1.0, 0.0]).round(2)
    array([3.14, 3.14, 3.14])
    """

    coefficients: Array

    def __post_init__(self) -> None:
        c = np.array(self.coefficients, dtype=np.float64)
        if c.ndim != 2 or c.shape[1] != 3:
            raise InputError(f"coefficients: found shape {c.shape}, expected (B*B, 3)")
        order_of(c)
        if not np.isfinite(c).all():
            raise InputError("coefficients: found values that are not finite")
        c.setflags(write=False)
        object.__setattr__(self, "coefficients", c)

    @classmethod
    def from_envmap(cls, source: str | Path | ArrayLike, order: int = 3) -> SHLighting:
        """Project a lat-long environment map, a file (.hdr, .exr) or an array (H, W, 3) of linear radiance.

        InputError for a file that can't be read, a wrong shape, or pixels that are not finite.
        """
        if isinstance(source, (str, Path)):
            from mifit.core.image import read_environment

            pixels = read_environment(source)
            try:
                return cls(project_latlong(pixels, order))
            except InputError as error:
                raise InputError(f"{source}: {error}") from None
        pixels = np.asarray(source)
        if pixels.ndim > 1 and pixels.shape[1] != 2 * pixels.shape[0]:
            raise InputError(f"environment map: found shape {pixels.shape}, expected twice as wide as high (H, 2 H, 3)")
        return cls(project_latlong(pixels, order))

    @property
    def order(self) -> int:
        """Number of bands B."""
        return order_of(self.coefficients)

    def evaluate(self, directions: ArrayLike) -> Array:
        """Radiance (..., 3) from unit directions (..., 3); negative where the expansion rings."""
        return basis(directions, self.order) @ self.coefficients

    def irradiance(self, normals: ArrayLike) -> Array:
        """Irradiance (..., 3) at unit normals (..., 3); a Lambertian point reflects albedo / pi of it."""
        factors = cosine_coefficients(self.order)[bands(self.order)]
        return basis(normals, self.order) @ (factors[:, None] * self.coefficients)

    def rotate(self, rotation: ArrayLike) -> SHLighting:
        """The lighting turned by a rotation R (3, 3): what came from d comes from R d."""
        return SHLighting(rotation_matrix(rotation, self.order) @ self.coefficients)

    def truncate(self, order: int) -> SHLighting:
        """The first bands only, or zeros appended up to a higher order."""
        check_order(order)
        out = np.zeros((order * order, 3))
        keep = min(order, self.order) ** 2
        out[:keep] = self.coefficients[:keep]
        return SHLighting(out)

    def dominant_direction(self) -> Array:
        """(3,) unit direction towards the brightest side, from the linear band (Sloan 2008).

        Lighting without a linear band has none; then it is (0, 0, 1).
        """
        if self.order < 2:
            return np.array([0.0, 0.0, 1.0])
        linear = self.coefficients[1:4] @ LUMINANCE
        d = np.array([-linear[2], -linear[0], linear[1]])
        length = np.linalg.norm(d)
        if length <= 1e-12 * max(float(np.abs(self.coefficients[0]).max()), 1e-300):
            return np.array([0.0, 0.0, 1.0])
        return d / length

    def to_latlong(self, height: int = 128, width: int = 256) -> Array:
        """Radiance as a lat-long image (H, W, 3)."""
        for name, size in (("height", height), ("width", width)):
            whole(size, 1, name, MAX_PIXELS)
        whole(height * width, 1, "height x width", MAX_PIXELS)
        return self.evaluate(latlong_directions(height, width))
