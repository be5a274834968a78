"""A head that one camera's landmarks place: other views say how large it is, and which landmarks are wrong."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mifit.capture import Capture
from mifit.config import GeometryConfig
from mifit.core.image import write_image
from mifit.morphable import MorphableModel
from mifit.stages.fit_geometry import fit_geometry
from mifit.stages.geometry.place_head import outline_contrast

SIZE = 1.08
"""Of the head, by the model's."""
PAIR = ("left", "right")


@pytest.fixture
def larger(tiny_capture: Path, tmp_path: Path) -> Callable[[str], Capture]:
    """The capture with all lengths scaled, and the right camera's landmarks missing, wrong or right."""

    def make(landmarks: str) -> Capture:
        folder = tmp_path / landmarks
        shutil.copytree(tiny_capture, folder)
        scene = json.loads((folder / "transforms.json").read_text())
        for frame in scene["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= SIZE
            if frame["camera_id"] != "right" or landmarks == "right":
                continue
            if landmarks == "missing":
                del frame["landmark_path"]
            else:
                path = folder / frame["landmark_path"]
                stored = json.loads(path.read_text())
                points = np.array(stored["points"])
                stored["points"] = ((points - points.mean(axis=0)) * (0.5, 0.8) + points.mean(axis=0) + 15).tolist()
                path.write_text(json.dumps(stored))
        (folder / "transforms.json").write_text(json.dumps(scene))
        return Capture.load(folder)

    return make


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


@pytest.mark.parametrize("landmarks", ["missing", "wrong"])
def test_other_views_say_how_large_a_head_is(
    larger: Callable[[str], Capture], model: MorphableModel, landmarks: str
) -> None:
    capture = larger(landmarks)
    found = fit_geometry(capture, model, PAIR, (0,), GeometryConfig())
    eye = capture.camera("left").position
    truth = SIZE * np.load(capture.path / "truth" / "0000.npz")["vertices"]
    face = np.unique(model.faces[model.face_mask])
    far, expected = (np.linalg.norm(v[face].mean(axis=0) - eye) for v in (found.vertices[0], truth))
    assert found.scale > 1.03
    assert far == pytest.approx(expected, rel=0.02)
    assert [w.camera for w in found.report.warnings if w.code == "landmarks-left-out"] == ["right"] * (
        landmarks == "wrong"
    )


def test_views_that_show_no_head_say_nothing(larger: Callable[[str], Capture], model: MorphableModel) -> None:
    capture = larger("missing")
    for seed in range(3):
        noise = np.random.default_rng(seed).random((150, 200, 3)).astype(np.float32)
        write_image(capture.shots["right", 0].image, cv2.GaussianBlur(noise, (0, 0), 2.0))
        found = fit_geometry(Capture.load(capture.path), model, PAIR, (0,), GeometryConfig())
        assert found.scale == 1.0


def test_landmarks_that_agree_decide_by_themselves(larger: Callable[[str], Capture], model: MorphableModel) -> None:
    found = fit_geometry(larger("right"), model, PAIR, (0,), GeometryConfig())
    assert found.scale == 1.0


def test_one_camera_keeps_the_size_of_the_model(larger: Callable[[str], Capture], model: MorphableModel) -> None:
    assert fit_geometry(larger("right"), model, PAIR[:1], (0,), GeometryConfig()).scale == 1.0


def test_an_outline_stands_out_where_it_lies() -> None:
    there = np.zeros((40, 60), bool)
    there[10:30, 20:40] = True
    log = np.where(there, 1.0, -1.0)[..., None].repeat(3, axis=2)
    beside = np.roll(there, 8, axis=1)
    right, wrong = outline_contrast(there, log), outline_contrast(beside, log)
    assert right is not None and wrong is not None
    assert right > 1.3 * wrong
    assert outline_contrast(np.ones((40, 60), bool), log) is None
