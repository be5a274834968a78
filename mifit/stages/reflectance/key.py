"""Where a compact light stands: a search over its direction and size, each judged by what it would explain.

Given direction and size, a compact light adds three unknowns to the lighting, its irradiance per channel. What it would
explain once lighting and maps have adapted follows in closed form from the normal equations without it, so a
candidate costs its shadow rays and a few products instead of a solve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.appearance.illumination import DistantLight, Light
from mifit.appearance.reception import fibonacci_sphere
from mifit.core.process import on_all_cores
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward, LightColumns
from mifit.stages.reflectance.lighting import LightingSolution, bounded_weight, linearize
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingPriors, LightingProblem

TEXELS = 1000
"""Texels that judge candidates."""
SPACING, WIDE = np.radians([12.0, 8.0])
"""First search: between directions all over the sphere, and angular radius; wide penumbras lead the way."""
LEAST = 0.05
"""Part of the texels that a light must reach to be looked at."""
STARTS, APART = 3, np.radians(30.0)
"""Second searches, and the least angle between their starts, and to compact lights that there are."""
STEPS = np.radians([4.0, 0.2])
"""Second search: from the first step to the last one."""
RADII = np.radians([0.25, 10.0])
"""Angular radii that count as compact; a search that ends at the upper one has found no compact light."""
WORTH, WORTH_BESIDE = 0.03, 0.01
"""Part of the energy that a compact light must explain to be tried: the first one, and one beside another, which is
weaker than that. This spares time; whether a light is kept is told by prediction."""


@dataclass(frozen=True)
class Candidates:
    """What a lighting leaves unexplained, ready to judge compact lights beside those that it has.

    Attributes
    ----------
    seen : Observations
        n texels in J images.
    forward : Forward
        The model without compact lights.
    columns : callable
        What a compact light sends off the texels, `Forward.light_columns`.
    rows : three of (n * J, K)
        Derivative of the image by the lighting, compact lights that are kept included, per channel.
    weight, residual, diffuse_light, specular_light : (n, J, 3)
    diffuse : (n, 3), specular_albedo : (n,)
    inverse : (n, 4, 4), diffuse_cross : (3, n, K), specular_cross : (n, 3K), own_right : (n, 4)
        The texels' blocks of the normal equations (`LightingEquations`).
    factor : (3K, 3K), right : (3K,)
        Inverse and right-hand side of the equations for the lighting with the texels eliminated.
    kept : tuple of Light
        Compact lights that are among the lighting.
    """

    seen: Observations
    forward: Forward
    columns: LightColumns
    rows: list[NDArray]
    weight: NDArray
    residual: NDArray
    diffuse_light: NDArray
    specular_light: NDArray
    diffuse: NDArray
    specular_albedo: NDArray
    inverse: NDArray
    diffuse_cross: NDArray
    specular_cross: NDArray
    own_right: NDArray
    factor: NDArray
    right: NDArray
    kept: tuple[Light, ...] = ()

    @classmethod
    def about(
        cls,
        seen: Observations,
        forward: Forward,
        problem: LightingProblem,
        found: LightingSolution,
        priors: LightingPriors = PRIORS,
        kept: tuple[Light, ...] = (),
    ) -> Candidates:
        """Linearise about a solution with the first of its compact lights kept.

        The others are taken away: candidates are to replace them.
        """
        k = forward.order**2 + len(kept)
        light = found.light.astype(np.float32)
        x, y = found.diffuse[:, None], found.specular[:, None, None]
        residual = problem.colour - form_image(0.0, x, problem.diffuse @ light, y, problem.specular @ light)
        weight = bounded_weight(problem, residual)
        plain = replace(problem, diffuse=problem.diffuse[..., :k], specular=problem.specular[..., :k])
        diffuse_light, specular_light = plain.diffuse @ light[:k], plain.specular @ light[:k]
        residual = problem.colour - form_image(0.0, x, diffuse_light, y, specular_light)
        there = plain.seen
        normal = linearize(
            plain,
            plain.rows(),
            found.light[:k],
            found.diffuse,
            found.specular,
            diffuse_light[there],
            specular_light[there],
            residual[there],
            weight[there],
            priors,
        )
        remaining = normal.eliminate(False, 1e-4)
        rows = [(x[..., c : c + 1] * plain.diffuse + y * plain.specular).reshape(-1, k) for c in range(3)]
        alone = forward.with_lights(())
        return cls(
            seen,
            alone,
            alone.light_columns(seen),
            rows,
            weight,
            residual,
            diffuse_light,
            specular_light,
            found.diffuse,
            found.specular,
            remaining.inverse(),
            normal.diffuse_cross,
            normal.specular_cross,
            normal.own_right,
            np.linalg.inv(remaining.reduced),
            remaining.right,
            kept,
        )

    def explained(self, lights: Sequence[DistantLight], open_sky: NDArray[np.uint32] | None = None) -> NDArray:
        """(M,) drop of the energy that each of some compact lights brings on its own, everything else adapting.

        Their shadows are traced, unless bits tell which directions of their discs the texels see (M, n, T).
        """
        return self.explained_by(*self.columns(lights, open_sky))

    def explained_by(self, by_diffuse: NDArray, by_specular: NDArray) -> NDArray:
        """(M,) drop of the energy for what compact lights send off the texels (M, n, J), as of `columns`."""
        m, n, k = len(by_diffuse), len(self.diffuse), self.rows[0].shape[1]
        system, right = np.zeros((m, 3, 3)), np.zeros((m, 3))
        across, moved = np.zeros((m, 3, 3 * k)), np.zeros((m, n, 4, 3))
        own = np.zeros((m, n, 4, 3), self.weight.dtype)
        for c in range(3):
            column = self.diffuse[:, None, c] * by_diffuse + self.specular_albedo[:, None] * by_specular
            weighted = self.weight[..., c] * column
            system[:, c, c] = np.einsum("mnj,mnj->m", weighted, column)
            right[:, c] = np.tensordot(weighted, self.residual[..., c], 2)
            across[:, c, c * k : (c + 1) * k] = weighted.reshape(m, -1) @ self.rows[c]
            own[:, :, c, c] = np.einsum("mnj,nj->mn", weighted, self.diffuse_light[..., c])
            own[:, :, 3, c] = np.einsum("mnj,nj->mn", weighted, self.specular_light[..., c])
            for unknown in (c, 3):  # a channel's light touches no other channel's albedo
                moved[..., c] += self.inverse[:, :, unknown] * own[:, :, unknown, c, None]
        system -= np.einsum("mnia,mnib->mab", own, moved, optimize=True)
        right -= np.tensordot(moved, self.own_right, ([1, 2], [0, 1]))
        single = moved.astype(self.specular_cross.dtype).transpose(2, 0, 3, 1)  # (4, M, 3, n)
        across -= (single[3].reshape(-1, n) @ self.specular_cross).reshape(m, 3, -1)
        for c in range(3):
            across[..., c * k : (c + 1) * k] -= (single[c].reshape(-1, n) @ self.diffuse_cross[c]).reshape(m, 3, -1)
        adapted = across @ self.factor
        system -= adapted @ across.transpose(0, 2, 1)
        right -= adapted @ self.right
        floor = 1e-9 * np.trace(system, axis1=1, axis2=2) + 1e-12
        damped = system + floor[:, None, None] * np.eye(3)
        irradiance = np.maximum(np.linalg.solve(damped, right[..., None])[..., 0], 0.0)
        return 2.0 * (right * irradiance).sum(1) - np.einsum("mi,mij,mj->m", irradiance, system, irradiance)


@dataclass(frozen=True)
class WideLights:
    """Wide lights from all over the sphere and what they send off some texels, whatever else lights them.

    Attributes
    ----------
    directions : (M, 3)
    reaching : (R,) int
        Those that reach enough of the texels.
    parts : list of two of (P, n, J)
        Diffuse and specular radiance of some of these at a time.
    """

    directions: NDArray[np.float64]
    reaching: NDArray[np.intp]
    parts: list[tuple[NDArray[np.float32], NDArray[np.float32]]]

    @classmethod
    def of(cls, seen: Observations, forward: Forward) -> WideLights:
        """Trace all directions' shadows on texels, a ray for each direction."""
        directions = fibonacci_sphere(round(4.0 * np.pi / SPACING**2))
        alone = forward.with_lights(())
        columns, reaching, parts = alone.light_columns(seen), [], []
        for start in range(0, len(directions), 32):
            part = directions[start : start + 32]
            bits = alone.open_towards(seen, part)
            visible = (bits[None] >> np.arange(len(part), dtype=np.uint32)[:, None, None]) & np.uint32(1)
            reached = np.flatnonzero(visible.mean((1, 2)) > LEAST)
            if len(reached):
                lights = [DistantLight(part[i], WIDE, np.zeros(3)) for i in reached]
                reaching.append(start + reached)
                parts.append(columns(lights, np.where(visible[reached], np.uint32(0xFFFFFFFF), np.uint32(0))))
        return cls(directions, np.concatenate(reaching) if reaching else np.zeros(0, np.intp), parts)

    def explained(self, candidates: Candidates) -> NDArray[np.float64]:
        """(M,) how much each explains."""
        gains = np.zeros(len(self.directions))
        if self.parts:
            found = on_all_cores(lambda part: candidates.explained_by(*part), self.parts)
            gains[self.reaching] = np.concatenate(found)
        return gains


def starts(candidates: Candidates, wide: WideLights) -> list[NDArray[np.float64]]:
    """Directions from which a search is worth a trial, the most promising first.

    They are `APART` from one another and from lights that are kept: what seems to stand beside a lamp is its shape.

    A wide light in a wrong place may explain as much as one in the right place: only the narrow ones that the searches
    end with tell them apart.
    """
    directions, gains = wide.directions, wide.explained(candidates)
    worth = WORTH_BESIDE if candidates.kept else WORTH
    energy = float((candidates.weight * candidates.residual**2).sum())
    found: list[NDArray[np.float64]] = []
    for number in np.argsort(-gains):
        if len(found) == STARTS or not gains[number] > worth * energy:
            break
        if apart(directions[number], [*(light.direction for light in candidates.kept), *found]):
            found.append(directions[number])
    return found


def apart(direction: NDArray, others: Sequence[NDArray]) -> bool:
    """Whether a direction is `APART` from all others."""
    return all(direction @ other < np.cos(APART) for other in others)


def find_lights(candidates: Candidates, wide: WideLights) -> list[tuple[DistantLight, ...]]:
    """What to try beside the lights that there are, the most promising first; none where nothing explains enough.

    Compact lights, each the best about one of `starts`. Where two lights are missing a search for one may widen to make
    up for the other: so the two best places of any size come last, together.
    """
    found = [search(candidates, direction, WIDE, STEPS[0]) for direction in starts(candidates, wide)]
    ranked: list[DistantLight] = []
    for _, light in sorted(found, key=lambda pair: -pair[0]):
        if apart(light.direction, [other.direction for other in (*candidates.kept, *ranked)]):
            ranked.append(light)
    compact = [(light,) for light in ranked if light.radius < RADII[1]]
    return [*compact, *([tuple(ranked[:2])] if len(ranked) > 1 else [])]


def search(
    candidates: Candidates, direction: NDArray[np.float64], radius: float, step: float
) -> tuple[float, DistantLight]:
    """The light near a direction and an angular radius that explains most, and how much; `step` is the first one."""
    (gain,) = candidates.explained([DistantLight(direction, radius, np.zeros(3))])
    widen = 1.5
    while step > STEPS[1]:
        around = [(d, radius) for d in ring(direction, step)]
        around += [(direction, float(np.clip(radius * f, *RADII))) for f in (widen, 1.0 / widen)]
        gains = candidates.explained([DistantLight(*c, np.zeros(3)) for c in around])
        best = int(np.argmax(gains))
        if gains[best] > gain:
            (direction, radius), gain = around[best], gains[best]
        else:
            step, widen = 0.5 * step, np.sqrt(widen)
    return float(gain), DistantLight(direction, float(radius), np.zeros(3))


def ring(direction: NDArray, angle: float, count: int = 6) -> NDArray[np.float64]:
    """(count, 3) directions at an angle from one."""
    across = np.linalg.svd(direction[None])[2][1:]
    turn = 2.0 * np.pi * np.arange(count) / count
    return np.cos(angle) * direction + np.sin(angle) * np.stack([np.cos(turn), np.sin(turn)], axis=1) @ across
