"""Writing the result folder, a `Reconstruction` on disk (docs/formats.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import mifit
from mifit.core.arrays import write_ply
from mifit.core.files import Document, file_name, write_bytes, write_json
from mifit.core.image import encode_png, write_image
from mifit.core.mesh import split_at_seams, tangent_space_map, vertex_normals
from mifit.core.process import on_all_cores
from mifit.result.ownership import replacing_files
from mifit.result.reconstruction import Reconstruction

FORMAT_VERSION = 1
CAMERA = ("name", "width", "height", "fx", "fy", "cx", "cy", "world_to_camera")
"""What is kept of a camera; images are undistorted when they are read."""


def label_file(camera: str, timestep: int) -> Path:
    """Where a result keeps what an image shows, relative to its folder: grey values of `core.estimate.Label`."""
    return Path("masks") / f"{file_name(camera)}_{timestep:04d}.png"


def save(result: Reconstruction, folder: Path, write_scene: Callable[[Path], None], force: bool = False) -> None:
    """Write a result folder, or replace what an older result left in it; see `Reconstruction.save`.

    All files are written beside the old ones first, so that one that fails leaves the old result whole.
    ``write_scene`` writes the scene file that it is given, and those beside it.
    """
    with replacing_files(folder, only=True, force=force) as new:
        files = [partial(_write_timestep, result, new, timestep) for timestep in result.timesteps]
        if result.reflectance is not None:
            for name in ("diffuse", "specular", "confidence", "residual_shading", "specular_confidence"):
                found = getattr(result.reflectance, name)
                if found is not None:
                    files.append(partial(write_image, new / "maps" / f"{name}.exr", found))
            files.append(partial(write_image, new / "lighting.exr", result.lighting.to_latlong()))
            for (camera, timestep), labels in zip(result.reflectance.labelled, result.reflectance.labels, strict=True):
                files.append(partial(write_bytes, new / label_file(camera, timestep), encode_png(labels)))
        on_all_cores(lambda write: write(), files)
        if result.geometry.displacement is not None:
            np.savez(new / "geometry" / "displacement.npz", displacement=result.geometry.displacement)
        write_scene(new / "scene.xml")
        _write_document(result, new)


def add_timestep(result: Reconstruction, folder: Path, timestep: int) -> None:
    """Write the files of one timestep of a result into its folder, and ``result.json`` anew, all or none."""
    with replacing_files(folder) as new:
        _write_timestep(result, new, timestep)
        _write_document(result, new)


def _write_document(result: Reconstruction, folder: Path) -> None:
    write_json(folder / "result.json", _document(result), allow_nan=False)


def _write_timestep(result: Reconstruction, folder: Path, timestep: int) -> None:
    """Meshes and maps of one timestep."""
    i, model = result.index(timestep), result.model
    split = split_at_seams(model.faces, model.faces_uv, model.uv)
    at, albedo = split.origin, result.geometry.vertex_albedo
    vertices = result.geometry.vertices[i]
    meshes = {"geometry": vertices}
    if result.mesh is not None and timestep in result.mesh.timesteps:
        meshes["refined"] = result.mesh.vertices[result.mesh.timesteps.index(timestep)]
    for name, points in meshes.items():
        normals = vertex_normals(points, model.faces)
        path = folder / name / f"{timestep:04d}.ply"
        write_ply(path, points[at], split.faces, normals[at], split.uv, albedo[at])
    refined = result.refined_normal(timestep)
    if refined is not None:
        rotation, normals = result.geometry.rotation[i], vertex_normals(vertices, model.faces)
        tangent = tangent_space_map(
            refined, (vertices @ rotation)[at], (normals @ rotation)[at], split, model.face_mask
        )
        write_image(folder / "maps" / f"normal_object_{timestep:04d}.exr", refined)
        codes = np.round(255 * np.clip(0.5 + 0.5 * tangent, 0, 1)).astype(np.uint8)  # no colours: no transfer curve
        write_bytes(folder / "maps" / f"normal_tangent_{timestep:04d}.png", encode_png(codes))
    residual = None if result.residual is None else result.residual.at(timestep)
    if residual is not None:
        write_image(folder / "maps" / f"residual_{timestep:04d}.exr", residual)


def _document(result: Reconstruction) -> Document:
    """``result.json`` as a dictionary."""
    geometry, reflectance = result.geometry, result.reflectance
    lighting: Document = {"order": 3, "shading": geometry.shading.tolist(), "shading_ambient": float(geometry.ambient)}
    if reflectance is not None:
        lighting |= {
            "order": reflectance.illumination.order,
            "radiance": reflectance.illumination.radiance.tolist(),
            "lights": [light.document() for light in reflectance.illumination.lights],
            "ambient": float(reflectance.illumination.ambient),
            "shading_model": reflectance.shading_model,
            **reflectance.lobe.parameters(),
        }
    hair = {} if reflectance is None or reflectance.hair is None else {"hair": reflectance.hair}
    found = {
        "format_version": FORMAT_VERSION,
        "mifit_version": mifit.__version__,
        "config": result.config,
        "capture": {
            "digest": result.capture_digest,
            "units": result.units,
            "unit_mm": result.unit_mm,
            "cameras": [{k: getattr(c, k) for k in CAMERA} for c in result.cameras],
            "photometry": geometry.photometry.document(),
            "landmark_noise": float(geometry.landmark_noise),
        },
        "model": {
            "source": _source(result.model_source),
            "name": result.model.name,
            "digest": result.model.digest,
            "identity": geometry.identity.tolist(),
            "albedo": geometry.albedo.tolist(),
            "scale": float(geometry.scale),
            "displaced": geometry.displacement is not None,
        },
        "lighting": lighting,
        **hair,
        "timesteps": [
            {
                "timestep": t,
                "rotation": geometry.rotation[i].tolist(),
                "translation": geometry.translation[i].tolist(),
                "expression": geometry.expression[i].tolist(),
                "tracked": result.tracked.get(t),
                "refined_normals": result.refined_normal(t) is not None,
                "refined_mesh": result.mesh is not None and t in result.mesh.timesteps,
                "residual": result.residual is not None and t in result.residual.timesteps,
            }
            for i, t in enumerate(result.timesteps)
        ],
        "stages": {name: report.document() for name, report in result.reports.items()},
        "seconds": result.seconds,
        "peak_memory": int(result.peak_memory),
        "warnings": [found.document() for found in result.warnings],
    }
    return {key: _finite(value) for key, value in found.items()}


def _source(source: str) -> str:
    """A model's source that still holds when the working folder changes."""
    named = source.partition(":")[0] == "builtin"
    return str(Path(source).resolve()) if source and not named and Path(source).exists() else source


def _finite(value: object) -> object:
    """The value with plain Python numbers, and null for what JSON can't hold."""
    if isinstance(value, dict):
        return {str(k): _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, np.ndarray):
        return _finite(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
