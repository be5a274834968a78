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
from mifit.stages.reflectance.albedo_priors import Tie, borders, row_sum
from mifit.stages.reflectance.maps import TexelSystems

PATCHES = 100
"""Independent measurements that a face is worth: about as many patches have an error of their own."""


@dataclass(frozen=True)
class LightingPriors:
    """What is assumed where the images are silent.

    Attributes
    ----------
    roughness : float
        Penalty on (l (l + 1))^2 times the squared coefficients of band l, relative to `LightingProblem.scale`.
    negative : float
        Penalty on squared negative radiance, relative to the same.
    albedo : float
        Pull of the diffuse albedo to the expected one, relative to the median texel's curvature.
    specular : float
        Pull of each texel's specular albedo to the expected one, relative to the same, at the least.
    """

    roughness: float = 1e-7
    negative: float = 0.5
    albedo: float = 1e-2
    specular: float = 2e-2


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
        The most that is expected of the specular albedo; below 1, at least half of it is.
    priors : LightingPriors
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
    priors: LightingPriors = LightingPriors()

    def shade(self, light: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(M, 3) diffuse and specular radiance at unit albedo under a lighting (K, 3)."""
        single = light.astype(np.float32)
        return self.diffuse @ single, self.specular @ single

    @cached_property
    def share(self) -> NDArray[np.float64]:
        """(n, 3) part of the observations that each texel has."""
        seen = self.sums(self.weight).astype(np.float64)
        return seen / max(float(seen.sum()), 1e-12)

    @cached_property
    def freedom(self) -> float:
        """Part of the observations that is left to judge by, once each texel has its four albedos."""
        count = 3 * np.diff(self.start)
        return max(float(np.maximum(count - 4, 0).sum()), 1.0) / max(int(count.sum()), 1)

    @cached_property
    def level(self) -> float:
        """Mean colour of what is observed."""
        return float((self.weight * self.colour).sum() / max(float(self.weight.sum()), 1e-12))

    @cached_property
    def scale(self) -> float:
        """Mean curvature of the smooth light's coefficients under the expected albedo, beside which priors count."""
        smooth = self.diffuse[:, : self.order**2]
        bright = (self.weight * self.albedo[self.texel] ** 2).sum(axis=1)
        return float(bright @ np.einsum("mk,mk->m", smooth, smooth)) / (3 * self.order**2)

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


def texel_systems(
    problem: LightingProblem, shading: tuple[NDArray, NDArray], weight: NDArray, target: NDArray
) -> TexelSystems:
    """Blocks of the n texels: what two shadings (M, 3), each times an albedo, have to add up to."""
    by_diffuse, by_specular = weight * shading[0], weight * shading[1]
    products = by_diffuse * shading[0], by_diffuse * shading[1], by_diffuse * target
    glossy = np.stack([(by_specular * shading[1]).sum(axis=1), (by_specular * target).sum(axis=1)], axis=1)
    own = problem.sums(np.concatenate([*products, glossy], axis=1)).astype(np.float64)
    return TexelSystems(own[:, :3], own[:, 3:6], own[:, 6:9], own[:, 9], own[:, 10])


@dataclass(frozen=True)
class LightingEquations:
    """Normal equations: lighting (3K) against the texels' own blocks of three diffuse albedos and one specular one.

    Diffuse albedos touch one another only by the specular one, and each only its own channel's light.

    Attributes
    ----------
    light : (3, K, K), right : (3, K)
        Of the lighting, by channel.
    texels : TexelSystems
        Of the n texels.
    ties : list of Tie, stiffness : float
        Rows that tie texels together, and the second one's own curvature.
    diffuse_cross : (3, n, K)
        Diffuse albedos against the light of their channel.
    specular_cross : (n, 3K)
        Specular albedo against the light.
    """

    light: NDArray[np.float64]
    right: NDArray[np.float64]
    texels: TexelSystems
    ties: list[Tie]
    stiffness: float
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
        texels = texel_systems(problem, shading, weight, residual)
        return cls(system, right, texels, [], 0.0, diffuse_cross, specular_cross)

    def eliminate(self, damping: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3K, 3K) and (3K,) what remains for the light once the texels follow it."""
        n, k = self.diffuse_cross.shape[1:]
        texels, slope, last = self.texels, self.texels.ds / self.texels.dd, self.texels.specular_information
        own, left = texels.dr / texels.dd, (texels.sr - (slope * texels.dr).sum(1)) / last

        def take(part: slice) -> tuple[NDArray, NDArray]:
            """What some of the texels take from the light's system and from its right-hand side."""
            cross, steep = self.specular_cross[part], slope[part].astype(np.float32)
            rest, squares, side = np.empty_like(cross), np.empty((3, k, k), cross.dtype), np.empty(3 * k)
            for c in range(3):
                block, own_cross = slice(c * k, (c + 1) * k), self.diffuse_cross[c, part]
                np.multiply(own_cross, -steep[:, c, None], out=rest[:, block])
                rest[:, block] += cross[:, block]
                scaled = own_cross / np.sqrt(texels.dd[part, c, None]).astype(np.float32)
                np.matmul(scaled.T, scaled, out=squares[c])
                side[block] = own[part, c].astype(np.float32) @ own_cross
            side += left[part].astype(np.float32) @ rest
            rest /= np.sqrt(last[part]).astype(np.float32)[:, None]
            square = rest.T @ rest
            for c in range(3):
                block = slice(c * k, (c + 1) * k)
                square[block, block] += squares[c]
            return square, side

        reduced, right = sl.block_diag(*self.light), self.right.ravel().copy()
        diagonal = np.diag(reduced).copy()
        for square, side in on_all_cores(take, blocks(n, 2 * k)):
            reduced -= square
            right -= side
        if self.ties:
            moves, core = borders(texels, self.ties, self.stiffness)
            along = np.stack([self._across(*move) for move in moves], axis=1)
            force = np.array([row_sum((texels.dr, texels.sr), move) for move in moves])
            reduced -= along @ np.linalg.solve(core, along.T)
            right -= along @ np.linalg.solve(core, force)
        reduced[np.diag_indices(3 * k)] += damping * diagonal + 1e-8 * diagonal.mean()
        return reduced, right

    def _across(self, diffuse: NDArray, specular: NDArray) -> NDArray[np.float64]:
        """(3K,) forces of moved albedos (n, 3), (n,) on the light."""
        force = np.einsum("cnk,nc->ck", self.diffuse_cross, diffuse.astype(np.float32)).ravel()
        return (force + specular.astype(np.float32) @ self.specular_cross).astype(np.float64)

    def solve(self, damping: float, lowest: NDArray | None = None) -> NDArray[np.float64]:
        """Step (K, 3) of the lighting; ``lowest`` (K, 3) bounds it from below."""
        reduced, right = self.eliminate(damping)
        least = np.full(len(right), -np.inf) if lowest is None else lowest.T.ravel()
        return bounded_step(reduced, right, least).reshape(3, -1).T


def bounded_step(system: NDArray, right: NDArray, lowest: NDArray) -> NDArray[np.float64]:
    """Step z (C,) that minimises ``z' A z / 2 - b' z``, at ``lowest`` (C,) or above, which may be -inf.

    ``system`` (C, C) is A, positive definite, ``right`` (C,) is b.
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
