"""A small capture on disk that tests damage in one way each."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mifit.capture.landmark_files import Landmarks, write_landmarks
from mifit.capture.transforms import Shot, View, write_transforms
from mifit.core.image import write_image
from mifit.synth.compose import place_cameras

SIZE = (48, 32)


def write_capture(folder: Path, timesteps: int = 2, size: tuple[int, int] = SIZE) -> Path:
    """Two calibrated cameras with random images and landmarks."""
    rng = np.random.default_rng(5)
    cameras = place_cameras(*size)[:2]
    shots = []
    for t in range(timesteps):
        for camera in cameras:
            image = folder / "images" / camera.name / f"{t:04d}.png"
            landmarks = folder / "landmarks" / camera.name / f"{t:04d}.json"
            write_image(image, rng.random((size[1], size[0], 3)) * 0.8)
            points = rng.uniform(2, 28, (68, 2))
            write_landmarks(landmarks, Landmarks(points, np.arange(68) % 5 > 0))
            shots.append(Shot(camera.name, t, image, landmarks=landmarks))
    write_transforms(folder / "transforms.json", [View.of(camera) for camera in cameras], shots, "cm")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "köpfe mit leerzeichen")


class Document:
    """The ``transforms.json`` of a capture, to be edited."""

    def __init__(self, folder: Path):
        self.path = folder / "transforms.json"
        self.content: dict[str, Any] = json.loads(self.path.read_text(encoding="utf-8"))

    @property
    def frames(self) -> list[dict[str, Any]]:
        return self.content["frames"]

    def save(self) -> None:
        self.path.write_text(json.dumps(self.content), encoding="utf-8")


@pytest.fixture
def make_capture() -> Callable[..., Path]:
    return write_capture


@pytest.fixture
def document(folder: Path) -> Document:
    return Document(folder)
