"""Cameras that RealityCapture (RealityScan) exports as XMP files beside the photographs.

"XMP camera math" of its help: rotation from the world to OpenCV's camera axes, row by row, and the camera's
position; focal length for a 36 mm wide film, principal point as a part of the image's longer side from its centre.
Lenses are Brown's, tangential terms in his order.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.capture.opencv_nodes import parse_xml
from mifit.capture.transforms import View, nearest_rotation
from mifit.core.files import read_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError
from mifit.extras.photos import Photo, local, opencv_lens, parse_numbers, view_name

MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"

Size = Callable[[str], tuple[int, int]]


def read_realitycapture(path: str | Path, size: Size) -> tuple[Photo, ...]:
    """Read a folder of XMP files.

    Parameters
    ----------
    path : path
        A folder with an ``.xmp`` file per photograph.
    size : callable
        Width and height in pixels of a photograph by its name, which may lack its suffix: the exports don't tell.

    Raises
    ------
    InputError
        A missing or malformed file, a lens that OpenCV's model lacks, or a pose that isn't one.
    """
    path = Path(path)
    files = sorted(p for p in path.iterdir() if p.suffix.lower() == ".xmp") if path.is_dir() else []
    if not files:
        raise InputError(f"{path}: found no .xmp file, expected a folder with one for each photograph; export XMP")
    return local([photo for file in files if (photo := _xmp(file, size)) is not None], str(path))


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
    (length,), (aspect,), (skew,) = (
        numbers(name, 1, default) for name, default in (("FocalLength35mm", ""), ("AspectRatio", "1"), ("Skew", "0"))
    )
    (u,), (v,) = (numbers(f"PrincipalPoint{axis}", 1, "0") for axis in "UV")
    radial = numbers("DistortionCoeficients", 6, "0 0 0 0 0 0")  # their spelling
    if model == "perspective":
        radial = np.zeros(6)
    if not (length > 0 and aspect > 0):
        raise InputError(f"{path}: found focal length {length:g} and aspect ratio {aspect:g}, expected positive ones")
    width, height = size(path.stem)
    longer = max(width, height)
    fx = length / 36.0 * longer  # of a film 36 mm wide
    k1, k2, k3, k4, t1, t2 = map(float, radial)
    distortion = opencv_lens(
        str(path), (width, height), fx, (k1, k2, k3, k4), (t2, t1), {"the skew": 0.5 * abs(skew) * height * aspect}
    )
    intrinsics = fx, fx * aspect, 0.5 * width + u * longer, 0.5 * height + v * longer
    return Photo(path.stem, View(view_name(path.stem), width, height, intrinsics, distortion, pose))
