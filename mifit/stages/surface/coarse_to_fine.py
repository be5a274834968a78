"""Sweeps, coarse to fine: the surface moves to where the views of all timesteps agree, and the timesteps with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import SurfaceConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.morphable.openings import leading_faces, skin_weights
from mifit.optim import Outcome
from mifit.progress import Progress
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.geometry.scenes import Scenes
from mifit.stages.surface.align_timesteps import align_timesteps
from mifit.stages.surface.displace import USUAL, Plate, solve_displacement
from mifit.stages.surface.epipolar import epipolar_residual
from mifit.stages.surface.local_planes import MeasuredPlanes, passing_planes, touching_planes
from mifit.stages.surface.outline import Borders, find_borders, joined
from mifit.stages.surface.sweep import Found, Posed, across_time, sweep
from mifit.stages.surface.views import Resolution, pose_texels, texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

SLACK = 0.01
"""Pixels that the surface may move by before what rays meet is built anew."""
STEP_PIXELS = 0.7
"""Parallax between neighbouring offsets of a sweep, pixels of the level."""
WINDOW = 11
"""Side of the windows that are compared, texels; a texel is about a pixel of the level."""
COARSEST = 3
"""Times that the images are halved at most."""
LARGEST_MAP = 1024
HALF_LAYERS = 6
"""Offsets to either side in a level's first sweep."""
ROBUST_STEPS = 0.7
"""Distance from the fitted surface, in steps of the sweep, where an offset counts as an outlier."""
FORGET_MM = 150.0
"""Wavelength above which displacements fall back to the model where nothing is measured."""
CONTACT_MM = 1.5
"""Gap below which opposed parts of the surface, such as closed lips, move together."""
OUTSIDE_STEPS, OUTSIDE_BORDER = 1.0, 3.0
"""Distance from the model at which a measurement counts as outside its span: steps of a sweep, pixels of an outline."""
SETTLED = 0.25
"""Part of the last sweep's step below which the surface counts as settled."""
THIN = 2
STIFFEST = 5000.0
"""Largest stiffness."""


@dataclass(frozen=True)
class Reached:
    """Where a run of sweeps ended; ``geometry`` is the model's surface under the displacement."""

    geometry: GeometryEstimate
    displacement: NDArray[np.float64]
    world: NDArray[np.float64]
    stiffness: float
    matched: float
    moved: float
    """Root mean square of what the last sweep moved the measured texels by along their normals, world length."""
    outcome: Outcome

    @classmethod
    def at(cls, estimate: GeometryEstimate, stiffness: float = USUAL) -> Reached:
        """On a surface that is displaced or not, nothing swept yet."""
        displacement = np.zeros((estimate.vertices.shape[1], 3))
        if estimate.displacement is not None:
            displacement = estimate.displacement.astype(np.float64)
        world = estimate.vertices.astype(np.float64)
        bare = replace(estimate, vertices=world, displacement=None)
        bare = replace(bare, vertices=displaced_world(bare, -displacement))
        return cls(bare, displacement, world, stiffness, 0.0, np.inf, Outcome.MAX_ITERATIONS)

    @property
    def estimate(self) -> GeometryEstimate:
        """The fit with this surface."""
        vertices, displacement = self.world.astype(np.float32), self.displacement.astype(np.float32)
        return replace(self.geometry, vertices=vertices, displacement=displacement)


@dataclass(frozen=True)
class Swept:
    """What one sweep found, and the way between its offsets, world length."""

    found: Found
    step: float


class Search:
    """Sweeps, coarse to fine, from a fit of the model.

    Parameters
    ----------
    capture, model, cameras, config, progress
        As in `find_surface`.
    resolution : Resolution
    pairs : sequence of (int, int)
        Views of a timestep that are compared.
    total : int
        Sweeps that there will be, for ``progress``.
    beyond : bool
        Whether the head is taken to lie beyond the model's span: its halves are then alike, and its timesteps aligned.
    count_as : float, optional
        Number of timesteps that all together count as; default: as many as there are.
    """

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        cameras: Sequence[str],
        resolution: Resolution,
        pairs: Sequence[tuple[int, int]],
        config: SurfaceConfig,
        progress: Progress,
        total: int,
        beyond: bool,
        count_as: float | None = None,
    ) -> None:
        self._beyond, self._count_as = beyond, count_as
        self._capture, self._model, self._cameras, self._pairs = capture, model, cameras, pairs
        self._resolution, self._config, self._progress = resolution, config, progress
        self._done, self._total = 0, total
        self._by_skin = skin_weights(model)
        self._own = model.n_vertices if self._by_skin is None else self._by_skin.shape[1]
        # Rays meet the skin alone: through eyes that were added, windows at the lids would match what the balls mirror.
        self._faces = model.faces[leading_faces(model, self._own)]
        self.scenes = Scenes(self._faces, np.unique(model.faces[model.face_mask]), SLACK * resolution.pixel)
        progress("find surface", 0, total)

    def finish(self) -> None:
        """All steps are done, or were not needed."""
        self._progress("find surface", self._total, self._total)

    def advance(self) -> None:
        """One more step is done."""
        self._done += 1
        self._progress("find surface", self._done, self._total)

    def _texels(self, world: NDArray, level: int) -> TexelMap:
        """Texels of a surface (T, V, 3) that are about as large as a level's pixels."""
        model = self._model
        size = texture_size(model, world[0], self._resolution.pixel * 2.0**level, LARGEST_MAP)
        return rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)

    def _posed(self, timestep: int, vertices: NDArray, texels: TexelMap, level: int) -> Posed:
        """Texels of one timestep's surface (V, 3), and the views of them."""
        scene = self.scenes.at(timestep, vertices)
        return pose_texels(
            self._capture, scene, vertices, self._model.faces, texels, self._cameras, timestep, 0.5**level
        )

    def _borders(self, timestep: int, vertices: NDArray, level: int) -> Borders:
        """Outlines of one timestep's surface in all views."""
        finer = min(
            2.0 * 0.5**level, 1.0
        )  # where the image mixes skin and background in a pixel the border is doubtful
        scene = self.scenes.at(timestep, vertices)
        return find_borders(self._capture, scene, self._cameras, timestep, finer)

    def _sweep(self, texels: TexelMap, posed: Sequence[Posed], level: int, half: int, further: Sequence) -> Swept:
        """One sweep of a surface, with ``further`` pairs of views beside those of each timestep."""
        step = STEP_PIXELS * self._resolution.pixel * 2.0**level / self._resolution.parallax
        pairs = [((k, a), (k, b)) for k in range(len(posed)) for a, b in self._pairs]
        found = sweep(texels, posed, step * np.arange(-half, half + 1), WINDOW, [*pairs, *further])
        if self._count_as is not None:
            found = replace(found, precision=found.precision * min(1.0, self._count_as / len(posed)))
        return Swept(found, step)

    def planes(
        self, timesteps: Sequence[int], world: NDArray, level: int, half: int, outlines: bool
    ) -> list[tuple[MeasuredPlanes, ...]]:
        """Planes that touch what a sweep finds, of each timestep, and those along the outlines where wanted.

        The timesteps share the precision of what the sweep finds.
        """
        texels = self._texels(world, level)
        posed = [self._posed(t, vertices, texels, level) for t, vertices in zip(timesteps, world, strict=True)]
        swept = self._sweep(texels, posed, level, half, ())
        shared = replace(swept.found, precision=swept.found.precision / len(posed))
        inside = [touching_planes(texels, one, shared, OUTSIDE_STEPS * swept.step) for one in posed]
        if not outlines:
            return [(planes,) for planes in inside]
        borders = [self._borders(t, vertices, level) for t, vertices in zip(timesteps, world, strict=True)]
        farthest = OUTSIDE_BORDER * self._resolution.pixel
        return [(planes, passing_planes(border, farthest)) for planes, border in zip(inside, borders, strict=True)]

    def descend(self, last: Reached, levels: Sequence[tuple[int, int]]) -> Reached:
        """Displace a fitted model's surface; levels as of `sweeps`."""
        model, geometry, scale = self._model, last.geometry, float(last.geometry.scale)
        neutral = model.shape(geometry.identity).astype(np.float64)
        # A head that the model spans is as symmetric as its modes make it.
        halves = model.symmetry if self._beyond else None
        # Eyes that were added have no bending of their own: as slivers beside the skin they would steer its stiffness.
        own = self._own
        if halves is not None and self._by_skin is not None:
            halves = halves[:own]
        plate = Plate.of(
            neutral[:own], self._faces, FORGET_MM / model.unit_mm, CONTACT_MM / model.unit_mm, symmetry=halves
        )
        world, displacement, stiffness = last.world, last.displacement, last.stiffness
        matched, moved, step = 0.0, 0.0, 0.0
        for level, half in levels:
            texels, timesteps = self._texels(world, level), geometry.timesteps
            posed = [self._posed(t, vertices, texels, level) for t, vertices in zip(timesteps, world, strict=True)]
            borders = [self._borders(t, vertices, level) for t, vertices in zip(timesteps, world, strict=True)]
            further: Sequence = ()
            # Landmarks without a bias place timesteps better than skin does, whose shading turns with the light.
            if self._beyond and len(posed) > 1:
                geometry = align_timesteps(model, geometry, texels, posed)
                aligned = displaced_world(geometry, displacement)
                posed, borders = followed(model, texels, posed, borders, aligned - world)
                world = aligned
                further = across_time(posed, geometry.rotation)
            swept = self._sweep(texels, posed, level, half, further)
            found, step = swept.found, swept.step
            matched = float((found.precision > 0).mean())
            objects = [p.normal @ rotation for p, rotation in zip(posed, geometry.rotation, strict=True)]
            some, outline = thinned(texels), joined(borders)
            turned = [b.normal @ rotation for b, rotation in zip(borders, geometry.rotation, strict=True)]
            face = np.concatenate([texels.face[some], outline.face])
            weights = np.concatenate([texels.weights[some], outline.weights])
            points = corner_matrix(model.faces, face, weights, len(neutral))
            solved = solve_displacement(
                plate,
                points if self._by_skin is None else points @ self._by_skin,
                np.concatenate([normalize(np.mean(objects, axis=0))[some], *turned]),
                np.concatenate([found.offset[some], outline.offset]) / scale,
                np.concatenate([found.precision[some] * THIN**2, outline.precision]) * scale**2,
                displacement[:own],
                stiffness,
                ROBUST_STEPS * step / scale,
            )
            reached = solved.displacement if self._by_skin is None else self._by_skin @ solved.displacement
            change, displacement = scale * reached - scale * displacement, reached
            stiffness = solved.likely_stiffness(self._config.stiffness, STIFFEST)
            world = displaced_world(geometry, displacement)
            measured = np.flatnonzero(found.precision > 0)
            along = np.einsum(
                "tvc,tvc->tv", change @ geometry.rotation.transpose(0, 2, 1), _normals(world, model.faces)
            )
            seen = np.unique(model.faces[texels.face[measured]])
            moved = float(np.sqrt(np.mean(along[:, seen] ** 2))) if len(seen) else 0.0
            self.advance()
        # A sweep tells offsets to a part of its step: where the last one moved the surface by less, it has settled.
        outcome = Outcome.CONVERGED if moved < SETTLED * step else Outcome.MAX_ITERATIONS
        return Reached(geometry, displacement, world, stiffness, matched, moved, outcome)

    def epipolar_residuals(self, geometry: GeometryEstimate, world: NDArray, level: int) -> dict[str, float | None]:
        """Median distance from one another's epipolar lines for each pair of views, pixels of the images."""
        pixel, texels = self._resolution.pixel * 2.0**level, self._texels(world, level)
        views = [self._capture.camera(name) for name in self._cameras]
        some = sorted({0, len(world) - 1})  # two timesteps tell what all would
        posed = [self._posed(geometry.timesteps[k], world[k], texels, level) for k in some]
        found: dict[str, float | None] = {}
        for a, b in self._pairs:
            residual = epipolar_residual(texels, posed, views, (a, b), pixel, WINDOW)
            found[f"{self._cameras[a]}, {self._cameras[b]}"] = None if residual is None else residual * 2.0**level
        return found


def displaced_world(geometry: GeometryEstimate, displacement: NDArray) -> NDArray[np.float64]:
    """(T, V, 3) vertices of a fit in the model's span, displaced by (V, 3) in its neutral space."""
    return geometry.vertices + float(geometry.scale) * displacement @ geometry.rotation.transpose(0, 2, 1)


def followed(
    model: MorphableModel, texels: TexelMap, posed: Sequence[Posed], borders: Sequence[Borders], moved: NDArray
) -> tuple[list[Posed], list[Borders]]:
    """Texels and outlines of a surface whose vertices have moved by (T, V, 3), world space.

    The movement is of a pixel or so: what is seen of the texels and which way they face stays.
    """
    found_texels, found_borders = [], []
    for one, outline, way in zip(posed, borders, moved, strict=True):
        by = interpolate(way, model.faces, texels.face, texels.weights)
        found_texels.append(replace(one, position=one.position + by))
        by = interpolate(way, model.faces, outline.face, outline.weights)
        offset = outline.offset - (by * outline.normal).sum(axis=1)
        found_borders.append(replace(outline, position=outline.position + by, offset=offset))
    return found_texels, found_borders


def _normals(world: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """(T, V, 3) unit normals of the vertices of each timestep."""
    return np.stack([vertex_normals(vertices, faces) for vertices in world])


def thinned(texels: TexelMap) -> NDArray[np.intp]:
    """Every `THIN`-th texel along rows and columns: windows overlap, so that nothing is lost."""
    row, column = np.divmod(texels.index, texels.size)
    return np.flatnonzero((row % THIN == 0) & (column % THIN == 0))


def sweeps(resolution: Resolution, config: SurfaceConfig, unit_mm: float) -> list[tuple[int, int]]:
    """Level and half the number of offsets of each sweep: as coarse as the reach needs, then finer.

    A level is the number of times that the images are halved.
    """
    finest = config.finest
    step_mm = STEP_PIXELS * resolution.pixel / resolution.parallax * unit_mm
    first = finest
    while first < max(COARSEST, finest) and HALF_LAYERS * step_mm * 2**first < config.reach:
        first += 1
    return [(first, HALF_LAYERS), *((level, 4) for level in range(first, finest - 1, -1))]
