"""Compact lights: the sparse part of one estimate that has smooth and hard light in it.

Smooth light has SH coefficients L, hard light irradiances e_g >= 0 from single directions d_g all over the sphere, with
shadows traced. With texel albedos x, y all are found together by `lighting.solve_lighting`:

    min  sum w (I - x (D L + D_g e) - y (S L + S_g e))^2 + priors,   e >= 0

Bands can show most of what a direction adds, and albedos adapt to it, so e is zero but for a few directions. They enter
one at a time (orthogonal matching pursuit, Pati et al. 1993): the one that lowers the sum most once smooth light and
albedos have followed. Its place and size are then found by Gauss-Newton with all else, and it stays if it explains more
than noise would.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.illumination import DistantLight
from mifit.appearance.reception import DIRECTIONS, fibonacci_sphere
from mifit.core.mesh import normalize
from mifit.core.sh import LUMINANCE
from mifit.sampling.observations import Observations
from mifit.sampling.visibility import DARKEST
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import (
    LightingSolution,
    Residuals,
    lighting_problem,
    solve_lighting,
)
from mifit.stages.reflectance.lighting_equations import PATCHES, LightingProblem

OBSERVATIONS = 8000
"""Texels times images that the estimate is made from."""
EVIDENCE = 4.0
"""Times what a number of no meaning explains that a light must explain. Chosen on the scan of scan_city under two suns
and in its lobby, on gloss, and on Emily c3,c4: lights that help views held out explain 4.3 or more, others less."""
FAINT = 0.1
"""Part of the mean colour that a light must reflect. Data without noise show fainter ones where there are none."""
LIGHTS = 3
"""Compact lights at the most: a face shows a few lamps apart, and what more there are is smooth light to it."""
ITERATIONS = 8
"""Gauss-Newton iterations of all light and albedos under lights in given places, and places that are tried."""
SLOPE = np.radians(1.0)
"""Angle over which the columns of a light are differentiated: shadows have edges."""
RADII = np.radians([0.25, 15.0])
"""Angular radii of a compact light; a larger one is smooth light."""


def find_lights(
    seen: Observations, forward: Forward, albedo: NDArray
) -> tuple[tuple[DistantLight, ...], LightingSolution]:
    """Compact lights beside smooth light, without colour, and all light; none where images show none.

    ``forward`` has the shading model, the lobe and the bands of the smooth light; ``albedo`` (n, 3) is the diffuse one
    that the morphable model expects of the n texels seen.
    """
    directions, lights = fibonacci_sphere(DIRECTIONS), tuple[DistantLight, ...]()
    columns = forward.columns(seen, directions)
    problem, found = _solved(seen, forward, lights, albedo)
    while len(lights) < LIGHTS:
        best = int(np.argmax(_gains(problem, found, columns)))
        more = (*lights, DistantLight(directions[best], float(np.sqrt(RADII.prod())), np.zeros(3)))
        more, problem, other = _settled(seen, forward, more, albedo, found)
        reflected = float(other.light[-1] @ LUMINANCE * albedo.mean() / np.pi)
        if _explained(found, other) < EVIDENCE or reflected < FAINT * problem.level or more[-1].radius >= RADII[1]:
            break
        lights, found = more, other
    return lights, found


def _wider(problem: LightingProblem, found: LightingSolution, columns: Sequence[NDArray]) -> tuple[NDArray, NDArray]:
    """Normal equations of the light with further unknowns that are zero so far; ``columns`` are two of (M, G)."""
    more = np.zeros((columns[0].shape[1], 3))
    wider, light = problem.with_columns(*columns), np.concatenate([found.light, more])
    left = Residuals.of(wider, light, (found.diffuse, found.specular), found.expected).rescaled(wider)
    return left.equations(wider, left.priors(wider)).eliminate(1e-4)


def _gains(problem: LightingProblem, found: LightingSolution, columns: Sequence[NDArray]) -> NDArray[np.float64]:
    """(G,) by how much light from each direction lowers the sum, to first order; ``columns`` are two of (M, G)."""
    k, count = problem.diffuse.shape[1], columns[0].shape[1]
    reduced, right = _wider(problem, found, columns)
    old = np.arange(3 * (k + count)) % (k + count) < k
    cross = reduced[np.ix_(old, ~old)]
    across = np.linalg.solve(reduced[np.ix_(old, old)], cross)
    force = right[~old] - across.T @ right[old]
    stiffness = np.diag(reduced)[~old] - (across * cross).sum(0)
    gain = np.maximum(force, 0.0) ** 2 / np.maximum(stiffness, 1e-9 * float(stiffness.max()))
    return np.asarray(gain.reshape(3, count).sum(0))


def _explained(before: LightingSolution, after: LightingSolution) -> float:
    """Part of the energy that is explained since, relative to what one number of no meaning explains."""
    return PATCHES * float(np.log((before.unexplained**2 + DARKEST**2) / (after.unexplained**2 + DARKEST**2)))


def _solved(
    seen: Observations, forward: Forward, lights: tuple[DistantLight, ...], albedo: NDArray
) -> tuple[LightingProblem, LightingSolution]:
    """All light and the albedos under compact lights in these places."""
    look = forward.with_lights(lights)
    problem = lighting_problem(seen, look, look.dark, albedo, True)
    return problem, solve_lighting(problem, iterations=ITERATIONS)


def _settled(
    seen: Observations,
    forward: Forward,
    lights: tuple[DistantLight, ...],
    albedo: NDArray,
    before: LightingSolution,
) -> tuple[tuple[DistantLight, ...], LightingProblem, LightingSolution]:
    """Lights whose directions and radii Gauss-Newton has moved together with all else, and all light and albedos then.

    A light of irradiance c adds ``c_k (t . slopes)`` to the image of channel k, where t are the three parameters of its
    place, the same for all channels, and the slopes are differences of its columns. They move as long as that explains
    more than ``before``; the best of all rounds is taken.
    """
    smooth, rounds = forward.order**2, [(lights, *_solved(seen, forward, lights, albedo))]
    while len(rounds) < ITERATIONS and _explained(before, rounds[-1][2]) > 1.0:
        lights, problem, before = rounds[-1]
        ways = [_moved(light, sign * step) for light in lights for step in np.eye(3) for sign in (1.0, -1.0)]
        moved = forward.with_lights(tuple(ways))
        both = moved.transfers(seen, moved.dark)
        slopes = [0.5 * (each[:, smooth::2] - each[:, smooth + 1 :: 2]) for each in both]
        steps = _place_steps(problem, before, slopes)
        lights = tuple(_moved(light, np.clip(step, -2.0, 2.0)) for light, step in zip(lights, steps, strict=True))
        rounds.append((lights, *_solved(seen, forward, lights, albedo)))
    return min(rounds, key=lambda each: each[2].unexplained)


def _moved(light: DistantLight, step: NDArray) -> DistantLight:
    """A light moved across by multiples of `SLOPE`, in two directions, and widened by a third one's power of 1.5."""
    across = np.linalg.svd(light.direction[None])[2][1:]
    radius = float(np.clip(light.radius * 1.5 ** step[2], *RADII))
    return replace(light, direction=normalize(light.direction + SLOPE * step[:2] @ across), radius=radius)


def _place_steps(problem: LightingProblem, found: LightingSolution, slopes: Sequence[NDArray]) -> NDArray[np.float64]:
    """(L, 3) steps of the places of L lights: ``slopes`` are two of (M, 3L), at unit irradiance."""
    k, m = problem.diffuse.shape[1], slopes[0].shape[1]
    reduced, right = _wider(problem, found, slopes)
    colour = np.repeat(found.light[k - m // 3 :], 3, axis=0)
    tied = np.zeros((3, k + m, 3 * k + m))
    for c in range(3):
        tied[c, :k, c * k : (c + 1) * k] = np.eye(k)
        tied[c, k:, 3 * k :] = np.diag(colour[:, c])
    tied = tied.reshape(-1, 3 * k + m)
    system = tied.T @ reduced @ tied
    system += 1e-6 * float(np.diag(system).mean()) * np.eye(len(system))
    steps = np.linalg.solve(system, tied.T @ right)[3 * k :].reshape(-1, 3)
    return np.asarray(steps, dtype=np.float64)
