"""A scanned head as truth: its mesh, its maps, the points of it that the fitted views see, and distances to it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.record import SHARED
from mifit import Capture
from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.render.gbuffer import SurfaceScene

SHRINK = 4
"""Pixels by which the hull of the landmarks shrinks."""
SAMPLES, KEPT = 60000, 8000
"""Points drawn on the scan, and those kept of the ones that all fitted views see."""
LEAST_COSINE = 0.25
NEAREST = 24
"""Faces with the nearest middles, among which the nearest point of a mesh is looked for."""
EYES_AND_MOUTH = ((36, 42, 1.6), (42, 48, 1.6), (60, 68, 1.2))
"""iBUG landmarks of what is no skin, and the factor by which their hull grows."""


def landmarks(capture: Capture, camera: str, timestep: int) -> NDArray[np.float32]:
    """The landmarks of one image, without reading the image."""
    found = capture.landmarks(camera, timestep)
    if found is None:
        raise ValueError(f"{capture.path}: camera {camera}, timestep {timestep}: no landmarks to find the face by")
    return found.points.astype(np.float32)


def _fill(shape: tuple[int, int], points: NDArray) -> NDArray[np.uint8]:
    area = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(area, cv2.convexHull(points.astype(np.float32)).astype(np.int32), 1)
    return area


def _grown(points: NDArray, factor: float) -> NDArray:
    middle = points.mean(0)
    return middle + factor * (points - middle)


def face_region(points: NDArray, camera: Camera) -> NDArray[np.bool_]:
    """(H, W) hull of the landmarks, eroded."""
    side = 2 * SHRINK + 1
    return cv2.erode(_fill((camera.height, camera.width), points), np.ones((side, side), np.uint8)) > 0


def skin_region(points: NDArray, camera: Camera) -> NDArray[np.bool_]:
    """The face without eyes and inner mouth."""
    shape = (camera.height, camera.width)
    holes = np.zeros(shape, np.uint8)
    for first, last, factor in EYES_AND_MOUTH:
        holes |= _fill(shape, _grown(points[first:last], factor))
    side = 2 * int(0.012 * np.ptp(points[:, 0])) + 1
    return face_region(points, camera) & (cv2.dilate(holes, np.ones((side, side), np.uint8)) == 0)


def relit_region(points: NDArray, camera: Camera) -> NDArray[np.bool_]:
    """The face without a wider surrounding of eyes and mouth, where relit views are compared."""
    region = face_region(points, camera)
    for first, last, _ in EYES_AND_MOUTH:
        region &= _fill(region.shape, _grown(points[first:last], 2.0)) == 0
    return region


@dataclass(frozen=True)
class Scan:
    """The true mesh of one timestep, world space, and what is known of its skin.

    Attributes
    ----------
    vertices : (V, 3), faces : (F, 3)
    uv : (V, 2) or None
        Row 0 of a map is at v = 1.
    maps : dict of (S, S, ...) float32
        ``albedo`` (linear), ``specular``, ``roughness``; empty where the truth has none.
    """

    vertices: NDArray
    faces: NDArray
    uv: NDArray | None
    maps: dict[str, NDArray]


def read_scan(capture: Capture, timestep: int) -> Scan | None:
    """The capture's scan at a timestep, or None where its truth is no scan.

    ``truth/TTTT.ply`` or, for a head that doesn't move, ``truth/head.ply``; texture coordinates from the mesh itself,
    ``truth/mesh.npz``, or the shared scan that the capture was made of.
    """
    folder = Path(capture.path) / "truth"
    path = next((p for p in (folder / f"{timestep:04d}.ply", folder / "head.ply") if p.exists()), None)
    if path is None:
        return None
    mesh = trimesh.load(path, process=False)
    maps = {}
    if (folder / "maps.npz").exists():
        with np.load(folder / "maps.npz") as stored:
            maps = {key: stored[key].astype(np.float32) for key in stored}
    uv = getattr(mesh.visual, "uv", None)
    source = SHARED / "models" / "lee_perry_smith" / "LeePerrySmith.glb"
    if uv is None and maps and source.exists():
        head = next(iter(trimesh.load(source, process=False).geometry.values()))
        # The file's v counts from the bottom, unlike glTF's, whose v is turned when it is read.
        uv = head.visual.uv * (1, -1) + (0, 1) if len(head.vertices) == len(mesh.vertices) else None
    return Scan(np.asarray(mesh.vertices), np.asarray(mesh.faces), None if uv is None else np.asarray(uv), maps)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a scan: position, smooth unit normal, face and barycentric weights."""

    position: NDArray
    normal: NDArray
    face: NDArray
    weights: NDArray

    def look_up(self, scan: Scan, name: str) -> NDArray:
        """Values of one of the scan's maps at the points."""
        assert scan.uv is not None
        return sample_map(scan.maps[name], interpolate(scan.uv, scan.faces, self.face, self.weights))


def points_seen(scan: Scan, capture: Capture, cameras: Sequence[str], timestep: int, seed: int = 0) -> SurfacePoints:
    """Points of the face, drawn evenly over the scan's surface, that all cameras see not too flat."""
    mesh = trimesh.Trimesh(scan.vertices, scan.faces, process=False)
    position, face = trimesh.sample.sample_surface(mesh, SAMPLES, seed=seed)
    position, keep, scene = np.asarray(position), np.ones(len(face), bool), SurfaceScene(scan.vertices, scan.faces)
    for name in cameras:
        view = capture.camera(name)
        away = normalize(position - view.position)
        pixel = np.clip(view.project(position).astype(int), 0, (view.width - 1, view.height - 1))
        inside = face_region(landmarks(capture, name, timestep), view)[pixel[:, 1], pixel[:, 0]]
        flat = -np.sum(mesh.face_normals[face] * away, axis=1)
        keep &= inside & (flat > LEAST_COSINE) & scene.visible_from(position, view.position)
    position, face = position[keep][:KEPT], face[keep][:KEPT]
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], position)
    normals = vertex_normals(scan.vertices, scan.faces)
    return SurfacePoints(position, normalize(interpolate(normals, scan.faces, face, weights)), face, weights)


def nearest(points: NDArray, vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Distance to the nearest point of a mesh, its face and its barycentric weights, for (N, 3) points."""
    triangles = np.asarray(vertices, np.float64)[faces]
    near = cKDTree(triangles.mean(1)).query(points, NEAREST)[1]
    found = trimesh.triangles.closest_point(triangles[near].reshape(-1, 3, 3), np.repeat(points, NEAREST, 0))
    distance = np.linalg.norm(found.reshape(-1, NEAREST, 3) - points[:, None], axis=2)
    pick = distance.argmin(1)
    face = near[np.arange(len(points)), pick]
    closest = found.reshape(-1, NEAREST, 3)[np.arange(len(points)), pick]
    weights = trimesh.triangles.points_to_barycentric(triangles[face], closest)
    return distance.min(1), face, weights


def relit_truths(capture: Capture) -> dict[str, tuple[Path, Path, float]]:
    """Per environment: the path-traced view under it, the environment's file, and the factor to the capture's units."""
    folder = Path(capture.path) / "truth"
    if not (folder / "meta.json").exists():
        return {}
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    found, own = {}, meta.get("relit_exposure", {})
    for view in sorted(folder.glob("relit_*.exr")):
        name = view.stem[len("relit_") :]
        for place in (folder / f"environment_{name}.exr", SHARED / "hdri" / f"{name}.hdr"):
            if place.exists():
                found[name] = (view, place, float(own.get(name, meta["exposure"])))
                break
    return found
