"""Normal equations of the lighting beside the maps: sums over the observations, priors, elimination of the texels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg as sl
import scipy.optimize
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.process import BLOCK, blocks, on_all_cores

SPECULAR_SPREAD = 0.15
"""Standard deviation of the specular albedo over a face, relative to its median."""
PATCHES = 100
"""Independent measurements that a face is worth: about as many patches have an error of their own."""


@dataclass(frozen=True)
class LightingProblem:
    """M observations of n texels, texel after texel, and K lighting coefficients.

    Attributes
    ----------
    texel : (M,)
        Which texel each observation shows, ascending.
    colour, weight : (M, 3)
        Observed linear colour and its weight.
    clipped : (M,) bool
        Observations that are lower bounds only.
    diffuse, specular : (M, K)
        Transfer vectors of diffuse and specular reflection at unit albedo.
    albedo : (n, 3)
        Diffuse albedo expected by the morphable model.
    order : int
        Bands B of the smooth light: the first B*B of the K; the others are the compact lights.
    gloss : float
        The most that is expected of the specular albedo.
    """

    texel: NDArray[np.intp]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    albedo: NDArray[np.float32]
    order: int
    gloss: float = 1.0

    def expected_specular(self, specular: NDArray) -> float:
        """Specular albedo to expect of a texel, given those of others (n,).

        What tells how much of a broad reflection is specular is little, and errors of the mesh look like it.
        """
        return min(float(np.median(specular)), self.gloss)

    @cached_property
    def start(self) -> NDArray[np.intp]:
        """(n + 1,) where the observations of each texel begin."""
        return np.searchsorted(self.texel, np.arange(len(self.albedo) + 1))

    def with_columns(self, diffuse: NDArray, specular: NDArray) -> LightingProblem:
        """The same with further lights, (M, L) columns of each reflection."""
        both = np.concatenate([self.diffuse, diffuse], axis=1), np.concatenate([self.specular, specular], axis=1)
        return replace(self, diffuse=both[0], specular=both[1])

    def sums(self, values: NDArray) -> NDArray:
        """Per texel (n, ...) the sum of values (M, ...)."""
        return _per_texel(self.start) @ values

    @cached_property
    def blocks(self) -> list[Block]:
        """All observations in parts, each of whole texels."""
        found, first, n = [], 0, len(self.albedo)
        step = max(BLOCK // self.diffuse.shape[1], 1)
        while first < n:
            last = max(int(np.searchsorted(self.start, self.start[first] + step, side="right")) - 1, first + 1)
            start = self.start[first : last + 1]
            found.append(Block(slice(first, last), slice(int(start[0]), int(start[-1])), _per_texel(start)))
            first = last
        return found


@dataclass(frozen=True)
class Block:
    """Some of the texels and their observations, with the matrix (texels, observations) that tells whose they are."""

    texels: slice
    rows: slice
    matrix: sp.csr_matrix

    def sums(self, factor: NDArray, values: NDArray) -> NDArray:
        """Per texel the sum of values (M, K), each observation's times its factor (M,)."""
        self.matrix.data = factor
        return np.asarray(self.matrix @ values)


def _per_texel(start: NDArray) -> sp.csr_matrix:
    """(n, M) with a 1 for each observation in the row of its texel."""
    count = int(start[-1] - start[0])
    shape = len(start) - 1, count
    return sp.csr_matrix((np.ones(count, np.float32), np.arange(count), start - start[0]), shape=shape)


def specular_pull(expected: float, sigma: float) -> float:
    """Weight that ties a texel's specular albedo to the expected one, beside squared residuals of deviation `sigma`."""
    return (sigma / (SPECULAR_SPREAD * max(expected, 1e-3))) ** 2


@dataclass(frozen=True)
class LightingPriors:
    """Weights of what is assumed where the images are silent, relative to the data's own scale.

    Attributes
    ----------
    roughness : float
        Penalty on (l (l + 1))^2 times the squared coefficients of band l.
    negative : float
        Penalty on squared negative radiance.
    albedo : float
        Pull of the diffuse albedo to the expected one.
    specular : float
        Pull of each texel's specular albedo to the expected one, at the least; see `SPECULAR_SPREAD`.
    """

    roughness: float = 1e-7
    negative: float = 0.5
    albedo: float = 1e-2
    specular: float = 2e-2


PRIORS = LightingPriors()
"""The usual weights."""


@dataclass
class LightingEquations:
    """Normal equations: lighting (3K) against the texels' own blocks of three diffuse albedos and one specular one.

    Diffuse albedos touch one another only by the specular one, and each only its own channel's light.

    Attributes
    ----------
    system : (3, K, K), right : (3, K)
        Of the lighting, by channel.
    diffuse, both : (n, 3), specular : (n,)
        Blocks: curvature of the diffuse albedos, theirs with the specular one, and its own.
    own_right : (n, 4)
    diffuse_cross : (3, n, K)
        Diffuse albedos against the light of their channel.
    specular_cross : (n, 3K)
        Specular albedo against the light.
    """

    system: NDArray[np.float64]
    right: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    both: NDArray[np.float64]
    specular: NDArray[np.float64]
    own_right: NDArray[np.float64]
    diffuse_cross: NDArray[np.float32]
    specular_cross: NDArray[np.float32]

    @classmethod
    def accumulate(
        cls,
        problem: LightingProblem,
        maps: tuple[NDArray, NDArray],
        shading: tuple[NDArray, NDArray],
        residual: NDArray,
        weight: NDArray,
    ) -> LightingEquations:
        """Sums over the observations, linearised about maps (n, 3), (n,) and diffuse and specular shading (M, 3)."""
        (diffuse, specular_albedo), (diffuse_light, specular_light) = maps, shading
        n, k = len(diffuse), problem.specular.shape[1]
        by_diffuse, by_specular = weight * diffuse_light, weight * specular_light
        products = by_diffuse * diffuse_light, by_diffuse * specular_light, by_specular * specular_light
        forces = by_diffuse * residual, by_specular * residual
        own = problem.sums(np.concatenate([*products, *forces], axis=1)).astype(np.float64)
        dd, ds, ss, dr, sr = (own[:, 3 * i : 3 * i + 3] for i in range(5))
        system, right = np.zeros((3, k, k)), np.zeros((3, k))
        diffuse_cross, specular_cross = np.empty((3, n, k), np.float32), np.empty((n, 3 * k), np.float32)
        root = np.sqrt(weight)

        def add(each: Block) -> tuple[NDArray, NDArray]:
            """A block's part of the light's system and of its right-hand side."""
            texels, part = each.texels, each.rows
            of = problem.texel[part]
            glossy = specular_albedo[of, None] * problem.specular[part]
            slope = np.empty_like(glossy)
            square, side = np.empty((3, k, k), slope.dtype), np.empty((3, k))
            for c in range(3):
                r = root[part, c]
                np.multiply(diffuse[of, c, None], problem.diffuse[part], out=slope)
                slope += glossy
                slope *= r[:, None]
                np.matmul(slope.T, slope, out=square[c])
                side[c] = (r * residual[part, c]) @ slope
                diffuse_cross[c, texels] = each.sums(r * diffuse_light[part, c], slope)
                specular_cross[texels, c * k : (c + 1) * k] = each.sums(r * specular_light[part, c], slope)
            return square, side

        for square, side in on_all_cores(add, problem.blocks):
            system += square
            right += side
        own_right = np.concatenate([dr, sr.sum(1, keepdims=True)], axis=1)
        return cls(system, right, dd, ds, ss.sum(1), own_right, diffuse_cross, specular_cross)

    def add_priors(
        self,
        priors: LightingPriors,
        light: NDArray,
        maps: tuple[NDArray, NDArray],
        expected: tuple[NDArray, float],
        stiffness: NDArray,
        sphere_basis: NDArray,
        sigma: float,
    ) -> None:
        """Add the quadratic penalties of `LightingPriors` beside residuals of standard deviation `sigma`.

        ``maps`` (n, 3) and (n,) are pulled to the expected ones.
        """
        k = len(stiffness)
        scale = float(np.trace(self.system, axis1=1, axis2=2).mean()) / k
        pull = priors.albedo * np.median(self.diffuse, axis=0)
        self.diffuse += pull
        self.own_right[:, :3] += pull * (expected[0] - maps[0])
        strong = max(priors.specular * float(np.median(self.specular)), specular_pull(expected[1], sigma))
        self.specular += strong
        self.own_right[:, 3] += strong * (expected[1] - maps[1])
        radiance = sphere_basis @ light
        smooth, force = priors.roughness * scale * stiffness, priors.negative * scale * 4.0 * np.pi / len(sphere_basis)
        for c in range(3):
            rows = sphere_basis[radiance[:, c] < 0]
            self.system[c] += force * rows.T @ rows + np.diag(smooth)
            self.right[c] -= force * rows.T @ (rows @ light[:, c]) + smooth * light[:, c]

    def eliminate(self, damping: float) -> Eliminated:
        """What remains for the light once the texels follow it."""
        n, k = self.diffuse_cross.shape[1:]
        floor = 1e-6 * float(np.median(np.concatenate([self.diffuse, self.specular[:, None]], axis=1))) + 1e-12
        pivot = (1.0 + damping) * self.diffuse + floor
        slope = self.both / pivot
        last = (1.0 + damping) * self.specular + floor - (slope * self.both).sum(1)
        own = self.own_right[:, :3] / pivot
        left = (self.own_right[:, 3] - (slope * self.own_right[:, :3]).sum(1)) / last

        def take(texels: slice) -> tuple[NDArray, NDArray]:
            """What some of the texels take from the light's system and from its right-hand side."""
            cross, steep = self.specular_cross[texels], slope[texels].astype(np.float32)
            rest, squares, side = np.empty_like(cross), np.empty((3, k, k), cross.dtype), np.empty(3 * k)
            for c in range(3):
                block, own_cross = slice(c * k, (c + 1) * k), self.diffuse_cross[c, texels]
                np.multiply(own_cross, -steep[:, c, None], out=rest[:, block])
                rest[:, block] += cross[:, block]
                part = own_cross / np.sqrt(pivot[texels, c, None]).astype(np.float32)
                np.matmul(part.T, part, out=squares[c])
                side[block] = own[texels, c].astype(np.float32) @ own_cross
            side += left[texels].astype(np.float32) @ rest
            rest /= np.sqrt(last[texels]).astype(np.float32)[:, None]
            square = rest.T @ rest
            for c in range(3):
                block = slice(c * k, (c + 1) * k)
                square[block, block] += squares[c]
            return square, side

        reduced, right = sl.block_diag(*self.system), self.right.ravel().copy()
        diagonal = np.diag(reduced).copy()
        for square, side in on_all_cores(take, blocks(n, 2 * k)):
            reduced -= square
            right -= side
        reduced[np.diag_indices(3 * k)] += damping * diagonal + 1e-8 * diagonal.mean()
        return Eliminated(pivot, slope, last, reduced, right)

    def solve(
        self, damping: float, lowest: NDArray | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
        """Steps of lighting (K, 3), diffuse (n, 3) and specular albedo (n,).

        ``lowest`` (K, 3) bounds the light's step from below.
        """
        remaining = self.eliminate(damping)
        least = np.full(len(remaining.right), -np.inf) if lowest is None else lowest.T.ravel()
        light = bounded_step(remaining.reduced, remaining.right, least)
        single = light.astype(np.float32).reshape(3, -1)
        left = self.own_right.copy()
        for c in range(3):
            left[:, c] -= self.diffuse_cross[c] @ single[c]
        left[:, 3] -= self.specular_cross @ single.ravel()
        specular = (left[:, 3] - (remaining.slope * left[:, :3]).sum(1)) / remaining.last
        diffuse = left[:, :3] / remaining.pivot - remaining.slope * specular[:, None]
        return light.reshape(3, -1).T, diffuse.astype(np.float32), specular.astype(np.float32)


@dataclass(frozen=True)
class Eliminated:
    """`LightingEquations` with the texels eliminated.

    Attributes
    ----------
    pivot, slope : (n, 3), last : (n,)
        Of the texels' blocks: curvature of the diffuse albedos, how they follow the specular one, and its curvature
        once they do.
    reduced : (3K, 3K), right : (3K,)
        What remains for the lighting.
    """

    pivot: NDArray[np.float64]
    slope: NDArray[np.float64]
    last: NDArray[np.float64]
    reduced: NDArray[np.float64]
    right: NDArray[np.float64]


def bounded_step(system: NDArray, right: NDArray, lowest: NDArray) -> NDArray[np.float64]:
    """Step z (C,), at ``lowest`` or above, that minimises ``z' A z / 2 - b' z``.

    Parameters
    ----------
    system : (C, C)
        A, positive definite.
    right : (C,)
        b.
    lowest : (C,)
        -inf where there is no bound.
    """
    bounded = np.isfinite(lowest)
    if not bounded.any():
        return np.asarray(np.linalg.solve(system, right))
    free = ~bounded
    factor = sl.cho_factor(system[np.ix_(free, free)])
    taken = sl.cho_solve(factor, system[np.ix_(free, bounded)])
    rest = system[np.ix_(bounded, bounded)] - system[np.ix_(bounded, free)] @ taken
    move = np.empty_like(right)
    toward = right[bounded] - taken.T @ right[free] - rest @ lowest[bounded]
    lower = np.linalg.cholesky(rest)
    move[bounded] = scipy.optimize.nnls(lower.T, sl.solve_triangular(lower, toward, lower=True))[0] + lowest[bounded]
    move[free] = sl.cho_solve(factor, right[free]) - taken @ move[bounded]
    return move
