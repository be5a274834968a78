"""Stage 1b: the surface that the images of all views and timesteps show together.

The surface is the model's modes, the head's pose and a smooth displacement under one Gaussian prior
(`surface.displace`). It is measured along its normals, where two views show the same skin (`surface.sweep`), and by the
outlines of the head (`surface.outline`). Measurements and solutions take turns, coarse to fine: coarse levels reach far
in few texels, and the prior holds what they don't measure. A solution weights its offsets anew as outliers come apart
from them. Stage 1 is only a start.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.config import SurfaceConfig
from mifit.core.calls import checked
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.metrics import INDEPENDENT, SURE, median_deviation
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.morphable.openings import leading_faces, skin_weights
from mifit.morphable.topology import INNER
from mifit.optim import Outcome
from mifit.progress import Progress, silent
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.geometry.surfaces import Scenes
from mifit.stages.surface.align_timesteps import align_timesteps
from mifit.stages.surface.close_openings import LIDS, LIPS, close_again, close_openings
from mifit.stages.surface.displace import Measurements, SurfacePrior, Walls, solve_surface
from mifit.stages.surface.outline import REACH, Borders, find_borders, joined
from mifit.stages.surface.sweep import Found, Posed, across_time, epipolar_residual, likeness, match
from mifit.stages.surface.views import Resolution, pose_texels, texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

NARROWEST = 0.03
"""Least parallax; below it, about 2 degrees between the views, depth isn't measured."""
NEIGHBOURS = 2
"""Views that each view is compared with, those whose directions are nearest."""
STEP_PIXELS = 0.7
"""Parallax of a step, the unit of offsets, pixels of the level."""
ROBUST_STEPS = ((4.0, 2.0), (2.8, 1.4), (1.4,))
"""Distance in steps where an offset counts as an outlier: per round at a level, one for each weighting. Chosen on gloss
and heads of Table 1 with the built-in model, Emily c3,c4, scan_city."""
START = 6.0
"""Steps of the coarsest level that reach as far as the surface is searched. Chosen on all development heads."""
COARSEST = 3
"""Times that the images are halved at most."""
LARGEST_MAP = 720
"""Texels along a side at most; a level with more than twice as many pixels is left out. Chosen on Emily c3,c4."""
SETTLED = 0.15
"""Part of a step below which the surface is at rest (root mean square over what is measured)."""
FORGET_MM = 150.0
"""Wavelength above which displacements fall back to the model where nothing is measured."""
CONTACT_MM = 1.5
"""Gap below which opposed parts of the surface, such as closed lips, move together."""
WALL_MM = 5.0
"""Distance between both sides of the skin below which they are a wall, such as the nose's wing: set by hand."""
POSE_MM = 10.0
"""Standard deviation of the head's pose in the first estimate, as movement of its surface."""
SLACK = 0.01
"""Pixels that the surface may move by before what rays meet is built anew."""
OFF_PIXELS = 1.0
"""Median distance from epipolar lines that deserves a warning."""
ALIKE = 0.55
"""Correlation of two views of one face: 0.78 to 0.93 on development heads, 0.25 to 0.51 of two persons."""


@checked
@one_blas_thread()
def find_surface(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: SurfaceConfig | None = None,
    progress: Progress = silent,
) -> GeometryEstimate:
    """The surface on which all views agree.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Where to start: the result of stage 1, or of this function.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : SurfaceConfig, optional
    progress : Progress

    Returns
    -------
    GeometryEstimate
        With ``displacement``, one for all timesteps, other coefficients, and the vertices that follow. With fewer
        than two views, or views from nearly one place, ``geometry`` with a warning.
    """
    began = time.perf_counter()
    config = config or SurfaceConfig()
    views = [capture.camera(name) for name in cameras]
    world = geometry.vertices.astype(np.float64)
    pairs = neighbours(views, world[0].mean(axis=0))
    if not pairs:
        return _unchanged(geometry, "one view: the surface stays in the model's span", began)
    resolution = Resolution.of(views, world[0].mean(axis=0), pairs)
    if resolution.parallax < NARROWEST:
        return _unchanged(geometry, "views from nearly one place: the surface stays in the model's span", began)
    level_step = STEP_PIXELS * resolution.pixel / resolution.parallax  # of level 0, world length
    finest = config.finest
    while texture_size(model, world[0], resolution.pixel * 2.0**finest, 4 * LARGEST_MAP) > 2 * LARGEST_MAP:
        finest += 1
    coarsest = finest
    while coarsest < COARSEST and START * level_step * 2**coarsest * capture.unit_mm < config.reach:
        coarsest += 1

    # The prior: modes and plate on the skin, which pieces that were added to the model, such as eyes, go along with.
    skin = Skin.of(model)
    neutral = model.shape(geometry.identity).astype(np.float64)
    motion = Motion.of(neutral, POSE_MM / model.unit_mm)
    prior = SurfacePrior.of(
        neutral[: skin.count],
        skin.faces,
        np.concatenate([model.identity, model.expression, motion.modes(neutral)], axis=2)[: skin.count],
        FORGET_MM / model.unit_mm,
        CONTACT_MM / model.unit_mm,
    )
    scenes = Scenes(skin.faces, np.unique(model.faces[model.face_mask]), SLACK * resolution.pixel)
    reach = config.reach / capture.unit_mm
    sight = Sight(capture, model, tuple(cameras), scenes, world[0], resolution.pixel, reach, finest)
    landmarks = Landmarks.of(capture, model, cameras, geometry)
    walls = Walls.of(model.mean[: skin.count], skin.faces, WALL_MM / model.unit_mm)
    search = Search(
        geometry, model, pairs, skin, prior, motion, landmarks, walls, sight, level_step, config.stiffness, progress
    )

    # Measure and solve in turn, coarse to fine. The finest level measures lids that have closed.
    rest = Rest(State.of(model, geometry))
    lips, lids = LIPS * config.close_lips, LIDS * config.close_lids
    closed: dict = {}
    for level in range(coarsest, finest - 1, -1):
        if level == finest:
            shut, closed = close_openings(capture, model, rest.state.estimate(geometry, model), cameras, lids)
            if any(opening["closed"] for opening in closed.values()):
                rest = replace(rest, state=State.of(model, shut))
        rest = search.settle(rest, level)
    progress("find surface", len(rest.levels), len(rest.levels))

    # Closed mouths and eyes.
    result = close_again(model, rest.state.without_motion(model, skin).estimate(geometry, model), closed, lids)
    result, closed_lips = close_openings(capture, model, result, cameras, lips)
    world = result.vertices.astype(np.float64)
    residuals, likenesses = sight.agreement(pairs, result.timesteps, world, result.rotation)
    seconds = time.perf_counter() - began
    moved = np.linalg.norm(rest.state.displacement, axis=1)[np.unique(model.faces[model.face_mask])] * model.unit_mm
    phase = {
        "name": "surface",
        "outcome": rest.outcome.value,
        "moved_last_mm": rest.moved * capture.unit_mm,
        "levels": list(rest.levels),
        "matched": rest.matched,
        "displacement_mm": float(np.sqrt(np.mean(moved**2))),
        "epipolar_pixels": residuals,
        "likeness": likenesses,
        "openings": closed | closed_lips,
        "seconds": seconds,
    }
    warnings = epipolar_warnings(residuals) + likeness_warnings(likenesses)
    return replace(result, report=geometry.report.after(seconds, phase, warnings))


def neighbours(cameras: Sequence[Camera], centre: NDArray) -> list[tuple[int, int]]:
    """Pairs of cameras to compare: each with those whose directions from a point (3,) are nearest to its own."""
    towards = normalize(np.array([camera.position - centre for camera in cameras]))
    nearest = np.argsort(-(towards @ towards.T), axis=1, kind="stable")
    return sorted(
        {(min(a, b), max(a, b)) for a, row in enumerate(nearest) for b in row[row != a][:NEIGHBOURS].tolist()}
    )


@dataclass(frozen=True)
class Skin:
    """The model's own skin.

    Attributes
    ----------
    count : int
        Its vertices come first.
    weights : (V, count) sparse or None
        What all vertices move with; None where nothing was added.
    faces : (F, 3) int
        Rays meet the skin alone: through eyes that were added, windows at the lids would match what balls mirror.
    """

    count: int
    weights: sp.csr_matrix | None
    faces: NDArray

    @classmethod
    def of(cls, model: MorphableModel) -> Skin:
        """Of a model with eyes that were added to it, or without."""
        weights = skin_weights(model)
        count = model.n_vertices if weights is None else weights.shape[1]
        return cls(count, weights, model.faces[leading_faces(model, count)])

    def spread(self, displacement: NDArray) -> NDArray[np.float64]:
        """(V, 3) displacement of all vertices by that of the skin."""
        return displacement if self.weights is None else self.weights @ displacement


@dataclass(frozen=True)
class Landmarks:
    """Detected points but for the jaw's, which lie on silhouettes and not on the skin.

    A detector's errors are the same in all images of a head: all of them together count as one,
    a weak hold where nothing else is measured.

    Attributes
    ----------
    views : sequence of (step, Camera, model vertices (n,), pixels (n, 2))
    """

    n_vertices: int
    views: Sequence[tuple[int, Camera, NDArray, NDArray]]

    @classmethod
    def of(
        cls, capture: Capture, model: MorphableModel, cameras: Sequence[str], geometry: GeometryEstimate
    ) -> Landmarks:
        """Of all images."""
        views = []
        for step, timestep in enumerate(geometry.timesteps):
            for name in cameras:
                frame = capture.frame(name, timestep)
                if frame.landmarks is not None:
                    index = np.flatnonzero(frame.visible[INNER]) + INNER[0]
                    pixels = np.asarray(frame.landmarks[index], np.float64)
                    views.append((step, capture.camera(name), model.landmarks[index], pixels))
        return cls(model.n_vertices, views)

    def at(self, world: NDArray, rotation: NDArray) -> Measurements:
        """What they measure at a surface (T, V, 3), with directions in object space."""
        rows, directions, offsets, precisions = [np.zeros(0, int)], [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0)]
        residuals = [pixels - camera.project(world[step][vertices]) for step, camera, vertices, pixels in self.views]
        apart = np.concatenate([np.zeros((0, 2)), *residuals])
        # Of a coordinate, pixels: what the surface lacks counts as the detector's.
        deviation = max(median_deviation(apart[np.isfinite(apart)]), 1.0)
        for (step, camera, vertices, _), apart in zip(self.views, residuals, strict=True):
            depth = camera.to_camera(world[step][vertices])[:, 2]
            good = np.flatnonzero((depth > 0) & np.isfinite(apart).all(axis=1))
            for axis, focal in ((0, camera.fx), (1, camera.fy)):
                pixel = depth[good] / focal
                rows.append(vertices[good])
                directions.append(np.tile(camera.rotation[axis] @ rotation[step], (len(good), 1)))
                offsets.append(apart[good, axis] * pixel)
                precisions.append(1.0 / (len(self.views) * (deviation * pixel) ** 2))
        index = np.concatenate(rows)
        ones = np.ones(len(index), np.float32)
        points = sp.csr_matrix((ones, index, np.arange(len(index) + 1)), shape=(len(index), self.n_vertices))
        precision = INDEPENDENT * np.concatenate(precisions)
        far = SURE / np.sqrt(precision[:, None])
        return Measurements(points, np.concatenate(directions), np.concatenate(offsets), precision, far)


@dataclass(frozen=True)
class State:
    """The unknowns: coefficients, poses, and the displacement (V, 3) in the model's neutral space."""

    timesteps: tuple[int, ...]
    identity: NDArray[np.float64]
    expression: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    scale: float
    displacement: NDArray[np.float64]

    @classmethod
    def of(cls, model: MorphableModel, geometry: GeometryEstimate) -> State:
        """A fit, displaced or not."""
        before = geometry.displacement
        return cls(
            geometry.timesteps,
            np.asarray(geometry.identity, np.float64),
            np.asarray(geometry.expression, np.float64),
            np.asarray(geometry.rotation, np.float64),
            np.asarray(geometry.translation, np.float64),
            float(geometry.scale),
            np.zeros((model.n_vertices, 3)) if before is None else before.astype(np.float64),
        )

    def posed_as(self, geometry: GeometryEstimate) -> State:
        """With the poses and expressions of a fit."""
        return replace(
            self,
            expression=np.asarray(geometry.expression, np.float64),
            rotation=np.asarray(geometry.rotation, np.float64),
            translation=np.asarray(geometry.translation, np.float64),
        )

    def without_motion(self, model: MorphableModel, skin: Skin) -> State:
        """The same surface, but what the face's displacement holds of a rigid motion is the pose's."""
        face = np.unique(model.faces[model.face_mask])
        shape = model.shape(self.identity, self.expression.mean(axis=0)).astype(np.float64)
        moved = shape + self.displacement
        before, after = shape[face].mean(axis=0), moved[face].mean(axis=0)
        turn = Rotation.align_vectors(moved[face] - after, shape[face] - before)[0].as_matrix()
        shift = after - turn @ before
        return replace(
            self,
            rotation=self.rotation @ turn,
            translation=self.translation + self.scale * self.rotation @ shift,
            displacement=skin.spread(((moved - shift) @ turn - shape)[: skin.count]),
        )

    def shape(self, model: MorphableModel) -> NDArray[np.float64]:
        """(V, 3) vertices of the mean expression, object space."""
        return model.shape(self.identity, self.expression.mean(axis=0)).astype(np.float64) + self.displacement

    def world(self, model: MorphableModel) -> NDArray[np.float64]:
        """(T, V, 3) vertices."""
        shapes = [model.shape(self.identity, e).astype(np.float64) + self.displacement for e in self.expression]
        return self.scale * np.stack(shapes) @ self.rotation.transpose(0, 2, 1) + self.translation[:, None]

    def estimate(self, geometry: GeometryEstimate, model: MorphableModel) -> GeometryEstimate:
        """The fit with these unknowns."""
        return replace(
            geometry,
            identity=self.identity,
            expression=self.expression,
            rotation=self.rotation,
            translation=self.translation,
            vertices=self.world(model).astype(np.float32),
            displacement=self.displacement.astype(np.float32),
        )


@dataclass(frozen=True)
class Motion:
    """Rigid motion of the head, linear in six coefficients of unit deviation: a rotation and a translation.

    ``centre`` (3,) of the rotation and ``radius``, root mean square distance from it, in object space; ``deviation``
    is the length of a movement of unit deviation.
    """

    centre: NDArray[np.float64]
    radius: float
    deviation: float

    @classmethod
    def of(cls, vertices: NDArray, deviation: float) -> Motion:
        """Of a head (V, 3)."""
        centre = vertices.mean(axis=0)
        return cls(centre, float(np.sqrt(((vertices - centre) ** 2).sum(axis=1).mean())), deviation)

    def modes(self, vertices: NDArray) -> NDArray[np.float32]:
        """(V, 3, 6) change of vertices by the coefficients."""
        turned = np.cross(np.eye(3), (vertices - self.centre)[:, None] / self.radius)
        shifted = np.broadcast_to(np.eye(3), turned.shape)
        modes = self.deviation * np.concatenate([turned, shifted], axis=1)
        return modes.transpose(0, 2, 1).astype(np.float32)

    def of_head(self, state: State, coefficients: NDArray) -> State:
        """A state whose poses have this motion in addition."""
        turn = Rotation.from_rotvec(self.deviation / self.radius * coefficients[:3]).as_matrix()
        shift = self.centre - turn @ self.centre + self.deviation * coefficients[3:]
        translation = state.translation + state.scale * state.rotation @ shift
        return replace(state, rotation=state.rotation @ turn, translation=translation)


@dataclass(frozen=True)
class Sight:
    """The views of the surface at the levels of the image pyramid.

    ``start`` (V, 3) is the first timestep's surface at the start, ``pixel`` the world length of a pixel of level 0
    at the face, ``reach`` how far borders are looked for, world length, at all levels but the finest.
    """

    capture: Capture
    model: MorphableModel
    cameras: tuple[str, ...]
    scenes: Scenes
    start: NDArray[np.float64]
    pixel: float
    reach: float
    finest: int

    def texels(self, level: int) -> tuple[TexelMap, TexelMap]:
        """Texels that are about as large as a level's pixels, and cells twice as wide."""
        model = self.model
        cells = texture_size(model, self.start, 2.0 * self.pixel * 2.0**level, LARGEST_MAP // 2)
        whole, half = (rasterize_uv(model.uv, model.faces_uv, n, model.face_mask) for n in (2 * cells, cells))
        return whole, half

    def posed(self, timestep: int, vertices: NDArray, texels: TexelMap, level: int) -> Posed:
        """Texels of one timestep's surface (V, 3), and the views of them."""
        scene = self.scenes.at(timestep, vertices)
        given = scene, vertices, self.model.faces, texels, self.cameras, timestep, 0.5**level
        return pose_texels(self.capture, *given)

    def borders(self, timestep: int, vertices: NDArray, level: int) -> Borders:
        """Outlines of one timestep's surface (V, 3) in all views, along the silhouettes of the one last posed."""
        factor = 2.0 * 0.5**level  # where a pixel mixes skin and background the border is doubtful
        if level > self.finest:
            factor = REACH * self.pixel / self.reach
        scene = self.scenes.last(timestep)
        found = find_borders(self.capture, scene, self.cameras, timestep, min(factor, 1.0))
        return found.moved(scene.faces, vertices - scene.vertices)

    def agreement(
        self, pairs: Sequence, timesteps: Sequence[int], world: NDArray, rotation: NDArray
    ) -> tuple[dict[str, float | None], dict[str, float | None]]:
        """How well views agree on surfaces (T, V, 3), for each pair of cameras.

        Returned are the median distance from one another's epipolar lines, pixels of the images, at the first and the
        last timestep; and the correlation of what they show at the first one.
        """
        level, steps = max(self.finest, 1), sorted({0, len(world) - 1})
        texels = self.texels(level)[0]
        posed = [self.posed(timesteps[k], world[k], texels, level) for k in steps]
        residuals, likenesses = dict[str, float | None](), dict[str, float | None]()
        for a, b in pairs:
            name = f"{self.cameras[a]}, {self.cameras[b]}"
            residual = epipolar_residual(texels, posed, rotation[steps], self.pixel * 2.0**level, (a, b))
            residuals[name] = None if residual is None else residual * 2.0**level
            likenesses[name] = likeness(posed[0], (a, b))
        return residuals, likenesses


@dataclass(frozen=True)
class Rest:
    """Where rounds have ended: ``moved`` is the root mean square of the last one's change, world length."""

    state: State
    levels: tuple[int, ...] = ()
    matched: float = 0.0
    moved: float = np.inf
    outcome: Outcome = Outcome.MAX_ITERATIONS


@dataclass(frozen=True)
class Search:
    """What stays the same in all rounds; ``level_step`` is a step of level 0, world length."""

    geometry: GeometryEstimate
    model: MorphableModel
    pairs: Sequence[tuple[int, int]]
    skin: Skin
    prior: SurfacePrior
    motion: Motion
    landmarks: Landmarks
    walls: Walls
    sight: Sight
    level_step: float
    stiffness: float
    progress: Progress

    def settle(self, rest: Rest, level: int) -> Rest:
        """Measure and solve at one level."""
        model, sight, skin = self.model, self.sight, self.skin
        step = self.level_step * 2.0**level
        state, factor = rest.state, None
        texels, cells = sight.texels(level)
        before = state.world(model)
        for number, outlier in enumerate(ROBUST_STEPS, 1):
            world = state.world(model)
            if number < len(ROBUST_STEPS):
                posed = [sight.posed(t, at, texels, level) for t, at in zip(state.timesteps, world, strict=True)]
                further: Sequence = ()
                if len(posed) > 1:
                    estimate = state.estimate(self.geometry, model)
                    aligned = align_timesteps(model, estimate, texels, posed, expected=self.geometry.expression)
                    state = state.posed_as(aligned)
                    posed = moved_with(model, texels, posed, state.world(model) - world)
                    world = state.world(model)
                    further = across_time(posed, state.rotation)
                borders = [sight.borders(t, at, level) for t, at in zip(state.timesteps, world, strict=True)]
            else:  # the last round moves the surface by too little to change which parts of it are visible
                posed = moved_with(model, texels, posed, world - before)
                borders = [b.moved(model.faces, way) for b, way in zip(borders, world - before, strict=True)]
            before = world
            joint = [((k, a), (k, b)) for k in range(len(posed)) for a, b in self.pairs]
            found = match(texels, cells, posed, state.rotation, step, [*joint, *further])
            if not (found.precision > 0).any():
                break

            # Object space, all timesteps alike: the surface that explains offsets, outlines and landmarks.
            marks = self.landmarks.at(world, state.rotation)
            outlines = joined([b.turned(r) for b, r in zip(borders, state.rotation, strict=True)])
            robust = step * np.array(outlier)
            rows = measurements(state, model, cells, world, found, outlines, marks, robust)
            if skin.weights is not None:
                rows = replace(rows, points=rows.points @ skin.weights)
            rows = rows.with_others(self.walls.at(state.shape(model)[: skin.count]))
            mean = state.expression.mean(axis=0)
            coefficients = np.concatenate([state.identity, mean, np.zeros(6)])
            surface = self.prior.move(coefficients) + state.displacement[: skin.count]
            factor = factor or self.prior.factor(rows, self.stiffness)
            solved = self.prior, rows, surface, self._bounds(state), self.stiffness, factor
            moved_by, coefficients = solve_surface(*solved)
            identity, changed, rigid = np.split(coefficients, [len(state.identity), len(coefficients) - 6])
            expression = state.expression + (changed - mean)
            state = replace(state, identity=identity, expression=expression, displacement=skin.spread(moved_by))
            state = self.motion.of_head(state, rigid)

            measured = np.unique(model.faces[cells.face[found.precision > 0]])
            moved = along_normals(state.world(model) - world, world, model.faces, measured)
            outcome = Outcome.CONVERGED if moved < SETTLED * step else Outcome.MAX_ITERATIONS
            rest = Rest(state, (*rest.levels, level), float((found.precision > 0).mean()), moved, outcome)
            left = len(ROBUST_STEPS) * (level - sight.finest + 1) - number
            self.progress("find surface", len(rest.levels), len(rest.levels) + left)
        return rest

    def _bounds(self, state: State) -> NDArray[np.float64]:
        """(K, 2) bounds of identity and mean expression: the expression of no timestep leaves the model's."""
        low, high = self.model.expression_bounds.T.astype(np.float64)
        mean = state.expression.mean(axis=0)
        low, high = (low - state.expression).max(axis=0), (high - state.expression).min(axis=0)
        of_mean = np.stack([mean + np.minimum(low, 0.0), mean + np.maximum(high, 0.0)], axis=1)
        free = [-np.inf, np.inf]
        return np.concatenate([np.tile(free, (len(state.identity), 1)), of_mean, np.tile(free, (6, 1))])


def measurements(
    state: State,
    model: MorphableModel,
    cells: TexelMap,
    world: NDArray,
    found: Found,
    borders: Borders,
    marks: Measurements,
    robust: NDArray,
) -> Measurements:
    """Offsets that were found, outlines and landmarks, all in object space."""
    scale = state.scale
    of_vertices = [vertex_normals(at, model.faces) @ r for at, r in zip(world, state.rotation, strict=True)]
    normals = interpolate(np.mean(of_vertices, axis=0), model.faces, cells.face, cells.weights)
    face = np.concatenate([cells.face, borders.face])
    weights = np.concatenate([cells.weights, borders.weights])
    rows = Measurements(
        corner_matrix(model.faces, face, weights, model.n_vertices),
        np.concatenate([normalize(normals), borders.normal]),
        np.concatenate([found.offset, borders.offset]),
        np.concatenate([found.precision, borders.precision]),
        np.tile(robust, (len(face), 1)),
    ).with_others(marks)
    return replace(rows, offsets=rows.offsets / scale, precision=rows.precision * scale**2, robust=rows.robust / scale)


def moved_with(model: MorphableModel, texels: TexelMap, posed: Sequence[Posed], moved: NDArray) -> list[Posed]:
    """Texels of a surface whose vertices have moved by (T, V, 3), a pixel or so: their visibility stays."""
    by = [interpolate(way, model.faces, texels.face, texels.weights) for way in moved]
    return [replace(one, position=one.position + way) for one, way in zip(posed, by, strict=True)]


def along_normals(change: NDArray, world: NDArray, faces: NDArray, vertices: NDArray) -> float:
    """Root mean square of a movement (T, V, 3) along the normals at some vertices."""
    if not len(vertices):
        return 0.0
    normals = np.stack([vertex_normals(one, faces) for one in world])
    return float(np.sqrt(np.mean((change * normals).sum(axis=2)[:, vertices] ** 2)))


def _unchanged(geometry: GeometryEstimate, text: str, began: float) -> GeometryEstimate:
    """The input with a warning."""
    report = geometry.report.after(time.perf_counter() - began, {"name": "surface", "outcome": "left out"})
    warning = Diagnostic("surface-in-span", text)
    return replace(geometry, report=replace(report, warnings=(*report.warnings, warning)))


def epipolar_warnings(residuals: Mapping[str, float | None]) -> list[Diagnostic]:
    """What to say of views, such as ``"left, right"``, that show points off one another's epipolar lines."""
    return [
        Diagnostic(
            "views-disagree",
            f"cameras {names}: what they show lies {pixels:.1f} pixels off one another's epipolar lines, expected at "
            f"most {OFF_PIXELS:g}; the calibration is off, or the cameras aren't in step",
        )
        for names, pixels in residuals.items()
        if pixels is not None and pixels > OFF_PIXELS
    ]


def likeness_warnings(likenesses: Mapping[str, float | None]) -> list[Diagnostic]:
    """What to say of views, such as ``"left, right"``, that show different skin in the same places."""
    return [
        Diagnostic(
            "skin-differs",
            f"cameras {names}: what they show on the fitted face correlates by {value:.2f}, expected at least "
            f"{ALIKE:g}; they show two people, or two moments, or the calibration is off",
        )
        for names, value in likenesses.items()
        if value is not None and value < ALIKE
    ]
