"""How well a way to explain the images predicts those that it isn't shown.

The residual of the images that were fitted prefers whatever has more freedom: ten bands of lighting adapt to any lobe.
Here some of the fitted cameras' images are left out, lighting and albedos are found without them, and the images that
were left out are compared with what should be seen there. Cameras that are not fitted are never read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.core.process import on_all_cores
from mifit.stages.observations import Observations
from mifit.stages.reflectance.lighting import bounded_weight, solve_lighting
from mifit.stages.reflectance.lighting_equations import LightingProblem

ENOUGH = 3
"""Timesteps from which they are left out in turn: what remains shows the head in several poses. Below it is cameras."""
LEAST = 50
"""Texels that the other images must show at the least: lighting has some hundred unknowns."""
ITERATIONS = 8
"""Gauss-Newton iterations without the images left out. They start anew: a few from the solution with all images still
knew what was left out, and made sheen look good that no other view had."""
TOLERANCE = 5e-3
"""Relative change of the energy at which they end: predicted errors, which are compared by parts of some hundredths,
move by a few thousandths afterwards."""


@dataclass(frozen=True)
class Prediction:
    """Images predicted by the others.

    Attributes
    ----------
    left_out : str
        What was left out in turn: ``timesteps`` or ``cameras``.
    errors : tuple of float
        Root of the mean squared error of each, linear colour, residuals bounded as in `bounded_weight`.
    """

    left_out: str
    errors: tuple[float, ...]

    @property
    def error(self) -> float:
        """Root of their mean square."""
        return float(np.sqrt(np.mean(np.square(self.errors))))


def folds(seen: Observations) -> tuple[str, list[NDArray[np.bool_]]]:
    """What is left out in turn, and the images (J,) of each; none where the images are of one timestep and camera."""
    names, groups = "timesteps", np.unique(seen.step)
    which = seen.step
    if len(groups) < ENOUGH:
        names, groups, which = "cameras", np.unique(seen.camera), seen.camera
    return names, [which == group for group in groups] if len(groups) > 1 else []


def predict(seen: Observations, problem: LightingProblem, specular: float, robust: bool = True) -> Prediction | None:
    """Leave images out in turn; None where there are too few, or where the others say nothing of them.

    Parameters
    ----------
    seen : Observations
        The images by timestep and camera.
    problem : LightingProblem
        The same texels with their transfer vectors; those may not turn with the lighting.
    specular, robust
        As in `solve_lighting`.
    """
    name, groups = folds(seen)

    def error(out: NDArray[np.bool_]) -> float | None:
        rest = replace(problem, weight=np.where(out[:, None], np.float32(0.0), problem.weight))
        known = np.any((rest.weight > 0).any(axis=2) & ~rest.clipped, axis=1)
        if known.sum() < LEAST:
            return None  # a camera that sees next to nothing can't predict the others
        solved = solve_lighting(rest, specular=specular, robust=robust, iterations=ITERATIONS, tolerance=TOLERANCE)
        judged = replace(
            problem,
            colour=problem.colour[:, out],
            weight=problem.weight[:, out] * np.reshape(known, (-1, 1, 1)),
            clipped=problem.clipped[:, out],
        )
        light = solved.light.astype(np.float32)
        shown = form_image(
            0.0,
            solved.diffuse[:, None],
            problem.diffuse[:, out] @ light,
            solved.specular[:, None, None],
            problem.specular[:, out] @ light,
        )
        residual = judged.colour - shown
        total = float(judged.weight.sum())
        return float(np.sqrt((bounded_weight(judged, residual) * residual**2).sum() / total)) if total > 0 else None

    # What is left out in turn is as much work each time and knows nothing of the others.
    errors = [found for found in on_all_cores(error, groups) if found is not None]
    return Prediction(name, tuple(errors)) if errors else None
