"""How far away a compact light stands: other places are judged in the place of one that has been fitted.

Where a compact light is nearly all the light there is, what is known of the albedos is known by it. So candidates are
not judged as if it were missing (`key`), but each by one Gauss-Newton step of lighting and albedos together from the
fit that has a light near it, under weights and priors that are the same for all: what remains unexplained after the
step follows in closed form from the normal equations.

Left out are the edges of the light's shadows: the least error of the mesh moves them, and a few texels that lie on the
wrong side outweigh what a light's distance does to all others. Without them all candidates have the same shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.appearance.illumination import DistantLight, Light, NearLight
from mifit.appearance.near_light import RAYS
from mifit.stages.observations import Observations
from mifit.stages.reflectance.forward import Forward, LightColumns
from mifit.stages.reflectance.key import RADII, ring
from mifit.stages.reflectance.lighting import LightingSolution, active_weight, linearize
from mifit.stages.reflectance.lighting_equations import PRIORS, LightingEquations, LightingPriors, LightingProblem

DAMPING = 1e-4
"""Of the step by which candidates are judged, relative to the diagonal."""
EDGE = np.radians(8.0)
"""Angle within which the edge of a shadow may lie elsewhere."""
REACH, PLACES = (3.0, 150.0), 10
"""First search: nearest and farthest distance, in root mean square distances of the texels from their middle, which
are some 7 cm on a face, and number of distances between. What is best at the farthest one is distant."""
TURN = np.radians(2.0)
"""Second search: first step across."""
LEAST_STEP = 0.03
"""Last step of the logarithm of the distance."""
TEXELS = 1000
"""Texels that judge places."""
UNKNOWN_SKIN = replace(PRIORS, albedo=0.01 * PRIORS.albedo)
"""What is known beforehand where places are judged: hardly the albedo. A light's distance changes brightness from the
middle of a face to its rim, as skin itself does, and over whole regions the albedo that a model expects errs alike."""


@dataclass(frozen=True)
class Judge:
    """A fit with compact lights, ready to judge others in the place of the last one.

    Attributes
    ----------
    columns : callable
        What a compact light sends off the texels, `Forward.light_columns`.
    problem : LightingProblem
        The columns of all other light.
    found : LightingSolution
        With the colour of the compact light that is to be replaced last.
    weight : (M, 3)
        Of the observations that there are, under the light that was fitted.
    priors : LightingEquations
        What the priors add to the equations, there.
    open_sky : (n, T) uint32
        Bits that tell of all candidates' samples which texels see them.
    """

    columns: LightColumns
    problem: LightingProblem
    found: LightingSolution
    weight: NDArray[np.float32]
    priors: LightingEquations
    open_sky: NDArray[np.uint32]

    @classmethod
    def about(
        cls,
        seen: Observations,
        forward: Forward,
        problem: LightingProblem,
        found: LightingSolution,
        priors: LightingPriors = PRIORS,
    ) -> Judge:
        """Linearise about a fit to observations without `edges`; the last compact light is the one to be replaced."""
        rest = forward.unknowns - 1
        rows = problem.rows()
        light = found.light.astype(np.float32)
        diffuse, specular = rows.diffuse @ light, rows.specular @ light
        maps = found.diffuse[rows.texel], found.specular[rows.texel, None]
        residual = rows.colour - form_image(0.0, maps[0], diffuse, maps[1], specular)
        weight, _ = active_weight(rows.weight, rows.clipped, residual, True)
        values = found.diffuse, found.specular, diffuse, specular, residual, weight
        plain = LightingEquations.accumulate(rows, *values)
        whole = linearize(problem, rows, found.light, *values, priors, found.sigma)
        added = LightingEquations(
            **{name: getattr(whole, name) - getattr(plain, name) for name in plain.__dataclass_fields__}
        )
        others = replace(problem, diffuse=problem.diffuse[..., :rest], specular=problem.specular[..., :rest])
        columns = forward.with_lights(()).light_columns(seen)
        return cls(columns, others, found, weight, added, forward.visible(seen, [forward.lights[-1]])[0])

    def unexplained(self, lights: Sequence[Light]) -> NDArray[np.float64]:
        """(M,) energy that each of some compact lights leaves once all else has followed it by a step."""
        near = [i for i, light in enumerate(lights) if isinstance(light, NearLight)]
        far = [i for i in range(len(lights)) if i not in near]
        left = np.zeros(len(lights))
        for kind in (near, far):
            if kind:
                same = np.broadcast_to(self.open_sky, (len(kind), *self.open_sky.shape))
                pairs = zip(*self.columns([lights[i] for i in kind], same), strict=True)
                left[kind] = [self._left(diffuse, specular) for diffuse, specular in pairs]
        return left

    def _left(self, diffuse: NDArray, specular: NDArray) -> float:
        """Energy under a light whose columns (n, J) are given."""
        problem, found = self.problem, self.found
        problem = replace(
            problem,
            diffuse=np.concatenate([problem.diffuse, diffuse[..., None]], axis=2),
            specular=np.concatenate([problem.specular, specular[..., None]], axis=2),
        )
        rows, light = problem.rows(), found.light.astype(np.float32)
        matt, glossy = rows.diffuse @ light, rows.specular @ light
        maps = found.diffuse[rows.texel], found.specular[rows.texel, None]
        residual = rows.colour - form_image(0.0, maps[0], matt, maps[1], glossy)
        normal = LightingEquations.accumulate(rows, found.diffuse, found.specular, matt, glossy, residual, self.weight)
        for name in normal.__dataclass_fields__:
            setattr(normal, name, getattr(normal, name) + getattr(self.priors, name))
        remaining = normal.eliminate(False, DAMPING)
        gain = (remaining.follow(normal.own_right) * normal.own_right).sum()
        gain += remaining.right @ np.linalg.solve(remaining.reduced, remaining.right)
        return float((self.weight * residual**2).sum() - gain)


def without_edges(seen: Observations, forward: Forward) -> Observations:
    """Observations where a model's last compact light, were it `EDGE` in radius, would be seen whole or not at all."""
    light = forward.lights[-1]
    assert isinstance(light, (DistantLight, NearLight))
    distance = light.distance if isinstance(light, NearLight) else 1.0
    bits = forward.visible(seen, [replace(light, radius=EDGE * distance)])[0]
    certain = (bits == 0) | (bits == (1 << RAYS) - 1)
    return replace(seen, weight=np.where(certain[:, seen.step], seen.weight, np.float32(0.0)))


def find_near(judge: Judge, light: DistantLight, points: NDArray) -> NearLight | None:
    """The place along and about a distant light's direction that leaves least unexplained.

    Parameters
    ----------
    judge : Judge
        About a fit with that light.
    light : DistantLight
    points : (..., 3)
        World positions of the texels.

    Returns
    -------
    NearLight or None
        None where a light beyond all places that are looked at leaves less.
    """
    points = np.reshape(points, (-1, 3)).astype(np.float64)
    centre = points.mean(0)
    size = float(np.sqrt(((points - centre) ** 2).sum(1).mean()))
    far = size * np.geomspace(*REACH, PLACES)
    lights = [placed(light.direction, light.radius, distance, centre) for distance in far]
    left = judge.unexplained([*lights, light])
    best = int(np.argmin(left))
    if best >= PLACES - 1:
        return None
    return approach(judge, lights[best], float(np.log(far[1] / far[0])))


def approach(judge: Judge, light: NearLight, step: float) -> NearLight:
    """The place about a near light's that leaves least unexplained; ``step`` is the first one, of log distance."""
    (left,) = judge.unexplained([light])
    turn = TURN
    while step > LEAST_STEP:
        direction, distance, angle = light.direction, light.distance, light.radius / light.distance
        factor, size = np.exp(step), np.exp(2.0 * step)
        around = [placed(d, angle, distance, light.centre) for d in ring(direction, turn)]
        around += [placed(direction, angle, distance * f, light.centre) for f in (factor, 1.0 / factor)]
        angles = np.clip([angle * size, angle / size], *RADII)
        around += [placed(direction, float(a), distance, light.centre) for a in angles]
        energies = judge.unexplained(around)
        best = int(np.argmin(energies))
        if energies[best] < left:
            light, left = around[best], float(energies[best])
        else:
            step, turn = 0.5 * step, 0.5 * turn
    return light


def placed(direction: NDArray, angle: float, distance: float, centre: NDArray) -> NearLight:
    """A light without colour, seen from the centre in a direction, at a distance and under an angular radius."""
    return NearLight(centre + distance * direction, angle * distance, np.zeros(3), centre)
