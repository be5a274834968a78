"""A writer of COLMAP text models, for cameras that are known."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.core.camera import Camera

Photos = Iterable[tuple[Camera, str]]
"""Cameras with the names of their photographs."""


def numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(list(values)))


def write_colmap(folder: str | Path, cameras: Photos) -> Path:
    """Write a text model of cameras with the names of their images; one COLMAP camera per image."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics, poses = [], []
    for i, (camera, name) in enumerate(cameras, start=1):
        model = "FULL_OPENCV" if len(camera.distortion) > 4 else "OPENCV" if any(camera.distortion) else "PINHOLE"
        lens = {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[model]
        coefficients = (*camera.distortion, *(0.0,) * 8)[:lens]
        parameters = (camera.fx, camera.fy, camera.cx, camera.cy, *coefficients)
        intrinsics.append(f"{i} {model} {camera.width} {camera.height} {numbers(parameters)}")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        poses.append(f"{i} {numbers((w, x, y, z, *camera.translation))} {i} {name}\n")
    first = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    (folder / "cameras.txt").write_text("\n".join([first, *intrinsics]) + "\n")
    header = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    (folder / "images.txt").write_text(header + "\n".join(poses) + "\n")
    (folder / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")
    return folder
