"""OpenCV stereo calibrations: YAML with M1, D1, M2, D2, R, T, as OpenCV's stereo sample writes them.

A point ``x`` in the first camera's frame is ``R x + T`` in the second's. OpenCV puts the first pixel's centre at
(0, 0); principal points move by half a pixel on the way in and out. World space is chosen as the first camera's
frame with OpenGL axes (y up, the subject looking along +z). Files are read without OpenCV, whose own reader ends the
process on some damaged ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from mifit.capture.lens import opencv_matrix
from mifit.capture.transforms import View, nearest_rotation
from mifit.core.camera import OPENGL_FROM_OPENCV, Camera, rigid
from mifit.core.files import read_text, replacing
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

_MATRICES = (("M1", "K1", "cameraMatrix1"), ("M2", "K2", "cameraMatrix2"))
_DISTORTIONS = (("D1", "distCoeffs1"), ("D2", "distCoeffs2"))
_Loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""Builds text, lists and maps and nothing else, whatever the tags say; numbers are made of the text here."""

Nodes = dict[str, NDArray[np.float64] | float]


def read_stereo(path: str | Path, names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> tuple[View, View]:
    """Read the calibration of a pair of cameras from YAML, with their names and (width, height) of their images.

    Without ``R`` and ``T`` in the file, ``extrinsics`` of the same suffix beside it is read too. InputError for a
    missing key, a matrix of another shape, a rotation that isn't one, or another image size in the file.
    """
    path = Path(path)
    found = read_nodes(path)
    beside = path.with_name("extrinsics" + path.suffix)
    if "R" not in found and beside != path and beside.exists():
        found = {**read_nodes(beside), **found}
    _check_size(found, sizes, path)
    rotation = nearest_rotation(_matrix(found, ("R",), path, (3, 3)), f"{path}: R")
    translation = _matrix(found, ("T",), path, (3, 1)).ravel()
    views = []
    for i, pose in enumerate((np.eye(4), rigid(rotation, translation))):
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


def read_nodes(path: Path) -> Nodes:
    """Matrices and numbers at the top level of an OpenCV YAML file by name; strings, lists and maps are left out.

    InputError where the file is missing or no YAML of OpenCV's, or a matrix holds another number of values than it
    says.
    """
    text = read_text(path, MAX_SETTINGS_BYTES, "calibration file").lstrip("\ufeff \r\n\t")
    if not text.startswith("%YAML"):
        raise _unreadable(path, f"it starts with {text[:12]!r}, expected %YAML")
    text = re.sub(r"\A%YAML[: ]1\.\d", "%YAML 1.1", text)  # OpenCV 4 writes %YAML:1.0, 5 writes %YAML 1.2
    try:
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > 16:  # OpenCV's matrices are two deep
                raise _unreadable(path, "nested more than 16 deep")
            if isinstance(event, yaml.AliasEvent):
                raise _unreadable(path, "an alias, which OpenCV never writes")
        documents = list(yaml.load_all(text, Loader=_Loader))  # OpenCV appends as another document
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise _unreadable(path, str(error)) from None
    found: Nodes = {}
    for document in documents:
        for name, value in document.items() if isinstance(document, dict) else ():
            if isinstance(value, dict) and isinstance(value.get("data"), list):
                found[str(name)] = _node_matrix(value, f"{path}: {name}")
            elif (number := _number(str(value))) is not None:
                found[str(name)] = number
    if not found:
        raise _unreadable(path, "no matrix and no number found")
    return found


def _node_matrix(node: dict, where: str) -> NDArray[np.float64]:
    rows, columns, kind = (str(node.get(key, "")) for key in ("rows", "cols", "dt"))
    values = [_number(str(word)) for word in node["data"]]
    shaped = rows.isdecimal() and columns.isdecimal() and len(rows + columns) < 10
    if not shaped or int(rows) * int(columns) != len(values) or None in values or len(kind.strip('"')) > 1:
        raise InputError(
            f"{where}: found {len(values)} values for {rows or '?'} x {columns or '?'} of type {kind or '?'}, expected "
            "a matrix of single numbers, as many as rows times cols"
        )
    return np.array(values, dtype=np.float64).reshape(int(rows), int(columns))


def _number(text: str) -> float | None:
    """A number as OpenCV writes it (infinities are ``.Inf``, the other one ``.Nan``), or None."""
    word = text.strip()
    if word.lstrip("+-").lower() in (".inf", ".nan"):
        word = word.replace(".", "", 1)
    try:
        return float(word)
    except ValueError:
        return None


def _unreadable(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: not a readable OpenCV YAML file ({' '.join(reason.split())[-80:]})")
