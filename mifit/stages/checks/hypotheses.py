"""What is wrong with a capture: each common mistake is undone, and landmarks judge which capture a face explains best.

Every mistake is a hypothesis about landmarks and cameras with a cost (`landmark_model.explain`), the negative
logarithm of how likely it makes what was detected. One that explains them far better than the capture itself is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import OPENGL_FROM_OPENCV, Camera, rigid
from mifit.morphable.topology import IBUG_MIRROR
from mifit.stages.checks.landmark_model import Shot

Matrix = NDArray[np.float64]
Change = Callable[[Shot], Shot]
LARGEST_DELAY = 3
"""Timesteps that a camera may lag behind the others."""


@dataclass(frozen=True)
class Hypothesis:
    """A mistake: its code, the words for it and for its remedy, the shots with it undone, and the camera.

    ``shifted`` names a camera whose landmarks may all lie off by the same pixels, ``(x, y)`` in the text.
    """

    code: str
    text: str
    remedy: str
    shots: tuple[Shot, ...]
    camera: str | None = None
    shifted: str | None = None


# Changes of one shot
# ----------------------------------------------------------------------------------------------------------------------


def _points(change: Callable[[NDArray, Camera], NDArray]) -> Change:
    return lambda shot: replace(shot, pixels=change(shot.pixels, shot.camera))


def _flipped(pixels: NDArray, camera: Camera) -> NDArray:
    return pixels * (-1, 1) + (camera.width, 0)


def _camera(change: Callable[[Camera], Camera]) -> Change:
    return lambda shot: replace(shot, camera=change(shot.camera))


def _pose(change: Callable[[Matrix], Matrix]) -> Change:
    return _camera(lambda camera: replace(camera, world_to_camera=change(camera.world_to_camera)))


def _intrinsics(by: float) -> Change:
    return _camera(lambda c: replace(c, fx=by * c.fx, fy=by * c.fy, cx=by * c.cx, cy=by * c.cy))


IMAGES: dict[str, tuple[Change, str, str]] = {
    "mirrored": (
        _points(lambda pixels, camera: _flipped(pixels, camera)[IBUG_MIRROR]),
        "images are mirrored, as front cameras store them",
        "flip them left to right and run `mifit landmarks` again",
    ),
    "flipped": (
        _points(_flipped),
        "images and landmarks are mirrored together",
        "flip the images left to right and run `mifit landmarks` again",
    ),
    "landmarks-swapped": (
        _points(lambda pixels, camera: pixels[IBUG_MIRROR]),
        "landmarks of the left side have the names of the right",
        "run `mifit landmarks`, or exchange them: point 0 is at the ear of the person's right side",
    ),
    "upside-down": (
        _points(lambda pixels, camera: (camera.width, camera.height) - pixels),
        "images are upside down",
        "turn them by 180 degrees and run `mifit landmarks` again, or turn the camera's pose",
    ),
    "landmarks-from-below": (
        _points(lambda pixels, camera: pixels * (1, -1) + (0, camera.height)),
        "landmarks count rows from below",
        "write y as the image's height minus y, or run `mifit landmarks`",
    ),
    "landmarks-transposed": (
        _points(lambda pixels, camera: pixels[:, ::-1]),
        "landmarks have row and column exchanged",
        "write them as x, y, or run `mifit landmarks`",
    ),
    "landmarks-doubled": (
        _points(lambda pixels, camera: 0.5 * pixels),
        "landmarks are in pixels of images twice as large",
        "halve them, or run `mifit landmarks`",
    ),
    "landmarks-halved": (
        _points(lambda pixels, camera: 2.0 * pixels),
        "landmarks are in pixels of images half as large",
        "double them, or run `mifit landmarks`",
    ),
    "intrinsics-doubled": (
        _intrinsics(0.5),
        "focal length and principal point are those of images twice as large",
        "halve fl_x, fl_y, cx and cy",
    ),
    "intrinsics-halved": (
        _intrinsics(2.0),
        "focal length and principal point are those of images half as large",
        "double fl_x, fl_y, cx and cy",
    ),
}
"""Mistakes of the images of one camera, or of all: what undoes them, what they are, the remedy."""
POSES: dict[str, tuple[Change, str, str]] = {
    "poses-location": (
        _pose(lambda pose: rigid(pose[:3, :3], -pose[:3, :3] @ pose[:3, 3])),
        "locations of the cameras are given where translations belong (t = -R C)",
        "write t = -R C",
    ),
    "poses-translation": (
        _pose(lambda pose: rigid(pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3])),
        "translations of the cameras are given where locations belong (C = -R' t)",
        "write C = -R' t into transform_matrix",
    ),
    "poses-axes": (
        _pose(lambda pose: np.diag([1.0, -1.0, -1.0, 1.0]) @ pose),
        "the cameras' y and z axes are flipped (OpenCV axes for OpenGL ones, or the reverse)",
        "negate the second and third column of transform_matrix",
    ),
}
"""Mistakes of all poses."""
INVERTED: tuple[Change, ...] = (
    _pose(lambda pose: np.asarray(OPENGL_FROM_OPENCV @ np.linalg.inv(OPENGL_FROM_OPENCV @ pose), dtype=np.float64)),
    _pose(lambda pose: np.asarray(np.linalg.inv(pose) @ OPENGL_FROM_OPENCV, dtype=np.float64)),
    _pose(lambda pose: np.asarray(np.linalg.inv(pose), dtype=np.float64)),
)
"""Undo world-to-camera matrices where camera-to-world ones belong, or the reverse: of either convention's axes."""
UNITS_MM = {
    "millimetres": 1.0,
    "centimetres": 10.0,
    "inches": 25.4,
    "decimetres": 100.0,
    "feet": 304.8,
    "metres": 1000.0,
}
"""Units that lengths of cameras may be in."""


def hypotheses(shots: Sequence[Shot], later: Sequence[Shot] = ()) -> Iterator[Hypothesis]:
    """Every mistake that may have been made with the images, landmarks and poses of some shots.

    Delays are looked for in ``later`` ones, of consecutive timesteps, ``shots`` among them.
    """
    names = list(dict.fromkeys(shot.camera.name for shot in shots))
    cameras = {shot.camera.name: shot.camera for shot in shots}
    for a, b in combinations(names, 2):
        other = {a: cameras[b], b: cameras[a]}
        undone = tuple(replace(shot, camera=other.get(shot.camera.name, shot.camera)) for shot in shots)
        text = f"cameras {a} and {b} are exchanged"
        yield Hypothesis("cameras-swapped", text, "exchange their images or their poses", undone)
    for code, (change, text, remedy) in IMAGES.items():
        for name in (None, *(names if len(names) > 1 else ())):
            undone = tuple(change(shot) if name in (None, shot.camera.name) else shot for shot in shots)
            who = "all cameras: " if name is None else f"camera {name}: "
            yield Hypothesis(code, who + text, remedy, undone, name)
    if len(names) < 2:
        return
    for code, (change, text, remedy) in POSES.items():
        yield Hypothesis(code, text, remedy, tuple(map(change, shots)))
    for change in INVERTED:
        text = "world-to-camera matrices are given where camera-to-world ones belong, or the reverse"
        yield Hypothesis("poses-inverted", text, "invert transform_matrix", tuple(map(change, shots)))
    for name in names:
        text = f"landmarks of camera {name} lie (x, y) pixels off where the other cameras' put them"
        remedy = "the camera was turned after calibration, or its principal point or landmarks are off; calibrate again"
        yield Hypothesis("camera-turned", text, remedy, tuple(shots), name, name)
    for name in names[1:] if len(names) == 2 else names:
        for late in range(-LARGEST_DELAY, LARGEST_DELAY + 1):
            moved = tuple(
                replace(shot, step=shot.step - late) if shot.camera.name == name else shot for shot in later or shots
            )
            whole = {s for s in {shot.step for shot in moved} if sum(shot.step == s for shot in moved) == len(names)}
            kept = tuple(shot for shot in moved if shot.step in whole)
            if late and len(whole) >= 2:
                text = f"camera {name} is {abs(late)} timestep{'s' * (abs(late) > 1)} {'late' if late > 0 else 'early'}"
                remedy = "synchronise the videos: leave out the first frames of the camera that is ahead"
                yield Hypothesis("camera-delayed", text, remedy, kept, name)
