"""Factors of groups of images, such as all of a camera or of a timestep, by which lighting explains them best.

Lighting with a specular lobe is fitted to the colours of shared surface points, and what it leaves unexplained per
group corrects the group's factor, in turns: lighting takes up most of a wrong factor, so that one turn shows a part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.formation import form_image
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution, solve_lighting
from mifit.stages.reflectance.lighting_equations import LightingProblem
from mifit.stages.reflectance.trials import lighting_problem

MAP_SIZE = 256
"""Texels along the side of the map whose points are compared."""
DARKEST = 0.02
"""Linear colour below which a ratio is noise."""
FEWEST_POINTS = 50
LEAST_COSINE = 0.4
"""Of the view angle: at grazing views skin shines and a small error of the mesh reaches another point."""
BANDS, EXPONENT = 4, 100.0
"""Of the lighting that tells sheen and shading from factors: broad, because detailed lighting can take a factor for
sheen."""
ROUNDS = 15
LONGEST_STEP = 0.05
"""Change of a log factor in a round at the most."""
SETTLED = 1e-4
"""Change of the log factors in a round at which they stand."""
ITERATIONS, TOLERANCE = 20, 1e-4
"""Lighting short of its optimum holds on to the factors that it was fitted with."""


def usable(seen: Observations) -> NDArray[np.bool_]:
    """(N, J) observations bright and frontal enough for a ratio."""
    cosine = np.einsum("njk,njk->nj", seen.image_normal, seen.view)
    return (seen.measured > 0) & (cosine > LEAST_COSINE) & (seen.colour.min(axis=2) > DARKEST)


def shared_points(parts: Sequence[Observations], count: int, rng: np.random.Generator) -> Observations:
    """Points that at least two images measure well, at most ``count``, chosen at random."""
    shared = [np.flatnonzero(usable(seen).sum(axis=1) >= 2) for seen in parts]
    total = sum(map(len, shared))
    kept = np.sort(rng.choice(total, min(count, total), replace=False))
    start, chosen = 0, []
    for seen, rows in zip(parts, shared, strict=True):
        here = kept[(kept >= start) & (kept < start + len(rows))] - start
        chosen.append(seen.take(rows[here]))
        start += len(rows)
    return Observations.join(chosen)


def robust_mean(values: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """(3,) weighted mean of (n, 3) by Geman and McClure's weights, scale from the median deviation."""
    centre = np.median(values, axis=0)
    for _ in range(30):
        distance = np.abs(values - centre)
        scale = 1.4826 * np.median(distance, axis=0) + 1e-6
        w = weight[:, None] / (1.0 + (distance / scale) ** 2) ** 2
        moved = (w * values).sum(axis=0) / w.sum(axis=0)
        if np.abs(moved - centre).max() < 1e-6:
            break
        centre = moved
    return np.asarray(centre, dtype=np.float64)


def gains_by_ratios(parts: Sequence[Observations], cameras: int) -> tuple[NDArray[np.float64], list[int]]:
    """(C, 3) log gains as if the skin were diffuse alone, and the cameras that shared points join to the first."""
    links: list[tuple[int, int, NDArray, float]] = []
    for a in range(cameras):
        for b in range(a + 1, cameras):
            ratios, weights = [], []
            for seen in parts:
                measured = usable(seen)
                level = np.log(np.maximum(seen.colour, DARKEST))
                for step in np.unique(seen.step):
                    (i,), (j,) = (np.flatnonzero((seen.step == step) & (seen.camera == c)) for c in (a, b))
                    both = measured[:, i] & measured[:, j]
                    ratios.append(level[both, j] - level[both, i])
                    weights.append(np.minimum(seen.weight[both, i], seen.weight[both, j]))
            ratio, weight = np.concatenate(ratios), np.concatenate(weights)
            if len(ratio) >= FEWEST_POINTS:
                links.append((a, b, robust_mean(ratio, weight), float(np.sqrt(weight.sum()))))
    known = {0}
    for _ in links:
        known |= {c for a, b, _, _ in links if a in known or b in known for c in (a, b)}
    log_gain = np.zeros((cameras, 3))
    if links:
        system, right = np.zeros((len(links), cameras)), np.zeros((len(links), 3))
        for row, (a, b, mean, trust) in enumerate(links):
            system[row, a], system[row, b], right[row] = -trust, trust, trust * mean
        log_gain[1:] = np.linalg.lstsq(system[:, 1:], right, rcond=None)[0]  # the first camera's is 0
    return log_gain, sorted(known)


def mean_albedo(seen: Observations, geometry: GeometryEstimate, faces: NDArray) -> NDArray[np.float32]:
    """(N, 3) albedo of the fitted model at the points, which the lighting starts from."""
    albedo = interpolate(geometry.vertex_albedo, faces, seen.face, seen.barycentric)
    return np.clip(np.nan_to_num(albedo, nan=0.3), 0.01, 1.0).astype(np.float32)


def factors_by_lighting(
    seen: Observations,
    group: NDArray,
    albedo: NDArray,
    start: NDArray,
    known: Sequence[int],
    turn: Callable[[int], None] = lambda number: None,
) -> NDArray[np.float64]:
    """Log factors of groups of images with which lighting and both albedos explain all images alike.

    Parameters
    ----------
    seen : Observations
        N points in J images.
    group : (J,) int
        Which of G groups an image belongs to.
    albedo : (N, 3)
        `mean_albedo`.
    start : (G, 3)
        Log factors to start from.
    known : sequence of int
        Groups that are told; the first group is the reference, the others keep their start.
    turn : callable, optional
        Called with the number of each of `ROUNDS` rounds.

    Returns
    -------
    (G, 3)
    """
    log_factor, problem = start, _problem(seen, albedo)
    found: LightingSolution | None = None
    tried: list[NDArray] = []
    shown: list[NDArray] = []
    for number in range(ROUNDS):
        turn(number)
        left, found = _left_by(problem, seen, group, log_factor, known, found)
        tried.append(log_factor)
        shown.append(left)
        step = _accelerated(tried, shown) - log_factor
        log_factor = log_factor + step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < SETTLED:
            break
    return log_factor


def left_by_lighting(seen: Observations, group: NDArray, albedo: NDArray) -> NDArray[np.float64]:
    """(G, 3) robust mean log ratio of each group's colours to those that lighting explains without any factors."""
    count = int(group.max()) + 1
    return _left_by(_problem(seen, albedo), seen, group, np.zeros((count, 3)), range(count), None)[0]


def _problem(seen: Observations, albedo: NDArray) -> LightingProblem:
    model = models.get("prefiltered")
    forward = Forward.of(model, BANDS, Lobe(EXPONENT, model.fresnel))
    return lighting_problem(seen, forward, np.zeros((BANDS**2, 3)), albedo, ReflectanceConfig().robust)


def _left_by(
    problem: LightingProblem,
    seen: Observations,
    group: NDArray,
    log_factor: NDArray,
    known: Sequence[int],
    before: LightingSolution | None,
) -> tuple[NDArray[np.float64], LightingSolution]:
    """What lighting leaves of each group (`_unexplained`) under some factors, and that lighting."""
    corrected = replace(problem, colour=seen.colour / np.exp(log_factor)[group].astype(np.float32))
    start = None if before is None else before.light
    found = solve_lighting(corrected, start, iterations=ITERATIONS, tolerance=TOLERANCE)
    return _unexplained(seen, group, corrected, found, len(log_factor), known), found


def _accelerated(tried: list[NDArray], shown: list[NDArray], depth: int = 4) -> NDArray[np.float64]:
    """Where the rounds lead to (Anderson acceleration): lighting takes up most of a wrong factor, so each round shows
    only part of what is left, and the parts of the last rounds tell how large a part."""
    x, f = tried[-1], shown[-1]
    if len(tried) < 2:
        return x + f
    moves, turns = (np.diff([v.ravel() for v in values[-depth - 1 :]], axis=0).T for values in (tried, shown))
    floor = 1e-3 * float((turns**2).sum()) + 1e-16
    mix = np.linalg.solve(turns.T @ turns + floor * np.eye(turns.shape[1]), turns.T @ f.ravel())
    return x + f - ((moves + turns) @ mix).reshape(x.shape)


def _unexplained(
    seen: Observations,
    group: NDArray,
    problem: LightingProblem,
    found: LightingSolution,
    count: int,
    known: Sequence[int],
) -> NDArray[np.float64]:
    """(G, 3) robust mean log ratio of each group's colours to the fitted ones, less the first group's."""
    light = found.light.astype(np.float32)
    diffuse, specular = (np.einsum("njk,kc->njc", t, light) for t in (problem.diffuse, problem.specular))
    fitted = form_image(0.0, found.diffuse[:, None], diffuse, found.specular[:, None, None], specular)
    measured = usable(seen) & (fitted.min(axis=2) > DARKEST)
    ratio = np.log(np.maximum(problem.colour, DARKEST)) - np.log(np.maximum(fitted, DARKEST))
    out = np.zeros((count, 3))
    for k in known:
        chosen = measured & (group == k)
        if chosen.any():
            out[k] = robust_mean(ratio[chosen], seen.weight[chosen])
    out[list(known)] -= out[0]
    return out
