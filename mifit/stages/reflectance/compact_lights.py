"""Compact lights: the sparse part of one estimate that has smooth and hard light in it from the start.

Smooth light has SH coefficients L, hard light irradiances e_g >= 0 from fixed directions d_g all over the sphere, with
shadows traced once. With texel albedos x, y both are found together by `lighting.solve_lighting`:

    min  sum w (I - x (D L + D_g e) - y (S L + S_g e))^2 + priors + SPARSITY * E * sum(e) / flux,   e >= 0

where E is the sum of squares itself and flux all light: what e adds must explain its share of the images. The penalty
leaves to the bands what bands can show, so e is zero but for a few directions. They are gathered into lights, and their
neighbourhood is estimated once more on a finer grid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.appearance.illumination import DistantLight, disc
from mifit.appearance.reception import fibonacci_sphere
from mifit.core.mesh import normalize
from mifit.core.sh import LUMINANCE
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import (
    NORMAL_REFLECTANCE,
    LightingSolution,
    active_weight,
    fit_lighting,
    flux,
    lighting_problem,
    linearize,
    solve_lighting,
)
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingProblem

DIRECTIONS = 512
"""Directions of the first grid, 7 degrees apart."""
FINER = 96
"""Directions of the second grid about each light, 2 degrees apart."""
OBSERVATIONS = 8000
"""Texels times images that the estimate is made from."""
REACH = np.radians(15.0)
"""Angle about a light's middle within which all is part of it."""
LIGHTS = 3
"""Compact lights at the most: a face shows a few lamps apart, and what more there are is smooth light to it."""
FAINT = 0.2
"""Irradiance of a compact light, relative to that of all other light: below, it is taken for a flaw of the model."""
SPARSITY = 0.03
"""Part of the energy that hard light must explain, were it all light."""
EXPONENT = 40.0
"""Exponent of the lobe beforehand, in the middle of `EXPONENTS`: as wide as a Beckmann roughness of 0.2."""
EXPONENTS = 10.0, 160.0
"""Exponents between which the lobe is looked for: Beckmann roughness 0.4 to 0.1."""
LEAN = 0.005
"""Logarithm of the error that an exponent one octave off must gain, fourfold for two: a prior of one octave beside a
hundred independent measurements, which is about how many patches of a face with their own error there are."""
ITERATIONS, LAST_ITERATIONS = 2, 8
"""Gauss-Newton iterations of each round, and of the fits about which lights are moved."""
SETTLING = 4
"""Moves of the lights' places."""
SLOPE = np.radians(1.0)
"""Angle over which the columns of a light are differentiated: shadows have edges."""
RADII = np.radians([0.25, 15.0])
"""Angular radii of a compact light."""
ROUNDS, LIGHT_ALONE, JOINING = 9, 3, 16
"""Rounds of column generation at the most, those of them with albedos held, and directions that join in each."""


def find_lights(seen: Observations, forward: Forward, albedo: NDArray) -> tuple[DistantLight, ...]:
    """Compact lights beside smooth light, brightest first, without colour; none where images show none.

    Parameters
    ----------
    seen : Observations
        n texels.
    forward : Forward
        Shading model, lobe and bands of the smooth light.
    albedo : (n, 3)
        Diffuse albedo that the morphable model expects.
    """
    directions = fibonacci_sphere(DIRECTIONS)
    lights = _gathered(directions, *_sparse(seen, forward, directions, albedo, SPARSITY))
    if not lights:
        return ()
    # Where there is light, the penalty has done its work: it would make lights smaller and weaker than they are.
    directions = np.concatenate([disc(light.direction, REACH, FINER) for light in lights])
    lights = _gathered(directions, *_sparse(seen, forward, directions, albedo, 0.0))
    return _settled(seen, forward, lights, albedo)


def _settled(
    seen: Observations, forward: Forward, lights: Sequence[DistantLight], albedo: NDArray
) -> tuple[DistantLight, ...]:
    """Lights without the faint ones, their directions and radii moved by Gauss-Newton together with all else.

    A light of irradiance c adds ``c_k (t . slopes)`` to the image of channel k, where t are the three parameters of its
    place, the same for all channels, and the slopes are differences of its columns. The best of all rounds is taken.
    """
    smooth, best, least, found = forward.order**2, tuple(lights), np.inf, None
    for _ in range(SETTLING):
        look = forward.with_lights(tuple(lights))
        problem = lighting_problem(seen, look, look.dark, albedo, True)
        if found is None:
            found = solve_lighting(problem, specular=NORMAL_REFLECTANCE, iterations=LAST_ITERATIONS)
        else:
            found = solve_lighting(problem, found.light, (found.diffuse, found.specular), iterations=LAST_ITERATIONS)
        bright = found.light[smooth:] @ LUMINANCE > FAINT * _irradiance(found.light) @ LUMINANCE
        if not bright.all():
            kept = [lights[k] for k in np.flatnonzero(bright).tolist()]
            return _settled(seen, forward, kept, albedo) if kept else ()
        if found.unexplained < least:
            best, least = tuple(lights), found.unexplained
        ways = [_moved(light, sign * step) for light in lights for step in np.eye(3) for sign in (1.0, -1.0)]
        both = forward.with_lights(tuple(ways)).transfers(seen, forward.with_lights(tuple(ways)).dark)
        slopes = [0.5 * (each[..., smooth::2] - each[..., smooth + 1 :: 2]) for each in both]
        steps = _place_steps(problem, found, slopes)
        lights = [_moved(light, np.clip(step, -2.0, 2.0)) for light, step in zip(lights, steps, strict=True)]
    return best


def _moved(light: DistantLight, step: NDArray) -> DistantLight:
    """A light moved across by multiples of `SLOPE`, in two directions, and widened by a third one's power of 1.5."""
    across = np.linalg.svd(light.direction[None])[2][1:]
    radius = float(np.clip(light.radius * 1.5 ** step[2], *RADII))
    return replace(light, direction=normalize(light.direction + SLOPE * step[:2] @ across), radius=radius)


def _place_steps(problem: LightingProblem, found: LightingSolution, slopes: Sequence[NDArray]) -> NDArray[np.float64]:
    """(L, 3) steps of the places of L lights: ``slopes`` are two of (n, J, 3L), at unit irradiance."""
    k, m = problem.diffuse.shape[2], slopes[0].shape[2]
    wider = replace(
        problem,
        diffuse=np.concatenate([problem.diffuse, slopes[0]], axis=2),
        specular=np.concatenate([problem.specular, slopes[1]], axis=2),
    )
    rows, light = wider.rows(), np.concatenate([found.light, np.zeros((m, 3))])
    shaded = rows.diffuse @ light.astype(np.float32), rows.specular @ light.astype(np.float32)
    maps = found.diffuse[rows.texel], found.specular[rows.texel, None]
    residual = rows.colour - form_image(0.0, maps[0], shaded[0], maps[1], shaded[1])
    weight, sigma = active_weight(rows.weight, rows.clipped, residual, True)
    equations = linearize(wider, rows, light, found.diffuse, found.specular, *shaded, residual, weight, sigma=sigma)
    remaining = equations.eliminate(False, 1e-4)
    colour = np.repeat(found.light[k - m // 3 :], 3, axis=0)
    tied = np.zeros((3, k + m, 3 * k + m))
    for c in range(3):
        tied[c, :k, c * k : (c + 1) * k] = np.eye(k)
        tied[c, k:, 3 * k :] = np.diag(colour[:, c])
    tied = tied.reshape(-1, 3 * k + m)
    system = tied.T @ remaining.reduced @ tied
    system += 1e-6 * float(np.diag(system).mean()) * np.eye(len(system))
    steps = np.linalg.solve(system, tied.T @ remaining.right)[3 * k :].reshape(-1, 3)
    return np.asarray(steps, dtype=np.float64)


def _sparse(
    seen: Observations, forward: Forward, directions: NDArray, albedo: NDArray, sparsity: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(G, 3) irradiance from each direction, and (3,) mean irradiance of the smooth light beside it.

    Few directions shine, so only those take part whose gradient outweighs the penalty (column generation). Where smooth
    light and albedos are at their optimum they don't change that gradient.
    """
    smooth, priors = forward.order**2, replace(PRIORS, sparsity=sparsity)
    problem = lighting_problem(seen, forward, forward.dark, albedo, True)
    columns = forward.columns(seen, directions)
    irradiance, active = np.zeros((len(directions), 3)), np.zeros(0, np.intp)
    start = None
    for number in range(ROUNDS):
        lit = replace(
            problem,
            diffuse=np.concatenate([problem.diffuse, columns[0][..., active]], axis=2),
            specular=np.concatenate([problem.specular, columns[1][..., active]], axis=2),
        )
        # With the expected albedos at first: albedos that adapt to smooth light alone take its shadows for skin.
        if number < LIGHT_ALONE:
            found = solve_lighting(lit, specular=NORMAL_REFLECTANCE, priors=priors, iterations=1)
        else:
            found = solve_lighting(lit, start, (found.diffuse, found.specular), priors=priors, iterations=ITERATIONS)
        irradiance[:] = 0.0
        irradiance[active] = found.light[smooth:]
        light = found.light.astype(np.float32)
        x, y = found.diffuse[:, None], found.specular[:, None, None]
        residual = lit.colour - form_image(0.0, x, lit.diffuse @ light, y, lit.specular @ light)
        weight, _ = active_weight(lit.weight, lit.clipped, residual, True)
        pull = weight * residual
        gradient = np.einsum("njc,njg->gc", pull * x, columns[0], optimize=True)
        gradient += np.einsum("njc,njg->gc", pull * y, columns[1], optimize=True)
        penalty = 0.5 * sparsity * float((weight * residual**2).sum()) / flux(found.light, forward.order)
        gain = np.maximum(gradient - penalty, 0.0).sum(axis=1)
        gain[active] = 0.0
        joining = np.argsort(-gain)[:JOINING]
        joining = joining[gain[joining] > 0]
        kept = active[irradiance[active].any(axis=1)]
        if not len(joining) and number >= LIGHT_ALONE:
            break
        active = np.concatenate([kept, joining])
        start = np.concatenate([found.light[:smooth], irradiance[active]])
    return irradiance, _irradiance(found.light)


def _irradiance(light: NDArray) -> NDArray[np.float64]:
    """(3,) mean irradiance by smooth light over all orientations."""
    return np.asarray(np.sqrt(np.pi) / 2.0 * light[0])


def _gathered(directions: NDArray, irradiance: NDArray, smooth: NDArray) -> tuple[DistantLight, ...]:
    """Lights of the directions (G, 3) that shine, each of all within `REACH` of where most is."""
    left = irradiance @ LUMINANCE
    near = (directions @ directions.T > np.cos(REACH)).astype(np.float64)
    lights: list[DistantLight] = []
    while len(lights) < LIGHTS:
        centre = directions[np.argmax(near @ left)]
        for _ in range(3):
            part = left * (directions @ centre > np.cos(REACH))
            centre = normalize(part @ directions + 1e-12 * centre)
        if not part.sum() > FAINT * float(smooth @ LUMINANCE):
            break
        # The mean squared angle from the middle of an even disc is half of its squared radius.
        angle = np.arccos(np.clip(directions @ centre, -1.0, 1.0))
        radius = float(np.clip(np.sqrt(2.0 * (part @ angle**2) / part.sum()), *RADII))
        lights.append(DistantLight(centre, radius, np.zeros(3)))
        left = np.where(part > 0, 0.0, left)
    return tuple(lights)


def best_exponent(seen: Observations, forward: Forward, albedo: NDArray, robust: bool) -> float:
    """Exponent of the lobe that leaves least unexplained, an octave at a time from the physical one.

    Parameters as in `find_lights`, with the lights in ``forward``.
    """

    def score(exponent: float) -> float:
        found = fit_lighting(seen, forward.with_lobe(replace(forward.lobe, exponent=exponent)), albedo, robust, 8)
        return float(np.log(max(found.unexplained, 1e-12)) + LEAN * np.log2(exponent / EXPONENT) ** 2)

    best, least = EXPONENT, score(EXPONENT)
    for factor in (2.0, 0.5):
        while EXPONENTS[0] <= factor * best <= EXPONENTS[1] and (error := score(factor * best)) < least:
            best, least = factor * best, error
        if best != EXPONENT:
            break
    return best
