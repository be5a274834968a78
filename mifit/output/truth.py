"""Ground truth that a capture carries in its ``truth`` folder: meshes, passes and relit views; for judging only.

===============================  =======================================================================================
``TTTT.ply``, ``head.ply``       mesh of a timestep, or of a head that doesn't move; world space
``TTTT.npz``, ``mesh.npz``       the same as arrays: ``vertices``, and ``faces`` (with ``face_mask``) of all timesteps
``diffuse_CAMERA.exr``           the first timestep without specular reflection, linear, before the exposure
``full_CAMERA.exr``              the same view with it, or ``specular_CAMERA.exr``; else the photograph. ``.png``: sRGB
``relit_ENV.exr``                the last camera's first view under another environment
``environment_ENV.exr``          that environment, lat-long
``meta.json``                    ``exposure``: factor from those images to the photographs; ``relit_exposure`` by ENV
===============================  =======================================================================================
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.appearance.occlusion import MeshPoints
from mifit.capture import Capture
from mifit.core.arrays import read_npz
from mifit.core.files import read_bytes, read_json
from mifit.core.image import read_image
from mifit.core.limits import MAX_MODEL_BYTES, MAX_SETTINGS_BYTES
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import leading_faces
from mifit.output.compare import face_region
from mifit.render.gbuffer import SurfaceScene


@dataclass(frozen=True)
class TrueMesh:
    """The true surface of one timestep in world space; ``face_mask`` (F,): the face area, or all of it."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_mask: NDArray[np.bool_]


@dataclass(frozen=True)
class TruePasses:
    """One view's diffuse and specular image, (H, W, 3) linear, in the photographs' exposure."""

    diffuse: NDArray[np.float64]
    specular: NDArray[np.float64]


@dataclass(frozen=True)
class RelitTruth:
    """A view under another environment: (H, W, 3) linear in the sensor's range, and the environment's file or None."""

    image: NDArray[np.float64]
    environment: Path | None


def true_mesh(capture: Capture, timestep: int, model: MorphableModel | None = None) -> TrueMesh | None:
    """The true mesh of a timestep; None where the capture has none.

    ``model`` gives the faces of a truth that has vertices alone. Of a model that got eyes the truth may have the
    first vertices, those of the model's file. InputError for a damaged file, or vertices of unknown faces.
    """
    folder = Path(capture.path) / "truth"
    for path in (folder / f"{timestep:04d}.ply", folder / "head.ply"):
        if path.exists():
            return read_mesh(path)
    path = folder / f"{timestep:04d}.npz"
    if not path.exists():
        return None
    try:
        vertices = read_npz(path, ("vertices",))["vertices"]
    except KeyError:
        raise InputError(f"{path}: not a ground-truth file: has no array 'vertices'") from None
    stored = folder / "mesh.npz"
    if stored.exists():
        data = read_npz(stored, ("faces", "face_mask"))
        if "faces" not in data:
            raise InputError(f"{stored}: has no array 'faces'")
        return _checked(stored, vertices, data["faces"], data.get("face_mask"))
    own = None if model is None else leading_faces(model, len(vertices))
    if own is None or model is None:
        given = "no model is named" if model is None else f"model {model.name!r} has {len(model.mean)}"
        raise InputError(
            f"{path}: found {len(vertices)} vertices, but {given}, so the faces are unknown; expected {stored} with "
            "the truth's faces, or the model that the capture was made with"
        )
    return TrueMesh(vertices.astype(np.float64), model.faces[own].astype(np.int64), model.face_mask[own])


def read_mesh(path: Path) -> TrueMesh:
    """Vertices and triangles of any PLY or OBJ file; InputError where it has none."""
    data = read_bytes(path, MAX_MODEL_BYTES, "mesh")
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=path.suffix[1:].lower(), process=False)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:  # whatever a damaged file makes the readers raise
        raise InputError(f"{path}: not a readable mesh ({error}), expected PLY or OBJ with triangles") from None
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: found vertices that are not finite")
    return _checked(path, vertices, faces)


def _checked(path: Path, vertices: NDArray, faces: NDArray, mask: NDArray | None = None) -> TrueMesh:
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: faces have shape {faces.shape}, expected (F, 3) indices of {len(vertices)} vertices")
    face_mask = np.ones(len(faces), bool) if mask is None else mask.astype(bool)
    return TrueMesh(vertices.astype(np.float64), faces.astype(np.int64), face_mask)


def points_seen(mesh: TrueMesh, capture: Capture, cameras: Sequence[str], timestep: int) -> MeshPoints:
    """Points of the face, drawn evenly over the true surface, that all cameras see at a cosine of 0.25 or more."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    position, face = trimesh.sample.sample_surface(whole, 60000, seed=0)
    position, keep, scene = np.asarray(position), np.ones(len(face), bool), SurfaceScene(mesh.vertices, mesh.faces)
    for name in cameras:
        view = capture.camera(name)
        away = normalize(position - view.position)
        pixel = np.clip(view.project(position).astype(int), 0, (view.width - 1, view.height - 1))
        inside = face_region(landmarks_of(capture, name, timestep), view)[pixel[:, 1], pixel[:, 0]]
        flat = -np.sum(whole.face_normals[face] * away, axis=1)
        keep &= inside & (flat > 0.25) & scene.visible_from(position, view.position)
    position, face = position[keep][:8000], face[keep][:8000]
    if not len(face):
        raise InputError(f"{capture.path}: cameras {', '.join(cameras)} see no point of the true mesh together")
    weights = trimesh.triangles.points_to_barycentric(whole.triangles[face], position)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return MeshPoints(position, normalize(interpolate(normals, mesh.faces, face, weights)), face, weights)


def landmarks_of(capture: Capture, camera: str, timestep: int) -> NDArray[np.float32]:
    """(68, 2) landmarks of one image, by which its face is found; InputError where there are none."""
    found = capture.landmarks(camera, timestep)
    if found is None:
        raise InputError(
            f"{capture.path}: camera {camera}, timestep {timestep}: has no landmarks, by which the face is found; "
            f"mifit landmarks {capture.path} finds them"
        )
    return found.points.astype(np.float32)


def nearest_points(points: NDArray, vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Distance (N,) to the nearest point of a mesh, its face and its barycentric weights, for points (N, 3)."""
    triangles = np.asarray(vertices, np.float64)[faces]
    count = min(24, len(triangles))  # faces with the nearest middles
    near = cKDTree(triangles.mean(1)).query(points, count)[1].reshape(-1, count)
    found = trimesh.triangles.closest_point(triangles[near].reshape(-1, 3, 3), np.repeat(points, count, 0))
    found = found.reshape(-1, count, 3)
    distance = np.linalg.norm(found - points[:, None], axis=2)
    pick, rows = distance.argmin(1), np.arange(len(points))
    face = near[rows, pick]
    weights = trimesh.triangles.points_to_barycentric(triangles[face], found[rows, pick])
    return distance.min(1), face, weights


def distance_figures(millimetres: NDArray) -> dict[str, float]:
    """Median, mean and 90 % of distances (N,) in mm, and how many there are."""
    return {
        "median_mm": float(np.median(millimetres)),
        "mean_mm": float(millimetres.mean()),
        "p90_mm": float(np.percentile(millimetres, 90)),
        "points": len(millimetres),
    }


def true_passes(capture: Capture, camera: str) -> TruePasses | None:
    """Diffuse and specular image of a camera at the first timestep; None where the truth has none."""
    folder, timestep = Path(capture.path) / "truth", capture.timesteps[0]
    diffuse, specular, full = (_image(folder, f"{name}_{camera}") for name in ("diffuse", "specular", "full"))
    if diffuse is None:
        return None
    if specular is None:
        specular = (capture.frame(camera, timestep).image if full is None else full) - diffuse
    return TruePasses(diffuse, specular)


def relit_truths(capture: Capture) -> dict[str, RelitTruth]:
    """Relit views of the last camera at the first timestep by the name of their environment."""
    folder = Path(capture.path) / "truth"
    meta, found = _meta(folder), {}
    for path in sorted(folder.glob("relit_*.exr")):
        name = path.stem.removeprefix("relit_")
        own = meta.get("relit_exposure", {})
        factor = own.get(name, meta.get("exposure", 1.0)) if isinstance(own, dict) else 1.0
        environment = folder / f"environment_{name}.exr"
        image = read_image(path).astype(np.float64) * factor
        found[name] = RelitTruth(image, environment if environment.exists() else None)
    return found


def _image(folder: Path, name: str) -> NDArray[np.float64] | None:
    """An image of the truth: EXR before the exposure, PNG after it."""
    if (folder / f"{name}.exr").exists():
        return read_image(folder / f"{name}.exr").astype(np.float64) * _meta(folder).get("exposure", 1.0)
    coded = folder / f"{name}.png"
    return read_image(coded).astype(np.float64) if coded.exists() else None


def _meta(folder: Path) -> dict:
    """What ``meta.json`` says; empty where it is missing."""
    path = folder / "meta.json"
    if not path.exists():
        return {}
    try:
        found = read_json(path, MAX_SETTINGS_BYTES)
        if isinstance(found, dict) and float(found.get("exposure", 1.0)) > 0:
            return found
    except (OSError, ValueError, TypeError):
        pass
    raise InputError(f"{path}: expected a JSON object with a positive 'exposure'")
