"""Normal equations of the lighting beside the maps: sums over the observations, priors, elimination of the texels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as sl
import scipy.optimize
import scipy.sparse as sp
from numpy.typing import NDArray

from mifit.core.process import on_all_cores

SPECULAR_SPREAD = 0.15
"""Standard deviation of the specular albedo over a face, relative to its median."""
SPECULAR_LIMIT = 0.03
"""Specular albedo expected of skin where the images don't tell: at the most what it reflects at normal incidence (index
of refraction 1.4)."""
FEW_IMAGES = 4
"""Images of a texel from which its four albedos are told by the images."""
BLOCK = 1 << 20
"""Derivatives that are held at a time: they stay in the cache."""
CROSSED = 1 << 17
"""Derivatives by albedo and a channel's light that are eliminated at a time."""


@dataclass(frozen=True)
class LightingProblem:
    """n texels seen in J images, K lighting coefficients.

    Attributes
    ----------
    colour : (n, J, 3)
        Observed linear colour.
    weight : (n, J, 3)
        Weight of each observation; 0 where there is none.
    clipped : (n, J) bool
        Observations that are lower bounds only.
    diffuse : (n, J, K)
        Transfer vectors of the diffuse reflection at unit albedo.
    specular : (n, J, K)
        Transfer vectors of the specular reflection at unit albedo.
    albedo : (n, 3)
        Diffuse albedo expected by the morphable model.
    order : int
        Bands B of the smooth light: the first B*B of the K; the others are the compact lights.
    """

    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    albedo: NDArray[np.float32]
    order: int

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(n, J) observations that there are."""
        return np.asarray((self.weight > 0).any(axis=2))

    def rows(self) -> SeenRows:
        """The observations that there are, texel after texel: a third of all texels and images face one another not."""
        seen = self.seen
        start = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
        every = (getattr(self, name)[seen] for name in ("colour", "weight", "clipped", "diffuse", "specular"))
        return SeenRows(np.nonzero(seen)[0], start, *every)


@dataclass(frozen=True)
class SeenRows:
    """The M observations of n texels that count, in the order of the texels.

    Attributes
    ----------
    texel : (M,)
        Which texel each shows.
    start : (n + 1,)
        Where the observations of each texel begin.
    colour, weight : (M, 3)
    clipped : (M,)
    diffuse, specular : (M, K)
        As in `LightingProblem`.
    """

    texel: NDArray[np.intp]
    start: NDArray[np.intp]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]

    def sums(self, values: NDArray) -> NDArray:
        """Per texel (n, ...) the sum of values (M, ...)."""
        return _per_texel(self.start) @ values

    @cached_property
    def blocks(self) -> list[Block]:
        """All of them in parts, each of whole texels."""
        found, first, n = [], 0, len(self.start) - 1
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


def expected_specular(specular: NDArray, seen: NDArray) -> float:
    """Specular albedo to expect of a texel, given those of others (n,) and which images see them (n, J).

    Two or three images of a still head leave it open how much of the broad reflection is specular.
    """
    found = float(np.median(specular))
    return found if float(np.median(seen.sum(axis=1))) >= FEW_IMAGES else min(found, SPECULAR_LIMIT)


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
        Pull of the diffuse albedo to the morphable model's: fixes the gauge between albedo and lighting.
    specular : float
        Pull of each texel's specular albedo to the expected one, at the least; see `SPECULAR_SPREAD`.
    sparsity : float
        Part of the data's energy that compact lights have to explain, were they all light.
    """

    roughness: float = 1e-7
    negative: float = 0.5
    albedo: float = 1e-2
    specular: float = 2e-2
    sparsity: float = 0.0


PRIORS = LightingPriors()
"""The usual weights."""


@dataclass(frozen=True)
class LightingStep:
    """A step of lighting (K, 3), ambient, diffuse (n, 3) and specular albedo (n,)."""

    light: NDArray[np.float64]
    ambient: float
    diffuse: NDArray[np.float32]
    specular_albedo: NDArray[np.float32]


@dataclass
class LightingEquations:
    """Normal equations: lighting (3K) and ambient (1) against the texels' own blocks of three diffuse albedos and one
    specular one. Diffuse albedos touch one another only by the specular one, and each only its own channel's light.

    Attributes
    ----------
    system : (3K + 1, 3K + 1), right : (3K + 1,)
        Of lighting and ambient.
    diffuse, both : (n, 3), specular : (n,)
        Blocks: curvature of the diffuse albedos, theirs with the specular one, and its own.
    own_right : (n, 4)
    diffuse_cross : (3, n, K)
        Diffuse albedos against the light of their channel.
    specular_cross : (n, 3K)
        Specular albedo against the light.
    ambient_cross : (n, 4)
        Albedos against ambient.
    """

    system: NDArray[np.float64]
    right: NDArray[np.float64]
    diffuse: NDArray[np.float64]
    both: NDArray[np.float64]
    specular: NDArray[np.float64]
    own_right: NDArray[np.float64]
    diffuse_cross: NDArray[np.float32]
    specular_cross: NDArray[np.float32]
    ambient_cross: NDArray[np.float64]

    @classmethod
    def accumulate(
        cls,
        rows: SeenRows,
        diffuse: NDArray,
        specular_albedo: NDArray,
        diffuse_light: NDArray,
        specular_light: NDArray,
        residual: NDArray,
        weight: NDArray,
    ) -> LightingEquations:
        """Sums over the observations of a problem, linearised about maps (n, 3), (n,) and shading (M, 3)."""
        n, k = len(diffuse), rows.specular.shape[1]
        by_diffuse, by_specular = weight * diffuse_light, weight * specular_light
        own = rows.sums(
            np.concatenate(
                [
                    by_diffuse * diffuse_light,
                    by_diffuse * specular_light,
                    by_specular * specular_light,
                    by_diffuse * residual,
                    by_specular * residual,
                    by_diffuse,
                    by_specular,
                ],
                axis=1,
            )
        ).astype(np.float64)
        dd, ds, ss, dr, sr, da, sa = (own[:, 3 * i : 3 * i + 3] for i in range(7))
        system, right = np.zeros((3 * k + 1, 3 * k + 1)), np.zeros(3 * k + 1)
        system[-1, -1], right[-1] = weight.sum(dtype=np.float64), (weight * residual).sum(dtype=np.float64)
        diffuse_cross, specular_cross = np.empty((3, n, k), np.float32), np.empty((n, 3 * k), np.float32)
        root = np.sqrt(weight)

        def add(each: Block) -> tuple[NDArray, NDArray, NDArray]:
            """A block's part of the light's system, of its column of ambient and of its right-hand side, by channel."""
            texels, part = each.texels, each.rows
            of = rows.texel[part]
            glossy = specular_albedo[of, None] * rows.specular[part]
            slope = np.empty_like(glossy)
            square, column, side = np.empty((3, k, k), slope.dtype), np.empty((3, k)), np.empty((3, k))
            for c in range(3):
                r = root[part, c]
                np.multiply(diffuse[of, c, None], rows.diffuse[part], out=slope)
                slope += glossy
                slope *= r[:, None]
                np.matmul(slope.T, slope, out=square[c])
                column[c], side[c] = r @ slope, (r * residual[part, c]) @ slope
                diffuse_cross[c, texels] = each.sums(r * diffuse_light[part, c], slope)
                specular_cross[texels, c * k : (c + 1) * k] = each.sums(r * specular_light[part, c], slope)
            return square, column, side

        for square, column, side in on_all_cores(add, rows.blocks):
            for c in range(3):
                block = slice(c * k, (c + 1) * k)
                system[block, block] += square[c]
                system[block, -1] += column[c]
                right[block] += side[c]
        system[-1, :-1] = system[:-1, -1]
        own_right = np.concatenate([dr, sr.sum(1, keepdims=True)], axis=1)
        ambient = np.concatenate([da, sa.sum(1, keepdims=True)], axis=1)
        return cls(system, right, dd, ds, ss.sum(1), own_right, diffuse_cross, specular_cross, ambient)

    def add_priors(
        self,
        priors: LightingPriors,
        light: NDArray,
        diffuse: NDArray,
        specular_albedo: NDArray,
        albedo: NDArray,
        stiffness: NDArray,
        sphere_basis: NDArray,
        sigma: float,
        expected: float,
    ) -> None:
        """Add the quadratic penalties of `LightingPriors` beside residuals of standard deviation `sigma`.

        `expected` is the specular albedo that texels are pulled to.
        """
        k = len(stiffness)
        scale = float(np.trace(self.system[:-1, :-1])) / (3 * k)
        pull = priors.albedo * np.median(self.diffuse, axis=0)
        self.diffuse += pull
        self.own_right[:, :3] += pull * (albedo - diffuse)
        strong = max(priors.specular * float(np.median(self.specular)), specular_pull(expected, sigma))
        self.specular += strong
        self.own_right[:, 3] += strong * (expected - specular_albedo)
        radiance = sphere_basis @ light
        for c in range(3):
            block = slice(c * k, (c + 1) * k)
            negative = radiance[:, c] < 0
            rows = sphere_basis[negative]
            force = priors.negative * scale * 4.0 * np.pi / len(sphere_basis)
            smooth = priors.roughness * scale * stiffness
            self.system[block, block] += force * rows.T @ rows + np.diag(smooth)
            self.right[block] -= force * rows.T @ radiance[negative, c] + smooth * light[:, c]

    def eliminate(self, with_ambient: bool, damping: float) -> Eliminated:
        """What remains for the light, and for ambient if asked for, once the texels follow it."""
        k = self.diffuse_cross.shape[2]
        floor = 1e-6 * float(np.median(np.concatenate([self.diffuse, self.specular[:, None]], axis=1))) + 1e-12
        pivot = (1.0 + damping) * self.diffuse + floor
        slope = self.both / pivot
        last = (1.0 + damping) * self.specular + floor - (slope * self.both).sum(1)
        size = len(self.right)
        taken, right = np.zeros((size, size)), self.right.copy()
        own = self.own_right[:, :3] / pivot
        left = (self.own_right[:, 3] - (slope * self.own_right[:, :3]).sum(1)) / last
        across = self.ambient_cross[:, 3] - (slope * self.ambient_cross[:, :3]).sum(1)
        taken[-1, -1] = (self.ambient_cross[:, :3] ** 2 / pivot).sum() + (across**2 / last).sum()
        right[-1] -= (own * self.ambient_cross[:, :3]).sum() + left @ across

        def take(texels: slice) -> tuple[NDArray, NDArray]:
            """What some of the texels take from the light's system, and from right-hand side and column of ambient."""
            cross, steep = self.specular_cross[texels], slope[texels].astype(np.float32)
            rest, squares = np.empty_like(cross), np.empty((3, k, k), cross.dtype)
            sides = np.empty((2, 3 * k))
            for c in range(3):
                block, own_cross = slice(c * k, (c + 1) * k), self.diffuse_cross[c, texels]
                np.multiply(own_cross, -steep[:, c, None], out=rest[:, block])
                rest[:, block] += cross[:, block]
                part = own_cross / np.sqrt(pivot[texels, c, None]).astype(np.float32)
                np.matmul(part.T, part, out=squares[c])
                both = np.stack([own[texels, c], self.ambient_cross[texels, c] / pivot[texels, c]])
                sides[:, block] = both.astype(np.float32) @ own_cross
            sides += np.stack([left[texels], across[texels] / last[texels]]).astype(np.float32) @ rest
            rest /= np.sqrt(last[texels]).astype(np.float32)[:, None]
            square = (rest.T @ rest).astype(np.float64)
            for c in range(3):
                block = slice(c * k, (c + 1) * k)
                square[block, block] += squares[c]
            return square, sides

        n, step = len(last), max(CROSSED // k, 1)
        for square, sides in on_all_cores(take, [slice(at, at + step) for at in range(0, n, step)]):
            taken[:-1, :-1] += square
            right[:-1] -= sides[0]
            taken[:-1, -1] += sides[1]
        taken[-1, :-1] = taken[:-1, -1]
        count = size if with_ambient else size - 1
        own_diagonal = np.diag(self.system)[:count]
        reduced = self.system[:count, :count] - taken[:count, :count]
        reduced += np.diag(damping * own_diagonal + 1e-8 * own_diagonal.mean())
        return Eliminated(pivot, slope, last, reduced, right[:count])

    def solve(
        self, with_ambient: bool, damping: float, lowest: NDArray | None = None, penalty: float = 0.0
    ) -> LightingStep:
        """Eliminate the texels, solve for lighting and ambient, and substitute back.

        ``lowest`` (K, 3) bounds the light's step from below, and ``penalty`` is that on the sum of what is bounded.
        """
        remaining = self.eliminate(with_ambient, damping)
        least = np.full(len(remaining.right), -np.inf)
        if lowest is not None:
            least[: lowest.size] = lowest.T.ravel()
        move = bounded_step(remaining.reduced, remaining.right, least, penalty)
        size = len(self.right) - 1
        ambient = float(move[size]) if with_ambient else 0.0
        light = np.asarray(move[:size], dtype=np.float64).reshape(3, -1)
        left = self.own_right - ambient * self.ambient_cross
        single = light.astype(np.float32)
        for c in range(3):
            left[:, c] -= self.diffuse_cross[c] @ single[c]
        left[:, 3] -= self.specular_cross @ single.ravel()
        own = remaining.follow(left).astype(np.float32)
        return LightingStep(light.T, ambient, own[:, :3], own[:, 3])


@dataclass(frozen=True)
class Eliminated:
    """`LightingEquations` with the texels eliminated.

    Attributes
    ----------
    pivot, slope : (n, 3), last : (n,)
        Of the texels' blocks: curvature of the diffuse albedos, how they follow the specular one, and its curvature
        once they do.
    reduced : (C, C), right : (C,)
        What remains for lighting and ambient.
    """

    pivot: NDArray[np.float64]
    slope: NDArray[np.float64]
    last: NDArray[np.float64]
    reduced: NDArray[np.float64]
    right: NDArray[np.float64]

    def follow(self, right: NDArray) -> NDArray[np.float64]:
        """Albedos (n, 4) that right-hand sides (n, 4) ask for."""
        specular = (right[:, 3] - (self.slope * right[:, :3]).sum(1)) / self.last
        return np.concatenate([right[:, :3] / self.pivot - self.slope * specular[:, None], specular[:, None]], axis=1)

    def inverse(self) -> NDArray[np.float64]:
        """(n, 4, 4) inverse blocks of the texels."""
        return np.stack([self.follow(np.broadcast_to(unit, (len(self.last), 4))) for unit in np.eye(4)], axis=2)


def bounded_step(system: NDArray, right: NDArray, lowest: NDArray, penalty: float = 0.0) -> NDArray[np.float64]:
    """Step z (C,), at ``lowest`` or above, that minimises ``z' A z / 2 - b' z + penalty * sum(z with a bound)``.

    Parameters
    ----------
    system : (C, C)
        A, positive definite.
    right : (C,)
        b.
    lowest : (C,)
        -inf where there is no bound.
    penalty : float
    """
    bounded = np.isfinite(lowest)
    if not bounded.any():
        return np.asarray(np.linalg.solve(system, right))
    free = ~bounded
    factor = sl.cho_factor(system[np.ix_(free, free)])
    taken = sl.cho_solve(factor, system[np.ix_(free, bounded)])
    rest = system[np.ix_(bounded, bounded)] - system[np.ix_(bounded, free)] @ taken
    move = np.empty_like(right)
    toward = right[bounded] - taken.T @ right[free] - penalty - rest @ lowest[bounded]
    move[bounded] = non_negative(rest, toward) + lowest[bounded]
    move[free] = sl.cho_solve(factor, right[free]) - taken @ move[bounded]
    return move


def non_negative(system: NDArray, right: NDArray) -> NDArray[np.float64]:
    """u >= 0 (G,) that minimises ``u' A u / 2 - b' u``; those that would grow join in, 32 at a time."""
    u, active = np.zeros(len(right)), np.zeros(0, np.intp)
    least = 1e-9 * float(np.abs(right).max(initial=0.0))
    for _ in range(len(right)):
        gradient = right - system[:, active] @ u[active]
        gradient[active] = 0.0
        joining = np.argsort(-gradient)[:32]
        joining = joining[gradient[joining] > least]
        if not len(joining):
            break
        active = np.concatenate([active, joining])
        lower = np.linalg.cholesky(system[np.ix_(active, active)])
        u[active] = scipy.optimize.nnls(lower.T, sl.solve_triangular(lower, right[active], lower=True))[0]
        active = active[u[active] > 0]
    return u
