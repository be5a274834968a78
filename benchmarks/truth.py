"""Ground truth of a path-traced capture: its geometry as if stage 1 had found it, and the errors of a result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, rasterize_uv, sample_map
from mifit.morphable import MorphableModel
from mifit.morphable.openings import STRIP, leading_faces
from mifit.result import Reconstruction


def true_geometry(capture: Capture, model: MorphableModel, timesteps: Sequence[int]) -> GeometryEstimate:
    """The capture's own vertices and poses, with the mean albedo of the model that was rendered."""
    frames = [np.load(Path(capture.path) / "truth" / f"{t:04d}.npz") for t in timesteps]
    return GeometryEstimate(
        timesteps=tuple(timesteps),
        identity=np.zeros(model.n_identity),
        albedo=np.zeros(model.n_albedo),
        expression=np.zeros((len(frames), model.n_expression)),
        rotation=np.stack([f["R"] for f in frames]),
        translation=np.stack([f["t"] for f in frames]),
        scale=1.0,
        vertices=np.stack([f["vertices"] for f in frames]),
        vertex_albedo=model.mean_albedo,
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report("converged"),
    )


def true_maps(capture: Capture, size: int) -> dict[str, NDArray]:
    """Painted albedo, specular lobe weight and roughness of the capture, averaged down to ``size`` texels a side."""
    with np.load(Path(capture.path) / "truth" / "maps.npz") as stored:
        return {key: _averaged(stored[key].astype(np.float32), size) for key in ("albedo", "specular", "roughness")}


def _averaged(image: NDArray, size: int) -> NDArray:
    """A square map -> its means over blocks, ``size`` of them a side."""
    k = image.shape[0] // size
    return image.reshape(size, k, size, k, *image.shape[2:]).mean((1, 3))


def truth_layout(model: MorphableModel, count: int) -> NDArray:
    """(U, 2) texture coordinates in the maps of a truth of ``count`` vertices.

    Eyes that a fit gave the model come after those vertices and moved its layout up.
    """
    return model.uv if count == model.n_vertices else (model.uv - (0.0, STRIP)) / (1.0, 1.0 - STRIP)


def bumped_normals(
    model: MorphableModel, capture: Path, timestep: int, texels: TexelMap, bump_unit: float = 1.0
) -> NDArray:
    """(N, 3) true world normals with the painted bump, a height along the normal in ``bump_unit`` of the world's unit.

    The gradient of the bump is taken at the map's full size and averaged down to the texels.
    """
    with np.load(capture / "truth" / f"{timestep:04d}.npz") as truth, np.load(capture / "truth" / "maps.npz") as maps:
        vertices, bump = truth["vertices"].astype(np.float64), bump_unit * maps["bump"].astype(np.float64)
    slope = np.stack([np.gradient(bump, axis=1), -np.gradient(bump, axis=0)], axis=-1) * len(bump)
    uv = truth_layout(model, len(vertices)).astype(np.float64)
    slope = sample_map(_averaged(slope, texels.size), interpolate(uv, model.faces_uv, texels.face, texels.weights))
    own = leading_faces(model, len(vertices))
    p, t = vertices[model.faces[own]], uv[model.faces_uv[own]]
    e, d = p[:, 1:] - p[:, :1], t[:, 1:] - t[:, :1]
    by_uv = np.einsum("fij,fjc->fic", np.linalg.pinv(d), e)[
        texels.face
    ]  # dp/du, dp/dv; the first faces are the truth's
    n = normalize(interpolate(vertex_normals(vertices, model.faces[own]), model.faces, texels.face, texels.weights))
    by_uv -= np.einsum("nic,nc->ni", by_uv, n)[..., None] * n[:, None]
    bent = np.cross(by_uv[:, 0] + slope[:, :1] * n, by_uv[:, 1] + slope[:, 1:] * n)
    return normalize(bent * np.sign(np.sum(bent * n, axis=1, keepdims=True)))


def _smooth_normals(model: MorphableModel, vertices: NDArray, texels: TexelMap) -> NDArray:
    return normalize(interpolate(vertex_normals(vertices, model.faces), model.faces, texels.face, texels.weights))


def angle(a: NDArray, b: NDArray) -> float:
    """Mean angle between unit vectors in degrees."""
    return float(np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1))).mean())


def mesh_error(result: Reconstruction, capture: Path) -> dict[str, float]:
    """Mean distance of face-area vertices (mm) and head rotation (degrees) to the truth, without any alignment."""
    area = np.unique(result.model.faces[result.model.face_mask])
    distances, angles = [], []
    for i, timestep in enumerate(result.timesteps):
        with np.load(capture / "truth" / f"{timestep:04d}.npz") as truth:
            distances.append(np.linalg.norm(result.geometry.vertices[i][area] - truth["vertices"][area], axis=1))
            turn = result.geometry.rotation[i] @ truth["R"].T
        angles.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    return {
        "mesh_mm": round(float(np.mean(distances)) * result.unit_mm, 3),
        "rotation_degrees": round(float(np.max(angles)), 3),
    }


def normal_errors(result: Reconstruction, capture: Path, bump_unit: float) -> dict[str, float]:
    """Mean angle (degrees) of the face area's normals to the truth with its bump: stage 1's, and the refined ones."""
    assert result.normals is not None
    model = result.model
    texels = rasterize_uv(model.uv, model.faces_uv, result.normals.normal_object.shape[1], model.face_mask)
    before, after = [], []
    for i, timestep in enumerate(result.timesteps):
        true = bumped_normals(model, capture, timestep, texels, bump_unit)
        before.append(angle(_smooth_normals(model, result.geometry.vertices[i].astype(np.float64), texels), true))
        normals = result.refined_normal(timestep)
        assert normals is not None
        refined = texels.from_map(normals) @ result.geometry.rotation[i].T
        after.append(angle(refined, true))
    return {
        "normal_degrees_stage1": round(float(np.mean(before)), 3),
        "normal_degrees": round(float(np.mean(after)), 3),
    }


def map_errors(capture: Capture, model: MorphableModel, found: ReflectanceEstimate) -> dict[str, float]:
    """Diffuse RMSE after one scale per channel, and the specular map's correlation with the true lobe weight.

    Over texels of the face area that were seen well.
    """
    size = len(found.diffuse)
    truth, texels = true_maps(capture, size), rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    with np.load(Path(capture.path) / "truth" / f"{capture.timesteps[0]:04d}.npz") as frame:
        uv = truth_layout(model, len(frame["vertices"]))
    uv = interpolate(uv, model.faces_uv, texels.face, texels.weights)
    seen = texels.from_map(found.confidence) > 0.5
    estimate, true = texels.from_map(found.diffuse)[seen], sample_map(truth["albedo"], uv)[seen]
    specular, lobe = texels.from_map(found.specular)[seen], sample_map(truth["specular"], uv)[seen]
    scale = (estimate * true).sum(0) / np.maximum((estimate**2).sum(0), 1e-12)
    return {
        "diffuse_rmse": round(float(np.sqrt(np.mean((scale * estimate - true) ** 2))), 4),
        "specular_correlation": round(float(np.corrcoef(specular, lobe)[0, 1]), 3) if np.ptp(specular) > 0 else 0.0,
    }


def truth_errors(result: Reconstruction, folder: Path, bump_unit: float) -> dict[str, float]:
    """All errors of a whole result against a capture's truth; ``bump_unit`` as for `bumped_normals`."""
    assert result.reflectance is not None
    return {
        **map_errors(Capture.load(folder), result.model, result.reflectance),
        **normal_errors(result, folder, bump_unit),
        **mesh_error(result, folder),
    }
