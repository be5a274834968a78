"""Tracking into a result folder: frames are written as they finish, so that a killed run goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import GeometryConfig, MeshConfig, NormalsConfig, from_mapping
from mifit.core.arrays import Rows
from mifit.core.estimate import NormalsEstimate, Report
from mifit.errors import InputError
from mifit.progress import Progress, silent
from mifit.result.ownership import locked
from mifit.result.record import R
from mifit.result.writing import add_timestep, write_remarks
from mifit.stages.normals.mesh_refinement import MeshRefiner
from mifit.stages.surface.frame_offsets import OUT_OF_STEP, frame_offset_warnings, frame_offsets
from mifit.stages.track import TrackedFrame, track

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Result


def track_into(
    folder: str | Path,
    result: R,
    capture: Capture,
    timesteps: Sequence[int],
    config: NormalsConfig | None = None,
    geometry_config: GeometryConfig | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Progress = silent,
) -> R:
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
    if result.reflectance is None:
        raise InputError(f"{folder}: found a result without reflectance, expected one of 'mifit fit' with all stages")
    tracked = [] if result.normals is None else list(result.normals.report.details.get("tracked", []))
    fitted = [t for t in result.timesteps if t not in tracked]
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
            result.reflectance,
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
        if timesteps:
            result = with_frame_offsets(result, capture)
            write_remarks(result, folder)
    return result


def with_frame_offsets(result: R, capture: Capture) -> R:
    """A tracked result whose normals' report says by how much cameras are out of step (``frame_offsets``)."""
    if result.normals is None:
        return result
    names = [camera.name for camera in result.cameras]
    seen = result.seen(capture)
    found = frame_offsets(seen, result.model, result.geometry, names)
    report = result.normals.report
    details = {**report.details, "frame_offsets": {name: asdict(offset) for name, offset in found.items()}}
    before = tuple(one for one in report.warnings if one.code != OUT_OF_STEP)
    warnings = (*before, *frame_offset_warnings(found, names[0]))
    return replace(result, normals=replace(result.normals, report=replace(report, details=details, warnings=warnings)))


def sequence_left(result: Result, capture: Capture, resume: bool) -> tuple[int, ...]:
    """Timesteps of a capture to track by default: those without geometry, and with ``resume`` the tracked ones."""
    tracked = [] if result.normals is None else result.normals.report.details.get("tracked", [])
    return tuple(t for t in capture.timesteps if t not in result.timesteps or (resume and t in tracked))


def mesh_refiner(result: Result) -> MeshRefiner:
    """What refines the meshes of further timesteps as those of a result are."""
    assert result.mesh is not None and result.reflectance is not None
    settings = from_mapping(MeshConfig, result.config.get("mesh", {}), "result.json: config: mesh")
    settings = replace(settings, subdivisions=result.mesh.subdivisions)
    return MeshRefiner(result.model, len(result.reflectance.diffuse), settings)


def _not_yet(result: Result, timesteps: Sequence[int], digests: Mapping[int, str]) -> list[int]:
    """The timesteps that aren't in a result, or whose images are others now, or that come after one of those."""
    details = {} if result.normals is None else result.normals.report.details
    known = details.get("tracked_from", {})
    kept = [t for t in timesteps if t in details.get("tracked", []) and known.get(str(t)) == digests[t]]
    changed = [t for t in timesteps if t in details.get("tracked", []) and t not in kept]
    # A frame starts from the one before.
    return [t for t in timesteps if t not in kept or (changed and t > min(changed))]


@dataclass(frozen=True)
class _Room:
    """Where the large arrays of further timesteps are written; None for those of a mesh that a result lacks."""

    vertices: Rows
    normals: Rows
    refined: Rows | None
    displacement: Rows | None


def _with_room(result: R, count: int) -> tuple[R, _Room]:
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
    result: R, frame: TrackedFrame, refiner: MeshRefiner | None = None, digest: str = "", room: _Room | None = None
) -> R:
    """A result with one more timestep; its normals' report lists it under ``tracked``, with the images' digest.

    With a refiner its refined mesh is made too. With ``room``, in which the result's arrays lie, they aren't copied.
    """

    def longer(array: NDArray, row: NDArray, rows: Rows | None) -> NDArray:
        return np.concatenate([array, row[None]]) if rows is None else rows.add(row)

    a, b = result.geometry, frame.geometry
    geometry = replace(
        a,
        timesteps=(*a.timesteps, frame.timestep),
        vertices=longer(a.vertices, b.vertices[0], room and room.vertices),
        **{
            name: np.concatenate([getattr(a, name), getattr(b, name)])
            for name in ("expression", "rotation", "translation")
        },
    )
    before = result.normals or NormalsEstimate((), frame.normal_object[None][:0], Report("converged"))
    details = {
        **before.report.details,
        "tracked": [*before.report.details.get("tracked", []), frame.timestep],
        "tracked_from": {**before.report.details.get("tracked_from", {}), str(frame.timestep): digest},
    }
    report = replace(
        before.report,
        seconds=before.report.seconds + frame.seconds,
        warnings=(*before.report.warnings, *frame.warnings),
        details=details,
    )
    normals = NormalsEstimate(
        (*before.timesteps, frame.timestep),
        longer(before.normal_object, frame.normal_object, room and room.normals),
        report,
    )
    mesh = result.mesh
    if mesh is not None and refiner is not None:
        vertices, height, _ = refiner.refine(frame.geometry, frame.timestep, frame.normal_object)
        mesh = replace(
            mesh,
            timesteps=(*mesh.timesteps, frame.timestep),
            vertices=longer(mesh.vertices, vertices, room and room.refined),
            displacement=longer(mesh.displacement, height, room and room.displacement),
        )
    return replace(result, geometry=geometry, normals=normals, mesh=mesh)


def _without(result: R, dropped: Sequence[int]) -> R:
    """A result less some of its tracked timesteps."""
    if not dropped or result.normals is None:
        return result

    def kept(array: NDArray, timesteps: Sequence[int]) -> NDArray:
        rows = [i for i, t in enumerate(timesteps) if t not in dropped]
        return Rows(len(rows), array.shape[1:], array.dtype).extend(array[i] for i in rows)

    def left(timesteps: Sequence[int]) -> tuple[int, ...]:
        return tuple(t for t in timesteps if t not in dropped)

    geometry, normals, report, mesh = result.geometry, result.normals, result.normals.report, result.mesh
    if mesh is not None:
        mesh = replace(
            mesh,
            timesteps=left(mesh.timesteps),
            vertices=kept(mesh.vertices, mesh.timesteps),
            displacement=kept(mesh.displacement, mesh.timesteps),
        )
    details = {**report.details, "tracked": [t for t in report.details["tracked"] if t not in dropped]}
    parts = ("expression", "rotation", "translation", "vertices")
    return replace(
        result,
        geometry=replace(
            geometry,
            timesteps=left(geometry.timesteps),
            **{name: kept(getattr(geometry, name), geometry.timesteps) for name in parts},
        ),
        normals=NormalsEstimate(
            left(normals.timesteps), kept(normals.normal_object, normals.timesteps), replace(report, details=details)
        ),
        mesh=mesh,
    )
