"""Diffuse and specular albedo of every texel with the lighting given.

With lighting fixed the objective is convex: a least-squares block of four unknowns per texel (three diffuse, one
specular), box constraints, and the L1 norm of the Laplacian, which ties neighbours together. ADMM takes these apart:
blocks and boxes are solved per texel in closed form, the L1 norm is a soft threshold, and the Laplacian of the whole
map is inverted at once by cosine transforms.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

SPLIT = 0.5
"""Weight of ADMM's splits relative to the median curvature of the blocks."""


@dataclass(frozen=True)
class TexelSystems:
    """Least-squares blocks of N texels: ``sum_c dd_c x_c^2 + 2 ds_c x_c y + ss y^2 - 2 (dr_c x_c + sr y)``.

    x is the diffuse albedo, y the specular one.

    Attributes
    ----------
    dd, ds, dr : (N, 3)
    ss, sr : (N,)
    """

    dd: NDArray[np.float32]
    ds: NDArray[np.float32]
    dr: NDArray[np.float32]
    ss: NDArray[np.float32]
    sr: NDArray[np.float32]

    @classmethod
    def accumulate(
        cls,
        colour: NDArray,
        weight: NDArray,
        diffuse_light: NDArray,
        specular_light: NDArray,
        pairs: NDArray,
        difference: float,
    ) -> TexelSystems:
        """Sum observations (N, J, 3) into blocks.

        Parameters
        ----------
        colour, weight, diffuse_light, specular_light : (N, J, 3)
            Observed colour, its weight, and the diffuse and specular reflection at unit albedo.
        pairs : (P, 2) int
            Images of the same timestep whose difference is specular only (the paper's E_S).
        difference : float
            Weight of the difference term, lambda_S.
        """
        wd = weight * diffuse_light
        ss = (weight * specular_light * specular_light).sum((1, 2))
        sr = (weight * specular_light * colour).sum((1, 2))
        for a, b in pairs:
            both = difference * np.minimum(weight[:, a], weight[:, b])
            step = specular_light[:, a] - specular_light[:, b]
            ss += (both * step * step).sum(1)
            sr += (both * step * (colour[:, a] - colour[:, b])).sum(1)
        return cls((wd * diffuse_light).sum(1), (wd * specular_light).sum(1), (wd * colour).sum(1), ss, sr)

    @classmethod
    def join(cls, parts: list[TexelSystems]) -> TexelSystems:
        """Blocks of several chunks of texels in a row."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def solve(self, x0: NDArray, y0: NDArray, px: NDArray | float, py: NDArray | float) -> tuple[NDArray, NDArray]:
        """Minimise each block plus ``px |x - x0|^2 + py (y - y0)^2`` within 0..1, in closed form.

        y is found with x eliminated; where that drives a diffuse value out of the box, the value is held at the bound
        and y found anew with the others.
        """
        dd = self.dd + px
        dr = self.dr + px * x0
        slope, offset = self.ds / dd, dr / dd
        y = self._specular(np.ones_like(dd), slope, offset, py, y0)
        x = offset - slope * y[:, None]
        free = ((x >= 0.0) & (x <= 1.0)).astype(dd.dtype)
        held = np.clip(x, 0.0, 1.0)
        y = self._specular(free, slope, np.where(free > 0, offset, held), py, y0)
        return np.clip(offset - slope * y[:, None], 0.0, 1.0), y

    def _specular(self, free: NDArray, slope: NDArray, offset: NDArray, py: NDArray | float, y0: NDArray) -> NDArray:
        """y for x = offset - slope y where free, x = offset elsewhere."""
        ss = self.ss + py - (free * self.ds * slope).sum(1)
        sr = self.sr + py * y0 - (self.ds * offset).sum(1)
        return np.clip(sr / np.maximum(ss, 1e-12), 0.0, 1.0)


def laplacian(image: NDArray) -> NDArray:
    """Five-point Laplacian of (S, S, ...) with mirrored borders."""
    padded = np.pad(image, [(1, 1), (1, 1)] + [(0, 0)] * (image.ndim - 2), mode="edge")
    return padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2] - 4.0 * image


def laplacian_eigenvalues(size: int) -> NDArray[np.float32]:
    """(S, S) eigenvalues of the five-point Laplacian under the type-2 cosine transform."""
    one = 2.0 * np.cos(np.pi * np.arange(size) / size) - 2.0
    return (one[:, None] + one[None, :]).astype(np.float32)


@dataclass(frozen=True)
class Smoothness:
    """Weights of the L1 norm of the Laplacian.

    Attributes
    ----------
    diffuse, specular : float
        lambda_H for the diffuse offset and for the specular map.
    """

    diffuse: float
    specular: float


def solve_maps(
    systems: TexelSystems,
    index: NDArray[np.int64],
    prior: NDArray,
    smoothness: Smoothness,
    start: NDArray | None = None,
    prior_weight: float = 1e-4,
    specular_pull: float = 0.0,
    iterations: int = 60,
    tolerance: float = 1e-4,
) -> NDArray[np.float32]:
    """Minimise the texels' blocks + lambda_H (|Laplacian delta C_d|_1 + |Laplacian C_s|_1) within 0..1.

    Parameters
    ----------
    systems : TexelSystems
        Blocks of the N texels of `index`.
    index : (N,) int64
        Flat positions of the texels in the map.
    prior : (S, S, 4) float
        Diffuse albedo of the model, and the specular albedo expected where nothing is seen.
    smoothness : Smoothness
    start : (S, S, 4), optional
        Start; the prior by default.
    prior_weight : float
        Weak pull to the prior, relative to the median block, that decides where the images are silent.
    specular_pull : float
        Pull of the specular albedo to its prior in the blocks' own units, where it is above the weak one.
    iterations : int
    tolerance : float
        Stop when no map moves by more than this.

    Returns
    -------
    (S, S, 4) float32
        Diffuse albedo and specular albedo.
    """
    prior = prior.astype(np.float32)
    base = prior.copy()
    base[..., 3] = 0.0  # the paper smooths the offset from the model's albedo, and C_s itself
    scale = np.array([float(np.median(systems.dd))] * 3 + [float(np.median(systems.ss))], dtype=np.float32)
    scale = np.maximum(scale, 1e-6)
    pull = prior_weight * scale
    pull[3] = max(pull[3], specular_pull)
    # Splitting weights near the blocks' own curvature let both sides of a split move at the same pace.
    rho = SPLIT * scale
    threshold = np.array([smoothness.diffuse] * 3 + [smoothness.specular], dtype=np.float32) / rho
    eigenvalues = laplacian_eigenvalues(prior.shape[0])[..., None]
    inverse = 1.0 / (1.0 + eigenvalues**2)
    smooth = (prior if start is None else start.astype(np.float32)) - base
    bent = laplacian(smooth)
    u, v = np.zeros_like(smooth), np.zeros_like(smooth)
    texel = prior
    for _ in range(iterations):
        wanted = 0.5 * rho * (base + smooth - u) + pull * prior
        wanted /= 0.5 * rho + pull
        texel = wanted.reshape(-1, 4)
        texel[index, :3], texel[index, 3] = systems.solve(
            texel[index, :3], texel[index, 3], (0.5 * rho + pull)[:3], (0.5 * rho + pull)[3]
        )
        texel = np.clip(texel, 0.0, 1.0).reshape(prior.shape)
        shifted = bent - v
        z = np.sign(shifted) * np.maximum(np.abs(shifted) - threshold, 0.0)
        right = texel - base + u + laplacian(z + v)
        previous = smooth
        smooth = idctn(dctn(right, axes=(0, 1), type=2) * inverse, axes=(0, 1), type=2)
        bent = laplacian(smooth)
        u = u + texel - base - smooth
        v = v + z - bent
        if np.abs(smooth - previous).max() < tolerance:
            break
    return texel.astype(np.float32)
