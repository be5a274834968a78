"""Photographs with known cameras, as photogrammetry programs give them: found on disk, named, made into cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from mifit.capture.transforms import View
from mifit.core.image import SUFFIXES, load_image
from mifit.errors import InputError

MAX_SHIFT = 0.05
"""Pixels that a term which OpenCV's lens model lacks may move a point of the image before it is refused."""
MAX_NUMBER = 1e30
"""No pose and no lens has numbers beyond it; their squares are numbers still."""


@dataclass(frozen=True)
class Photo:
    """One registered photograph: its name where it was registered (it may have folders) and its camera."""

    name: str
    view: View


def view_name(photo_name: str) -> str:
    """Camera name of a photograph: its innermost folder, or its stem."""
    path = PurePosixPath(photo_name.replace("\\", "/"))
    return path.parent.name or path.stem


@dataclass(frozen=True)
class PhotoFolders:
    """Where photographs are looked for by their names: in each folder and its ``images``."""

    folders: tuple[Path, ...]

    @classmethod
    def of(cls, registration: Path, photos: str | Path | None) -> PhotoFolders:
        """``photos`` where it is given, else the place of a registration and the three folders above it."""
        if photos is not None:
            return cls((Path(photos),))
        folder = registration if registration.is_dir() else registration.parent
        return cls((folder, *folder.absolute().parents[:3]))

    def find(self, name: str) -> Path:
        """The file of a photograph; its name may lack the suffix.

        Raises
        ------
        InputError
            There is none.
        """
        relative = PurePosixPath(name.replace("\\", "/"))
        last = PurePosixPath(relative.name)
        # a registration may name folders of another machine: then the name alone counts
        choices = [last] if relative.is_absolute() or ".." in relative.parts or ":" in name else [relative, last]
        for base in (place for folder in self.folders for place in (folder, folder / "images")):
            for choice in dict.fromkeys(choices):
                file = base / choice
                if file.is_file():
                    return file
                if choice.suffix.lower() not in SUFFIXES:
                    beside = (file.with_name(choice.name + end) for s in SUFFIXES for end in (s, s.upper()))
                    if (found := next((path for path in beside if path.is_file()), None)) is not None:
                        return found
        raise InputError(
            f"{self.folders[0] / relative}: no such image; expected it there or in 'images', or --photos and its folder"
        )

    def size(self, name: str) -> tuple[int, int]:
        """(width, height) of a photograph in pixels."""
        height, width = load_image(self.find(name)).pixels.shape[:2]
        return width, height


def parse_numbers(words: Sequence[str], count: int, where: str) -> NDArray[np.float64]:
    """As many numbers as a text must have; InputError for others, NaN and numbers beyond `MAX_NUMBER`."""
    try:
        values = np.array([float(word) for word in words[: count + 1]])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) < MAX_NUMBER).all():
        text = " ".join(words)
        found = repr(text if len(text) < 60 else text[:57] + "...")
        raise InputError(f"{where}: found {found}, expected {count} finite numbers")
    return values


def opencv_lens(
    where: str,
    view: tuple[int, int],
    focal: float,
    radial: Sequence[float],
    tangential: tuple[float, float],
    other: dict[str, float],
) -> tuple[float, ...]:
    """OpenCV's ``(k1, k2, p1, p2[, k3])`` of Brown's model.

    Parameters
    ----------
    where : str
        For messages.
    view : (width, height)
        Pixels.
    focal : float
        Pixels.
    radial : sequence of float
        Coefficients of r^2, r^4, r^6 and, where there is one, r^8, which OpenCV lacks.
    tangential : (float, float)
        OpenCV's p1 and p2. Brown's own P1 and P2 (Metashape, RealityCapture) are the other way round.
    other : dict
        Further terms that OpenCV lacks, by name: pixels that each moves a point at most.

    Raises
    ------
    InputError
        A term that OpenCV lacks moves points by more than `MAX_SHIFT`.
    """
    corner = 0.5 * float(np.hypot(*view)) / focal
    lacking = dict(other)
    if len(radial) > 3:
        lacking["k4"] = abs(radial[3]) * corner**9 * focal
    for name, shift in lacking.items():
        if not shift <= MAX_SHIFT:
            raise InputError(
                f"{where}: {name} moves points by up to {shift:.3g} pixels, expected at most {MAX_SHIFT}, since "
                "OpenCV's lens model lacks it; adjust the cameras without it, or export undistorted images"
            )
    k1, k2, k3 = (*radial[:3], 0.0, 0.0, 0.0)[:3]
    values = (k1, k2, *tangential, k3)
    return values[: 5 if k3 else 4] if any(values) else ()


def local(photos: Sequence[Photo], where: str) -> tuple[Photo, ...]:
    """The photographs, once it is clear that their coordinates are local ones and not those of the Earth.

    Those of the Earth lie 1e5 from the origin and more, and 1e4 times as far as the cameras from one another.

    Raises
    ------
    InputError
        No photograph, or cameras so far from the origin that single precision loses the head.
    """
    if not photos:
        raise InputError(f"{where}: found no image with a pose, expected at least one; align the cameras first")
    poses = [photo.view.world_to_camera for photo in photos]
    places = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses if pose is not None])
    distance = float(np.linalg.norm(places, axis=1).max())
    spread = float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())
    if distance > max(1e5, 1e4 * spread):
        raise InputError(
            f"{where}: found cameras {distance:.4g} from the origin and {spread:.4g} around their middle, expected "
            "local coordinates; export them without a geographic coordinate system"
        )
    return tuple(photos)


def group_photos(photos: Iterable[Photo]) -> dict[str, list[Photo]]:
    """Photographs by camera, each in the order of the names.

    Photographs of one folder with one pose are the timesteps of one camera, called after the folder. Where poses differ
    a camera has moved about a still head: each photograph is a camera of its own, called after its file.

    Raises
    ------
    InputError
        Two photographs that would have one name.
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
