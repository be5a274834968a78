"""COLMAP's text models: ``cameras.txt`` and ``images.txt``.

COLMAP's pixels are ours (the first centre at 0.5, 0.5), its camera axes OpenCV's, its poses world to camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.capture.transforms import View
from mifit.core.files import read_text
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_PIXELS
from mifit.errors import InputError
from mifit.extras.photos import Photo, local, parse_numbers, view_name

_MODELS = {  # where fx, fy, cx, cy and OpenCV's distortion coefficients are among the parameters
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}

_Camera = tuple[int, int, tuple[float, float, float, float], tuple[float, ...]]


def read_colmap(folder: str | Path) -> tuple[Photo, ...]:
    """Read a text model.

    Each view is named after the image: its folder (``left/0000.png`` -> ``left``), or its stem when it has none.

    Raises
    ------
    InputError
        A missing or malformed file, an unknown camera model, or a pose that isn't one.
    """
    folder = Path(folder)
    cameras: dict[str, _Camera] = {}
    for where, words in _lines(folder / "cameras.txt"):
        if len(words) < 5:
            raise InputError(f"{where}: found {len(words)} fields, expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        cameras[words[0]] = _camera(where, words[1], words[2:])
    photos = []
    for where, words in _lines(folder / "images.txt", every=2):
        if len(words) < 10:
            raise InputError(f"{where}: found {len(words)} fields, expected ID, QW QX QY QZ, TX TY TZ, CAMERA_ID, NAME")
        pose, key, name = parse_numbers(words[1:8], 7, where), words[8], " ".join(words[9:])
        if key not in cameras:
            raise InputError(f"{where}: camera {key} is not in cameras.txt")
        length = float(np.linalg.norm(pose[:4]))
        if abs(length - 1.0) > 1e-3:
            raise InputError(f"{where}: found a quaternion of length {length:.4g}, expected 1")
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()
        matrix[:3, 3] = pose[4:]
        columns, rows, intrinsics, distortion = cameras[key]
        photos.append(Photo(name, View(view_name(name), columns, rows, intrinsics, distortion, matrix)))
    return local(photos, str(folder))


def _camera(where: str, model: str, words: list[str]) -> _Camera:
    """Width, height, intrinsics and OpenCV's distortion of one camera entry: width, height and its parameters."""
    if model not in _MODELS:
        raise InputError(f"{where}: found camera model {model!r}, expected one of {', '.join(_MODELS)}")
    pinhole, lens = _MODELS[model]
    count = max(*pinhole, *lens) + 1
    if len(words) != count + 2:
        raise InputError(f"{where}: found {len(words) - 2} parameters, expected {count} of {model}")
    width, height, *parameters = parse_numbers(words, len(words), where).tolist()
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS and width % 1 == height % 1 == 0):
        raise InputError(
            f"{where}: found {width:g} x {height:g} pixels, expected whole numbers of at most "
            f"{MAX_PIXELS // 10**6} megapixels"
        )
    fx, fy, cx, cy = (parameters[i] for i in pinhole)
    if not (min(fx, fy) > 0):
        raise InputError(f"{where}: found focal length {min(fx, fy):g}, expected a positive one")
    distortion = tuple(parameters[i] for i in lens)
    if len(distortion) in (1, 2):
        distortion = (*distortion, 0.0, 0.0, 0.0)[:4]
    return int(width), int(height), (fx, fy, cx, cy), distortion if any(distortion) else ()


def _lines(path: Path, every: int = 1) -> Iterator[tuple[str, list[str]]]:
    """Every N-th line that is no comment, with its place for messages; blank lines count where N > 1."""
    if not path.exists():
        raise InputError(
            f"{path}: no such file; expected a COLMAP text model (cameras.txt, images.txt); of a binary one "
            "`colmap model_converter --output_type TXT` makes one"
        )
    text = read_text(path, MAX_DOCUMENT_BYTES, "text file")
    kept = [(i, line) for i, line in enumerate(text.splitlines(), start=1) if not line.startswith("#")]
    if every == 1:
        kept = [(i, line) for i, line in kept if line.strip()]
    for i, line in kept[::every]:
        if line.strip():
            yield f"{path}: line {i}", line.split()
