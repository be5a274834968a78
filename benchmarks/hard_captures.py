"""Small captures for `benchmarks.hard_cases`: path traced at the edge of what is possible, or damaged afterwards."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit import MorphableModel
from mifit.capture.landmark_files import Landmarks, read_landmarks, write_landmarks
from mifit.core.image import read_image, write_image
from mifit.synth import compose, head
from mifit.synth.skin import SkinMaps, SkinStyle
from mifit.synth.studio import studio_environment

SEED = 7
WIDTH, HEIGHT, TIMESTEPS, SPP = 192, 144, 2, 16
MODEL = "builtin:coarse"

Make = Callable[[Path, Path], None]
"""Makes a capture in the second folder, from the base capture in the first where it needs one."""


# -- captures that are path traced ------------------------------------------------------------------------------------


def traced(
    light: Callable[[], NDArray] = lambda: studio_environment(SEED),
    skin: Callable[[SkinMaps], SkinMaps] = lambda maps: maps,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    angles: Sequence[float] = (-20.0, 20.0),
) -> Make:
    """A capture as `synthesize` makes it, with a choice of light, skin, head pose (pitch, yaw, roll) and views."""

    def make(base: Path, out: Path) -> None:
        model = MorphableModel.load(MODEL)
        subject = compose._draw_subject(model, SkinStyle.draw(SEED), TIMESTEPS, 512, "poses", head.OUTSIDE)
        rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        subject = dataclasses.replace(
            subject,
            skin={name: skin(maps) for name, maps in subject.skin.items()},
            poses=[
                dataclasses.replace(p, rotation=rotation @ p.rotation, translation=rotation @ p.translation)
                for p in subject.poses
            ],
        )
        cameras = compose.place_cameras(WIDTH, HEIGHT)
        cameras[:2] = [
            compose._camera(camera.name, WIDTH, HEIGHT, camera.fx, compose.DISTANCE, angle, 0.0)
            for camera, angle in zip(cameras, angles, strict=False)
        ]
        compose._write_capture(out, subject, cameras, light().astype(np.float32), SPP, lambda done: None)

    return make


def uniform() -> NDArray:
    return np.ones((64, 128, 3))


def spot(column: int, ambient: float = 0.01) -> Callable[[], NDArray]:
    """One small source of 3 degrees, a little above the horizon; column 64 of 128 is in front of the face."""

    def light() -> NDArray:
        image = np.full((64, 128, 3), ambient)
        image[24, column] = 3000.0
        return image

    return light


def recoloured(albedo: Callable[[NDArray], NDArray], **others: float) -> Callable[[SkinMaps], SkinMaps]:
    """Skin with another albedo, and other maps set to one value."""

    def change(maps: SkinMaps) -> SkinMaps:
        flat = {name: np.full_like(maps.specular, value) for name, value in others.items()}
        return dataclasses.replace(maps, albedo=albedo(maps.albedo).astype(np.float32), **flat)

    return change


# -- captures that are damaged ----------------------------------------------------------------------------------------


def damaged(
    images: Callable[[NDArray, np.random.Generator], NDArray] | None = None,
    cameras: tuple[str, ...] = ("left", "right", "third"),
    landmarks: Callable[[Landmarks, np.random.Generator], Landmarks] | None = None,
    document: Callable[[dict[str, Any]], None] | None = None,
    world: Callable[[NDArray], NDArray] | None = None,
    suffix: str = ".png",
) -> Make:
    """The base capture with other images (linear in, linear out; of some cameras), landmarks, transforms.json or world
    coordinates.
    """

    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        rng = np.random.default_rng(SEED)
        file = out / "transforms.json"
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            if images and frame["camera_id"] in cameras:
                path = out / frame["file_path"]
                frame["file_path"] = str(Path(frame["file_path"]).with_suffix(suffix))
                write_image(out / frame["file_path"], images(read_image(path), rng))
            if landmarks:
                path = out / frame["landmark_path"]
                write_landmarks(path, landmarks(read_landmarks(path), rng))
            if world:
                matrix = np.array(frame["transform_matrix"])
                matrix[:3, 3] = world(matrix[:3, 3])
                frame["transform_matrix"] = matrix.tolist()
        if world:
            for path in (out / "truth").glob("0*.npz"):
                truth = dict(np.load(path))
                np.savez(path, **{**truth, "vertices": world(truth["vertices"].astype(np.float64))})
        if document:
            document(content)
        file.write_text(json.dumps(content))

    return make


def exposed(factor: float) -> Make:
    return damaged(images=lambda x, rng: np.clip(factor * x, 0, 1))


def spoilt_exr(value: float) -> Make:
    """EXR images of the fitted cameras; 3 % of the pixels and a block in the face take a value that is no light."""

    def change(image: NDArray, rng: np.random.Generator) -> NDArray:
        out = image.copy()
        out[rng.random(out.shape[:2]) < 0.03] = value
        out[65:75, 90:100] = value
        return out

    return damaged(images=change, cameras=("left", "right"), suffix=".exr")


def moved(points: Callable[[NDArray, np.random.Generator], NDArray]) -> Make:
    return damaged(landmarks=lambda found, rng: Landmarks(points(found.points, rng), found.visible))


def noisy(image: NDArray, rng: np.random.Generator) -> NDArray:
    return np.clip(image + rng.normal(0, 0.1, image.shape), 0, 1)


MIRRORED = np.array(
    [*range(16, -1, -1), *range(26, 16, -1), *range(27, 31), *range(35, 30, -1), 45, 44, 43, 42, 47, 46, 39, 38, 37, 36,
     41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
)  # fmt: skip
"""The 68 points as a detector names them that takes left for right."""


def outliers(points: NDArray, rng: np.random.Generator) -> NDArray:
    out = points.copy()
    out[rng.choice(68, 8, replace=False)] += rng.choice([-1.0, 1.0], (8, 2)) * 25.0
    return out


def anywhere(points: NDArray, rng: np.random.Generator) -> NDArray:
    return rng.uniform((0, 0), (WIDTH, HEIGHT), (68, 2))


def half_hidden(found: Landmarks, rng: np.random.Generator) -> Landmarks:
    return Landmarks(found.points, found.visible & (rng.random(68) < 0.5))


def without_landmarks(*cameras: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            if not cameras or frame["camera_id"] in cameras:
                del frame["landmark_path"]

    return change


def with_units(units: str) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(units=units)


def shuffled(content: dict[str, Any]) -> None:
    np.random.default_rng(SEED).shuffle(content["frames"])


def doubled(content: dict[str, Any]) -> None:
    """Camera ``left`` once more under the name ``copy``."""
    content["frames"] += [{**f, "camera_id": "copy"} for f in content["frames"] if f["camera_id"] == "left"]


def file_changed(change: Callable[[Path], object], name: str = "images/left/0001.png") -> Make:
    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        change(out / name)

    return make


def masked(covered: Callable[[NDArray], NDArray]) -> Make:
    """Masks that cover a part of every image (the function takes columns 0..1)."""

    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        keep = ~covered(np.linspace(0, 1, WIDTH)[None].repeat(HEIGHT, 0))
        write_image(out / "mask.png", keep.astype(np.float32))
        content = json.loads((out / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["mask_path"] = "mask.png"
        (out / "transforms.json").write_text(json.dumps(content))

    return make
