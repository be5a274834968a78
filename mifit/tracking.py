"""Further timesteps with reflectance and lighting fixed: pose and expression, then normals (paper, section 6).

Each new timestep starts where the last one ended, and at its landmarks. Its surface texture is then aligned to that of
the fitted timesteps, so that nothing drifts (`surface.kept_texture`). Its normals are drawn to the mean correction of
the last frames, carried along in the tangent planes of the moving face: where the images say little the detail stays,
where they say much it follows at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import GeometryConfig, MeshConfig, NormalsConfig, from_mapping
from mifit.core.arrays import Rows
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, Report
from mifit.core.files import Document
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap, bend, rasterize_uv, tangent_plane, transport, unbend
from mifit.errors import ConvergenceError, InputError
from mifit.progress import Progress, silent
from mifit.result import Reconstruction
from mifit.result.ownership import locked
from mifit.result.writing import add_timestep
from mifit.sampling.observations import Surface
from mifit.stages.fit_geometry import fit_pose_expression
from mifit.stages.normals.refine_mesh import MeshRefiner
from mifit.stages.normals.refine_normals import check_maps, refine_frame
from mifit.stages.surface.kept_texture import KeptTexture

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

MEMORY = 4
"""Frames whose corrections make the prior of the next."""


@dataclass(frozen=True)
class TrackedFrame:
    """One timestep as tracking leaves it.

    ``geometry`` is that of this timestep alone; ``normal_object`` (S, S, 3) has unit normals in object space, zero
    outside the covered texels; ``refound``: the last pose led nowhere and landmarks found the face again.
    """

    timestep: int
    geometry: GeometryEstimate
    normal_object: NDArray[np.float32]
    seconds: float
    refound: bool
    warnings: tuple[Diagnostic, ...]


@checked
def track(
    capture: Capture,
    result: Reconstruction,
    timesteps: Sequence[int],
    config: NormalsConfig | None = None,
    geometry_config: GeometryConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Iterator[TrackedFrame]:
    """Frames of a fitted face at further timesteps, each yielded as soon as it is done.

    The caller may stop at any frame and go on later with the frames so far.

    Parameters
    ----------
    capture : Capture
        Only images of the result's cameras are read.
    result : Reconstruction
        With reflectance; timesteps tracked before count as frames so far.
    timesteps : sequence of int
        Timesteps to track, in this order.
    config, geometry_config : optional
        Settings of stages 3 and 1.
    seed : int
    progress : Progress
        ``done`` counts frames.

    Raises
    ------
    InputError
        A timestep that the result has or the capture lacks, or a result without reflectance.
    ConvergenceError
        A frame in which neither the last pose nor the landmarks find the face.
    """
    config, geometry_config = config or NormalsConfig(), geometry_config or GeometryConfig()
    model, geometry, reflectance, normals = result.model, result.geometry, result.reflectance, result.normals
    if reflectance is None:
        raise InputError("track: found a result without reflectance, expected one of 'mifit fit' with all stages")
    for timestep in timesteps:
        if timestep not in capture.timesteps:
            known = ", ".join(map(str, capture.timesteps))
            raise InputError(f"timestep {timestep}: not in the capture; it has {known}")
        if timestep in geometry.timesteps:
            raise InputError(f"timestep {timestep}: the result has it already; name timesteps that weren't fitted")
    cameras = [camera.name for camera in result.cameras]
    texels = rasterize_uv(model.uv, model.faces_uv, check_maps(reflectance), model.face_mask)
    follower = Follower(capture, model, geometry, cameras, geometry_config, result.fitted)
    memory = _Memory(model, texels)
    if normals is not None:
        for timestep in [t for t in geometry.timesteps if t in normals.timesteps][-MEMORY:]:
            refined = normals.normal_object[normals.timesteps.index(timestep)]
            memory.add(geometry.at((timestep,)), texels.from_map(refined))
    progress("track", 0, len(timesteps))
    for done, timestep in enumerate(timesteps):
        began = time.perf_counter()
        found, refound, warnings = follower.next(timestep)
        prior = memory.offsets(found)
        surface = Surface(capture, model, found, cameras, texels.size, texels=texels)
        frame = refine_frame(surface, reflectance, config, prior, seed)
        if frame.measured == 0.0:
            text = f"timestep {timestep}: no camera measures the face; normals are those of the frames before"
            warnings.append(Diagnostic("face-unseen", text))
        memory.add(found, frame.normal_object)
        progress("track", done + 1, len(timesteps))
        seconds = time.perf_counter() - began
        yield TrackedFrame(timestep, found, texels.to_map(frame.normal_object), seconds, refound, tuple(warnings))


class Follower:
    """Pose and expression of further timesteps, each found from where the last one ended.

    ``fitted`` are the timesteps of ``geometry`` that give the reference texture; all by default.
    """

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        geometry: GeometryEstimate,
        cameras: Sequence[str],
        geometry_config: GeometryConfig,
        fitted: Sequence[int] | None = None,
    ) -> None:
        self._capture, self._model, self._cameras = capture, model, tuple(cameras)
        self._config = geometry_config
        self._home = geometry.at(geometry.timesteps if fitted is None else fitted)
        self._texture = KeptTexture(capture, model, self._home, cameras)
        self._last = geometry.at(geometry.timesteps[-1:])

    @one_blas_thread()
    def next(self, timestep: int) -> tuple[GeometryEstimate, bool, list[Diagnostic]]:
        """Geometry of a timestep, whether landmarks had to find the lost face again, and warnings.

        ConvergenceError where neither the last pose nor the landmarks find the face.
        """

        def fit(start: GeometryEstimate) -> GeometryEstimate:
            return fit_pose_expression(self._capture, self._model, start, self._cameras, timestep, self._config)

        def error(found: GeometryEstimate) -> float:
            return landmark_error(self._capture, self._model, found, self._cameras)

        found, refound = _follow(fit, error, self._last, self._home)
        found = self._texture.aligned(found)
        warnings = list(found.report.warnings)
        if refound:
            text = f"timestep {timestep}: lost the face and found it again by its landmarks"
            warnings.append(Diagnostic("face-lost", text, "note"))
        self._last = found
        return found, refound, warnings


def landmark_error(
    capture: Capture, model: MorphableModel, geometry: GeometryEstimate, cameras: Sequence[str]
) -> float:
    """Median distance in pixels of the visible landmarks from the model's, over all cameras; 0 without landmarks.

    Jaw-line points slide along the silhouette and are left out.
    """
    distances = []
    for name in cameras:
        frame = capture.frame(name, geometry.timesteps[0])
        if frame.landmarks is None:
            continue
        shown = np.flatnonzero(frame.visible[17:]) + 17
        pixels = capture.camera(name).project(geometry.vertices[0][model.landmarks[shown]])
        distances.append(np.linalg.norm(pixels - frame.landmarks[shown], axis=1))
    every = np.concatenate(distances) if distances else np.zeros(0)
    return float(np.median(np.nan_to_num(every, nan=np.inf))) if len(every) else 0.0


def _follow(
    fit: Callable[[GeometryEstimate], GeometryEstimate],
    error: Callable[[GeometryEstimate], float],
    last: GeometryEstimate,
    home: GeometryEstimate,
) -> tuple[GeometryEstimate, bool]:
    """Fit from the last frame; when that is lost, from the fitted timesteps, and keep the better of the two."""
    first: GeometryEstimate | None = None
    failure: ConvergenceError | None = None
    try:
        first = fit(last)
        if error(first) <= 6.0:  # pixels, in the median
            return first, False
    except ConvergenceError as found:
        failure = found
    try:
        second = fit(home)
    except ConvergenceError:
        if first is None:
            assert failure is not None
            raise failure from None
        return first, False
    if first is not None and error(first) <= error(second):
        return first, False
    return second, True


class _Memory:
    """Corrections of the last frames, in tangent planes that move with the face."""

    def __init__(self, model: MorphableModel, texels: TexelMap) -> None:
        self._carried = CarriedTangents(model, texels)
        self._frames: list[NDArray] = []

    def add(self, geometry: GeometryEstimate, normals: NDArray) -> None:
        """Remember refined normals (N, 3) of a timestep, object space."""
        self._frames = [*self._frames, unbend(*self._carried.frame(geometry), normals.astype(np.float64))][-MEMORY:]

    def offsets(self, geometry: GeometryEstimate) -> NDArray | None:
        """(N, 2) mean correction in the tangent planes of `refine_frame` for a new timestep; None without a past."""
        if not self._frames:
            return None
        base, tangents = self._carried.frame(geometry)
        wanted = bend(base, tangents, np.mean(self._frames, axis=0))
        return unbend(base, tangent_plane(base), wanted)


def track_into(
    folder: str | Path,
    result: Reconstruction,
    capture: Capture,
    timesteps: Sequence[int],
    config: NormalsConfig | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Progress = silent,
) -> Reconstruction:
    """The result with further timesteps, each written into its folder as it is done; errors as of `track`.

    With ``resume`` the timesteps that an earlier run has tracked from the same images are kept; those whose images,
    masks, landmarks or cameras have changed since, and all after the first of them, are tracked anew. Without it all
    are.

    The files of a frame are written before ``result.json`` names it, so a run that is killed leaves a folder with the
    frames finished so far. Frames depend on those before alone: going on later gives what an uninterrupted run gives.
    Large arrays of a long sequence lie in a file that is mapped (`core.arrays`), so that memory doesn't grow with it.
    """
    digests = {t: capture.digest([camera.name for camera in result.cameras], [t]) for t in timesteps}
    if resume:
        timesteps = _not_yet(result, timesteps, digests)
    folder = Path(folder)
    refiner = None
    if result.mesh is not None and result.reflectance is not None:
        settings = from_mapping(MeshConfig, result.config.get("mesh", {}), "result.json: config: mesh")
        refiner = MeshRefiner(result.model, len(result.reflectance.diffuse), settings)
    with locked(folder):
        result, room = _with_room(result, [t for t in result.tracked if t in timesteps], len(timesteps))
        for frame in track(result.seen(capture), result, timesteps, config, seed=seed, progress=progress):
            result = _extended(result, frame, refiner, digests[frame.timestep], room)
            add_timestep(result, folder, frame.timestep)
    return result


def sequence_left(result: Reconstruction, capture: Capture, resume: bool) -> tuple[int, ...]:
    """Timesteps of a capture to track by default: those without geometry, and with ``resume`` the tracked ones."""
    return tuple(t for t in capture.timesteps if t not in result.timesteps or (resume and t in result.tracked))


def _not_yet(result: Reconstruction, timesteps: Sequence[int], digests: Mapping[int, str]) -> list[int]:
    """The timesteps that aren't in a result, or whose images are others now, or that come after one of those."""
    known = result.tracked
    kept = [t for t in timesteps if t in known and known[t] == digests[t]]
    changed = [t for t in timesteps if t in known and t not in kept]
    # A frame starts from the one before.
    return [t for t in timesteps if t not in kept or (changed and t > min(changed))]


PER_TIMESTEP: dict[str, tuple[str, ...]] = {
    "geometry": ("vertices", "expression", "rotation", "translation"),
    "normals": ("normal_object",),
    "mesh": ("vertices",),
}
"""Arrays of a result's estimates that have a row for each timestep."""
Room = dict[tuple[str, str], Rows]
"""Where further rows of these arrays are written."""


def _with_room(result: Reconstruction, dropped: Sequence[int], count: int) -> tuple[Reconstruction, Room]:
    """A result less some of its tracked timesteps, whose arrays lie where ``count`` further ones have room."""
    if result.normals is None and result.reflectance is not None:
        empty = np.zeros((0, *result.reflectance.diffuse.shape), np.float32)
        result = replace(result, normals=NormalsEstimate((), empty, Report("converged")))
    room: Room = {}
    parts: Document = {}
    for part, names in PER_TIMESTEP.items():
        estimate = getattr(result, part)
        if estimate is None:
            continue
        kept = [i for i, t in enumerate(estimate.timesteps) if t not in dropped]
        arrays: Document = {}
        for name in names:
            array = getattr(estimate, name)
            rows = room[part, name] = Rows(len(kept) + count, array.shape[1:], array.dtype)
            arrays[name] = rows.extend(array[i] for i in kept)
        parts[part] = replace(estimate, timesteps=tuple(estimate.timesteps[i] for i in kept), **arrays)
    if "normals" in parts:
        left = {t: digest for t, digest in parts["normals"].tracked.items() if t not in dropped}
        parts["normals"] = replace(parts["normals"], tracked=left)
    return replace(result, **parts), room


def _extended(
    result: Reconstruction, frame: TrackedFrame, refiner: MeshRefiner | None, digest: str, room: Room
) -> Reconstruction:
    """A result with one more timestep, whose images have a digest; its arrays lie in ``room`` and aren't copied."""
    before = result.normals
    assert before is not None
    rows: Document = {
        "geometry": {name: getattr(frame.geometry, name)[0] for name in PER_TIMESTEP["geometry"]},
        "normals": {"normal_object": frame.normal_object},
    }
    if result.mesh is not None and refiner is not None:
        rows["mesh"] = {"vertices": refiner.refine(frame.geometry, frame.timestep, frame.normal_object)[0]}
    parts: Document = {}
    for part, values in rows.items():
        estimate = getattr(result, part)
        arrays: Document = {name: room[part, name].add(row) for name, row in values.items()}
        parts[part] = replace(estimate, timesteps=(*estimate.timesteps, frame.timestep), **arrays)
    seconds, warnings = before.report.seconds + frame.seconds, (*before.report.warnings, *frame.warnings)
    parts["normals"] = replace(
        parts["normals"],
        report=replace(before.report, seconds=seconds, warnings=warnings),
        tracked={**before.tracked, frame.timestep: digest},
    )
    return replace(result, **parts)


class CarriedTangents:
    """Tangents of the model's mean face, carried to other poses and expressions by the smallest rotations."""

    def __init__(self, model: MorphableModel, texels: TexelMap) -> None:
        self._faces, self._texels = model.faces, texels
        self.home = self._base(model.mean)
        self._tangents = tangent_plane(self.home)

    def frame(
        self, geometry: GeometryEstimate, rows: NDArray | slice = slice(None)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Base normals (N, 3) and tangents (N, 2, 3) of the first timestep of a geometry, object space.

        ``rows`` are the texels that are wanted; all by default.
        """
        base = self._base(geometry.vertices[0].astype(np.float64) @ geometry.rotation[0], rows)
        return base, transport(self.home[rows], self._tangents[rows], base)

    def _base(self, vertices: NDArray, rows: NDArray | slice = slice(None)) -> NDArray[np.float64]:
        texels = self._texels
        normals = vertex_normals(vertices, self._faces)
        return normalize(interpolate(normals, self._faces, texels.face[rows], texels.weights[rows]))
