"""Further timesteps with reflectance and lighting fixed: pose and expression, then normals (paper, section 6).

Each new timestep starts where the last one ended. Its surface texture is compared with that of the fitted timesteps,
so that nothing drifts: at spread points by stage 1's terms, then finely where landmarks are biased
(`surface.kept_texture`). Its normals are drawn to the mean correction of the last frames, carried along in the tangent
planes of the moving face: where the images say little the detail stays, where they say much it follows at once.

`track` follows a face; `track_into` also writes each frame into a result folder as it finishes, so that a killed run
goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mifit.config import GeometryConfig, MeshConfig, NormalsConfig, from_mapping
from mifit.core.arrays import Rows
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap, bend, rasterize_uv, tangent_plane, transport, unbend
from mifit.errors import ConvergenceError, InputError
from mifit.progress import Progress, silent
from mifit.result import Reconstruction
from mifit.result.ownership import locked
from mifit.result.writing import add_timestep
from mifit.stages.fit_geometry import fit_pose_expression
from mifit.stages.geometry.refine import texture_reference
from mifit.stages.normals.refine_mesh import MeshRefiner
from mifit.stages.normals.refine_normals import check_maps, refine_frame
from mifit.stages.surface.kept_texture import KeptTexture
from mifit.stages.surface.model_fit import landmarks_are_biased

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

MEMORY = 4
"""Frames whose corrections make the prior of the next."""


@dataclass(frozen=True)
class TrackedFrame:
    """One timestep as tracking leaves it.

    Attributes
    ----------
    timestep : int
    geometry : GeometryEstimate
        Of this timestep alone.
    normal_object : (S, S, 3) float32
        Unit normals in object space; zero outside the covered texels.
    seconds : float
    refound : bool
        The last pose led nowhere and landmarks found the face again.
    warnings : tuple of Diagnostic
    """

    timestep: int
    geometry: GeometryEstimate
    normal_object: NDArray[np.float32]
    seconds: float
    refound: bool
    warnings: tuple[Diagnostic, ...]


def track(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    normals: NormalsEstimate | None,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    config: NormalsConfig | None = None,
    geometry_config: GeometryConfig | None = None,
    fitted: Sequence[int] | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Iterator[TrackedFrame]:
    """Follow a fitted face through further timesteps, one frame at a time.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry, reflectance, normals
        Results of the three stages, and of timesteps tracked before.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    timesteps : sequence of int
        Timesteps to track, in this order.
    config, geometry_config : optional
        Settings of stages 3 and 1.
    fitted : sequence of int, optional
        Timesteps of ``geometry`` that were fitted jointly and give the reference texture; all by default.
    seed : int
    progress : Progress
        ``done`` counts frames.

    Yields
    ------
    TrackedFrame
        As soon as it is done; the caller may stop at any frame and go on later with the frames so far.

    Raises
    ------
    InputError
        A timestep that the fit has or the capture lacks, or no camera.
    ConvergenceError
        A frame in which neither the last pose nor the landmarks find the face.
    """
    config, geometry_config = config or NormalsConfig(), geometry_config or GeometryConfig()
    check_timesteps(capture.timesteps, geometry.timesteps, timesteps)
    texels = rasterize_uv(model.uv, model.faces_uv, check_maps(reflectance), model.face_mask)
    follower = Follower(capture, model, geometry, cameras, geometry_config, fitted, seed)
    memory = _Memory(model, texels)
    if normals is not None:
        for timestep in [t for t in geometry.timesteps if t in normals.timesteps][-MEMORY:]:
            memory.add(
                geometry.at((timestep,)),
                texels.from_map(normals.normal_object[normals.timesteps.index(timestep)]),
            )
    progress("track", 0, len(timesteps))
    for done, timestep in enumerate(timesteps):
        began = time.perf_counter()
        found, refound, warnings = follower.next(timestep)
        prior = memory.offsets(found)
        frame = refine_frame(capture, model, found, reflectance, cameras, config, texels, prior, seed)
        if frame.measured == 0.0:
            text = f"timestep {timestep}: no camera measures the face; normals are those of the frames before"
            warnings.append(Diagnostic("face-unseen", text))
        memory.add(found, frame.normal_object)
        progress("track", done + 1, len(timesteps))
        yield TrackedFrame(
            timestep,
            found,
            texels.to_map(frame.normal_object),
            time.perf_counter() - began,
            refound,
            tuple(warnings),
        )


class Follower:
    """Pose and expression of further timesteps, each found from where the last one ended.

    Parameters
    ----------
    capture, model, geometry, cameras, geometry_config, fitted, seed
        As in `track`.
    """

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        geometry: GeometryEstimate,
        cameras: Sequence[str],
        geometry_config: GeometryConfig,
        fitted: Sequence[int] | None = None,
        seed: int = 0,
    ) -> None:
        self._capture, self._model, self._cameras = capture, model, tuple(cameras)
        self._config, self._seed = geometry_config, seed
        self._home = geometry.at(geometry.timesteps if fitted is None else fitted)
        self._reference = texture_reference(capture, model, self._home, cameras, geometry_config, seed)
        # Landmarks without a bias place a face better than skin does, whose shading turns with the light.
        biased = landmarks_are_biased(self._home)
        self._texture = KeptTexture(capture, model, self._home, cameras) if biased else None
        self._last = geometry.at(geometry.timesteps[-1:])

    @one_blas_thread()
    def next(self, timestep: int) -> tuple[GeometryEstimate, bool, list[Diagnostic]]:
        """Geometry of a timestep, whether landmarks had to find the lost face again, and warnings.

        Raises
        ------
        ConvergenceError
            Neither the last pose nor the landmarks find the face.
        """

        def fit(start: GeometryEstimate) -> GeometryEstimate:
            return fit_pose_expression(
                self._capture,
                self._model,
                start,
                self._cameras,
                timestep,
                self._config,
                seed=self._seed,
                reference=self._reference,
            )

        def error(found: GeometryEstimate) -> float:
            return landmark_error(self._capture, self._model, found, self._cameras)

        found, refound = _follow(fit, error, self._last, self._home)
        found = found if self._texture is None else self._texture.aligned(found)
        warnings = list(found.report.warnings)
        if refound:
            text = f"timestep {timestep}: lost the face and found it again by its landmarks"
            warnings.append(Diagnostic("face-lost", text, "note"))
        self._last = found
        return found, refound, warnings


def check_timesteps(known: Sequence[int], fitted: Sequence[int], wanted: Sequence[int]) -> None:
    """Refuse timesteps that can't be tracked; InputError names them."""
    for timestep in wanted:
        if timestep not in known:
            raise InputError(f"timestep {timestep}: not in the capture; it has {', '.join(map(str, known))}")
        if timestep in fitted:
            raise InputError(f"timestep {timestep}: the result has it already; name timesteps that weren't fitted")


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
    geometry_config: GeometryConfig | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Progress = silent,
) -> Reconstruction:
    """Track timesteps and write each into the result folder as it is done.

    Parameters
    ----------
    folder : path
        Folder of ``result``; extended in place.
    result : Reconstruction
        With reflectance.
    capture, timesteps, config, geometry_config, seed, progress
        As in `track`.
    resume : bool
        Keep the timesteps that an earlier run has tracked from the same images; those whose images, masks, landmarks
        or cameras have changed since, and all after the first of them, are tracked anew. Without it all are.

    Returns
    -------
    Reconstruction
        With the new timesteps.

    Raises
    ------
    InputError
        As in `track`, or a result without reflectance.

    Notes
    -----
    The files of a frame are written before ``result.json`` names it, and ``result.json`` is replaced as a whole, so
    a run that is killed leaves a folder with the frames finished so far. Frames depend on those before alone:
    going on later gives what an uninterrupted run gives. Meshes and normals of a long sequence lie in a file that is
    mapped (`core.arrays`), so that memory doesn't grow with the frames.
    """
    reflectance = result.reflectance
    if reflectance is None:
        raise InputError(f"{folder}: found a result without reflectance, expected one of 'mifit fit' with all stages")
    tracked, fitted = result.tracked, result.fitted
    names = [camera.name for camera in result.cameras]
    digests = {t: capture.digest(names, [t]) for t in timesteps}
    if resume:
        timesteps = _not_yet(result, timesteps, digests)
    result = _without(result, [t for t in tracked if t in timesteps])
    folder = Path(folder)
    refiner = None if result.mesh is None else mesh_refiner(result)
    with locked(folder):
        result, room = _with_room(result, len(timesteps))
        for frame in track(
            result.seen(capture),
            result.model,
            result.geometry,
            reflectance,
            result.normals,
            names,
            timesteps,
            config,
            geometry_config,
            fitted,
            seed,
            progress,
        ):
            result = extend(result, frame, refiner, digests[frame.timestep], room)
            add_timestep(result, folder, frame.timestep)
    return result


def sequence_left(result: Reconstruction, capture: Capture, resume: bool) -> tuple[int, ...]:
    """Timesteps of a capture to track by default: those without geometry, and with ``resume`` the tracked ones."""
    return tuple(t for t in capture.timesteps if t not in result.timesteps or (resume and t in result.tracked))


def mesh_refiner(result: Reconstruction) -> MeshRefiner:
    """What refines the meshes of further timesteps as those of a result are."""
    assert result.mesh is not None and result.reflectance is not None
    settings = from_mapping(MeshConfig, result.config.get("mesh", {}), "result.json: config: mesh")
    settings = replace(settings, subdivisions=result.mesh.subdivisions)
    return MeshRefiner(result.model, len(result.reflectance.diffuse), settings)


def _not_yet(result: Reconstruction, timesteps: Sequence[int], digests: Mapping[int, str]) -> list[int]:
    """The timesteps that aren't in a result, or whose images are others now, or that come after one of those."""
    known = result.tracked
    kept = [t for t in timesteps if t in known and known[t] == digests[t]]
    changed = [t for t in timesteps if t in known and t not in kept]
    # A frame starts from the one before.
    return [t for t in timesteps if t not in kept or (changed and t > min(changed))]


@dataclass(frozen=True)
class _Room:
    """Where the large arrays of further timesteps are written; None for those that have no place of their own."""

    vertices: Rows | None = None
    normals: Rows | None = None
    refined: Rows | None = None
    displacement: Rows | None = None


def _with_room(result: Reconstruction, count: int) -> tuple[Reconstruction, _Room]:
    """A result whose large arrays lie where ``count`` further timesteps have room behind them."""

    def moved(array: NDArray) -> tuple[Rows, NDArray]:
        rows = Rows(len(array) + count, array.shape[1:], array.dtype)
        return rows, rows.extend(array)

    vertices, kept = moved(result.geometry.vertices)
    result = replace(result, geometry=replace(result.geometry, vertices=kept))
    refined = displacement = None
    if result.normals is None:
        assert result.reflectance is not None
        normals = Rows(count, result.reflectance.diffuse.shape, np.float32)
    else:
        normals, kept = moved(result.normals.normal_object)
        result = replace(result, normals=replace(result.normals, normal_object=kept))
    if result.mesh is not None:
        refined, meshes = moved(result.mesh.vertices)
        displacement, kept = moved(result.mesh.displacement)
        result = replace(result, mesh=replace(result.mesh, vertices=meshes, displacement=kept))
    return result, _Room(vertices, normals, refined, displacement)


def extend(
    result: Reconstruction,
    frame: TrackedFrame,
    refiner: MeshRefiner | None = None,
    digest: str = "",
    room: _Room | None = None,
) -> Reconstruction:
    """A result with one more timestep; its normals' report lists it under ``tracked``, with the images' digest.

    With a refiner its refined mesh is made too. With ``room``, in which the result's arrays lie, they aren't copied.
    """

    room = room or _Room()

    def longer(array: NDArray, row: NDArray, rows: Rows | None) -> NDArray:
        return np.concatenate([array, row[None]]) if rows is None else rows.add(row)

    a, b = result.geometry, frame.geometry
    geometry = replace(
        a,
        timesteps=(*a.timesteps, frame.timestep),
        vertices=longer(a.vertices, b.vertices[0], room.vertices),
        expression=np.concatenate([a.expression, b.expression]),
        rotation=np.concatenate([a.rotation, b.rotation]),
        translation=np.concatenate([a.translation, b.translation]),
    )
    before = result.normals or NormalsEstimate((), frame.normal_object[None][:0], Report("converged"))
    report = replace(
        before.report,
        seconds=before.report.seconds + frame.seconds,
        warnings=(*before.report.warnings, *frame.warnings),
    )
    normals = NormalsEstimate(
        (*before.timesteps, frame.timestep),
        longer(before.normal_object, frame.normal_object, room.normals),
        report,
        {**before.tracked, frame.timestep: digest},
    )
    mesh = result.mesh
    if mesh is not None and refiner is not None:
        vertices, height, _ = refiner.refine(frame.geometry, frame.timestep, frame.normal_object)
        mesh = replace(
            mesh,
            timesteps=(*mesh.timesteps, frame.timestep),
            vertices=longer(mesh.vertices, vertices, room.refined),
            displacement=longer(mesh.displacement, height, room.displacement),
        )
    return replace(result, geometry=geometry, normals=normals, mesh=mesh)


def _without(result: Reconstruction, dropped: Sequence[int]) -> Reconstruction:
    """A result less some of its tracked timesteps."""
    if not dropped or result.normals is None:
        return result

    def kept(array: NDArray, timesteps: Sequence[int]) -> NDArray:
        rows = [i for i, t in enumerate(timesteps) if t not in dropped]
        return Rows(len(rows), array.shape[1:], array.dtype).extend(array[i] for i in rows)

    def left(timesteps: Sequence[int]) -> tuple[int, ...]:
        return tuple(t for t in timesteps if t not in dropped)

    geometry, normals, mesh = result.geometry, result.normals, result.mesh
    if mesh is not None:
        mesh = replace(
            mesh,
            timesteps=left(mesh.timesteps),
            vertices=kept(mesh.vertices, mesh.timesteps),
            displacement=kept(mesh.displacement, mesh.timesteps),
        )
    parts: dict[str, Any] = {
        name: kept(getattr(geometry, name), geometry.timesteps)
        for name in ("expression", "rotation", "translation", "vertices")
    }
    return replace(
        result,
        geometry=replace(geometry, timesteps=left(geometry.timesteps), **parts),
        normals=NormalsEstimate(
            left(normals.timesteps),
            kept(normals.normal_object, normals.timesteps),
            normals.report,
            {t: digest for t, digest in normals.tracked.items() if t not in dropped},
        ),
        mesh=mesh,
    )


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
