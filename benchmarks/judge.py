"""What a fit is worth against photographs and truth: views, relit views, passes, the surface and its maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from benchmarks.heads import ICT, Case
from benchmarks.record import SHARED
from benchmarks.truth import angle
from mifit import Capture, MorphableModel, Reconstruction
from mifit.appearance.occlusion import MeshPoints
from mifit.core.camera import Camera
from mifit.core.image import to_8_bit
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.metrics import psnr_from_rmse
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.output.compare import Errors, face_region, relit_region, scaled_psnr, skin_region
from mifit.output.truth import (
    TrueMesh,
    distance_figures,
    landmarks_of,
    nearest_points,
    points_seen,
    relit_truths,
    true_mesh,
)
from mifit.render.image_based import BLENDS, image_based

MARGIN = 48
"""Pixels around the landmarks that are rendered: more than any window of a measure reaches beyond the face."""
SAMPLES = 2
"""Samples per pixel along each side, of renders and of image-based rendering alike."""
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Row:
    """One row of a table: the fit of every timestep, and the method to render it by."""

    results: Mapping[int, Reconstruction]
    method: str = "full"

    @classmethod
    def of(cls, result: Reconstruction, method: str = "full") -> Row:
        """All timesteps by one joint fit."""
        return cls({t: result for t in result.timesteps}, method)

    @property
    def first(self) -> Reconstruction:
        """The fit of the first timestep."""
        return next(iter(self.results.values()))


@dataclass(frozen=True)
class View:
    """One photograph and the pixels that count in it, cut down to the surroundings of the face.

    ``face``, ``skin`` and ``relit`` as `output.compare` has them.
    """

    name: str
    timestep: int
    camera: Camera
    box: tuple[slice, slice]
    photograph: Image
    face: NDArray[np.bool_]
    skin: NDArray[np.bool_]
    relit: NDArray[np.bool_]


def view(capture: Capture, name: str, timestep: int) -> View:
    """Cut one photograph of a capture down to its face."""
    camera, points = capture.camera(name), landmarks_of(capture, name, timestep)
    low = np.maximum(np.floor(points.min(0)).astype(int) - MARGIN, 0)
    high = np.minimum(np.ceil(points.max(0)).astype(int) + MARGIN, (camera.width, camera.height))
    width, height = (high - low).tolist()
    cut = replace(camera, width=width, height=height, cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1]))
    box = slice(low[1], high[1]), slice(low[0], high[0])
    frame = capture.frame(name, timestep)
    regions = (r(points, camera)[box] & frame.valid[box] for r in (face_region, skin_region, relit_region))
    return View(name, timestep, cut, box, to_8_bit(frame.image)[box], *regions)


def rendered(result: Reconstruction, at: View, method: str) -> Image:
    """A render as 8-bit sRGB; black where the model covers less than half of a pixel."""
    linear = result.render(at.camera, at.timestep, method)  # type: ignore[arg-type]
    image = to_8_bit(linear[..., :3])
    return image * (np.round(255 * linear[..., 3:]) > 127).astype(np.uint8)


def scan_of(case: Case, capture: Capture, timestep: int) -> TrueMesh | None:
    """The true mesh; the vertices of own captures are in the order of the model that they were made with."""
    own = MorphableModel.load(ICT) if case.capture in ("soft", "gloss", "hard") else None
    return true_mesh(capture, timestep, own)


def judge_views(case: Case, capture: Capture, rows: Mapping[str, Row], names: Sequence[str]) -> dict[str, Any]:
    """Errors of every row, and of image-based rendering by every blend on the first row's mesh and on the scan.

    The same pixels for all rows: ``skin``, where a fitted view sees the scan (without a scan: the first row's mesh);
    ``face``, the hull of the landmarks where the wanted view meets it; and ``whole``, the hull as it is, in which an
    uncovered pixel is black.
    """
    tallies: dict[str, dict[str, Errors]] = {}

    def add(row: str, image: Image, at: View, regions: dict[str, NDArray[np.bool_]]) -> None:
        for region, pixels in regions.items():
            tallies.setdefault(row, {}).setdefault(region, Errors()).add(image, at.photograph, pixels)

    cameras = [capture.camera(c) for c in case.fitted]
    first = next(iter(rows.values()))
    for timestep in case.timesteps:
        scan, ours = scan_of(case, capture, timestep), first.results[timestep]
        meshes = {"our mesh": (ours.geometry.vertices[ours.index(timestep)], ours.model.faces)}
        if scan is not None:
            meshes["scan"] = (scan.vertices, scan.faces)
        seen_as = ours.seen(capture)  # with the exposures that the fit found
        for name in names:
            at = view(capture, name, timestep)
            based = {
                mesh: image_based(seen_as, cameras, at.camera, timestep, *given, blends=BLENDS, oversampling=SAMPLES)
                for mesh, given in meshes.items()
            }
            seen = based["scan" if scan is not None else "our mesh"].seen
            regions = {"skin": at.skin & seen, "face": at.face & seen, "whole": at.face}
            for label, row in rows.items():
                add(label, rendered(row.results[timestep], at, row.method), at, regions)
            for mesh, found in based.items():
                for blend, image in found.colours.items():
                    add(f"image-based, {mesh}, {blend}", to_8_bit(image), at, regions)
    return {
        row: {region: _rounded(errors.figures()) for region, errors in found.items()} for row, found in tallies.items()
    }


def best_blend(figures: Mapping[str, Any], mesh: str, region: str = "skin") -> str:
    """The blend of image-based rendering with the highest PSNR on a mesh; nothing where there is none."""
    known = [b for b in BLENDS if region in figures.get(f"image-based, {mesh}, {b}", {})]
    return max(known, key=lambda b: figures[f"image-based, {mesh}, {b}"][region]["psnr"], default="")


def judge_relit(
    case: Case, capture: Capture, rows: Mapping[str, Row], integrators: Sequence[str], samples: int, lights: int
) -> dict[str, dict[str, float]]:
    """PSNR (dB) of relit views against path-traced ones, one factor per channel, per row, integrator and light.

    Only rows ``full`` and ``refit`` are path traced.
    """
    timestep = capture.timesteps[0]
    at = view(capture, case.held_out[0], timestep)
    found: dict[str, dict[str, float]] = {}
    for name, truth in list(relit_truths(capture).items())[:lights]:
        environment = truth.environment or SHARED / "hdri" / f"{name}.hdr"
        if not environment.exists():
            continue
        for label, row in rows.items():
            if timestep not in row.results:
                continue
            try:
                lit = row.results[timestep].relight(str(environment))
            except InputError:
                if label.startswith("paper"):  # its light may be darker than none, and has no level to keep then
                    continue
                raise
            for integrator in integrators if label in ("full", "refit") else ("local",):
                count = samples if integrator == "path" else None
                image = lit.render(at.camera, timestep, row.method, integrator, count)  # type: ignore[arg-type]
                value = scaled_psnr(image[..., :3], truth.image[at.box], at.relit)
                found.setdefault(f"{label}, {integrator}", {})[name] = round(value, 2)
    for figures in found.values():
        figures["mean"] = round(float(np.mean(list(figures.values()))), 2)
    return found


def judge_mesh(case: Case, capture: Capture, row: Row) -> dict[str, float]:
    """Distances (mm) from the scan's points that all fitted views see to the fitted mesh, without any alignment."""
    found = []
    for timestep in case.timesteps:
        scan, result = scan_of(case, capture, timestep), row.results[timestep]
        assert scan is not None
        points = points_seen(scan, capture, case.fitted, timestep)
        vertices = result.geometry.vertices[result.index(timestep)]
        found.append(nearest_points(points.position, vertices, result.model.faces)[0])
    return _rounded(distance_figures(np.concatenate(found) * capture.unit_mm), 3)


def judge_surface(case: Case, capture: Capture, row: Row) -> dict[str, float]:
    """Normals, albedo and specular map at the scan's points that all fitted views see, each at the nearest point of
    the fitted mesh.

    Normals are compared with the scan's smooth ones (mean angle in degrees); the diffuse albedo after one scale per
    channel (RMSE, and PSNR of reflectance 0..1) and as it is (``albedo_psnr_unscaled``); the specular map by its
    correlation with the true lobe's weight.
    """
    angles: dict[str, list[float]] = {"normal_degrees": [], "normal_degrees_stage1": []}
    albedo, specular = [], []
    maps, layout = scan_maps(capture)
    for timestep in case.timesteps:
        scan, result = scan_of(case, capture, timestep), row.results[timestep]
        assert scan is not None
        points, i = points_seen(scan, capture, case.fitted, timestep), result.index(timestep)
        vertices, faces = result.geometry.vertices[i], result.model.faces
        _, face, weights = nearest_points(points.position, vertices, faces)
        inside = result.model.face_mask[face]
        smooth = normalize(interpolate(vertex_normals(vertices, faces), faces, face, weights))
        uv = interpolate(result.model.uv, result.model.faces_uv, face, weights)
        angles["normal_degrees_stage1"].append(angle(smooth[inside], points.normal[inside]))
        refined = result.refined_normal(timestep)
        if refined is not None:
            bent = sample_map(refined, uv)
            known = np.linalg.norm(bent, axis=1) > 0.5
            bent = np.where(known[:, None], normalize(bent) @ result.geometry.rotation[i].T, smooth)
            angles["normal_degrees"].append(angle(bent[inside], points.normal[inside]))
        if result.reflectance is not None and layout is not None and len(layout) == len(scan.vertices):
            at = _scan_uv(scan, layout, points)[inside]
            albedo.append((sample_map(result.reflectance.diffuse, uv)[inside], sample_map(maps["albedo"], at)))
            specular.append((sample_map(result.reflectance.specular, uv)[inside], sample_map(maps["specular"], at)))
    found = {key: round(float(np.mean(values)), 2) for key, values in angles.items() if values}
    if albedo:
        estimate, true = (np.concatenate(part).astype(np.float64) for part in zip(*albedo, strict=True))
        scale = (estimate * true).sum(0) / np.maximum((estimate**2).sum(0), 1e-12)
        errors = [float(np.sqrt(np.mean((factor * estimate - true) ** 2))) for factor in (scale, 1.0)]
        found["albedo_rmse"] = round(errors[0], 4)
        found["albedo_psnr"], found["albedo_psnr_unscaled"] = (round(psnr_from_rmse(e, 1.0), 2) for e in errors)
        estimate, true = (np.concatenate(part).astype(np.float64) for part in zip(*specular, strict=True))
        flat = np.ptp(estimate) == 0
        found["specular_correlation"] = 0.0 if flat else round(float(np.corrcoef(estimate, true)[0, 1]), 3)
    return found


def scan_maps(capture: Capture) -> tuple[dict[str, NDArray], NDArray | None]:
    """Albedo and specular map of a scan, and its texture coordinates per vertex; empty and None without them."""
    folder = Path(capture.path) / "truth"
    meshes = sorted(folder.glob("*.ply"))
    if not (folder / "maps.npz").exists() or not meshes:
        return {}, None
    with np.load(folder / "maps.npz") as stored:
        maps = {key: stored[key].astype(np.float32) for key in ("albedo", "specular")}
    stored_mesh: Any = trimesh.load(meshes[0], process=False)
    uv = getattr(stored_mesh.visual, "uv", None)
    source = SHARED / "models" / "lee_perry_smith" / "LeePerrySmith.glb"
    if uv is None and source.exists():
        scene: Any = trimesh.load(source, process=False)
        head = next(iter(scene.geometry.values()))
        # The file's v counts from the bottom, unlike glTF's, whose v is turned when it is read.
        uv = head.visual.uv * (1, -1) + (0, 1)
    return maps, None if uv is None else np.asarray(uv)


def _scan_uv(scan: TrueMesh, layout: NDArray, points: MeshPoints) -> NDArray:
    return interpolate(layout, scan.faces, points.face, points.barycentric)


def _rounded(figures: Mapping[str, float], digits: int = 4) -> dict[str, float]:
    return {key: value if isinstance(value, int) else round(value, digits) for key, value in figures.items()}
