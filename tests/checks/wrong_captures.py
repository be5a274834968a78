"""Wrong captures: each takes a good one at half resolution and makes one mistake that people make.

``python -m tests.checks.wrong_captures GOOD OUT NAME`` writes one of them as a capture folder.
"""

from __future__ import annotations

import copy
import functools
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.core.image import write_image
from mifit.morphable.topology import IBUG_MIRROR

CAMERAS = ("left", "right", "third")


@dataclass
class Rough:
    """A capture in memory that may be made wrong: frames by (camera, timestep), units, and its folder."""

    frames: dict[tuple[str, int], dict]
    units: str
    good: Path

    def of(self, *cameras: str) -> list[dict]:
        return [frame for (name, _), frame in self.frames.items() if name in cameras]

    @property
    def steps(self) -> list[int]:
        return sorted({step for _, step in self.frames})


def read(folder: Path, timesteps: int = 3, factor: float = 0.5, cameras: tuple[str, ...] = CAMERAS) -> Rough:
    """The first timesteps of a good capture; images (h, w, 3) as stored codes, BGR."""
    return copy.deepcopy(_read(folder, timesteps, factor, cameras))


@functools.cache
def _read(folder: Path, timesteps: int, factor: float, cameras: tuple[str, ...]) -> Rough:
    document = json.loads((folder / "transforms.json").read_text())
    frames = {}
    for entry in document["frames"]:
        name, step = entry["camera_id"], entry["timestep_index"]
        if name not in cameras or step >= timesteps:
            continue
        image = cv2.imread(str(folder / entry["file_path"]), cv2.IMREAD_COLOR)
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        landmarks = json.loads((folder / entry["landmark_path"]).read_text())
        frames[name, step] = {
            "image": image,
            "points": factor * np.array(landmarks["points"]),
            "visible": np.array(landmarks["visible"]),
            "deviation": factor * landmarks.get("deviation", 0.0),
            "pose": np.array(entry["transform_matrix"]),
            "lens": {key: entry.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")},
            **{key: factor * entry[key] for key in ("fl_x", "fl_y", "cx", "cy")},
        }
    return Rough(frames, document["units"], folder)


def write(rough: Rough, out: Path) -> Path:
    """Write it as a capture folder; 8-bit images as PNG, others as linear EXR."""
    entries = []
    for (name, step), frame in rough.frames.items():
        image = frame["image"]
        file = f"images/{name}/{step:04}.{'png' if image.dtype == np.uint8 else 'exr'}"
        landmarks = f"landmarks/{name}/{step:04}.json"
        for path in (file, landmarks):
            (out / path).parent.mkdir(parents=True, exist_ok=True)
        if image.dtype == np.uint8:
            cv2.imwrite(str(out / file), image, (cv2.IMWRITE_PNG_COMPRESSION, 1))
        else:
            write_image(out / file, image[..., ::-1])
        points = {"convention": "ibug68", "points": frame["points"].tolist(), "visible": frame["visible"].tolist()}
        points |= {"deviation": frame["deviation"]} if frame["deviation"] else {}
        (out / landmarks).write_text(json.dumps(points))
        height, width = image.shape[:2]
        entries.append(
            {
                "file_path": file,
                "landmark_path": landmarks,
                "camera_id": name,
                "timestep_index": step,
                "w": width,
                "h": height,
                **{key: float(frame[key]) for key in ("fl_x", "fl_y", "cx", "cy")},
                **frame["lens"],
                "transform_matrix": frame["pose"].tolist(),
            }
        )
    document = {"camera_model": "OPENCV", "units": rough.units, "frames": entries}
    (out / "transforms.json").write_text(json.dumps(document))
    return out


# What can be wrong. Each changes a `Rough` in place.
# ----------------------------------------------------------------------------------------------------------------------


def flip(frames: list[dict], detected_after: bool = False) -> None:
    """Mirror images; landmarks move along and keep their names, or get those of a detector that ran afterwards."""
    for frame in frames:
        width = frame["image"].shape[1]
        frame["image"] = frame["image"][:, ::-1].copy()
        frame["points"] = frame["points"] * (-1, 1) + (width, 0)
        if detected_after:
            swap_sides([frame])


def swap_sides(frames: list[dict]) -> None:
    """Give landmarks of the left the names of the right."""
    for frame in frames:
        frame["points"], frame["visible"] = frame["points"][IBUG_MIRROR], frame["visible"][IBUG_MIRROR]


def turn(frames: list[dict]) -> None:
    """Turn images upside down."""
    for frame in frames:
        height, width = frame["image"].shape[:2]
        frame["image"] = frame["image"][::-1, ::-1].copy()
        frame["points"] = (width, height) - frame["points"]


def swap(rough: Rough, a: str, b: str, *keys: str) -> None:
    """Exchange what two cameras have under some keys."""
    for step in rough.steps:
        for key in keys:
            one, other = rough.frames[a, step], rough.frames[b, step]
            one[key], other[key] = other[key], one[key]


SHOT = ("image", "points", "visible")
PLACE = ("pose", "fl_x", "fl_y", "cx", "cy", "lens")


def late(rough: Rough, name: str, lag: int) -> None:
    """A camera whose timestep t shows what the others show at t - lag."""
    steps = rough.steps
    shots = {step: {key: rough.frames[name, step][key] for key in SHOT} for step in steps}
    for other in {camera for camera, _ in rough.frames} - {name}:
        for step in steps[:lag]:
            rough.frames.pop((other, step))
    for step in steps[lag:]:
        rough.frames[name, step].update(shots[step - lag])
    for step in steps[:lag]:
        rough.frames.pop((name, step))


def scale(frames: list[dict], key: str, factor: float) -> None:
    for frame in frames:
        frame[key] = frame[key] * factor


def shift(frames: list[dict], key: str, by: object) -> None:
    for frame in frames:
        frame[key] = frame[key] + np.asarray(by)


def lengths(rough: Rough, factor: float) -> None:
    """Poses whose lengths are in another unit."""
    for frame in rough.frames.values():
        frame["pose"] = frame["pose"] * np.r_[1, 1, 1, factor]
        frame["pose"][3] = (0, 0, 0, 1)


def baseline(rough: Rough, factor: float) -> None:
    """Cameras that stand further apart in the file than they do, each about the middle of the two."""
    middle = np.mean([frame["pose"][:3, 3] for frame in rough.of("left", "right")], axis=0)
    for frame in rough.of("left", "right"):
        frame["pose"] = frame["pose"].copy()
        frame["pose"][:3, 3] = middle + factor * (frame["pose"][:3, 3] - middle)


def turned(frames: list[dict], degrees: tuple[float, float, float]) -> None:
    """A camera that was moved after calibration: turned about its own x, y, z."""
    for frame in frames:
        frame["pose"] = frame["pose"].copy()
        frame["pose"][:3, :3] = frame["pose"][:3, :3] @ Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()


def codes(frames: list[dict], change: Callable[[NDArray], NDArray]) -> None:
    """Other 8-bit codes: ``change`` maps sRGB values 0..1."""
    for frame in frames:
        frame["image"] = np.clip(np.rint(255 * change(frame["image"] / 255.0)), 0, 255).astype(np.uint8)


def decoded(value: NDArray) -> NDArray:
    """sRGB to linear."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encoded_exr(frames: list[dict]) -> None:
    for frame in frames:
        frame["image"] = (frame["image"] / 255.0).astype(np.float32)


def channels(frames: list[dict]) -> None:
    for frame in frames:
        frame["image"] = frame["image"][..., ::-1].copy()


def copied(rough: Rough, source: str, target: str, *keys: str) -> None:
    for step in rough.steps:
        for key in keys:
            rough.frames[target, step][key] = rough.frames[source, step][key].copy()


def repeated(rough: Rough, step: int, of: int) -> None:
    for name in CAMERAS:
        if (name, of) in rough.frames:
            for key in SHOT:
                rough.frames[name, step][key] = rough.frames[name, of][key].copy()


def s_curve(value: NDArray) -> NDArray:
    """A strong contrast curve of a phone's picture style."""
    return value**2 * (3 - 2 * value)


def another_person(rough: Rough, name: str, who: str = "gloss") -> None:
    """A camera shows another head, which stands where the first one does; skin of ``gloss`` is that of ``soft``."""
    other = read(rough.good.parent / who, len(rough.steps))
    for step in rough.steps:
        rough.frames[name, step].update({key: other.frames[name, step][key] for key in SHOT})


def lens(frames: list[dict], k1: float) -> None:
    """Images through a lens of which the file says nothing."""
    for frame in frames:
        focal, centre = np.array([frame["fl_x"], frame["fl_y"]]), np.array([frame["cx"], frame["cy"]])
        matrix = np.array([[focal[0], 0, centre[0] - 0.5], [0, focal[1], centre[1] - 0.5], [0, 0, 1]])
        grid = np.stack(np.meshgrid(*map(np.arange, frame["image"].shape[1::-1])), axis=-1)
        ideal = cv2.undistortPoints(grid.reshape(-1, 1, 2).astype(float), matrix, np.array([k1, 0, 0, 0]), P=matrix)
        x, y = ideal.reshape(*grid.shape).astype(np.float32).transpose(2, 0, 1)
        frame["image"] = cv2.remap(frame["image"], x, y, cv2.INTER_LINEAR)
        seen = (frame["points"] - centre) / focal
        frame["points"] = seen * (1 + k1 * (seen**2).sum(1, keepdims=True)) * focal + centre


def frontal(frames: list[dict], front: dict, half: bool = False) -> None:
    """Landmarks of a detector that takes a profile for a front, or lays the hidden half of a face on the seen one."""
    for frame in frames:
        seen = frame["points"][frame["visible"]]
        low, size = seen.min(0), np.ptp(seen, axis=0)
        if half:
            frame["points"] = frame["points"] + np.outer(np.arange(68) % 2, (0.15 * size[0], 0))
        else:
            frame["points"] = (front["points"] - front["points"].min(0)) / np.ptp(front["points"], axis=0) * size + low
        frame["visible"] = np.ones(68, dtype=bool)


Change = Callable[[Rough], None]
both: Callable[[Rough], list[dict]] = lambda rough: rough.of("left", "right")  # noqa: E731

WRONG: dict[str, Change] = {
    # the table of outside trials
    "one mirrored": lambda r: flip(r.of("right"), detected_after=True),
    "one mirrored, landmarks along": lambda r: flip(r.of("right")),
    "both mirrored, swapped": lambda r: (flip(both(r), detected_after=True), swap(r, "left", "right", *SHOT)),
    "landmarks swapped": lambda r: swap_sides(both(r)),
    "cameras swapped": lambda r: swap(r, "left", "right", *SHOT),
    "upside down": lambda r: turn(both(r)),
    "right copies left": lambda r: copied(r, "left", "right", *SHOT),
    "principal point": lambda r: shift(both(r), "cx", 20.0),
    "fy": lambda r: scale(both(r), "fl_y", 1.1),
    "focal 1.15": lambda r: (scale(both(r), "fl_x", 1.15), scale(both(r), "fl_y", 1.15)),
    "focal 2": lambda r: (scale(both(r), "fl_x", 2.0), scale(both(r), "fl_y", 2.0)),
    "baseline": lambda r: baseline(r, 1.1),
    "one turned, yaw": lambda r: turned(r.of("right"), (0, 1, 0)),
    "one turned, pitch": lambda r: turned(r.of("right"), (1, 0, 0)),
    "landmarks shifted": lambda r: shift(both(r), "points", (10.0, 0.0)),
    "inches": lambda r: lengths(r, 1 / 2.54),
    "landmarks at twice the scale": lambda r: scale(both(r), "points", 2.0),
    "one late": lambda r: late(r, "right", 1),
    "BGR in both": lambda r: channels(both(r)),
    "BGR in one": lambda r: channels(r.of("right")),
    "sRGB codes in EXR": lambda r: encoded_exr(both(r)),
    "linear in PNG": lambda r: codes(both(r), decoded),
    "tone curve": lambda r: codes(both(r), s_curve),
    "lengths x 10": lambda r: lengths(r, 10.0),
    "two people": lambda r: another_person(r, "right"),
    "lens left out": lambda r: lens(both(r), -1.5),
    # more
    "all mirrored": lambda r: flip(both(r), detected_after=True),
    "feet": lambda r: lengths(r, 1 / 30.48),
    "one upside down": lambda r: turn(r.of("left")),
    "one landmarks swapped": lambda r: swap_sides(r.of("left")),
    "landmarks x and y exchanged": lambda r: [f.update(points=f["points"][:, ::-1].copy()) for f in both(r)],
    "landmarks from below": lambda r: [
        f.update(points=f["points"] * (1, -1) + (0, f["image"].shape[0])) for f in both(r)
    ],
    "timestep repeated": lambda r: repeated(r, 1, 0),
    "OpenCV axes": lambda r: [f.update(pose=f["pose"] @ np.diag([1.0, -1, -1, 1])) for f in both(r)],
    "intrinsics of the full image": lambda r: [scale(both(r), key, 2.0) for key in ("fl_x", "fl_y", "cx", "cy")],
    "world-to-camera": lambda r: [f.update(pose=np.linalg.inv(f["pose"])) for f in both(r)],
    "sRGB codes in EXR, one": lambda r: encoded_exr(r.of("left")),
    "right mirrors left": lambda r: (copied(r, "left", "right", *SHOT), flip(r.of("right"), detected_after=True)),
}


def make(name: str, good: Path, out: Path, timesteps: int = 3, cameras: tuple[str, ...] = CAMERAS) -> Path:
    """Write one wrong capture."""
    rough = read(good, timesteps, cameras=cameras)
    WRONG[name](rough)
    return write(rough, out)


if __name__ == "__main__":
    print(make(sys.argv[3], Path(sys.argv[1]), Path(sys.argv[2])))
