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
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.progress import Progress, silent
from mifit.stages.image_factors import (
    DARKEST,
    ROUNDS,
    factors_by_lighting,
    gains_by_ratios,
    mean_albedo,
    shared_points,
    usable,
)
from mifit.stages.observations import Observations, Surface

Gains = dict[str, tuple[float, float, float]]

POINTS = 4000
"""Points that several cameras see and that the lighting is fitted to."""
SAME = 0.1
"""Log gain up to which cameras count as alike: what sheen leaves in the ratios of equal cameras, 1 to 7 per cent."""


def estimate_gains(
    surface: Surface,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    seed: int = 0,
    progress: Progress = silent,
    certain: bool = False,
) -> Gains:
    """Factor of each camera's linear RGB over the first camera's.

    Parameters
    ----------
    surface : Surface
        Of the fitted geometry, with no gains applied.
    geometry : GeometryEstimate
        Its fitted albedo is where the lighting starts from.
    cameras : sequence of str
        Cameras of the surface.
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
    """
    progress("Camera gains", 0, ROUNDS)

    def observe(surface: Surface) -> list[Observations]:
        return [surface.observe(part) for part in surface.chunks()]

    log_gain, known = gains_by_ratios(observe(surface), len(cameras))
    ratios = log_gain
    if certain and not differ(ratios):  # whatever the lighting says then
        progress("Camera gains", ROUNDS, ROUNDS)
        return {}
    if len(known) > 1:
        # Which observations agree, and so are trusted, shows only when the cameras are about equal.
        parts = observe(surface.exposed(_gains(log_gain, known, cameras)))
        left, _ = gains_by_ratios(parts, len(cameras))
        seen = shared_points(parts, POINTS, np.random.default_rng(seed))
        albedo = mean_albedo(seen, geometry, surface.faces)
        log_gain = log_gain + _from_lighting(seen, albedo, left, known, progress)
    progress("Camera gains", ROUNDS, ROUNDS)
    return {} if certain and not differ(ratios, log_gain) else _gains(log_gain, known, cameras)


def _gains(log_gain: NDArray, known: Sequence[int], cameras: Sequence[str]) -> Gains:
    """Gains of the known cameras from logarithms (C, 3)."""
    return {cameras[i]: (float(r), float(g), float(b)) for i in known for r, g, b in [np.exp(log_gain[i])]}


def differ(*bounds: NDArray) -> bool:
    """Whether some camera's log gain in some channel is beyond `SAME` at all bounds (C, 3), and to the same side."""
    return bool(any(np.all([side * bound > SAME for bound in bounds], axis=0).any() for side in (1.0, -1.0)))


def _from_lighting(
    seen: Observations, albedo: NDArray, log_gain: NDArray, known: list[int], progress: Progress
) -> NDArray[np.float64]:
    """(C, 3) log gains with which lighting and both albedos explain all cameras alike, as far as sheen has the tint."""

    def turn(number: int) -> None:
        progress("Camera gains", number, ROUNDS)

    found = factors_by_lighting(seen, seen.camera, albedo, log_gain, known, turn)
    return log_gain + (found - log_gain) @ _sheen_tint(seen)


def _sheen_tint(seen: Observations) -> NDArray[np.float64]:
    """(3, 3) symmetric: the part of a change of log colours that is of the tints of sheen.

    Standard deviations of the cameras' log ratios over the surface, relative to the largest: 1 along the tint in which
    they scatter most, and little across it where the light has one colour.
    """
    measured = usable(seen)
    level = np.log(np.maximum(seen.colour, DARKEST)).astype(np.float64)
    around = []
    for i, j in combinations(range(len(seen.step)), 2):
        both = measured[:, i] & measured[:, j]
        if seen.step[i] == seen.step[j] and both.any():
            ratio = level[both, j] - level[both, i]
            around.append(ratio - np.median(ratio, axis=0))
    offset = np.concatenate(around)
    square = (offset**2).sum(axis=1)
    weight = 1.0 / (1.0 + square / max(float(np.median(square)), 1e-12)) ** 2
    values, axes = np.linalg.eigh((offset * weight[:, None]).T @ offset)
    return np.asarray((axes * np.sqrt(np.maximum(values, 0.0) / max(float(values[-1]), 1e-12))) @ axes.T)
