"""``mifit calibrate CAPTURE``: cameras from the heads in it, held-out ones placed by their landmarks."""

from __future__ import annotations

import contextlib
import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture import Capture
from mifit.capture.landmark_files import Landmarks, write_landmarks
from mifit.cli import main
from mifit.core.camera import Camera
from mifit.core.image import write_image
from mifit.morphable import MorphableModel
from mifit.synth.compose import place_cameras


def write_photos(folder: Path, names: tuple[str, ...], noise: float = 0.3) -> dict[str, Camera]:
    """An uncalibrated capture of the mean face in three poses; a key that mifit doesn't know is in every entry."""
    model = MorphableModel.load("builtin:coarse")
    head = model.mean[model.landmarks] * (model.unit_mm / 10)
    head = head - head.mean(axis=0)
    cameras = {c.name: c for c in place_cameras(320, 240, distance=60.0) if c.name in names}
    rng, frames = np.random.default_rng(6), []
    for t in range(3):
        turn = Rotation.from_euler("yx", [18 * np.sin(1.7 * t), 9 * np.cos(2 * t)], degrees=True).as_matrix()
        for i, (name, camera) in enumerate(cameras.items()):
            write_image(folder / f"{name}{t}.png", np.zeros((240, 320, 3)))
            pixels = camera.project(head @ turn.T) + noise * np.random.default_rng([t, i]).standard_normal((68, 2))
            write_landmarks(folder / f"{name}{t}.json", Landmarks(pixels, np.ones(68, dtype=bool)))
            frames.append(
                {
                    "file_path": f"{name}{t}.png",
                    "landmark_path": f"{name}{t}.json",
                    "camera_id": name,
                    "w": 320,
                    "h": 240,
                }
                | {"timestep_index": t, "exif": {"iso": int(rng.integers(100, 800))}}
            )
    (folder / "transforms.json").write_text(json.dumps({"units": "cm", "frames": frames, "studio": "ours"}))
    return cameras


def relative(first: Camera, second: Camera) -> np.ndarray:
    return second.world_to_camera @ np.linalg.inv(first.world_to_camera)


@dataclass(frozen=True)
class Placed:
    """A capture of three cameras that was calibrated: the true ones, the file as it was, and what the command said."""

    folder: Path
    truth: dict[str, Camera]
    before: dict
    said: str


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Placed:
    folder = tmp_path_factory.mktemp("placed") / "three"
    truth = write_photos(folder, ("left", "right", "third"))
    before, said = json.loads((folder / "transforms.json").read_text()), io.StringIO()
    with contextlib.redirect_stdout(said):
        assert main(["calibrate", str(folder), "--model", "builtin:coarse"]) == 0
    return Placed(folder, truth, before, said.getvalue())


def test_cameras_are_written_into_the_capture(placed: Placed, capsys: pytest.CaptureFixture[str]) -> None:
    folder, truth, before = placed.folder, placed.truth, placed.before
    assert "left: decided" in placed.said and "third: placed" in placed.said
    after = json.loads((folder / "transforms.json").read_text())
    assert after["studio"] == "ours"
    for old, new in zip(before["frames"], after["frames"], strict=True):
        assert old.items() <= new.items() and set(new) - set(old) == {"fl_x", "fl_y", "cx", "cy", "transform_matrix"}
    capture = Capture.load(folder)
    assert capture.calibrated
    found = {name: capture.camera(name) for name in truth}
    for name in ("right", "third"):
        off = relative(found["left"], found[name])[:3, :3] @ relative(truth["left"], truth[name])[:3, :3].T
        assert np.degrees(Rotation.from_matrix(off).magnitude()) < 2.0, name
    for name, camera in truth.items():
        assert found[name].fx == pytest.approx(camera.fx, rel=0.1)
    assert main(["calibrate", str(folder), "--model", "builtin:coarse"]) == 2
    assert "is calibrated already" in capsys.readouterr().err


def test_a_held_out_camera_moves_no_other(placed: Placed, tmp_path: Path) -> None:
    write_photos(tmp_path / "two", ("left", "right"))
    assert main(["calibrate", str(tmp_path / "two"), "--model", "builtin:coarse"]) == 0
    two, three = (Capture.load(folder) for folder in (tmp_path / "two", placed.folder))
    for name in ("left", "right"):
        np.testing.assert_array_equal(two.camera(name).world_to_camera, three.camera(name).world_to_camera)
        assert two.camera(name).fx == three.camera(name).fx


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "expected one of CAPTURE and --board"),
        (["--board", "charuco:9x6:30:22"], "--board needs --out"),
        (["--board", "rubbish", "--out", "x"], "--board: found 'rubbish', expected charuco:"),
        (["nowhere"], "nowhere: no such folder"),
        (["--board", "charuco:9x6:30:22", "--out", "x", "--video", "none.mp4"], "none.mp4: no such video file"),
    ],
)
def test_bad_usage(tmp_path, monkeypatch, capsys, options, message) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", *options]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
