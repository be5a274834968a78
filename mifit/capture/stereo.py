"""OpenCV stereo calibrations: YAML or XML with M1, D1, M2, D2, R, T, as OpenCV's stereo sample writes them.

A point ``x`` in the first camera's frame is ``R x + T`` in the second's. OpenCV puts the first pixel's centre at
(0, 0); principal points move by half a pixel on the way in and out. World space is chosen as the first camera's
frame with OpenGL axes (y up, the subject looking along +z).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.lens import opencv_matrix
from mifit.capture.opencv_nodes import Nodes, read_nodes
from mifit.capture.transforms import View, nearest_rotation
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera
from mifit.core.files import replacing
from mifit.errors import InputError

_MATRICES = (("M1", "K1", "cameraMatrix1"), ("M2", "K2", "cameraMatrix2"))
_DISTORTIONS = (("D1", "distCoeffs1"), ("D2", "distCoeffs2"))


def read_stereo(path: str | Path, names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> tuple[View, View]:
    """Read the calibration of a pair of cameras.

    Parameters
    ----------
    path : path
        YAML or XML file. Without ``R`` and ``T`` in it, ``extrinsics`` of the same suffix beside it is read too.
    names : two str
        Names of the first and the second camera.
    sizes : two (width, height)
        Sizes of their images.

    Raises
    ------
    InputError
        A missing key, a matrix of another shape, a rotation that isn't one, or another image size in the file.
    """
    path = Path(path)
    found = read_nodes(path)
    beside = path.with_name("extrinsics" + path.suffix)
    if "R" not in found and beside != path and beside.exists():
        found = {**read_nodes(beside), **found}
    _check_size(found, sizes, path)
    rotation = nearest_rotation(_matrix(found, ("R",), path, (3, 3)), f"{path}: R")
    translation = _matrix(found, ("T",), path, (3, 1)).ravel()
    second = np.eye(4)
    second[:3, :3], second[:3, 3] = rotation, translation
    views = []
    for i, pose in enumerate((np.eye(4), second)):
        matrix = _matrix(found, _MATRICES[i], path, (3, 3))
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
        if not (fx > 0 and fy > 0):
            raise InputError(f"{path}: {_MATRICES[i][0]}: found focal lengths {fx:g}, {fy:g}, expected positive ones")
        views.append(
            View(
                names[i],
                *sizes[i],
                intrinsics=(float(fx), float(fy), float(cx), float(cy)),
                distortion=_distortion(found, _DISTORTIONS[i], path),
                world_to_camera=pose @ OPENGL_FROM_OPENCV,
            )
        )
    return views[0], views[1]


def write_stereo(path: str | Path, first: Camera, second: Camera) -> None:
    """Write two cameras in the layout that `read_stereo` reads; the world frame itself is not kept."""
    relative = second.world_to_camera @ np.linalg.inv(first.world_to_camera)
    with replacing(path) as temporary:
        file = cv2.FileStorage(str(temporary), cv2.FILE_STORAGE_WRITE)
        for i, camera in ((1, first), (2, second)):
            file.write(f"M{i}", opencv_matrix(camera))
            file.write(f"D{i}", np.array([camera.distortion or (0.0,) * 5], dtype=np.float64))
        file.write("R", np.ascontiguousarray(relative[:3, :3]))
        file.write("T", np.ascontiguousarray(relative[:3, 3:]))
        if (first.width, first.height) == (second.width, second.height):
            file.write("image_width", first.width)
            file.write("image_height", first.height)
        file.release()


def _matrix(found: Nodes, keys: tuple[str, ...], path: Path, shape: tuple[int, int]) -> NDArray[np.float64]:
    for key in keys:
        if found.get(key) is not None:
            matrix = np.asarray(found[key], dtype=np.float64)
            if matrix.shape != shape and not (shape == (3, 1) and matrix.shape == (1, 3)):
                raise InputError(f"{path}: {key}: found a matrix of shape {matrix.shape}, expected {shape}")
            if not np.isfinite(matrix).all():
                raise InputError(f"{path}: {key}: found a NaN or infinite value, expected finite numbers")
            return matrix
    raise InputError(f"{path}: found keys {', '.join(found) or 'none'}, expected {keys[0]} {shape[0]} x {shape[1]}")


def _distortion(found: Nodes, keys: tuple[str, ...], path: Path) -> tuple[float, ...]:
    values = next((found[key] for key in keys if found.get(key) is not None), np.zeros((1, 4)))
    coefficients = np.asarray(values, dtype=np.float64).ravel()
    if len(coefficients) > 8 and not coefficients[8:].any():
        coefficients = coefficients[:8]
    if len(coefficients) not in (4, 5, 8) or not np.isfinite(coefficients).all():
        raise InputError(f"{path}: {keys[0]}: found {len(coefficients)} coefficients, expected 4, 5 or 8 finite ones")
    return tuple(coefficients.tolist()) if coefficients.any() else ()


def _check_size(found: Nodes, sizes: Sequence[tuple[int, int]], path: Path) -> None:
    expected = found.get("image_width"), found.get("image_height")
    for size in sizes:
        if None not in expected and size != expected:
            width, height = (f"{x:g}" if isinstance(x, float) else "a matrix" for x in expected)
            raise InputError(
                f"{path}: calibrated for {width} x {height} pixels, but the images have "
                f"{size[0]} x {size[1]}; calibrate at their size"
            )
