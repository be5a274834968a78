"""Pose and expression of each timestep, by what its views show of one surface.

Landmarks leave what is painted on the skin pixels apart from one timestep to the next. Every view's texture is compared
with the mean of all views of all timesteps, and each timestep follows its gradient:

    sum_ki w_ki (f_i(x_k(r_k, t_k, e_k)) - mean)^2 / s^2 + |e_k|^2 / EXPRESSION^2 + |r_k, t_k / size|^2 / POSE^2

over turns r, shifts t and changes e of the expression at each timestep k, with the band-passed views f_i. What all
timesteps would do alike is left out: that is for the surface to tell. A timestep that is followed goes to where those
that stay agree with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.core.metrics import INDEPENDENT, median_deviation
from mifit.core.process import on_all_cores
from mifit.core.uv import TexelMap
from mifit.morphable import MorphableModel
from mifit.stages.geometry.parameters import exponential
from mifit.stages.surface.band import FeatureImage, look_up
from mifit.stages.surface.sweep import FEWEST, Posed

POINTS = 12000
"""Texels that are compared at the most; the more there are, the less the priors count. Chosen on gloss and scan_city
with both models: with a quarter of them the mean distance from the truth is 0.03 mm larger."""
ITERATIONS = 10
STILL_PIXELS = 0.02
"""Largest root mean square shift of an iteration's step that ends the iterations, pixels of the level."""
LEAST_SPREAD = 1e-3
"""Of the features."""
ASIDE = np.array([[-0.5, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]], np.float32)
"""Where a view is read for its value and slope, pixels of the level."""
POSE = 0.03
"""Deviation of turns beforehand, radians, and of shifts in terms of the head's size."""
EXPRESSION = 0.3
"""Deviation of the expressions' coefficients from those found before: a part of that of the coefficients themselves."""


@dataclass(frozen=True)
class Look:
    """What one view shows at points.

    Attributes
    ----------
    value, weight : (n,)
        Feature, and how far it counts; weight 0 where the view doesn't see the point.
    slope : (n, 3)
        Change of the feature per world length that the point moves.
    pixel : float
        World length of a pixel of the level.
    step : int
        Place of the timestep among those that were posed.
    """

    value: NDArray[np.float64]
    weight: NDArray[np.float64]
    slope: NDArray[np.float64]
    pixel: float
    step: int


def align_timesteps(
    model: MorphableModel,
    geometry: GeometryEstimate,
    texels: TexelMap,
    posed: Sequence[Posed],
    still: Sequence[Look] = (),
    expected: NDArray | None = None,
) -> GeometryEstimate:
    """Move timesteps to where their views agree with those of the others.

    Parameters
    ----------
    model : MorphableModel
    geometry : GeometryEstimate
        Fit at the timesteps of ``posed``.
    texels : TexelMap
    posed : sequence of Posed
        The texels of the surface, which may be displaced from ``geometry``'s.
    still : sequence of Look, optional
        What views of other timesteps, which stay, show of the same texels (`looks_at`); without them what all
        timesteps do alike is left out.
    expected : (T, Ke), optional
        Expressions beforehand, the fit's own by default. Without ``still`` their mean says nothing.

    Returns
    -------
    GeometryEstimate
        With other ``rotation``, ``translation``, ``expression`` and the ``vertices`` that follow.
    """
    rows = _points(texels)
    flat = model.expression.reshape(model.n_vertices, -1)
    basis = interpolate(flat, model.faces, texels.face[rows], texels.weights[rows]).reshape(len(rows), 3, -1)
    scale, rotation = float(geometry.scale), geometry.rotation.astype(np.float64)
    low, high = model.expression_bounds.T.astype(np.float64)[:, None] - geometry.expression
    # Object space about the middle, in world lengths: what moves alike at all timesteps is alike here.
    middles = np.stack([p.position.mean(axis=0) for p in posed])
    start = np.stack([(p.position[rows] - c) @ r for p, c, r in zip(posed, middles, rotation, strict=True)])
    size = float(np.sqrt((start**2).sum(axis=2).mean()))
    wide = np.concatenate([np.full(3, POSE), np.full(3, POSE * size), np.full(model.n_expression, EXPRESSION)])
    turns = np.tile(np.eye(3), (len(posed), 1, 1))
    shifts, changes = np.zeros((len(posed), 3)), np.zeros((len(posed), model.n_expression))
    spent = np.zeros((len(posed), len(wide)))
    if expected is not None:
        spent[:, 6:] = geometry.expression - expected
    if not still:
        spent -= spent.mean(axis=0)
    for _ in range(ITERATIONS):
        at = start + scale * np.einsum("nck,tk->tnc", basis, changes)
        at = at @ turns.transpose(0, 2, 1) + shifts[:, None]
        looks = _looks(posed, rows, [c + x @ r.T for x, c, r in zip(at, middles, rotation, strict=True)])
        steps = _steps(looks, still, at, rotation, turns, scale * basis, wide, spent)
        if steps is None:
            return geometry
        if not still:
            steps -= steps.mean(axis=0)
        steps[:, 6:] = np.clip(changes + steps[:, 6:], np.minimum(low, 0.0), np.maximum(high, 0.0)) - changes
        spent += steps
        for k, step in enumerate(steps):
            turn = exponential(step[:3])
            turns[k], shifts[k] = turn @ turns[k], turn @ shifts[k] + step[3:6]
        changes += steps[:, 6:]
        moved = np.sqrt((steps[:, :3] ** 2).sum(1) * size**2 + (steps[:, 3:6] ** 2).sum(1)).max()
        if moved < STILL_PIXELS * min(look.pixel for look in looks):
            break
    return _moved(model, geometry, middles, turns, shifts, changes)


def looks_at(texels: TexelMap, posed: Sequence[Posed]) -> list[Look]:
    """What all views show of the points that `align_timesteps` compares."""
    rows = _points(texels)
    return _looks(posed, rows, [p.position[rows] for p in posed])


def _points(texels: TexelMap) -> NDArray[np.intp]:
    """Rows of the texels that are compared, the same for the same texels."""
    rows = np.arange(len(texels.index))
    if len(rows) > POINTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, POINTS, replace=False))
    return rows


def _looks(posed: Sequence[Posed], rows: NDArray, world: Sequence[NDArray]) -> list[Look]:
    """What each view shows of its timestep's points (n, 3), which are texels' ``rows``."""
    steps = enumerate(zip(posed, world, strict=True))
    given = [(k, image, at, seen[rows]) for k, (p, at) in steps for image, seen in zip(p.images, p.seen, strict=True)]
    return on_all_cores(lambda view: _look(*view), given)


def _look(step: int, image: FeatureImage, points: NDArray, seen: NDArray) -> Look:
    """One view of world points (n, 3); central differences over a pixel."""
    camera = image.camera
    fx, fy = camera.fx * image.factor, camera.fy * image.factor
    u, v, depth = camera.to_camera(points).T
    depth = np.maximum(depth, 1e-12)
    right, down, ahead = camera.rotation
    pixels = image.place(points)
    left, middle, beside, above, below = (look_up(image.values, pixels + way) for way in ASIDE)
    known = np.min([one[:, 1] for one in (left, middle, beside, above, below)], axis=0) > 0.99
    x, y = (beside - left)[:, 0] * fx / depth, (below - above)[:, 0] * fy / depth
    slope = x[:, None] * right + y[:, None] * down - ((x * u + y * v) / depth)[:, None] * ahead
    weight = np.where(known, seen, 0.0).astype(np.float64)
    return Look(middle[:, 0].astype(np.float64), weight, slope, float(np.median(depth)) / fx, step)


def _steps(
    looks: list[Look],
    still: Sequence[Look],
    at: NDArray,
    rotation: NDArray,
    turns: NDArray,
    basis: NDArray,
    wide: NDArray,
    spent: NDArray,
) -> NDArray[np.float64] | None:
    """(T, 6 + Ke) steps of turns, shifts and expressions, object space; None where too little is seen."""
    value = np.stack([look.value for look in (*looks, *still)])
    weight = np.stack([look.weight for look in (*looks, *still)])
    used = (weight > 0) & ((weight > 0).sum(axis=0) > 1)
    if used.sum() < FEWEST:
        return None
    mean = (weight * value).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-6)
    residual = np.where(used, value - mean, 0.0)
    spread = max(median_deviation(residual[used]), LEAST_SPREAD)
    weight = np.where(used, weight / (1.0 + (residual / (2.0 * spread)) ** 2) ** 2, 0.0) * INDEPENDENT / spread**2

    def equations(part: tuple[Look, NDArray, NDArray]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """What one view adds to its timestep's system and gradient."""
        look, counts, off = part
        k, some = look.step, np.flatnonzero(counts > 0)
        root = np.sqrt(counts[some, None])
        slope = root * (look.slope[some] @ rotation[k])  # by object-space movement
        bent = (slope @ turns[k]).astype(np.float32)[:, None] @ basis[some]
        rigid = np.concatenate([np.cross(at[k, some], slope), slope], axis=1).astype(np.float32)
        jacobian = np.concatenate([rigid, bent[:, 0]], axis=1)
        return jacobian.T @ jacobian, jacobian.T @ (root[:, 0] * off[some]).astype(np.float32)

    moving = list(zip(looks, weight, residual, strict=False))
    prior = np.diag(wide**-2.0)
    system, gradient = np.tile(prior, (len(spent), 1, 1)), spent @ prior
    for look, (curvature, pull) in zip(looks, on_all_cores(equations, moving), strict=True):
        system[look.step] += curvature
        gradient[look.step] += pull
    return np.asarray(-np.linalg.solve(system, gradient[..., None])[..., 0], np.float64)


def _moved(
    model: MorphableModel,
    geometry: GeometryEstimate,
    middles: NDArray,
    turns: NDArray,
    shifts: NDArray,
    changes: NDArray,
) -> GeometryEstimate:
    """The fit whose timesteps have moved about their middles."""
    rotation = geometry.rotation @ turns
    old = geometry.rotation.astype(np.float64)
    about = (geometry.translation - middles)[:, None] @ old  # of the object's origin from the middle, object axes
    origin = (about @ turns.transpose(0, 2, 1) + shifts[:, None]) @ old.transpose(0, 2, 1) + middles[:, None]
    shapes = (geometry.vertices - geometry.translation[:, None]) @ old
    shapes = shapes + float(geometry.scale) * np.einsum("vck,tk->tvc", model.expression, changes)
    vertices = shapes @ rotation.transpose(0, 2, 1) + origin
    return replace(
        geometry,
        rotation=rotation,
        translation=origin[:, 0],
        expression=geometry.expression + changes,
        vertices=vertices.astype(geometry.vertices.dtype),
    )
