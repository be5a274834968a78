"""Diffuse and specular albedo of every texel with the lighting given.

With lighting fixed the objective is convex: a least-squares block of four unknowns per texel (three diffuse, one
specular), box constraints, and the L1 norm of the Laplacian, which ties neighbours together. ADMM takes these apart:
blocks and boxes are solved per texel in closed form, the L1 norm is a soft threshold, and the Laplacian of the whole
map is inverted at once by cosine transforms.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from mifit.core.threads import threads
from mifit.solve import Outcome

SPLIT = 0.5
"""Weight of ADMM's splits relative to the median curvature of the blocks."""
RELAX = 1.7
"""Over-relaxation of both splits (Boyd et al. 2011, section 3.4.3): 40 iterations end nearer to it than 60 did."""
CHUNK = 32768
"""Texels whose blocks are solved at once: what they need stays in a core's cache."""


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

    def take(self, rows: slice) -> TexelSystems:
        """Blocks of some of the texels."""
        return TexelSystems(*(getattr(self, f.name)[rows] for f in fields(self)))

    def solve(self, x0: NDArray, y0: NDArray, px: NDArray | float, py: NDArray | float) -> tuple[NDArray, NDArray]:
        """Minimise each block plus ``px |x - x0|^2 + py (y - y0)^2`` within 0..1: x (N, 3) and y (N,)."""
        blocks = _Blocks(self, np.broadcast_to(px, 3).astype(self.dd.dtype)[:, None], py)
        x, y = blocks.solve(np.broadcast_to(x0, self.dd.shape).T, np.broadcast_to(y0, self.sr.shape))
        return x.T, y


class _Blocks:
    """`TexelSystems` with the pulls of ADMM's splits, which are the same in all iterations, worked in.

    Channels come first here, (3, N): sums over three neighbours in memory are slow.
    """

    def __init__(self, systems: TexelSystems, px: NDArray, py: NDArray | float) -> None:
        self.px, self.py = px, py
        self.ds, self.dr = (np.ascontiguousarray(a.T) for a in (systems.ds, systems.dr))
        self.sr = systems.sr
        self.inverse = 1.0 / (systems.dd.T + px)
        self.slope = self.ds * self.inverse
        self.removed = self.ds * self.slope  # what eliminating each x takes from the curvature of y
        self.curvature = systems.ss + py
        self.eliminated = np.maximum(self.curvature - _over_channels(self.removed), 1e-12)

    def solve(self, x0: NDArray, y0: NDArray) -> tuple[NDArray, NDArray]:
        """x (3, N) and y (N,) in closed form.

        y is found with x eliminated; where that drives a diffuse value out of the box, the value is held at the bound
        and y found anew with the others.
        """
        offset = (self.dr + self.px * x0) * self.inverse
        pull = self.sr + self.py * y0
        y = np.clip((pull - _over_channels(self.ds * offset)) / self.eliminated, 0.0, 1.0)
        x = offset - self.slope * y
        rows = np.flatnonzero(((x < 0.0) | (x > 1.0)).any(axis=0))
        if len(rows):
            bound, free = x[:, rows], (x[:, rows] >= 0.0) & (x[:, rows] <= 1.0)
            shifted = np.where(free, offset[:, rows], np.clip(bound, 0.0, 1.0))
            curvature = self.curvature[rows] - _over_channels(np.where(free, self.removed[:, rows], 0.0))
            right = pull[rows] - _over_channels(self.ds[:, rows] * shifted)
            y[rows] = np.clip(right / np.maximum(curvature, 1e-12), 0.0, 1.0)
            x[:, rows] = np.clip(offset[:, rows] - self.slope[:, rows] * y[rows], 0.0, 1.0)
        return x, y


def _over_channels(values: NDArray) -> NDArray:
    """Sum of (3, N) over the channels."""
    return values[0] + values[1] + values[2]


@dataclass
class Splits:
    """ADMM's copies and multipliers, planes (4, S, S): handed on, they make the next solve a short one.

    Attributes
    ----------
    smooth, bent : smooth copy of the maps without their base, and its Laplacian
    u, v : multipliers of the two splits
    outcome : Outcome
        Of the solve that left them.
    iterations : int
    """

    smooth: NDArray[np.float32] | None = None
    bent: NDArray[np.float32] | None = None
    u: NDArray[np.float32] | None = None
    v: NDArray[np.float32] | None = None
    outcome: Outcome = Outcome.MAX_ITERATIONS
    iterations: int = 0


def plane_laplacian(planes: NDArray) -> NDArray:
    """Five-point Laplacian of planes (..., S, S) with mirrored borders."""
    out = -4.0 * planes
    for axis in (planes.ndim - 2, planes.ndim - 1):
        low, high = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        out[high] += planes[low]
        out[low] += planes[high]
        first, last = ((slice(None),) * axis + (part,) for part in (slice(0, 1), slice(-1, None)))
        out[first] += planes[first]
        out[last] += planes[last]
    return out


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
    splits: Splits | None = None,
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
    splits : Splits, optional
        Those of an earlier solve with nearly the same blocks, to go on from instead of from ``start``; they take those
        of this one, and say how it ended.

    Returns
    -------
    (S, S, 4) float32
        Diffuse albedo and specular albedo.
    """
    size = prior.shape[0]
    prior = np.ascontiguousarray(prior.transpose(2, 0, 1), dtype=np.float32)
    base = prior.copy()
    base[3] = 0.0  # the paper smooths the offset from the model's albedo, and C_s itself
    scale = np.array([float(np.median(systems.dd))] * 3 + [float(np.median(systems.ss))], dtype=np.float32)
    scale = np.maximum(scale, 1e-6)
    pull = prior_weight * scale
    pull[3] = max(pull[3], specular_pull)
    # Splitting weights near the blocks' own curvature let both sides of a split move at the same pace.
    rho = (SPLIT * scale)[:, None, None]
    threshold = np.array([smoothness.diffuse] * 3 + [smoothness.specular], dtype=np.float32)[:, None, None] / rho
    weak = pull[:, None, None]
    inverse = 1.0 / (1.0 + laplacian_eigenvalues(size) ** 2)
    splits = Splits() if splits is None else splits
    smooth, bent, u, v = splits.smooth, splits.bent, splits.u, splits.v
    if smooth is None or bent is None or u is None or v is None:
        smooth = (prior if start is None else start.transpose(2, 0, 1).astype(np.float32)) - base
        bent, u, v = plane_laplacian(smooth), np.zeros_like(smooth), np.zeros_like(smooth)
    total = 0.5 * rho + weak
    rows = [slice(at, at + CHUNK) for at in range(0, len(index), CHUNK)]
    parts = [(_Blocks(systems.take(r), total[:3, :, 0], float(total[3, 0, 0])), index[r]) for r in rows]
    share, drawn = 0.5 * rho / total, weak / total * prior
    texel, splits.outcome, splits.iterations = prior.copy(), Outcome.MAX_ITERATIONS, 0

    def pull_texels(k: int) -> None:
        """Where the blocks are drawn to, and what texels without a block take."""
        texel[k] = share[k] * (base[k] + smooth[k] - u[k]) + drawn[k]

    def solve_blocks(part: tuple[_Blocks, NDArray[np.int64]]) -> None:
        block, rows = part
        flat = texel.reshape(4, -1)
        x, y = block.solve(flat[:3, rows], flat[3, rows])
        flat[:3, rows], flat[3, rows] = x, y

    def smooth_plane(k: int) -> float:
        """One plane's smooth copy and multipliers; the largest change of the copy."""
        np.clip(texel[k], 0.0, 1.0, out=texel[k])
        shifted = bent[k] - v[k]
        z = shifted - np.clip(shifted, -threshold[k], threshold[k])  # soft threshold
        z = RELAX * z + (1.0 - RELAX) * bent[k]
        offset = RELAX * (texel[k] - base[k]) + (1.0 - RELAX) * smooth[k]
        right = offset + u[k] + plane_laplacian(z + v[k])
        found = idctn(dctn(right, type=2) * inverse, type=2)
        moved = float(np.abs(found - smooth[k]).max())
        smooth[k], bent[k] = found, plane_laplacian(found)
        u[k] += offset - found
        v[k] += z - bent[k]
        return moved

    # Planes are independent but for the blocks, and those of each other; NumPy and SciPy let go of the interpreter.
    with ThreadPoolExecutor(min(4, threads())) as pool:
        for _ in range(iterations):
            splits.iterations += 1
            list(pool.map(pull_texels, range(4)))
            list(pool.map(solve_blocks, parts))
            if max(pool.map(smooth_plane, range(4))) < tolerance:
                splits.outcome = Outcome.CONVERGED
                break
    splits.smooth, splits.bent, splits.u, splits.v = smooth, bent, u, v
    return np.ascontiguousarray(texel.transpose(1, 2, 0), dtype=np.float32)
