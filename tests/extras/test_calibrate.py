"""Uncalibrated captures: cameras from landmarks and the model's landmark positions."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture import Capture
from mifit.capture.landmark_files import Landmarks, write_landmarks
from mifit.capture.transforms import Shot, View, write_transforms
from mifit.core.camera import Camera
from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.extras.calibrate_heads import calibrate_heads
from mifit.synth.compose import place_cameras


def make_head() -> np.ndarray:
    """68 points on an ellipsoid, centimetres."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-6, 6, 68), rng.uniform(-8, 8, 68)
    return np.column_stack([x, y, 10 * np.sqrt(np.maximum(1 - (x / 8) ** 2 - (y / 11) ** 2, 0.05))])


def write_uncalibrated(folder: Path, intrinsics: bool, noise: float = 0.0, timesteps: int = 3) -> list[Camera]:
    rng = np.random.default_rng(6)
    cameras, head, shots = place_cameras(160, 120, distance=55.0)[:2], make_head(), []
    for t in range(timesteps):
        turn = Rotation.from_euler("yx", [18 * np.sin(1.7 * t), 9 * np.cos(2 * t)], degrees=True).as_matrix()
        for camera in cameras:
            shot = Shot(camera.name, t, folder / f"{camera.name}{t}.png", landmarks=folder / f"{camera.name}{t}.json")
            assert shot.landmarks is not None
            write_image(shot.image, np.zeros((120, 160, 3)))
            pixels = camera.project(head @ turn.T) + noise * rng.standard_normal((68, 2))
            write_landmarks(shot.landmarks, Landmarks(pixels, np.ones(68, dtype=bool)))
            shots.append(shot)
    views = [View.of(camera) for camera in cameras]
    views = [
        dataclasses.replace(v, world_to_camera=None, intrinsics=v.intrinsics if intrinsics else None) for v in views
    ]
    write_transforms(folder / "transforms.json", views, shots, "cm")
    return cameras


def relative(first: Camera, second: Camera) -> np.ndarray:
    return second.world_to_camera @ np.linalg.inv(first.world_to_camera)


@pytest.mark.parametrize("intrinsics", [True, False])
def test_exact_landmarks_give_the_cameras_back(tmp_path: Path, intrinsics: bool) -> None:
    truth = write_uncalibrated(tmp_path, intrinsics)
    capture = Capture.load(tmp_path)
    assert not capture.calibrated
    estimate = calibrate_heads(capture, make_head(), noise=1e-4).capture
    assert not estimate.calibrated  # an estimate never passes for a calibration
    found = [estimate.camera(name) for name in estimate.cameras]
    for camera, expected in zip(found, truth, strict=True):
        assert camera.fx == pytest.approx(expected.fx, rel=1e-3)
        assert (camera.cx, camera.cy) == (80.0, 60.0)
    np.testing.assert_allclose(relative(*found), relative(*truth), atol=0.02)
    np.testing.assert_allclose(found[0].position, 0.0, atol=1e-9)  # the world is the first camera's frame


def test_one_camera_is_enough(tmp_path: Path) -> None:
    truth = write_uncalibrated(tmp_path, intrinsics=False, noise=0.05)
    estimate = calibrate_heads(Capture.load(tmp_path), make_head(), cameras=["right"], noise=1e-3).capture
    assert estimate.camera("right").fx == pytest.approx(truth[1].fx, rel=0.05)
    with pytest.raises(InputError, match="camera 'left' has no intrinsics"):
        estimate.camera("left")


def test_too_few_landmarks_are_counted(tmp_path: Path) -> None:
    write_uncalibrated(tmp_path, intrinsics=False)
    write_landmarks(tmp_path / "left2.json", Landmarks(np.zeros((68, 2)), np.arange(68) < 5))
    with pytest.raises(InputError, match=r"camera 'left', timestep 2: found 5 visible landmarks, expected at least 6"):
        calibrate_heads(Capture.load(tmp_path), make_head())
    with pytest.raises(InputError, match=r"landmarks3d: found shape \(5, 3\)"):
        calibrate_heads(Capture.load(tmp_path), np.zeros((5, 3)))


@pytest.mark.slow
def test_known_intrinsics_and_the_model_give_poses_of_a_real_pair(shared: Path, ict_path: Path) -> None:
    import mifit

    model = mifit.MorphableModel.load(ict_path)
    reference = Capture.load(shared / "captures/gloss")
    views = {name: dataclasses.replace(view, world_to_camera=None) for name, view in reference.views.items()}
    capture = dataclasses.replace(reference, views=views)
    scale = model.unit_mm / capture.unit_mm
    estimate = calibrate_heads(
        capture,
        model.mean[model.landmarks] * scale,
        model.identity[model.landmarks][:, :, :15] * scale,
        cameras=["left", "right"],
        timesteps=[0, 1, 2],
    ).capture
    found, truth = (relative(c.camera("left"), c.camera("right")) for c in (estimate, reference))
    angle = np.degrees(Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude())
    assert angle < 2.0
    np.testing.assert_allclose(found[:3, 3], truth[:3, 3], atol=3.0)
