"""Exposure and white balance of each camera relative to the first, from what cameras say of the same surface points.

A diffuse point sends the same light to all cameras, so between two of them its colours differ by their gains alone: the
start is a robust mean of the log ratios. Skin is not diffuse alone, and its sheen adds more to one camera than to
another (4 to 9 per cent between two views 40 degrees apart of a head lit from one side), so lighting with a specular
lobe is fitted to the corrected colours, and what it leaves unexplained per camera corrects the gains, in turns.
What sheen adds to the log ratios is the more the darker the skin is in a channel (Shafer's dichromatic reflection), and
in which proportion is seen in how the ratios differ from point to point, as gains don't: under light of one colour they
scatter about a line. So of what the lighting takes for sheen, that counts which lies along the scatter.

How much of the ratios is sheen is the lighting's opinion, though, and on a mesh that is millimetres or a degree off it
sees sheen where there is none: it has found 15 to 20 per cent of it between equal cameras whose colours agreed within
4 to 7. Such an opinion need not scatter over the timesteps, and predicts left-out images as well as the truth, so its
error is taken to be as large as itself: the gain lies between the ratios without and with the correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.formation import form_image
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.progress import Progress, silent
from mifit.stages.observations import Observations, Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import LightingSolution, solve_lighting
from mifit.stages.reflectance.lighting_equations import LightingProblem
from mifit.stages.reflectance.trials import lighting_problem

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

Gains = dict[str, tuple[float, float, float]]

MAP_SIZE = 256
"""Texels along the side of the map whose points are compared."""
POINTS = 4000
"""Points that several cameras see and that the lighting is fitted to."""
DARKEST = 0.02
"""Linear colour below which a ratio is noise."""
LEAST_COSINE = 0.4
"""Of the view angle: at grazing views skin shines and a small error of the mesh reaches another point."""
FEWEST_POINTS = 50
BANDS, EXPONENT = 4, 100.0
"""Of the lighting that tells sheen from gain: broad, because detailed lighting can take a gain for sheen."""
ROUNDS = 15
LONGEST_STEP = 0.05
"""Change of a log gain in a round at the most."""
SETTLED = 1e-4
"""Change of the log gains in a round at which they stand."""
SAME = 0.1
"""Log gain up to which cameras count as alike: what sheen leaves in the ratios of equal cameras, 1 to 7 per cent."""
ITERATIONS, TOLERANCE = 20, 1e-4
"""Lighting short of its optimum holds on to the gains that it was fitted with."""


def estimate_gains(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    seed: int = 0,
    progress: Progress = silent,
    certain: bool = False,
) -> Gains:
    """Factor of each camera's linear RGB over the first camera's.

    Parameters
    ----------
    capture : Capture
    model : MorphableModel
    geometry : GeometryEstimate
        Fitted vertices and albedo; gains that it already has are not applied.
    cameras : sequence of str
        Cameras to compare; no other camera of the capture is read.
    seed : int
        Chooses the points that the lighting is fitted to.
    progress : Progress
    certain : bool
        Only where some camera surely differs: by more than `SAME`, whether none of the ratios is sheen or all that the
        lighting takes for it.

    Returns
    -------
    dict of str to (r, g, b)
        The first camera has (1, 1, 1). A camera that shares fewer than `FEWEST_POINTS` surface points with the others
        is left out. Empty where no camera surely differs and that was asked for.

    Raises
    ------
    InputError
        No image shows the face.
    """
    progress("Camera gains", 0, ROUNDS)

    surface = Surface(capture, model, replace(geometry, gains={}), cameras, MAP_SIZE)

    def observe(surface: Surface) -> list[Observations]:
        return [surface.observe(part) for part in surface.chunks()]

    log_gain, known = _from_ratios(observe(surface), len(cameras))
    ratios = log_gain
    if certain and not differ(ratios):  # whatever the lighting says then
        progress("Camera gains", ROUNDS, ROUNDS)
        return {}
    if len(known) > 1:
        # Which observations agree, and so are trusted, shows only when the cameras are about equal.
        parts = observe(surface.exposed(_gains(log_gain, known, cameras)))
        left, _ = _from_ratios(parts, len(cameras))
        seen = _shared_points(parts, POINTS, np.random.default_rng(seed))
        albedo = interpolate(geometry.vertex_albedo, model.faces, seen.face, seen.barycentric)
        albedo = np.clip(np.nan_to_num(albedo, nan=0.3), 0.01, 1.0).astype(np.float32)
        log_gain = log_gain + _from_lighting(seen, albedo, left, known, progress)
    progress("Camera gains", ROUNDS, ROUNDS)
    return {} if certain and not differ(ratios, log_gain) else _gains(log_gain, known, cameras)


def _gains(log_gain: NDArray, known: Sequence[int], cameras: Sequence[str]) -> Gains:
    """Gains of the known cameras from logarithms (C, 3)."""
    return {cameras[i]: (float(r), float(g), float(b)) for i in known for r, g, b in [np.exp(log_gain[i])]}


def differ(*bounds: NDArray) -> bool:
    """Whether some camera's log gain in some channel is beyond `SAME` at all bounds (C, 3), and to the same side."""
    return bool(any(np.all([side * bound > SAME for bound in bounds], axis=0).any() for side in (1.0, -1.0)))


def _usable(seen: Observations) -> NDArray[np.bool_]:
    """(N, J) observations bright and frontal enough for a ratio."""
    cosine = np.einsum("njk,njk->nj", seen.image_normal, seen.view)
    return (seen.measured > 0) & (cosine > LEAST_COSINE) & (seen.colour.min(axis=2) > DARKEST)


def _from_ratios(parts: Sequence[Observations], cameras: int) -> tuple[NDArray[np.float64], list[int]]:
    """(C, 3) log gains as if the skin were diffuse alone, and the cameras that shared points join to the first."""
    links: list[tuple[int, int, NDArray, float]] = []
    for a in range(cameras):
        for b in range(a + 1, cameras):
            ratios, weights = [], []
            for seen in parts:
                usable = _usable(seen)
                level = np.log(np.maximum(seen.colour, DARKEST))
                for step in np.unique(seen.step):
                    (i,), (j,) = (np.flatnonzero((seen.step == step) & (seen.camera == c)) for c in (a, b))
                    both = usable[:, i] & usable[:, j]
                    ratios.append(level[both, j] - level[both, i])
                    weights.append(np.minimum(seen.weight[both, i], seen.weight[both, j]))
            ratio, weight = np.concatenate(ratios), np.concatenate(weights)
            if len(ratio) >= FEWEST_POINTS:
                links.append((a, b, _robust_mean(ratio, weight), float(np.sqrt(weight.sum()))))
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


def _shared_points(parts: Sequence[Observations], count: int, rng: np.random.Generator) -> Observations:
    """Points that at least two images measure well, at most ``count``, chosen at random."""
    shared = [np.flatnonzero(_usable(seen).sum(axis=1) >= 2) for seen in parts]
    total = sum(map(len, shared))
    kept = np.sort(rng.choice(total, min(count, total), replace=False))
    start, chosen = 0, []
    for seen, rows in zip(parts, shared, strict=True):
        here = kept[(kept >= start) & (kept < start + len(rows))] - start
        chosen.append(seen.take(rows[here]))
        start += len(rows)
    return Observations.join(chosen)


def _from_lighting(
    seen: Observations, albedo: NDArray, log_gain: NDArray, known: list[int], progress: Progress
) -> NDArray[np.float64]:
    """(C, 3) log gains with which lighting and both albedos explain all cameras alike, as far as sheen has the tint."""
    ratios = log_gain
    model = models.get("prefiltered")
    forward = Forward.of(model, BANDS, Lobe(EXPONENT, model.fresnel))
    problem = lighting_problem(seen, forward, np.zeros((BANDS**2, 3)), albedo, ReflectanceConfig().robust)
    found: LightingSolution | None = None
    tried: list[NDArray] = []
    shown: list[NDArray] = []
    for number in range(ROUNDS):
        progress("Camera gains", number, ROUNDS)
        corrected = replace(problem, colour=seen.colour / np.exp(log_gain)[seen.camera].astype(np.float32))
        start = None if found is None else found.light
        found = solve_lighting(corrected, start, iterations=ITERATIONS, tolerance=TOLERANCE)
        left = _unexplained(seen, corrected, found, len(log_gain), known)
        tried.append(log_gain)
        shown.append(left)
        step = _accelerated(tried, shown) - log_gain
        log_gain = log_gain + step * min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        if np.abs(step).max() < SETTLED:
            break
    return ratios + (log_gain - ratios) @ _sheen_tint(seen)


def _sheen_tint(seen: Observations) -> NDArray[np.float64]:
    """(3, 3) symmetric: the part of a change of log colours that is of the tints of sheen.

    Standard deviations of the cameras' log ratios over the surface, relative to the largest: 1 along the tint in which
    they scatter most, and little across it where the light has one colour.
    """
    usable = _usable(seen)
    level = np.log(np.maximum(seen.colour, DARKEST)).astype(np.float64)
    around = []
    for i, j in combinations(range(len(seen.step)), 2):
        both = usable[:, i] & usable[:, j]
        if seen.step[i] == seen.step[j] and both.any():
            ratio = level[both, j] - level[both, i]
            around.append(ratio - np.median(ratio, axis=0))
    offset = np.concatenate(around)
    square = (offset**2).sum(axis=1)
    weight = 1.0 / (1.0 + square / max(float(np.median(square)), 1e-12)) ** 2
    values, axes = np.linalg.eigh((offset * weight[:, None]).T @ offset)
    return np.asarray((axes * np.sqrt(np.maximum(values, 0.0) / max(float(values[-1]), 1e-12))) @ axes.T)


def _accelerated(tried: list[NDArray], shown: list[NDArray], depth: int = 4) -> NDArray[np.float64]:
    """Where the rounds lead to (Anderson acceleration): lighting takes up most of a wrong gain, so each round shows
    only part of what is left, and the parts of the last rounds tell how large a part."""
    x, f = tried[-1], shown[-1]
    if len(tried) < 2:
        return x + f
    moves, turns = (np.diff([v.ravel() for v in values[-depth - 1 :]], axis=0).T for values in (tried, shown))
    floor = 1e-3 * float((turns**2).sum()) + 1e-16
    mix = np.linalg.solve(turns.T @ turns + floor * np.eye(turns.shape[1]), turns.T @ f.ravel())
    return x + f - ((moves + turns) @ mix).reshape(x.shape)


def _unexplained(
    seen: Observations, problem: LightingProblem, found: LightingSolution, cameras: int, known: list[int]
) -> NDArray[np.float64]:
    """(C, 3) robust mean log ratio of each camera's colours to the fitted ones, less the first camera's."""
    light = found.light.astype(np.float32)
    diffuse, specular = (np.einsum("njk,kc->njc", t, light) for t in (problem.diffuse, problem.specular))
    fitted = form_image(0.0, found.diffuse[:, None], diffuse, found.specular[:, None, None], specular)
    usable = _usable(seen) & (fitted.min(axis=2) > DARKEST)
    ratio = np.log(np.maximum(problem.colour, DARKEST)) - np.log(np.maximum(fitted, DARKEST))
    out = np.zeros((cameras, 3))
    for camera in known:
        chosen = usable & (seen.camera == camera)
        if chosen.any():
            out[camera] = _robust_mean(ratio[chosen], seen.weight[chosen])
    out[known] -= out[0]
    return out


def _robust_mean(values: NDArray, weight: NDArray) -> NDArray[np.float64]:
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
