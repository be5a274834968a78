"""From two clips of a face to its surface in one command."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mifit
from mifit.capture import Capture
from mifit.capture.detect import available
from mifit.capture.stereo import write_stereo
from mifit.cli import main
from mifit.core.image import to_8_bit
from mifit.extras.boards import Board
from mifit.output.truth import nearest_points
from tests.capture.test_clips import write_with_sound
from tests.extras.board_video import Studio

RATE, HELD = 25, 10
"""Frames a second, and frames for which each photograph stays."""
LATE, SCALE, CLAP = 0.4, 0.75, 0.9
"""Seconds by which the second camera runs before the first, its size, and when there is a clap."""


BOARD = "charuco:9x6:18:13"
"""The board that is filmed, in a dictionary that nobody names."""


def write_clips(soft: Capture, folder: Path) -> list[str]:
    """Clips of a head by two cameras: photographs that stay a while."""
    early = round(LATE * RATE)
    for name, scale, begin, end in (("left", 1.0, 0, 7), ("right", SCALE, early, 0)):
        images = [to_8_bit(soft.frame(name, t).image) for t in soft.timesteps[:4]]
        images = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in images]
        frames = [images[0]] * begin + [image for image in images for _ in range(HELD)] + [images[-1]] * end
        write_with_sound(folder / f"{name}.mp4", frames, RATE, CLAP + begin / RATE)
    return [str(folder / f"{name}.mp4") for name in ("left", "right")]


def write_board_clips(soft: Capture, folder: Path) -> list[str]:
    """Clips of a board that is held before the same cameras, the second one's later by 8 frames."""
    board, rng = Board.parse(f"{BOARD}:DICT_4X4_50"), np.random.default_rng(2)
    left = soft.camera("left")
    places = []
    for _ in range(18):
        pose = np.eye(4)
        angles = rng.uniform([-45, -30, -30], [5, 30, 30])
        pose[:3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
        centre = np.array([13.0, 0.0, 670.0]) + rng.uniform([-70, -50, -60], [70, 50, 60])
        pose[:3, 3] = centre - pose[:3, :3] @ (*np.divide(board.extent, 2.0), 0.0)
        places.append(pose)
    for name, scale, skipped in (("left", 1.0, 0), ("right", SCALE, 8)):
        camera = soft.camera(name).resized(scale)
        to_camera = camera.world_to_camera @ np.linalg.inv(left.world_to_camera)
        to_camera[:3, 3] *= 10.0  # centimetres
        studio = Studio(board, dataclasses.replace(camera, world_to_camera=to_camera))
        frames = [image for k, pose in enumerate(places) for image in [studio.render(pose, k)] * 2]
        write_with_sound(folder / f"board_{name}.mp4", frames[skipped:], RATE, CLAP - skipped / RATE)
    return [str(folder / f"board_{name}.mp4") for name in ("left", "right")]


@pytest.mark.slow
@pytest.mark.parametrize("by", ["board", "calibration"])
def test_two_clips_become_a_face(shared: Path, tmp_path: Path, variant: str, capsys, by: str) -> None:
    if not available()["mediapipe"]:
        pytest.skip("the networks that find landmarks are not here: mifit doctor --install landmarks")
    soft = Capture.load(shared / "captures" / "soft")
    out = tmp_path / "me"
    command = ["fit", *write_clips(soft, tmp_path), "--out", str(out), "--every", "5"]
    if by == "board":
        command += ["--board", *write_board_clips(soft, tmp_path), "--pattern", BOARD]
    else:
        write_stereo(tmp_path / "stereo.yml", soft.camera("left"), soft.camera("right").resized(SCALE))
        command += ["--calibration", str(tmp_path / "stereo.yml")]
    (tmp_path / "fit.toml").write_text("surface.finest = 1\n")
    command += ["--until", "geometry", "--model", "builtin:coarse", "--timesteps", "auto:2"]
    command += ["--config", str(tmp_path / "fit.toml")]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "right begins 0.400 s before left, by sound" in said
    if by == "board":
        assert "right begins 0.320 s after left, by sound" in said
        assert "dictionary DICT_4X4_50" in said
    result = mifit.Reconstruction.load(out)
    faces = np.load(shared / "models" / "ict_facekit" / "ict_facekit_head.npz")["faces"]
    gauge = np.linalg.inv(result.cameras[0].world_to_camera) @ soft.camera("left").world_to_camera
    used = np.unique(result.model.faces[result.model.face_mask])
    means = []
    for i, timestep in enumerate(result.timesteps):
        photograph = soft.timesteps[min(5 * timestep // HELD, 3)]
        truth = np.load(shared / "captures" / "soft" / "truth" / f"{photograph:04d}.npz")["vertices"]
        truth = truth @ gauge[:3, :3].T + gauge[:3, 3]
        distance = nearest_points(result.geometry.vertices[i][used], truth, faces)[0] * result.unit_mm
        assert np.median(distance) < 1.0, (timestep, np.median(distance))
        means.append(distance.mean())
    assert np.mean(means) < 1.0, means
    if by == "board":
        return
    assert main(command) == 2
    assert "holds a result already" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert "as an earlier run made it of these clips" in capsys.readouterr().err
