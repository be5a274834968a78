"""From two clips of a face to its surface in one command."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import mifit
from mifit.capture import Capture
from mifit.capture.detect import available
from mifit.capture.stereo import write_stereo
from mifit.cli import main
from mifit.core.image import to_8_bit
from tests.capture.test_clips import write_with_sound

RATE, HELD = 25, 10
"""Frames a second, and frames for which each photograph stays."""
LATE, SCALE, CLAP = 0.4, 0.75, 0.9
"""Seconds by which the second camera runs before the first, its size, and when there is a clap."""


@pytest.mark.slow
def test_two_clips_become_a_face(shared: Path, tmp_path: Path, variant: str, capsys) -> None:
    if not available()["mediapipe"]:
        pytest.skip("the networks that find landmarks are not here: mifit doctor --install landmarks")
    soft = Capture.load(shared / "captures" / "soft")
    early = round(LATE * RATE)
    for name, scale, begin, end in (("left", 1.0, 0, 7), ("right", SCALE, early, 0)):
        images = [to_8_bit(soft.frame(name, t).image) for t in soft.timesteps[:4]]
        images = [cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for image in images]
        frames = [images[0]] * begin + [image for image in images for _ in range(HELD)] + [images[-1]] * end
        write_with_sound(tmp_path / f"{name}.mp4", frames, RATE, CLAP + begin / RATE)
    write_stereo(tmp_path / "stereo.yml", soft.camera("left"), soft.camera("right").resized(SCALE))
    out = tmp_path / "me"
    command = ["fit", *(str(tmp_path / f"{name}.mp4") for name in ("left", "right")), "--out", str(out), "--every", "5"]
    command += ["--calibration", str(tmp_path / "stereo.yml"), "--until", "geometry", "--model", "builtin"]
    command += ["--timesteps", "auto:2"]
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "right begins 0.400 s before left, by sound" in said
    result = mifit.Reconstruction.load(out)
    faces = np.load(shared / "models" / "ict_facekit" / "ict_facekit_head.npz")["faces"]
    gauge = np.linalg.inv(result.cameras[0].world_to_camera) @ soft.camera("left").world_to_camera
    used = np.unique(result.model.faces[result.model.face_mask])
    means = []
    for i, timestep in enumerate(result.timesteps):
        photograph = soft.timesteps[min(5 * timestep // HELD, 3)]
        truth = np.load(shared / "captures" / "soft" / "truth" / f"{photograph:04d}.npz")["vertices"]
        mesh = trimesh.Trimesh(truth @ gauge[:3, :3].T + gauge[:3, 3], faces, process=False)
        points = trimesh.sample.sample_surface(mesh, 200_000, seed=1)[0]
        distance = cKDTree(points).query(result.geometry.vertices[i][used])[0] * result.unit_mm
        assert np.median(distance) < 1.0, (timestep, np.median(distance))
        means.append(distance.mean())
    assert np.mean(means) < 1.0, means
    assert main(command) == 2
    assert "holds a result already" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert "as an earlier run made it of these clips" in capsys.readouterr().err
