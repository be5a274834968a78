"""Diffuse and specular albedo of every texel with the lighting given.

With lighting fixed the objective is convex: a least-squares block of four unknowns per texel (three diffuse, one
specular), box constraints, and the L1 norm of the Laplacian, which ties neighbours together. ADMM takes these apart:
blocks and boxes are solved per texel in closed form, the L1 norm is a soft threshold, and the Laplacian of the whole
map is inverted at once by cosine transforms.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from mifit.core.process import blocks, on_all_cores, threads
from mifit.optim import Outcome

SPLIT = 0.5
"""Weight of ADMM's splits relative to the median curvature of the blocks."""
WEAK = 1e-4
"""Weight of what is expected relative to the median block: it decides where no image measures."""
RELAX = 1.7
"""Over-relaxation of both splits (Boyd et al. 2011, section 3.4.3): 40 iterations end nearer to it than 60 did."""


@dataclass(frozen=True)
class TexelSystems:
    """Least-squares blocks of N texels: ``sum_c dd_c x_c^2 + 2 ds_c x_c y + ss y^2 - 2 (dr_c x_c + sr y)``.

    x is the diffuse albedo, y the specular one.

    Attributes
    ----------
    dd, ds, dr : (N, 3)
    ss, sr : (N,)
    """

    dd: NDArray[np.floating]
    ds: NDArray[np.floating]
    dr: NDArray[np.floating]
    ss: NDArray[np.floating]
    sr: NDArray[np.floating]

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

        def add(rows: slice) -> TexelSystems:
            seen, w, d, s = colour[rows], weight[rows], diffuse_light[rows], specular_light[rows]
            wd = w * d
            ss = (w * s * s).sum((1, 2))
            sr = (w * s * seen).sum((1, 2))
            for a, b in pairs:
                both = difference * np.minimum(w[:, a], w[:, b])
                step = s[:, a] - s[:, b]
                ss += (both * step * step).sum(1)
                sr += (both * step * (seen[:, a] - seen[:, b])).sum(1)
            return cls((wd * d).sum(1), (wd * s).sum(1), (wd * seen).sum(1), ss, sr)

        return cls.join(on_all_cores(add, blocks(len(colour), 32 * colour.shape[1]) or [slice(0, 0)]))

    @classmethod
    def join(cls, parts: list[TexelSystems]) -> TexelSystems:
        """Blocks of several chunks of texels in a row."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def with_priors(self, pulls: tuple[NDArray, float], diffuse: NDArray, specular: NDArray | float) -> TexelSystems:
        """With ``pull (x - expected)^2`` added for diffuse (N, 3) and specular albedo (N,)."""
        pull, gloss = pulls
        dr, sr = self.dr + pull * diffuse, self.sr + gloss * specular
        return replace(self, dd=self.dd + pull, dr=dr, ss=self.ss + gloss, sr=sr)

    def inverse(self, diffuse: NDArray, specular: NDArray | float) -> tuple[NDArray, NDArray]:
        """The blocks' inverses times vectors of diffuse (N, 3) and specular parts (N,)."""
        slope = self.ds / self.dd
        y = (specular - (slope * diffuse).sum(axis=1)) / np.maximum(self.specular_information, 1e-12)
        return diffuse / self.dd - slope * y[:, None], y

    @property
    def specular_information(self) -> NDArray[np.floating]:
        """(N,) curvature of the specular albedo once the diffuse ones follow it."""
        taken = self.ds**2 / np.maximum(self.dd, np.float32(1e-12))
        return np.maximum(self.ss - taken.sum(1), np.float32(0.0))


@dataclass(frozen=True)
class _Blocks:
    """Blocks of N texels plus quadratic terms of ADMM's, worked out as far as they are the same in all iterations.

    Channels come first: sums over three neighbours in memory are slow. With x eliminated, and a target t (4, N),
    ``o = at + gain t`` are the x that would be found if y were 0, ``eliminated y = right + pull t - sum_c both_c o_c``,
    and ``x = o - slope y``.

    Attributes
    ----------
    at, gain, slope, both : (3, N)
    right, curvature, eliminated : (N,)
        Of y; its curvature with x held, and with x eliminated.
    pull : float
        Weight of the target of y.
    """

    at: NDArray[np.float32]
    gain: NDArray[np.float32]
    slope: NDArray[np.float32]
    both: NDArray[np.float32]
    right: NDArray[np.float32]
    curvature: NDArray[np.float32]
    eliminated: NDArray[np.float32]
    pull: float

    @classmethod
    def of(
        cls, systems: TexelSystems, index: NDArray, weight: NDArray, drawn: NDArray, pull: NDArray[np.float32]
    ) -> _Blocks:
        """Blocks at some of N texels plus, at all, ``weight z^2 - 2 (drawn + pull t) z`` of all four albedos z.

        Parameters
        ----------
        systems : TexelSystems
        index : (M,) int
            Texels of the blocks.
        weight, pull : (4, 1)
        drawn : (4, N)
        """

        def spread(values: NDArray, added: NDArray) -> NDArray[np.float32]:
            out = np.zeros(drawn.shape[1], drawn.dtype) + added
            out[index] += values
            return out

        held, zero = np.broadcast_to(weight, (4, 1)), np.zeros((3, 1), drawn.dtype)
        dd, both, dr = (
            np.stack([spread(values[:, c], added[c]) for c in range(3)])
            for values, added in ((systems.dd, held), (systems.ds, zero), (systems.dr, drawn))
        )
        slope, curvature = both / dd, spread(systems.ss, held[3])
        eliminated = np.maximum(curvature - _over_channels(both * slope), np.float32(1e-12))
        right = spread(systems.sr, drawn[3])
        return cls(dr / dd, pull[:3] / dd, slope, both, right, curvature, eliminated, float(pull[3, 0]))

    def take(self, rows: slice | NDArray[np.intp]) -> _Blocks:
        """Those of some of the texels."""
        names = [f.name for f in fields(self) if f.name != "pull"]
        return replace(self, **{name: getattr(self, name)[..., rows] for name in names})

    def solve(self, target: NDArray, out: NDArray) -> None:
        """Minimise within 0..1 for targets (4, N), in closed form.

        y is found with x eliminated; where that drives a diffuse value out of the box, the value is held at the bound
        and y found anew with the others.
        """
        x, y = out[:3], out[3]
        np.multiply(self.gain, target[:3], out=x)
        x += self.at
        np.multiply(self.pull, target[3], out=y)
        y += self.right
        for both, offset in zip(self.both, x, strict=True):
            y -= both * offset
        y /= self.eliminated
        np.clip(y, 0.0, 1.0, out=y)
        for slope, offset in zip(self.slope, x, strict=True):
            offset -= slope * y
        if x.min(initial=0.0) < 0.0 or x.max(initial=0.0) > 1.0:
            self._bounded(np.flatnonzero(((x < 0.0) | (x > 1.0)).any(axis=0)), target, out)

    def _bounded(self, rows: NDArray[np.intp], target: NDArray, out: NDArray) -> None:
        """Find again those whose x left the box."""
        blocks, x = self.take(rows), out[:3, rows]
        free = (x >= 0.0) & (x <= 1.0)
        offset = blocks.at + blocks.gain * target[:3, rows]
        shifted = np.where(free, offset, np.clip(x, 0.0, 1.0))
        curvature = blocks.curvature - _over_channels(np.where(free, blocks.both * blocks.slope, 0.0))
        right = blocks.right + blocks.pull * target[3, rows] - _over_channels(blocks.both * shifted)
        y = np.clip(right / np.maximum(curvature, 1e-12), 0.0, 1.0)
        out[:3, rows], out[3, rows] = np.clip(offset - blocks.slope * y, 0.0, 1.0), y


def _over_channels(values: NDArray) -> NDArray:
    """Sum of (3, N) over the channels."""
    return values[0] + values[1] + values[2]


def laplacian(image: NDArray) -> NDArray:
    """Five-point Laplacian of (S, S) or (S, S, C <= 4) with mirrored borders."""
    return cv2.Laplacian(image, -1, borderType=cv2.BORDER_REPLICATE)


def laplacian_eigenvalues(size: int) -> NDArray[np.float32]:
    """(S, S) eigenvalues of the five-point Laplacian under the type-2 cosine transform."""
    one = 2.0 * np.cos(np.pi * np.arange(size) / size) - 2.0
    return (one[:, None] + one[None, :]).astype(np.float32)


def solve_maps(
    systems: TexelSystems,
    index: NDArray[np.int64],
    prior: NDArray,
    smoothness: tuple[float, float],
    start: NDArray | None = None,
    pulls: tuple[float, float] = (0.0, WEAK),
    iterations: int = 60,
    tolerance: float = 1e-4,
) -> tuple[NDArray[np.float32], Outcome]:
    """Minimise the texels' blocks + lambda_H (|Laplacian delta C_d|_1 + |Laplacian C_s|_1) within 0..1.

    Parameters
    ----------
    systems : TexelSystems
        Blocks of the N texels of `index`.
    index : (N,) int64
        Flat positions of the texels in the map.
    prior : (S, S, 4) float
        Diffuse albedo of the model, and the specular albedo expected where nothing is seen.
    smoothness : (float, float)
        lambda_H of the L1 norm of the Laplacian: of the diffuse offset, and of the specular map.
    start : (S, S, 4), optional
        Start; the prior by default.
    pulls : (float, float)
        Weight of the expected specular albedo, in the blocks' own units, and that of all that is expected, relative to
        the median block: the latter decides where no image measures, and where it is above the former.
    iterations : int
    tolerance : float
        Stop when no map moves by more than this.

    Returns
    -------
    (S, S, 4) float32
        Diffuse albedo and specular albedo.
    Outcome
    """
    size = prior.shape[0]
    prior = np.ascontiguousarray(prior.transpose(2, 0, 1), dtype=np.float32)
    base = prior.copy()
    base[3] = 0.0  # the paper smooths the offset from the model's albedo, and C_s itself
    scale = np.array([float(np.median(systems.dd))] * 3 + [float(np.median(systems.ss))], dtype=np.float32)
    scale = np.maximum(scale, 1e-6)
    drawing = pulls[1] * scale
    drawing[3] = max(drawing[3], pulls[0])
    # Splitting weights near the blocks' own curvature let both sides of a split move at the same pace.
    rho = (SPLIT * scale)[:, None]
    threshold = np.array([smoothness[0]] * 3 + [smoothness[1]], dtype=np.float32)[:, None] / rho
    inverse = 1.0 / (1.0 + laplacian_eigenvalues(size) ** 2)
    # Planes (4, S, S) without their base: the smooth copy, and the sums of each split's copy and its multiplier.
    smooth = (prior if start is None else start.transpose(2, 0, 1).astype(np.float32)) - base
    level, bend = smooth.copy(), np.stack([laplacian(plane) for plane in smooth])
    # Texels without a block are solved like all others, by what draws them alone.
    flat = prior.reshape(4, -1), base.reshape(4, -1)
    drawn = drawing[:, None] * flat[0] + 0.5 * rho * flat[1]
    every = _Blocks.of(systems, index, 0.5 * rho + drawing[:, None], drawn, 0.5 * rho)
    rows = blocks(size * size, 64)
    lines = blocks(size, 64 * size)
    parts = [(every.take(r), r) for r in rows]
    texel, outcome = prior.copy(), Outcome.MAX_ITERATIONS

    def solve_blocks(part: tuple[_Blocks, slice]) -> None:
        blocks, rows = part
        target = 2.0 * smooth.reshape(4, -1)[:, rows]
        target -= level.reshape(4, -1)[:, rows]
        blocks.solve(target, texel.reshape(4, -1)[:, rows])

    def smooth_plane(k: int) -> float:
        """One plane's smooth copy and multipliers; the largest change of the copy."""
        bent, bound = laplacian(smooth[k]), float(threshold[k, 0])
        for part in lines:
            shifted = 2.0 * bent[part]
            shifted -= bend[k, part]
            change = shifted - np.clip(shifted, -bound, bound)  # soft threshold
            change -= bent[part]
            change *= RELAX
            bend[k, part] += change
            np.subtract(texel[k, part], base[k, part], out=change)
            change -= smooth[k, part]
            change *= RELAX
            level[k, part] += change
        waves = laplacian(bend[k])
        waves += level[k]
        waves = dctn(waves, type=2, overwrite_x=True)
        waves *= inverse
        found = idctn(waves, type=2, overwrite_x=True)
        moved = np.subtract(found, smooth[k], out=bent)
        smooth[k] = found
        return max(float(moved.max()), -float(moved.min()))

    # Planes are independent but for the blocks, and those of each other; NumPy and SciPy let go of the interpreter.
    with ThreadPoolExecutor(min(4, threads())) as pool:
        for _ in range(iterations):
            list(pool.map(solve_blocks, parts))
            if max(pool.map(smooth_plane, range(4))) < tolerance:
                outcome = Outcome.CONVERGED
                break
    return np.ascontiguousarray(texel.transpose(1, 2, 0), dtype=np.float32), outcome
