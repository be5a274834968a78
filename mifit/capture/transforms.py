"""``transforms.json``: the file of a capture, in nerfstudio's convention.

One entry per image with ``fl_x fl_y cx cy w h k1 k2 p1 p2 [k3 k4 k5 k6]``, a camera-to-world ``transform_matrix``
with OpenGL axes (x right, y up, looking down -z) and, as VHAP writes it, ``camera_id`` and ``timestep_index``. Keys
of the top level serve all frames that lack them. Added here: ``landmark_path``, ``mask_path`` and ``gain`` per frame,
``units`` (``mm``, ``cm``, ``dm``, ``m``) at the top.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import OPENGL_FROM_OPENCV, Camera, inverse, rigid
from mifit.core.files import Document, read_json, write_json
from mifit.core.limits import MAX_DOCUMENT_BYTES, MAX_NUMBER, MAX_PIXELS
from mifit.errors import InputError

UNITS_MM = {"mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0}
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
MIN_SIDE = 16
MASK_KEYS = ("mask_path", "fg_mask_path")
"""Ours and nerfstudio's, VHAP's."""
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's order of distortion coefficients; k4 to k6 are its rational model."""


@dataclass(frozen=True)
class View:
    """What a capture knows of one camera and its images.

    ``intrinsics`` (fx, fy, cx, cy) are in pixels, ``world_to_camera`` (4, 4) has OpenCV axes; None when not calibrated.
    ``distortion`` are OpenCV coefficients, empty when none; ``gain`` (r, g, b) factors on the linear image that bring
    the cameras to one exposure and white balance.
    """

    name: str
    width: int
    height: int
    intrinsics: tuple[float, float, float, float] | None = None
    distortion: tuple[float, ...] = ()
    world_to_camera: NDArray[np.float64] | None = field(default=None, repr=False)
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def calibrated(self) -> bool:
        """Whether intrinsics and pose are known."""
        return self.intrinsics is not None and self.world_to_camera is not None

    def camera(self) -> Camera:
        """The camera of the images as stored, with distortion; only for a calibrated view."""
        assert self.intrinsics is not None and self.world_to_camera is not None
        return Camera(
            self.name, self.width, self.height, *self.intrinsics, self.world_to_camera, distortion=self.distortion
        )

    @classmethod
    def of(cls, camera: Camera) -> View:
        """The view of a known camera."""
        intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
        return cls(camera.name, camera.width, camera.height, intrinsics, camera.distortion, camera.world_to_camera)


@dataclass(frozen=True)
class Shot:
    """One image of a capture: where its files are."""

    camera: str
    timestep: int
    image: Path
    mask: Path | None = None
    landmarks: Path | None = None


@dataclass(frozen=True)
class Transforms:
    """The content of a ``transforms.json``, checked."""

    views: tuple[View, ...]
    shots: tuple[Shot, ...]
    units: str


def read_transforms(path: str | Path, units: str = "cm") -> Transforms:
    """Read and check a ``transforms.json``; file names in it are taken relative to its folder.

    ``units`` is the unit of length of a file that doesn't say its own. InputError names the entry and key, the value
    found and the one expected.
    """
    path = Path(path)
    document = _load(path)
    units = document.get("units", units)
    if not isinstance(units, str) or units not in UNITS_MM:
        raise InputError(f"{path}: units: found {_short(units)}, expected one of {', '.join(UNITS_MM)}")
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: found {_short(frames)}, expected a list of at least one image")
    views: dict[str, View] = {}
    shots: dict[tuple[str, int], Shot] = {}
    for i, frame in enumerate(frames):
        where = f"{path}: frames[{i}]"
        if not isinstance(frame, dict):
            raise InputError(f"{where}: found {_short(frame)}, expected an object")
        entry = _Entry({**{k: v for k, v in document.items() if k != "frames"}, **frame}, where)
        if entry.values.get("camera_model", "OPENCV") not in CAMERA_MODELS:
            raise entry.fail("camera_model", "OPENCV or PINHOLE")
        shot = _shot(entry, path.parent)
        view = _view(entry, shot.camera)
        key = (shot.camera, shot.timestep)
        if key in shots:
            raise InputError(f"{where}: timestep {shot.timestep} of camera {shot.camera!r} is there twice")
        shots[key] = shot
        _check_same_camera(views.setdefault(shot.camera, view), view, where)
    _check_complete(shots, path)
    return Transforms(tuple(views.values()), tuple(shots[key] for key in sorted(shots)), units)


def write_transforms(path: str | Path, views: Iterable[View], shots: Iterable[Shot], units: str) -> None:
    """Write a ``transforms.json``, whole or not at all; shots' paths must lie below its folder."""
    path = Path(path)
    by_name = {view.name: view for view in views}
    frames = []
    for shot in shots:
        view = by_name[shot.camera]
        entry: dict[str, object] = {"file_path": _relative(shot.image, path.parent)}
        if shot.landmarks is not None:
            entry["landmark_path"] = _relative(shot.landmarks, path.parent)
        if shot.mask is not None:
            entry["mask_path"] = _relative(shot.mask, path.parent)
        entry |= {"camera_id": shot.camera, "timestep_index": shot.timestep, "w": view.width, "h": view.height}
        if view.intrinsics is not None:
            entry |= dict(zip(("fl_x", "fl_y", "cx", "cy"), view.intrinsics, strict=True))
            coefficients = (*view.distortion, 0.0, 0.0, 0.0, 0.0)[: max(len(view.distortion), 4)]
            entry |= dict(zip(DISTORTION_KEYS, coefficients, strict=False))
        if view.world_to_camera is not None:
            entry["transform_matrix"] = (inverse(view.world_to_camera) @ OPENGL_FROM_OPENCV).tolist()
        if view.gain != (1.0, 1.0, 1.0):
            entry["gain"] = list(view.gain)
        frames.append(entry)
    document = {"camera_model": "OPENCV", "units": units, "frames": frames}
    write_json(path, document)


def update_frames(path: str | Path, changes: Mapping[tuple[str, int], Mapping[str, object]]) -> None:
    """Set keys of some images' entries in a ``transforms.json``; all else in it stays, keys unknown to mifit too.

    ``changes`` are new values by key, None to take one away, by camera and timestep. The file is replaced whole or not
    at all; InputError where it can't be read.
    """
    path = Path(path)
    document = _load(path)
    common = {k: v for k, v in document.items() if k != "frames"}
    for i, frame in enumerate(document["frames"]):
        shot = _shot(_Entry({**common, **frame}, f"{path}: frames[{i}]"), path.parent)
        for key, value in changes.get((shot.camera, shot.timestep), {}).items():
            if value is None and key not in common:
                frame.pop(key, None)
            else:
                frame[key] = value
    write_json(path, document)


def _relative(file: Path, folder: Path) -> str:
    return file.relative_to(folder).as_posix()


def _load(path: Path) -> Document:
    document = read_json(path, MAX_DOCUMENT_BYTES, "file of a capture")
    if not isinstance(document, dict):
        raise InputError(f"{path}: found {_short(document)}, expected an object with a list 'frames'")
    return document


def _short(value: object) -> str:
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


class _Entry:
    """Checked access to one frame's keys; messages name the frame and the key."""

    def __init__(self, values: Document, where: str):
        self.values, self.where = values, where

    def __contains__(self, key: str) -> bool:
        return self.values.get(key) is not None

    def fail(self, key: str, expected: str) -> InputError:
        return InputError(f"{self.where}: {key}: found {_short(self.values.get(key))}, expected {expected}")

    def number(self, key: str, expected: str = "a finite number") -> float:
        value = self.values.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.fail(key, expected)
        try:
            number = float(value)
        except OverflowError:  # an integer of hundreds of digits
            number = math.inf
        if not abs(number) <= MAX_NUMBER:
            within = "" if math.isinf(number) or "at most" in expected else f" within {MAX_NUMBER:g}"
            raise self.fail(key, expected + within)
        return number

    def positive(self, key: str) -> float:
        expected = "a positive number of pixels"
        value = self.number(key, expected)
        if value < 1e-3:
            raise self.fail(key, expected)
        return value

    def whole(self, key: str, low: int, high: int = int(MAX_NUMBER)) -> int:
        expected = f"a whole number of at least {low} and at most {high}"
        value = self.number(key, expected)
        if value != int(value) or not low <= value <= high:
            raise self.fail(key, expected)
        return int(value)

    def text(self, key: str) -> str:
        value = self.values.get(key)
        if isinstance(value, int) and not isinstance(value, bool):
            value = str(value)
        if not isinstance(value, str) or not value or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in value):
            raise self.fail(key, "a non-empty string")  # of characters that a file name may have
        return value


def _shot(entry: _Entry, folder: Path) -> Shot:
    image = folder / entry.text("file_path")
    if not image.name:
        raise entry.fail("file_path", "the name of an image file")
    if not image.suffix and not os.path.exists(image):  # nerfstudio's Blender scenes leave the suffix out
        image = image.with_name(image.name + ".png")
    timestep = entry.whole("timestep_index", 0) if "timestep_index" in entry else 0
    if "camera_id" in entry:
        camera = entry.text("camera_id")
    else:  # plain nerfstudio: a still scene, every image from a place of its own
        camera = "camera" if "timestep_index" in entry else image.stem
    return Shot(
        camera,
        timestep,
        image,
        next((folder / entry.text(key) for key in MASK_KEYS if key in entry), None),
        folder / entry.text("landmark_path") if "landmark_path" in entry else None,
    )


def _view(entry: _Entry, name: str) -> View:
    width, height = entry.whole("w", 1), entry.whole("h", 1)
    if min(width, height) < MIN_SIDE or width * height > MAX_PIXELS:
        raise InputError(
            f"{entry.where}: w, h: found {width} x {height} pixels, expected at least {MIN_SIDE} on each side "
            f"and at most {MAX_PIXELS // 10**6} megapixels"
        )
    intrinsics: tuple[float, float, float, float] | None = None
    distortion: tuple[float, ...] = ()
    if "camera_angle_x" in entry and "fl_x" not in entry:
        angle = entry.number("camera_angle_x")
        if not 0.0 < angle < math.pi:
            raise entry.fail("camera_angle_x", "an angle of view between 0 and pi")
        fx = 0.5 * width / math.tan(0.5 * angle)
        entry = _Entry({**entry.values, "fl_x": fx}, entry.where)
    if "fl_x" in entry:
        fx = entry.positive("fl_x")
        fy = entry.positive("fl_y") if "fl_y" in entry else fx
        cx = entry.number("cx") if "cx" in entry else width / 2
        cy = entry.number("cy") if "cy" in entry else height / 2
        if not (-width <= cx <= 2 * width and -height <= cy <= 2 * height):
            raise InputError(
                f"{entry.where}: cx, cy: found {cx:g}, {cy:g}, expected a principal point near the "
                f"{width} x {height} image"
            )
        intrinsics = (fx, fy, cx, cy)
        distortion = _distortion(entry)
    pose = _world_to_camera(entry) if "transform_matrix" in entry else None
    return View(name, width, height, intrinsics, distortion, pose, _gain(entry))


def _distortion(entry: _Entry) -> tuple[float, ...]:
    values = [entry.number(key) if key in entry else 0.0 for key in DISTORTION_KEYS]
    for key, value in zip(DISTORTION_KEYS, values, strict=True):
        if abs(value) > 1e4:  # those of rational models reach tens
            raise entry.fail(key, "a coefficient within 10000")
    if not any(values):
        return ()
    used = 8 if any(values[5:]) else 5 if values[4] else 4
    return tuple(values[:used])


def _gain(entry: _Entry) -> tuple[float, float, float]:
    if "gain" not in entry:
        return (1.0, 1.0, 1.0)
    value = entry.values["gain"]
    try:
        r, g, b = (float(v) for v in (value if isinstance(value, list) else [value] * 3))
    except (TypeError, ValueError, OverflowError):
        raise entry.fail("gain", "a positive number or three of them") from None
    if not (1e-6 <= min(r, g, b) and max(r, g, b) <= 1e6):
        raise entry.fail("gain", "a positive number or three of them, from 1e-6 to 1e6")
    return (r, g, b)


def _world_to_camera(entry: _Entry) -> NDArray[np.float64]:
    """Check ``transform_matrix`` and invert it to OpenCV axes."""
    try:
        matrix = np.array(entry.values["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise entry.fail("transform_matrix", "4 x 4 numbers") from None
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    key = f"{entry.where}: transform_matrix"
    if matrix.shape != (4, 4):
        raise InputError(f"{key}: found shape {matrix.shape}, expected 4 x 4 numbers")
    if not (np.abs(matrix) <= MAX_NUMBER).all():
        raise InputError(f"{key}: found a NaN or infinite value or a huge one, expected numbers within {MAX_NUMBER:g}")
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError(f"{key}: found last row {matrix[3].tolist()}, expected [0, 0, 0, 1]")
    camera_to_world = matrix @ OPENGL_FROM_OPENCV
    return inverse(rigid(nearest_rotation(camera_to_world[:3, :3], key), camera_to_world[:3, 3]))


def nearest_rotation(matrix: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """The rotation that a matrix is up to rounding (1e-3); InputError when it isn't one."""
    u, singular, vt = np.linalg.svd(matrix)
    determinant = np.linalg.det(matrix)
    if singular[-1] < 1e-6 * max(singular[0], 1e-30):
        raise InputError(f"{where}: found a singular rotation (determinant {determinant:.3g}), expected determinant 1")
    if determinant < 0:
        raise InputError(
            f"{where}: found a left-handed rotation (determinant {determinant:.3g}), expected a right-handed one; "
            "an axis is mirrored"
        )
    if np.abs(singular - 1.0).max() > 1e-3:
        raise InputError(
            f"{where}: found a scaled or sheared rotation (singular values {np.round(singular, 4).tolist()}), "
            "expected an orthonormal one"
        )
    return np.asarray(u @ vt)


def _check_same_camera(first: View, view: View, where: str) -> None:
    """A camera keeps size, intrinsics, pose and gain over time: a moving head, not a moving camera."""
    for key, a, b in (
        ("w, h", (first.width, first.height), (view.width, view.height)),
        ("fl_x, fl_y, cx, cy", first.intrinsics, view.intrinsics),
        ("distortion", first.distortion, view.distortion),
        ("transform_matrix", first.world_to_camera, view.world_to_camera),
        ("gain", first.gain, view.gain),
    ):
        same = (a is None) == (b is None) and (a is None or (len(a) == len(b) and np.allclose(a, b, atol=1e-6)))  # type: ignore[arg-type]
        if not same:
            raise InputError(
                f"{where}: {key}: differs from the first image of camera {view.name!r}, expected one fixed camera "
                "per camera_id; give a camera that moved another camera_id"
            )


def _check_complete(shots: Mapping[tuple[str, int], Shot], path: Path) -> None:
    cameras = list(dict.fromkeys(camera for camera, _ in shots))
    timesteps = sorted({timestep for _, timestep in shots})
    for camera in cameras:
        missing = [t for t in timesteps if (camera, t) not in shots]
        if missing:
            raise InputError(
                f"{path}: camera {camera!r} has no image of timestep {missing[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
                + f", expected every camera ({', '.join(cameras)}) at every timestep"
            )
