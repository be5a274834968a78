"""``import_colmap``: photographs with the cameras of a COLMAP text model -> a capture folder.

COLMAP's pixels are ours (the first centre at 0.5, 0.5), its camera axes OpenCV's, its poses world to camera. Other
programs write its files too: Metashape and RealityScan among them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.capture.importer import Material, Selection, import_material, length_unit, match_views, sources_of
from mifit.capture.sources import ImageFiles
from mifit.capture.transforms import View
from mifit.core.camera import rigid
from mifit.core.files import read_text
from mifit.core.image import SUFFIXES
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_NUMBER, MAX_PIXELS
from mifit.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Unpack

_MODELS = {  # where fx, fy, cx, cy and OpenCV's distortion coefficients are among the parameters
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3,)),
    "RADIAL": ((0, 0, 1, 2), (3, 4)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8, 9, 10, 11)),
}


@dataclass(frozen=True)
class Photo:
    """One registered photograph: its name where it was registered (it may have folders) and its camera."""

    name: str
    view: View


def view_name(photo_name: str) -> str:
    """Camera name of a photograph: its innermost folder, or its stem."""
    path = PurePosixPath(photo_name.replace("\\", "/"))
    return path.parent.name or path.stem


def import_colmap(
    model: str | Path,
    out: str | Path,
    videos: Sequence[str | Path] = (),
    images: Sequence[str | Path] = (),
    photos: str | Path | None = None,
    units: str | None = None,
    **options: Unpack[Selection],
) -> Path:
    """Make a capture folder from the cameras of a COLMAP model; else as `mifit.capture.import_capture`.

    ``model`` is the folder with ``cameras.txt`` and ``images.txt``; ``photos`` that of the photographs, by default the
    model's, or one of the three above it. ``videos`` and ``images`` are pixels in their place, for cameras of these
    names.
    """
    model = Path(model)

    def gather() -> Material:
        unit, sources, found = length_unit(units), sources_of(videos, images), read_colmap(model)
        if sources:
            views = match_views(sources, [photo.view for photo in found], str(model))
            return Material(sources, views, {}, unit)
        folders = (model, *model.absolute().parents[:3]) if photos is None else (Path(photos),)
        cameras = group_photos(found)
        files = [ImageFiles.of(name, [find_photo(p.name, folders) for p in group]) for name, group in cameras.items()]
        views = match_views(files, [group[0].view for group in cameras.values()], str(model))
        return Material(files, views, {}, unit)

    return import_material(out, gather, **options)


def read_colmap(folder: str | Path) -> tuple[Photo, ...]:
    """Read a text model.

    Each view is named after the image: its folder (``left/0000.png`` -> ``left``), or its stem when it has none.
    InputError for a missing or malformed file, an unknown camera model, or a pose that isn't one.
    """
    folder = Path(folder)
    cameras: dict[str, View] = {}
    for where, words in _lines(folder / "cameras.txt"):
        if len(words) < 5:
            raise InputError(f"{where}: found {len(words)} fields, expected CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS")
        cameras[words[0]] = _camera(where, words[0], words[1], words[2:])
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
        matrix = rigid(Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix(), pose[4:])
        photos.append(Photo(name, dataclasses.replace(cameras[key], name=view_name(name), world_to_camera=matrix)))
    if not photos:
        raise InputError(f"{folder / 'images.txt'}: found no image with a pose, expected at least one")
    return tuple(photos)


def _camera(where: str, key: str, model: str, words: list[str]) -> View:
    """The view of one camera entry, still without a pose: its width, height and parameters."""
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
    return View(key, int(width), int(height), (fx, fy, cx, cy), distortion if any(distortion) else ())


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


def find_photo(name: str, folders: Sequence[Path]) -> Path:
    """The file of a photograph, in one of the folders or its ``images``; its name may lack the suffix.

    InputError where there is none.
    """
    relative = PurePosixPath(name.replace("\\", "/"))
    last = PurePosixPath(relative.name)
    # a registration may name folders of another machine: then the name alone counts
    choices = [last] if relative.is_absolute() or ".." in relative.parts or ":" in name else [relative, last]
    for base in (place for folder in folders for place in (folder, folder / "images")):
        for choice in dict.fromkeys(choices):
            file = base / choice
            if file.is_file():
                return file
            if choice.suffix.lower() not in SUFFIXES:
                beside = (file.with_name(choice.name + end) for s in SUFFIXES for end in (s, s.upper()))
                if (found := next((path for path in beside if path.is_file()), None)) is not None:
                    return found
    raise InputError(
        f"{folders[0] / relative}: no such image; expected it there or in 'images', or --photos and its folder"
    )


def parse_numbers(words: Sequence[str], count: int, where: str) -> NDArray[np.float64]:
    """As many numbers as a text must have; InputError for others, NaN and numbers beyond `MAX_NUMBER`."""
    try:
        values = np.array([float(word) for word in words[: count + 1]])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) <= MAX_NUMBER).all():
        text = " ".join(words)
        found = repr(text if len(text) < 60 else text[:57] + "...")
        raise InputError(f"{where}: found {found}, expected {count} finite numbers")
    return values


def group_photos(photos: Iterable[Photo]) -> dict[str, list[Photo]]:
    """Photographs by camera, each in the order of the names.

    Photographs of one folder with one pose are the timesteps of one camera, called after the folder. Where poses differ
    a camera has moved about a still head: each photograph is a camera of its own, called after its file. InputError for
    two photographs that would have one name.
    """
    folders: dict[str, list[Photo]] = {}
    for photo in photos:
        folders.setdefault(view_name(photo.name), []).append(photo)
    cameras: dict[str, list[Photo]] = {}
    for folder, inside in folders.items():
        first = inside[0].view
        fixed = all(_same(first, photo.view) for photo in inside)
        for photo in sorted(inside, key=lambda photo: photo.name):
            name = folder if fixed else PurePosixPath(photo.name.replace("\\", "/")).stem
            if name in cameras and not (fixed and cameras[name][0].view.name == folder):
                raise InputError(
                    f"photograph {photo.name!r}: another one is called {name!r} too, expected different names"
                )
            cameras.setdefault(name, []).append(Photo(photo.name, dataclasses.replace(photo.view, name=name)))
    return cameras


def _same(a: View, b: View) -> bool:
    pairs = (a.world_to_camera, b.world_to_camera), (a.intrinsics, b.intrinsics)
    return all(x is not None and y is not None and np.allclose(x, y, rtol=1e-6, atol=1e-6) for x, y in pairs)
