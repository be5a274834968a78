"""Cameras that RealityCapture (RealityScan) exports: XMP files beside the photographs, or the CSV of camera parameters.

XMP ("XMP camera math" of its help): rotation from the world to OpenCV's camera axes, row by row, and the camera's
position; focal length for a 36 mm wide film, principal point as a part of the image's longer side from its centre.
CSV ("Internal/External camera parameters"): position and heading, pitch and roll in degrees of a camera that looks down
at zero; the principal point is a part of the longer side as well. Lenses are Brown's, tangential terms in his order.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.capture.opencv_nodes import parse_xml
from mifit.capture.transforms import View, invert_pose, nearest_rotation
from mifit.core.camera import OPENGL_FROM_OPENCV
from mifit.core.files import read_text
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_SETTINGS_BYTES
from mifit.errors import InputError
from mifit.extras.photos import Photo, local, opencv_lens, parse_numbers, view_name

MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")

Size = Callable[[str], tuple[int, int]]


def read_realitycapture(path: str | Path, size: Size) -> tuple[Photo, ...]:
    """Read a folder of XMP files, or a CSV file.

    Parameters
    ----------
    path : path
        A folder with an ``.xmp`` file per photograph, or a ``.csv`` file.
    size : callable
        Width and height in pixels of a photograph by its name, which may lack its suffix: the exports don't tell.

    Raises
    ------
    InputError
        A missing or malformed file, a lens that OpenCV's model lacks, or a pose that isn't one.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".xmp")
        if not files:
            raise InputError(f"{path}: found no .xmp file, expected one for each photograph, or name a .csv file")
        found = [photo for file in files if (photo := _xmp(file, size)) is not None]
        return local(found, str(path))
    return local(_csv(path, size), str(path))


def _xmp(path: Path, size: Size) -> Photo | None:
    """The photograph beside an XMP file; None where the file holds no pose."""
    root = parse_xml(read_text(path, MAX_SETTINGS_BYTES, "XMP file"), f"{path}: not a readable XMP file")
    values: dict[str, str] = {}
    for node in root.iter():
        values |= {key.removeprefix(NAMESPACE): text for key, text in node.attrib.items() if key.startswith(NAMESPACE)}
        if node.tag.startswith(NAMESPACE):
            values[node.tag.removeprefix(NAMESPACE)] = node.text or ""
    if "Rotation" not in values or "Position" not in values:
        return None
    model = values.get("DistortionModel", "perspective")
    if model not in MODELS:
        raise InputError(f"{path}: DistortionModel: found {model!r}, expected one of {', '.join(MODELS)}")

    def numbers(name: str, count: int, default: str) -> NDArray[np.float64]:
        return parse_numbers(values.get(name, default).split(), count, f"{path}: {name}")

    rotation = nearest_rotation(numbers("Rotation", 9, "").reshape(3, 3), f"{path}: Rotation")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ numbers("Position", 3, "")
    (focal,), (aspect,), (skew,) = (
        numbers(name, 1, default) for name, default in (("FocalLength35mm", ""), ("AspectRatio", "1"), ("Skew", "0"))
    )
    (u,), (v,) = (numbers(f"PrincipalPoint{axis}", 1, "0") for axis in "UV")
    radial = numbers("DistortionCoeficients", 6, "0 0 0 0 0 0")  # their spelling
    if model == "perspective":
        radial = np.zeros(6)
    return _photo(path.stem, str(path), size, (focal, aspect, skew), (u, v), radial, pose)


def _csv(path: Path, size: Size) -> list[Photo]:
    text = read_text(path, MAX_DOCUMENT_BYTES, "CSV file").lstrip("\ufeff")
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if line.lstrip("# ").lower().startswith("name,")), None)
    header = [] if first is None else [name.strip(" #").lower() for name in lines[first].split(",")]
    missing = [name for name in COLUMNS if name not in header]
    if first is None or missing:
        raise InputError(
            f"{path}: found no column {', '.join(missing or COLUMNS)}, expected RealityCapture's export of "
            "internal and external camera parameters"
        )
    photos = []
    for i, row in enumerate(_rows(lines[first + 1 :], path), start=first + 2):
        if not row or row[0].startswith("#"):
            continue
        where = f"{path}: line {i}"
        if len(row) != len(header):
            raise InputError(f"{where}: found {len(row)} fields, expected {len(header)}")
        entry = dict(zip(header, row, strict=True))
        names = (*COLUMNS[1:], *OPTIONAL)
        values = dict(zip(names, parse_numbers([entry.get(n, "0") for n in names], len(names), where), strict=True))
        turn = Rotation.from_euler("ZXY", (-values["heading"], values["pitch"], values["roll"]), degrees=True)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.as_matrix(), (values["x"], values["y"], values["alt"])
        pose = invert_pose(pose @ OPENGL_FROM_OPENCV, where)
        centre = values["px"], values["py"]
        brown = np.array([values[name] for name in OPTIONAL[2:]])
        photos.append(_photo(entry["name"].strip(), where, size, (values["f"], 1.0, 0.0), centre, brown, pose))
    return photos


def _photo(
    name: str,
    where: str,
    size: Size,
    focal: tuple[float, float, float],
    centre: tuple[float, float],
    brown: NDArray[np.float64],
    pose: NDArray[np.float64],
) -> Photo:
    """A photograph of focal length, aspect ratio and skew; principal point; k1 ... k4, t1, t2."""
    length, aspect, skew = focal
    if not (length > 0 and aspect > 0):
        raise InputError(f"{where}: found focal length {length:g} and aspect ratio {aspect:g}, expected positive ones")
    width, height = size(name)
    longer = max(width, height)
    fx = length / 36.0 * longer  # of a film 36 mm wide
    k1, k2, k3, k4, t1, t2 = map(float, brown)
    distortion = opencv_lens(
        where, (width, height), fx, (k1, k2, k3, k4), (t2, t1), {"the skew": 0.5 * abs(skew) * height * aspect}
    )
    intrinsics = fx, fx * aspect, 0.5 * width + centre[0] * longer, 0.5 * height + centre[1] * longer
    return Photo(name, View(view_name(name), width, height, intrinsics, distortion, pose))


def _rows(lines: list[str], path: Path) -> list[list[str]]:
    """The lines' fields; InputError where Python's reader gives up (Python 3.10 at a NUL)."""
    try:
        return list(csv.reader(lines))
    except csv.Error as error:
        raise InputError(f"{path}: not a readable table ({error})") from None
