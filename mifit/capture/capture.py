"""``Capture``: cameras x timesteps of images, calibration, landmarks and masks, read as they are needed."""

from __future__ import annotations

import dataclasses
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.landmark_files import COUNT, Landmarks, read_landmarks
from mifit.capture.lens import undistort_points, undistortion
from mifit.capture.transforms import UNITS_MM, Shot, View, read_transforms
from mifit.core.camera import Camera
from mifit.core.files import file_digest, note_read
from mifit.core.image import load_image
from mifit.core.limits import MAX_FILE_BYTES
from mifit.core.photometry import Photometry
from mifit.errors import InputError

CACHE_BYTES = 2**30
"""Decoded images that a capture keeps at most: eight of 3840 x 2160 pixels."""


@dataclass(frozen=True)
class Frame:
    """One image, undistorted: what the stages see.

    ``image`` (H, W, 3) is linear Rec. 709, gain applied, and 0 where not ``valid`` (H, W): inside the stored image, the
    mask file, if it is ``masked``, and the alpha channel, and a number that is light. Noise goes down to -0.1, skies
    reach 1e5 (white is 1); others are damage, as NaN is. ``clipped`` (H, W) pixels are at the largest code value in
    some channel (touched by such a pixel after undistortion): no measurement. ``landmarks`` (68, 2) are iBUG points in
    the undistorted image, ``visible`` (68,) those to be trusted, ``deviation`` what the errors of the detector amount
    to, see `Landmarks`; 0 where it isn't known.
    """

    image: NDArray[np.float32]
    valid: NDArray[np.bool_]
    clipped: NDArray[np.bool_]
    landmarks: NDArray[np.float64] | None
    visible: NDArray[np.bool_]
    deviation: float = 0.0
    masked: bool = False

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return self.image.nbytes + self.valid.nbytes + self.clipped.nbytes


class _Cache:
    """Frames by key, the least recently used dropped beyond a number of bytes; safe between threads."""

    def __init__(self, limit: int):
        self.limit, self.used = limit, 0
        self._frames: OrderedDict[tuple[str, int], Frame] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._frames)

    def __reduce__(self) -> tuple[type[_Cache], tuple[int]]:
        return _Cache, (self.limit,)  # a copy reads its images anew

    def get(self, key: tuple[str, int]) -> Frame | None:
        with self._lock:
            if key in self._frames:
                self._frames.move_to_end(key)
            return self._frames.get(key)

    def put(self, key: tuple[str, int], frame: Frame) -> None:
        with self._lock:
            if key in self._frames or frame.nbytes > self.limit:
                return
            self._frames[key] = frame
            self.used += frame.nbytes
            while self.used > self.limit:
                self.used -= self._frames.popitem(last=False)[1].nbytes


@dataclass(frozen=True)
class Capture:
    """A capture on disk.

    Nothing but ``transforms.json`` is read by `load`; images, masks and landmarks are read by `frame`, for the
    camera and timestep asked for and no other.

    Attributes
    ----------
    path : Path
        Folder.
    views : dict of str to View
        Per camera: image size, calibration as stored, gain.
    shots : dict of (camera, timestep) to Shot
        Files.
    units : str
        Unit of length of the poses: ``mm``, ``cm``, ``dm`` or ``m``.
    estimated : dict of str to Camera
        Cameras that were estimated, or refined from their calibration; empty where all are as calibrated.
    photometry : Photometry
        Gains and exposures that images are divided by, where a fit found some; files and `digest` stay as they are.
    """

    path: Path
    views: Mapping[str, View]
    shots: Mapping[tuple[str, int], Shot] = field(repr=False)
    units: str = "cm"
    estimated: Mapping[str, Camera] = field(default_factory=dict, repr=False)
    photometry: Photometry = field(default_factory=Photometry, repr=False)
    _cache: _Cache = field(default_factory=lambda: _Cache(CACHE_BYTES), repr=False, compare=False)

    @classmethod
    def load(cls, path: str | Path, cache_bytes: int = CACHE_BYTES) -> Capture:
        """Open a capture folder, or its ``transforms.json``; at most ``cache_bytes`` of decoded images are kept in
        memory.

        InputError for a missing folder or file, or an entry that isn't what it must be.
        """
        path = Path(path)
        if not path.exists():
            raise InputError(f"{path}: no such folder; expected a capture folder with a transforms.json")
        place = path / "transforms.json" if path.is_dir() else path
        transforms = read_transforms(place)
        note_read(file for shot in transforms.shots for file in (shot.image, shot.landmarks, shot.mask) if file)
        return cls(
            place.parent,
            {view.name: view for view in transforms.views},
            {(shot.camera, shot.timestep): shot for shot in transforms.shots},
            transforms.units,
            _cache=_Cache(cache_bytes),
        )

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of the file."""
        return tuple(self.views)

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps, ascending; every camera has each of them."""
        return tuple(sorted({timestep for _, timestep in self.shots}))

    @property
    def unit_mm(self) -> float:
        """Millimetres per unit of length."""
        return UNITS_MM[self.units]

    @property
    def calibrated(self) -> bool:
        """Whether every camera's intrinsics and pose came with the capture."""
        return all(view.calibrated for view in self.views.values())

    def camera(self, name: str) -> Camera:
        """The pinhole camera of a view's undistorted images, calibrated or estimated.

        InputError for an unknown name, or a view that is neither calibrated nor estimated yet.
        """
        self._view(name)
        return dataclasses.replace(self.estimated.get(name) or self.stored_camera(name), distortion=())

    def stored_camera(self, name: str) -> Camera:
        """The calibrated camera of a view's images as stored, with lens distortion; InputError where there is none."""
        view = self._view(name)
        if not view.calibrated:
            missing = "intrinsics (fl_x ...)" if view.intrinsics is None else "pose (transform_matrix)"
            raise InputError(
                f"{self.path}: camera {name!r} has no {missing}; estimate it with mifit calibrate or import the "
                "capture with its calibration"
            )
        return view.camera()

    def frame(self, name: str, timestep: int) -> Frame:
        """One image with its masks and landmarks, undistorted; arrays are read-only and may come from the cache.

        InputError for an unknown camera or timestep, or a file that is missing, damaged, or of another size than ``w``
        x ``h``.
        """
        shot = self._shot(name, timestep)
        frame = self._cache.get((name, timestep))
        if frame is None:
            frame = self._read(shot)
            self._cache.put((name, timestep), frame)
        if not self.photometry:
            return frame
        image = frame.image / self.photometry.factor(name, timestep)
        image.flags.writeable = False
        return dataclasses.replace(frame, image=image)

    def landmarks(self, name: str, timestep: int) -> Landmarks | None:
        """Landmarks of one image in undistorted coordinates, without reading the image; None when there are none."""
        shot, view = self._shot(name, timestep), self._view(name)
        if shot.landmarks is None:
            return None
        found = read_landmarks(shot.landmarks)
        if view.intrinsics is None:
            return found
        return Landmarks(undistort_points(_lens_camera(view), found.points), found.visible, found.deviation)

    def digest(self, cameras: Sequence[str] | None = None, timesteps: Sequence[int] | None = None) -> str:
        """Hex digest of calibration, images, masks and landmarks; only files of the named cameras are read."""
        result = hashlib.sha256(self.units.encode())
        for name in self.cameras if cameras is None else cameras:
            view = self._view(name)
            result.update(repr(view).encode())
            for source in (view, self.estimated.get(name)):
                if source is not None and source.world_to_camera is not None:
                    result.update(np.asarray(source.world_to_camera, dtype="<f8").tobytes())
            for timestep in self.timesteps if timesteps is None else timesteps:
                shot = self._shot(name, timestep)
                for file in (shot.image, shot.mask, shot.landmarks):
                    result.update(b"-" if file is None else file_digest(file, MAX_FILE_BYTES, "file of the capture"))
        return result.hexdigest()

    def with_estimate(self, cameras: Sequence[Camera]) -> Capture:
        """The same capture with estimated cameras; whether it is `calibrated` stays as it is.

        TypeError for other objects.
        """
        if not all(isinstance(camera, Camera) for camera in cameras):
            raise TypeError("with_estimate: cameras: found other objects, expected Camera")
        return dataclasses.replace(self, estimated={camera.name: camera for camera in cameras}, _cache=self._cache)

    def with_photometry(self, photometry: Photometry) -> Capture:
        """The same capture with images divided by gains and exposures, in place of any that it has.

        TypeError for another object.
        """
        if not isinstance(photometry, Photometry):
            raise TypeError(f"with_photometry: found {type(photometry).__name__}, expected Photometry")
        return dataclasses.replace(self, photometry=photometry, _cache=self._cache)

    def with_fitted(self, cameras: Sequence[Camera]) -> Capture:
        """The capture as a fit with these cameras saw it: its own calibration, or else the estimated cameras."""
        return self if self.calibrated or not cameras else self.with_estimate(cameras)

    def _view(self, name: str) -> View:
        if name not in self.views:
            raise InputError(f"camera {name!r}: not in {self.path}; it has {', '.join(self.cameras)}")
        return self.views[name]

    def _shot(self, name: str, timestep: int) -> Shot:
        self._view(name)
        if (name, timestep) not in self.shots:
            steps = self.timesteps
            raise InputError(f"timestep {timestep}: not in {self.path}; it has {steps[0]} to {steps[-1]}")
        return self.shots[name, timestep]

    def _read(self, shot: Shot) -> Frame:
        view = self.views[shot.camera]
        found = load_image(shot.image)
        _check_size(found.pixels.shape[:2], view, shot.image)
        image: NDArray[np.float32] = np.ascontiguousarray(found.pixels)
        valid: NDArray[np.bool_] = cv2.inRange(image, (-0.1,) * 3, (1e6,) * 3) > 0  # NaN is outside
        if found.alpha is not None:
            valid &= found.alpha >= 0.5
        if shot.mask is not None:
            mask = load_image(shot.mask).pixels
            _check_size(mask.shape[:2], view, shot.mask)
            valid &= mask.max(axis=-1) >= 0.2  # mid-grey of an 8-bit sRGB file
        if not valid.all():
            image = np.where(valid[..., None], image, np.float32(0))
        clipped = found.clipped
        if view.gain != (1.0, 1.0, 1.0):
            image = image * np.array(view.gain, dtype=np.float32)
        if view.intrinsics is not None and view.distortion:
            lens = undistortion(_lens_camera(view))
            image = lens.apply(image)
            valid = np.asarray(lens.valid & (lens.apply(valid.astype(np.float32)) > 0.999))
            clipped = np.asarray(lens.apply(clipped.astype(np.float32)) > 0.001)
            image[~valid] = 0.0
        for array in (image, valid, clipped):
            array.setflags(write=False)
        landmarks, masked = self.landmarks(shot.camera, shot.timestep), shot.mask is not None
        if landmarks is None:
            return Frame(image, valid, clipped, None, np.zeros(COUNT, dtype=bool), masked=masked)
        return Frame(image, valid, clipped, landmarks.points, landmarks.visible, landmarks.deviation, masked)


def _lens_camera(view: View) -> Camera:
    """Intrinsics and distortion of a view, pose left at the origin."""
    assert view.intrinsics is not None
    return Camera(view.name, view.width, view.height, *view.intrinsics, np.eye(4), distortion=view.distortion)


def _check_size(shape: tuple[int, ...], view: View, path: Path) -> None:
    if shape != (view.height, view.width):
        raise InputError(
            f"{path}: found {shape[1]} x {shape[0]} pixels, expected {view.width} x {view.height} (w, h of camera "
            f"{view.name!r})"
        )
