"""The result folder: `Reconstruction` on disk (docs/formats.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import mifit
from mifit.config import MeshConfig
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, MeshEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.files import replacing, write_text
from mifit.core.image import encode_png, read_image, write_image
from mifit.core.keylight import KeyLight
from mifit.core.mesh import vertex_normals
from mifit.errors import InputError
from mifit.output.ply import read_ply, write_ply
from mifit.output.scene import write_scene
from mifit.output.surface import SplitMesh, split_at_seams, tangent_space_map
from mifit.stages.refine_mesh import split_faces

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel
    from mifit.output.reconstruction import Reconstruction

FORMAT_VERSION = 1


def save(result: Reconstruction, folder: Path) -> None:
    """Write a result folder.

    An older ``result.json`` goes first and the new one comes last: a folder that has one is whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "result.json").unlink(missing_ok=True)
    for pattern in (
        "geometry/*.ply",
        "refined/*.ply",
        "maps/*",
        "lighting.exr",
        "scene*.xml",
        "scene_files/*",
        "overlay_*.mp4",
        "sequence.glb",
    ):
        for old in folder.glob(pattern):
            old.unlink()
    surfaces = _surfaces(result)
    for timestep in result.timesteps:
        _write_timestep(result, folder, timestep, surfaces)
    if result.reflectance is not None:
        for name in ("diffuse", "specular", "confidence"):
            write_image(folder / "maps" / f"{name}.exr", getattr(result.reflectance, name))
        write_image(folder / "lighting.exr", result.lighting.to_latlong())
    write_scene(result, folder / "scene.xml", result.timesteps[0])
    write_text(folder / "result.json", json.dumps(_document(result), indent=1, allow_nan=False) + "\n")


def add_timestep(result: Reconstruction, folder: Path, timestep: int) -> None:
    """Write the files of one timestep of a result into its folder, then ``result.json`` anew."""
    _write_timestep(result, folder, timestep, _surfaces(result))
    write_text(folder / "result.json", json.dumps(_document(result), indent=1, allow_nan=False) + "\n")


def _surfaces(result: Reconstruction) -> list[_Surface]:
    """The fitted mesh and, where there is one, the refined mesh, as files hold them."""
    albedo = result.geometry.vertex_albedo
    found = [_Surface("geometry", split_at_seams(result.model), result.model.faces, albedo)]
    if result.mesh is not None:
        albedo = split_faces(result.model, result.mesh.subdivisions).matrix @ albedo
        found.append(_Surface("refined", split_at_seams(result.mesh), result.mesh.faces, albedo))
    return found


@dataclass(frozen=True)
class _Surface:
    """What the mesh files of one folder share over the timesteps; ``albedo`` (V, 3) is linear."""

    folder: str
    mesh: SplitMesh
    faces: NDArray
    albedo: NDArray

    def write(self, result_folder: Path, timestep: int, vertices: NDArray, normals: NDArray) -> None:
        """Write one timestep from its vertices and their normals (V, 3), world space."""
        at = self.mesh.origin
        path = result_folder / self.folder / f"{timestep:04d}.ply"
        write_ply(path, vertices[at], self.mesh.faces, normals[at], self.mesh.uv, self.albedo[at])


def _write_timestep(result: Reconstruction, folder: Path, timestep: int, surfaces: Sequence[_Surface]) -> None:
    """Meshes, normal maps and displacement map of one timestep."""
    i, fitted = result.index(timestep), surfaces[0]
    vertices = result.geometry.vertices[i]
    normals = vertex_normals(vertices, result.model.faces)
    fitted.write(folder, timestep, vertices, normals)
    refined = result.refined_normal(timestep)
    if refined is not None:
        rotation, at = result.geometry.rotation[i], fitted.mesh.origin
        tangent = tangent_space_map(
            refined, (vertices @ rotation)[at], (normals @ rotation)[at], fitted.mesh, result.model.face_mask
        )
        write_image(folder / "maps" / f"normal_object_{timestep:04d}.exr", refined)
        write_data_png(folder / "maps" / f"normal_tangent_{timestep:04d}.png", 0.5 + 0.5 * tangent)
    if result.mesh is not None and timestep in result.mesh.timesteps:
        k = result.mesh.timesteps.index(timestep)
        vertices = result.mesh.vertices[k]
        surfaces[1].write(folder, timestep, vertices, vertex_normals(vertices, result.mesh.faces))
        write_image(folder / "maps" / f"displacement_{timestep:04d}.exr", result.mesh.displacement[k])


def write_data_png(path: Path, values: NDArray) -> None:
    """Write values 0..1 that are no colours (normals) as an 8-bit PNG without a transfer curve."""
    with replacing(path) as temporary:
        temporary.write_bytes(encode_png(np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)))


def _document(result: Reconstruction) -> dict[str, Any]:
    """``result.json`` as a dictionary."""
    geometry, reflectance = result.geometry, result.reflectance
    lighting: dict[str, Any] = {
        "order": 3,
        "shading": geometry.shading.tolist(),
        "shading_ambient": float(geometry.ambient),
    }
    if reflectance is not None:
        lighting |= {
            "order": math.isqrt(len(reflectance.radiance)),
            "radiance": reflectance.radiance.tolist(),
            "ambient": float(reflectance.ambient),
            "exponent": float(reflectance.exponent),
            "shading_model": reflectance.shading_model,
            "fresnel": reflectance.fresnel,
            "key": _key_document(reflectance.key),
        }
    return _finite(
        {
            "format_version": FORMAT_VERSION,
            "mifit_version": mifit.__version__,
            "config": result.config,
            "capture": {
                "digest": result.capture_digest,
                "units": result.units,
                "unit_mm": result.unit_mm,
                "cameras": [_camera_document(c) for c in result.cameras],
                "gains": {name: list(gain) for name, gain in geometry.gains.items()},
            },
            "model": {
                "source": _source(result.model_source),
                "name": result.model.name,
                "digest": result.model.digest,
                "identity": geometry.identity.tolist(),
                "albedo": geometry.albedo.tolist(),
                "scale": float(geometry.scale),
            },
            "lighting": lighting,
            "timesteps": [
                {
                    "timestep": t,
                    "rotation": geometry.rotation[i].tolist(),
                    "translation": geometry.translation[i].tolist(),
                    "expression": geometry.expression[i].tolist(),
                    "refined_normals": result.refined_normal(t) is not None,
                    "refined_mesh": result.mesh is not None and t in result.mesh.timesteps,
                }
                for i, t in enumerate(result.timesteps)
            ],
            "stages": {name: _report_document(report) for name, report in result.reports.items()},
            "seconds": result.seconds,
            "peak_memory": int(result.peak_memory),
            "warnings": list(result.warnings),
        }
    )


def _source(source: str) -> str:
    """A model's source that still holds when the working folder changes."""
    return str(Path(source).resolve()) if source and Path(source).exists() else source


def _camera_document(camera: Camera) -> dict[str, Any]:
    keys = ("name", "width", "height", "fx", "fy", "cx", "cy")
    return {k: getattr(camera, k) for k in keys} | {"world_to_camera": camera.world_to_camera.tolist()}


def _key_document(key: KeyLight | None) -> dict[str, Any] | None:
    if key is None:
        return None
    return {"direction": key.direction.tolist(), "radius": key.radius, "irradiance": key.irradiance.tolist()}


def _report_document(report: Report) -> dict[str, Any]:
    return {
        "status": report.outcome,
        "seconds": report.seconds,
        "energies": report.energies,
        "warnings": list(report.warnings),
        "details": report.details,
    }


def _finite(value: Any) -> Any:
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


def load(folder: Path, model: MorphableModel | None) -> Reconstruction:
    """Read a result folder; see `Reconstruction.load`."""
    from mifit.output.reconstruction import Reconstruction

    path = folder / "result.json"
    document = _read_document(folder, path)
    try:
        if model is None:
            model = _load_model(document["model"], path)
        if model.digest != document["model"]["digest"]:
            raise InputError(
                f"{path}: was made with model {document['model']['name']!r} "
                f"(digest {document['model']['digest']}), but {document['model']['source']} is now "
                f"{model.name!r} (digest {model.digest}); fit again, or bring the model back"
            )
        geometry = _geometry(folder, document, model)
        capture = document["capture"]
        return Reconstruction(
            model=model,
            model_source=document["model"]["source"],
            geometry=geometry,
            reflectance=_reflectance(folder, document),
            normals=_normals(folder, document),
            mesh=_mesh(folder, document, model, geometry),
            config=document["config"],
            cameras=tuple(_camera(entry) for entry in capture["cameras"]),
            capture_digest=capture["digest"],
            units=capture["units"],
            unit_mm=float(capture["unit_mm"]),
            seconds=float(document["seconds"]),
            peak_memory=int(document["peak_memory"]),
            warnings=tuple(document["warnings"]),
        )
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{path}: key {error} is missing; the file is damaged, fit again") from None
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: holds a value of the wrong kind ({error}); fit again") from None


def _read_document(folder: Path, path: Path) -> dict[str, Any]:
    """Parse ``result.json`` and check that it is one, of this version."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a result that `mifit fit` wrote")
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            f"{path}: missing, so {folder} is no result or an unfinished one; "
            "name a folder that `mifit fit` wrote, or finish it with --resume"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({error}); fit again") from None
    version = document.get("format_version") if isinstance(document, dict) else None
    if version != FORMAT_VERSION:
        raise InputError(
            f"{path}: found format_version {version!r}, this mifit reads {FORMAT_VERSION}; "
            "fit again, or use the mifit version named in the file"
        )
    return document


def _load_model(entry: dict[str, Any], path: Path) -> MorphableModel:
    from mifit.morphable import MorphableModel

    if not entry["source"]:
        raise InputError(
            f"{path}: doesn't say which file holds its model {entry['name']!r}; "
            "give it: Reconstruction.load(folder, model=...)"
        )
    try:
        return MorphableModel.load(entry["source"])
    except InputError as error:
        raise InputError(f"{path}: the model it was fitted with can't be read: {error}") from None


def _camera(entry: dict[str, Any]) -> Camera:
    """A camera from the keys of `_camera_document`, all of its numbers finite and its sizes positive."""
    size, focal = (_array([entry[k] for k in keys], (2,), "camera") for keys in (("width", "height"), ("fx", "fy")))
    if not (size.min() >= 1 and focal.min() > 0):
        raise ValueError(f"camera: found size {size.tolist()}, focal lengths {focal.tolist()}, expected positive ones")
    centre = _array([entry["cx"], entry["cy"]], (2,), "camera")
    pose = _array(entry["world_to_camera"], (4, 4), "world_to_camera")
    return Camera(str(entry["name"]), int(size[0]), int(size[1]), *focal.tolist(), *centre.tolist(), pose)


def _report(document: dict[str, Any], stage: str) -> Report:
    entry = document["stages"][stage]
    energies = {k: [math.nan if x is None else float(x) for x in v] for k, v in entry["energies"].items()}
    return Report(entry["status"], energies, float(entry["seconds"]), tuple(entry["warnings"]), entry["details"])


def _array(value: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """A float64 array of a given shape, all finite."""
    out = np.array(value, dtype=np.float64)
    if out.shape != shape or not np.isfinite(out).all():
        raise ValueError(f"{name}: found shape {out.shape}, expected {shape} of finite numbers")
    return out


def _geometry(folder: Path, document: dict[str, Any], model: MorphableModel) -> GeometryEstimate:
    entry, steps, lighting = document["model"], document["timesteps"], document["lighting"]
    identity = _array(entry["identity"], (model.identity.shape[2],), "identity")
    albedo = _array(entry["albedo"], (model.albedo_modes.shape[2],), "albedo")
    n = len(steps)
    expression = _array([s["expression"] for s in steps], (n, model.expression.shape[2]), "expression")
    mesh = split_at_seams(model)
    vertices = np.empty((n, len(model.mean), 3), dtype=np.float32)
    vertex_albedo = model.albedo(albedo).astype(np.float32)
    for i, step in enumerate(steps):
        # Vertices that no face uses are in no mesh file: they follow from the coefficients.
        rotation, translation = np.array(step["rotation"]), np.array(step["translation"])
        shape = model.shape(identity, expression[i])
        vertices[i] = entry["scale"] * shape @ rotation.T + translation
        stored = _read_mesh(folder / "geometry" / f"{step['timestep']:04d}.ply", mesh)
        vertices[i, mesh.origin] = stored["vertices"]
        vertex_albedo[mesh.origin] = stored["albedo"]
    return GeometryEstimate(
        timesteps=tuple(int(s["timestep"]) for s in steps),
        identity=identity,
        albedo=albedo,
        expression=expression,
        rotation=_array([s["rotation"] for s in steps], (n, 3, 3), "rotation"),
        translation=_array([s["translation"] for s in steps], (n, 3), "translation"),
        scale=float(entry["scale"]),
        vertices=vertices,
        vertex_albedo=vertex_albedo,
        shading=_array(lighting["shading"], (9, 3), "shading"),
        ambient=float(lighting["shading_ambient"]),
        report=_report(document, "geometry"),
        gains={
            name: tuple(_array(gain, (3,), f"gain of {name}").tolist())
            for name, gain in document["capture"].get("gains", {}).items()
        },
    )


def _read_mesh(path: Path, mesh: SplitMesh) -> dict[str, NDArray]:
    """Read a mesh file and check that it has the vertices that the model gives it."""
    stored = read_ply(path)
    if len(stored["vertices"]) != len(mesh.origin) or not np.isfinite(stored["vertices"]).all():
        raise InputError(
            f"{path}: found {len(stored['vertices'])} vertices, expected {len(mesh.origin)} finite ones "
            "as the model has; fit again"
        )
    return stored


def _read_map(path: Path, channels: int, size: int | None = None) -> NDArray[np.float32]:
    """Read one map and check its shape and that it is finite."""
    image = read_image(path)
    if channels == 1 and image.ndim == 3:
        image = image[..., 0]
    shape = image.shape[:2]
    expected = (size, size) if size else (shape[0], shape[0])
    if shape != expected or (channels == 3 and image.shape[2:] != (3,)) or not np.isfinite(image).all():
        raise InputError(
            f"{path}: found an image of shape {image.shape}, expected {expected[0]} x {expected[1]} texels "
            f"of {channels} finite channels; fit again"
        )
    return np.ascontiguousarray(image, dtype=np.float32)


def _reflectance(folder: Path, document: dict[str, Any]) -> ReflectanceEstimate | None:
    if "reflectance" not in document["stages"]:
        return None
    lighting = document["lighting"]
    order = int(lighting["order"])
    key = lighting.get("key")
    diffuse = _read_map(folder / "maps" / "diffuse.exr", 3)
    return ReflectanceEstimate(
        diffuse=diffuse,
        specular=_read_map(folder / "maps" / "specular.exr", 1, len(diffuse)),
        confidence=_read_map(folder / "maps" / "confidence.exr", 1, len(diffuse)),
        radiance=_array(lighting["radiance"], (order * order, 3), "radiance"),
        ambient=float(lighting["ambient"]),
        exponent=float(lighting["exponent"]),
        shading_model=str(lighting["shading_model"]),
        report=_report(document, "reflectance"),
        fresnel=None if lighting.get("fresnel") is None else float(lighting["fresnel"]),
        key_direction=None if key is None else _array(key["direction"], (3,), "key direction"),
        key_irradiance=None if key is None else _array(key["irradiance"], (3,), "key irradiance"),
        key_radius=0.0 if key is None else float(key["radius"]),
    )


def _normals(folder: Path, document: dict[str, Any]) -> NormalsEstimate | None:
    if "normals" not in document["stages"]:
        return None
    timesteps = [int(s["timestep"]) for s in document["timesteps"] if s["refined_normals"]]
    maps = [_read_map(folder / "maps" / f"normal_object_{t:04d}.exr", 3) for t in timesteps]
    return NormalsEstimate(tuple(timesteps), np.stack(maps), _report(document, "normals"))


def _mesh(
    folder: Path, document: dict[str, Any], model: MorphableModel, geometry: GeometryEstimate
) -> MeshEstimate | None:
    if "mesh" not in document["stages"]:
        return None
    report = _report(document, "mesh")
    subdivisions = MeshConfig(subdivisions=int(report.details["subdivisions"])).subdivisions  # in its bounds
    topology = split_faces(model, subdivisions)
    timesteps = tuple(int(s["timestep"]) for s in document["timesteps"] if s["refined_mesh"])
    mesh = split_at_seams(topology)
    # Vertices that no face uses are in no mesh file: they stay where the fit left them.
    vertices = np.stack([topology.matrix @ geometry.vertices[geometry.index(t)] for t in timesteps])
    for k, timestep in enumerate(timesteps):
        vertices[k, mesh.origin] = _read_mesh(folder / "refined" / f"{timestep:04d}.ply", mesh)["vertices"]
    heights = [_read_map(folder / "maps" / f"displacement_{t:04d}.exr", 1) for t in timesteps]
    return MeshEstimate(
        timesteps,
        vertices.astype(np.float32),
        topology.faces,
        topology.faces_uv,
        topology.uv,
        np.stack(heights),
        report,
    )
