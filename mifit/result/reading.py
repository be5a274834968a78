"""Reading the result folder back, with every value checked (docs/formats.md)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.appearance import models
from mifit.appearance.illumination import Illumination, light_from
from mifit.appearance.lobe import Lobe
from mifit.core.arrays import Rows, read_npz, read_ply
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import (
    GeometryEstimate,
    MeshEstimate,
    NormalsEstimate,
    ReflectanceEstimate,
    Report,
    ResidualEstimate,
)
from mifit.core.files import Document, read_json
from mifit.core.image import read_image, to_8_bit
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_LIGHTS, MAX_NUMBER, MAX_PIXELS
from mifit.core.mesh import SplitMesh, split_at_seams
from mifit.core.photometry import Photometry
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import lacks_eyes, with_eyes
from mifit.result.ownership import changed, unchanging
from mifit.result.reconstruction import Reconstruction
from mifit.result.writing import FORMAT_VERSION, label_file


def load(folder: Path, model: MorphableModel | None = None) -> Reconstruction:
    """Read a result folder; see `Reconstruction.load`."""
    with unchanging(folder):
        result = _load(folder, model)
        for name in changed(folder):
            warnings.warn(f"{folder / name}: has changed since mifit wrote it", stacklevel=3)
    return result


def _load(folder: Path, model: MorphableModel | None) -> Reconstruction:
    path = folder / "result.json"
    document = read_document(folder)
    try:
        if model is None:
            model = _load_model(document["model"], path)
        if model.digest != document["model"]["digest"] and lacks_eyes(model):
            whole = with_eyes(model)  # as a fit has it
            model = whole if whole.digest == document["model"]["digest"] else model
        if model.digest != document["model"]["digest"]:
            raise InputError(
                f"{path}: was made with model {document['model']['name']!r} "
                f"(digest {document['model']['digest']}), but {document['model']['source']} is now "
                f"{model.name!r} (digest {model.digest}); fit again, or bring the model back"
            )
        _check_names(document)
        geometry = _geometry(folder, document, model)
        reflectance = _reflectance(folder, document)
        capture = document["capture"]
        return Reconstruction(
            model=model,
            model_source=document["model"]["source"],
            geometry=geometry,
            reflectance=reflectance,
            normals=_normals(folder, document),
            mesh=_mesh(folder, document, model, geometry),
            residual=None if reflectance is None else _residual(folder, document, len(reflectance.diffuse)),
            config=document["config"],
            cameras=tuple(_camera(entry) for entry in capture["cameras"]),
            capture_digest=capture["digest"],
            units=capture["units"],
            unit_mm=_positive(capture["unit_mm"], "unit_mm"),
            seconds=float(document["seconds"]),
            peak_memory=int(document["peak_memory"]),
            warnings=_diagnostics(document["warnings"]),
        )
    except InputError:
        raise
    except KeyError as error:
        raise InputError(f"{path}: key {error} is missing; the file is damaged, fit again") from None
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise InputError(f"{path}: holds a value of the wrong kind ({error}); fit again") from None


def _check_names(document: Document) -> None:
    """Refuse settings that are no table, and cameras or timesteps that are missing or there twice."""
    if not isinstance(document["config"], dict):
        raise ValueError(f"config: found {type(document['config']).__name__}, expected a table of settings")
    for kind, names in (
        ("cameras", [entry["name"] for entry in document["capture"]["cameras"]]),
        ("timesteps", [int(entry["timestep"]) for entry in document["timesteps"]]),
    ):
        if len(set(names)) < len(names) or (kind == "timesteps" and not names):  # a result may have no cameras
            raise ValueError(f"{kind}: found {', '.join(map(str, names)) or 'none'}, expected each once")


def read_document(folder: Path) -> Document:
    """Parse ``result.json`` and check that it is one, of this version; InputError otherwise."""
    path = folder / "result.json"
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a result that `mifit fit` wrote")
    if not path.exists():
        raise InputError(
            f"{path}: missing, so {folder} is no result or an unfinished one; "
            "name a folder that `mifit fit` wrote, or finish it with --resume"
        )
    document = read_json(path, MAX_DOCUMENT_BYTES, "result")
    version = document.get("format_version") if isinstance(document, dict) else None
    if version != FORMAT_VERSION:
        raise InputError(
            f"{path}: found format_version {version!r}, this mifit reads {FORMAT_VERSION}; "
            "fit again, or use the mifit version named in the file"
        )
    return document


def _load_model(entry: Document, path: Path) -> MorphableModel:
    if not entry["source"]:
        raise InputError(
            f"{path}: doesn't say which file holds its model {entry['name']!r}; "
            "give it: Reconstruction.load(folder, model=...)"
        )
    try:
        return MorphableModel.load(entry["source"])
    except InputError as error:
        raise InputError(f"{path}: the model it was fitted with can't be read: {error}") from None


def _camera(entry: Document) -> Camera:
    """A camera from the keys of `writing.CAMERA`, all of its numbers finite and its sizes positive."""
    size, focal = (_array([entry[k] for k in keys], (2,), "camera") for keys in (("width", "height"), ("fx", "fy")))
    if not (size.min() >= 1 and size.prod() <= MAX_PIXELS and focal.min() > 0):
        raise ValueError(f"camera: found size {size.tolist()}, focal lengths {focal.tolist()}, expected positive ones")
    centre = _array([entry["cx"], entry["cy"]], (2,), "camera")
    pose = _array(entry["world_to_camera"], (4, 4), "world_to_camera")
    (fx, fy), (cx, cy) = focal.tolist(), centre.tolist()
    return Camera(str(entry["name"]), int(size[0]), int(size[1]), fx, fy, cx, cy, pose)


def _report(document: Document, stage: str) -> Report:
    entry = document["stages"][stage]
    energies = {k: [math.nan if x is None else float(x) for x in v] for k, v in entry["energies"].items()}
    return Report(entry["status"], energies, float(entry["seconds"]), _diagnostics(entry["warnings"]), entry["details"])


def _diagnostics(entries: Sequence[Document]) -> tuple[Diagnostic, ...]:
    return tuple(Diagnostic.of(entry) for entry in entries)


def _array(value: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """A float64 array of a given shape, all finite and within bounds."""
    out = np.array(value, dtype=np.float64)
    if out.shape != shape or not (np.abs(out) <= MAX_NUMBER).all():
        raise ValueError(f"{name}: found shape {out.shape}, expected {shape} of numbers within {MAX_NUMBER:g}")
    return out


def _positive(value: ArrayLike, name: str) -> float:
    """A number from 1e-9 to 1e9."""
    number = float(_array(value, (), name))
    if not 1.0 / MAX_NUMBER <= number <= MAX_NUMBER:
        raise ValueError(f"{name}: found {number:g}, expected a number from {1.0 / MAX_NUMBER:g} to {MAX_NUMBER:g}")
    return number


def _rotations(value: ArrayLike, count: int) -> NDArray[np.float64]:
    """(N, 3, 3) rotations."""
    out = _array(value, (count, 3, 3), "rotation")
    if not (np.allclose(out @ out.transpose(0, 2, 1), np.eye(3), atol=1e-3) and (np.linalg.det(out) > 0).all()):
        raise ValueError("rotation: found a matrix that is no rotation, expected orthonormal ones of determinant 1")
    return out


def _geometry(folder: Path, document: Document, model: MorphableModel) -> GeometryEstimate:
    entry, steps, lighting = document["model"], document["timesteps"], document["lighting"]
    identity = _array(entry["identity"], (model.identity.shape[2],), "identity")
    albedo = _array(entry["albedo"], (model.albedo_modes.shape[2],), "albedo")
    n = len(steps)
    expression = _array([s["expression"] for s in steps], (n, model.expression.shape[2]), "expression")
    mesh = split_at_seams(model.faces, model.faces_uv, model.uv)
    vertices = Rows(n, (len(model.mean), 3), np.float32)
    vertex_albedo = model.albedo(albedo).astype(np.float32)
    scale, rotations = _positive(entry["scale"], "scale"), _rotations([s["rotation"] for s in steps], n)
    translations = _array([s["translation"] for s in steps], (n, 3), "translation")
    for i, step in enumerate(steps):
        # Vertices that no face uses are in no mesh file: they follow from the coefficients.
        shape = model.shape(identity, expression[i])
        with np.errstate(over="ignore"):
            posed = (scale * shape @ rotations[i].T + translations[i]).astype(np.float32)
        if not np.isfinite(posed).all():
            raise ValueError(f"timestep {step['timestep']}: found a pose that is out of all bounds")
        stored = _read_mesh(folder / "geometry" / f"{step['timestep']:04d}.ply", mesh)
        posed[mesh.origin] = stored["vertices"]
        vertices.add(posed)
        vertex_albedo[mesh.origin] = stored["albedo"]
    return GeometryEstimate(
        timesteps=tuple(int(s["timestep"]) for s in steps),
        identity=identity,
        albedo=albedo,
        expression=expression,
        rotation=rotations,
        translation=translations,
        scale=scale,
        vertices=vertices.all,
        vertex_albedo=vertex_albedo,
        shading=_array(lighting["shading"], (9, 3), "shading"),
        ambient=float(_array(lighting["shading_ambient"], (), "shading_ambient")),
        report=_report(document, "geometry"),
        photometry=Photometry.from_document(document["capture"].get("photometry", {})),
        displacement=_displacement(folder, len(model.mean)) if entry.get("displaced") else None,
        landmark_noise=float(document["capture"]["landmark_noise"]),
    )


def _displacement(folder: Path, count: int) -> NDArray[np.float32]:
    """(V, 3) displacement from the model, object space."""
    path = folder / "geometry" / "displacement.npz"
    found = read_npz(path, ["displacement"]).get("displacement", np.zeros(0))
    if found.shape != (count, 3) or found.dtype.kind != "f" or not np.isfinite(found).all():
        raise InputError(f"{path}: found shape {found.shape}, expected ({count}, 3) finite numbers; fit again")
    return found.astype(np.float32)


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
    image = image[..., 0] if channels == 1 else image
    shape = image.shape[:2]
    expected = (size, size) if size else (shape[0], shape[0])
    if shape != expected or not np.isfinite(image).all():
        raise InputError(
            f"{path}: found an image of shape {image.shape}, expected {expected[0]} x {expected[1]} texels "
            f"of {channels} finite channels; fit again"
        )
    return np.ascontiguousarray(image, dtype=np.float32)


def _read_maps(folder: Path, name: str, timesteps: Sequence[int], channels: int) -> NDArray[np.float32]:
    """The maps of a name, all of one size, one timestep after the other."""
    paths = [folder / "maps" / f"{name}_{t:04d}.exr" for t in timesteps]
    first = _read_map(paths[0], channels)
    rows = Rows(len(paths), first.shape, np.float32)
    return rows.extend(chain([first], (_read_map(path, channels, len(first)) for path in paths[1:])))


def _reflectance(folder: Path, document: Document) -> ReflectanceEstimate | None:
    if "reflectance" not in document["stages"]:
        return None
    lighting = document["lighting"]
    order = int(lighting["order"])
    lights = lighting["lights"]
    if len(lights) > MAX_LIGHTS:
        raise ValueError(f"lights: found {len(lights)}, expected at most {MAX_LIGHTS}")
    model = models.get(str(lighting["shading_model"]))
    fresnel = lighting.get("fresnel")
    lobe = Lobe(
        _positive(lighting["exponent"], "exponent"),
        None if fresnel is None else float(_array(fresnel, (), "fresnel")),
        bool(lighting["normalized"]),
    )
    radiance = _array(lighting["radiance"], (order * order, 3), "radiance")
    ambient = float(_array(lighting["ambient"], (), "ambient"))
    diffuse = _read_map(folder / "maps" / "diffuse.exr", 3)
    labels = _labels(folder, document)

    def optional(name: str, channels: int) -> NDArray[np.float32] | None:
        path = folder / "maps" / f"{name}.exr"
        return _read_map(path, channels, len(diffuse)) if path.exists() else None

    return ReflectanceEstimate(
        diffuse=diffuse,
        specular=_read_map(folder / "maps" / "specular.exr", 1, len(diffuse)),
        confidence=_read_map(folder / "maps" / "confidence.exr", 1, len(diffuse)),
        illumination=Illumination(radiance, tuple(light_from(x) for x in lights), ambient),
        lobe=lobe,
        shading_model=model.name,
        report=_report(document, "reflectance"),
        labels=tuple(labels.values()),
        labelled=tuple(labels),
        residual_shading=optional("residual_shading", 3),
        specular_confidence=optional("specular_confidence", 1),
        hair=tuple(_array(document["hair"], (3,), "hair").tolist()) if "hair" in document else None,
    )


def _labels(folder: Path, document: Document) -> dict[tuple[str, int], NDArray[np.uint8]]:
    """What images show, by camera and timestep: of those that the result keeps it of."""
    found = {}
    for camera in map(_camera, document["capture"]["cameras"]):
        for timestep in (int(entry["timestep"]) for entry in document["timesteps"]):
            path = folder / label_file(camera.name, timestep)
            if path.is_file():
                image = to_8_bit(read_image(path)[..., 0])
                if image.shape != (size := (camera.height, camera.width)):
                    raise InputError(f"{path}: found {image.shape}, expected {size}; fit again")
                found[camera.name, timestep] = image
    return found


def _normals(folder: Path, document: Document) -> NormalsEstimate | None:
    if "normals" not in document["stages"]:
        return None
    timesteps = [int(s["timestep"]) for s in document["timesteps"] if s["refined_normals"]]
    tracked = {int(s["timestep"]): str(s["tracked"]) for s in document["timesteps"] if s["tracked"]}
    maps = _read_maps(folder, "normal_object", timesteps, 3)
    return NormalsEstimate(tuple(timesteps), maps, _report(document, "normals"), tracked)


def _residual(folder: Path, document: Document, size: int) -> ResidualEstimate | None:
    if "residual" not in document["stages"]:
        return None
    timesteps = [int(s["timestep"]) for s in document["timesteps"] if s["residual"]]
    radiance = Rows(len(timesteps), (size, size, 3), np.float32)
    radiance.extend(_read_map(folder / "maps" / f"residual_{t:04d}.exr", 3, size) for t in timesteps)
    return ResidualEstimate(tuple(timesteps), radiance.all, _report(document, "residual"))


def _mesh(folder: Path, document: Document, model: MorphableModel, geometry: GeometryEstimate) -> MeshEstimate | None:
    if "mesh" not in document["stages"]:
        return None
    report = _report(document, "mesh")
    timesteps = tuple(int(s["timestep"]) for s in document["timesteps"] if s["refined_mesh"])
    mesh = split_at_seams(model.faces, model.faces_uv, model.uv)
    # Vertices that no face uses are in no mesh file: they stay where the fit left them.
    vertices = Rows(len(timesteps), (len(model.mean), 3), np.float32)
    for timestep in timesteps:
        row = geometry.vertices[geometry.index(timestep)].copy()
        row[mesh.origin] = _read_mesh(folder / "refined" / f"{timestep:04d}.ply", mesh)["vertices"]
        vertices.add(row)
    return MeshEstimate(timesteps, vertices.all, report)
