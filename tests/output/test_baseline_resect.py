"""The image-based figure beside ours, and held-out cameras that nobody calibrated."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mifit.capture import Capture
from mifit.errors import InputError
from mifit.output.evaluate import compare, evaluate
from mifit.output.placement import needs_resection, resect
from tests.output.conftest import RADIUS, ball_camera
from tests.output.test_render_evaluate import FakeCapture

LEFT, RIGHT, THIRD = ball_camera("left", -20), ball_camera("right", 20), ball_camera("third", 0)


def painted(camera, timestep):
    """Photographs of a matt ball whose colour is its height, and a highlight that only the third camera sees."""
    rows = np.linspace(0.1, 0.5, camera.height, dtype=np.float32)
    image = np.repeat(np.repeat(rows[:, None, None], camera.width, 1), 3, 2)
    if camera.name == "third":
        image[30:34, 30:34] = 1.0
    return image


@pytest.fixture
def photographs():
    return FakeCapture((LEFT, RIGHT, THIRD), painted)


def test_baseline_and_our_methods_are_measured_on_the_same_pixels(ball, photographs, variant):
    found = evaluate(ball, photographs, "third", timesteps=[0], baseline=True)
    plain = evaluate(ball, photographs, "third", timesteps=[0])
    assert {k: v for k, v in found.items() if k != "baseline"} == plain
    base, each = found["baseline"], compare(ball, photographs, "third", 0, baseline=True)
    blends = {"image_based", "image_based_nearest", "image_based_angle"}
    assert set(base["methods"]) == blends | {"pca", "diffuse", "full"} and set(each.baseline) == blends
    assert 0 < base["region_pixels"] <= found["region_pixels"]
    assert each.seen.sum() == base["region_pixels"] and not (each.seen & ~each.region).any()
    images = {**each.baseline, "full": each.renders["full"][..., :3]}
    for name, image in images.items():
        error = (image.astype(float) - each.photograph)[each.seen]
        assert base["methods"][name]["rmse"] == pytest.approx(np.sqrt((error**2).mean()))
    # The views agree but for the highlight, which no fitted view shows.
    away = each.seen.copy()
    away[26:38, 26:38] = False
    assert np.abs(each.baseline["image_based"].astype(float) - each.photograph)[away].mean() < 4
    assert base["methods"]["image_based"]["psnr"] > base["methods"]["full"]["psnr"] + 3


def uncalibrated(folder, ball, noise=0.0, intrinsics=False):
    """A capture without poses whose landmarks are the ball's own, seen by the third camera."""
    rng = np.random.default_rng(0)
    frames = []
    for camera in (LEFT, THIRD):
        for i, t in enumerate(ball.timesteps):
            points = camera.project(ball.geometry.vertices[i][ball.model.landmarks].astype(float))
            points += noise * rng.standard_normal(points.shape)
            name = f"{camera.name}_{t}.json"
            (folder / name).write_text(json.dumps({"points": points.tolist(), "visible": [True] * 68}))
            frame = {"file_path": "x.png", "landmark_path": name, "camera_id": camera.name, "timestep_index": t}
            frame |= {"w": 64, "h": 64}
            if intrinsics:
                frame |= {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
            frames.append(frame)
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return Capture.load(folder)


@pytest.mark.parametrize("intrinsics", [False, True])
def test_a_camera_is_placed_from_its_landmarks_alone(ball, tmp_path, intrinsics):
    capture = uncalibrated(tmp_path, ball, intrinsics=intrinsics)
    assert needs_resection(ball, capture, "third") and not needs_resection(ball, capture, "left")
    camera, pixels = resect(ball, capture, "third")
    assert pixels < 0.02
    assert np.linalg.norm(camera.position - THIRD.position) < 0.2
    assert camera.fx == pytest.approx(THIRD.fx, rel=3e-3)


def test_a_camera_of_another_size_gets_its_own_focal_length(ball, tmp_path):
    capture = uncalibrated(tmp_path, ball)
    zoomed = replace(THIRD, width=96, height=96, fx=1.3 * THIRD.fx, fy=1.3 * THIRD.fy, cx=48.0, cy=48.0)
    document = json.loads((tmp_path / "transforms.json").read_text())
    for frame in document["frames"]:
        if frame["camera_id"] == "third":
            i = ball.timesteps.index(frame["timestep_index"])
            points = zoomed.project(ball.geometry.vertices[i][ball.model.landmarks].astype(float))
            (tmp_path / frame["landmark_path"]).write_text(json.dumps({"points": points.tolist()}))
            frame |= {"w": 96, "h": 96}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    camera, pixels = resect(ball, Capture.load(tmp_path), "third")
    assert camera.fx == pytest.approx(zoomed.fx, rel=0.03) and pixels < 0.1
    assert needs_resection(ball, capture, "third")


def test_noise_of_landmarks_moves_the_camera_little(ball, tmp_path):
    camera, pixels = resect(ball, uncalibrated(tmp_path, ball, noise=0.3), "third")
    assert 0.2 < pixels < 0.8
    centre = camera.project(ball.geometry.vertices[0].mean(0).astype(float))
    assert np.linalg.norm(centre - THIRD.project(ball.geometry.vertices[0].mean(0).astype(float))) < 0.3
    assert np.linalg.norm(camera.position - THIRD.position) < 0.1 * np.linalg.norm(THIRD.position)


def test_evaluation_says_that_it_placed_the_camera(ball, tmp_path, variant, monkeypatch):
    capture = uncalibrated(tmp_path, ball)
    frame = SimpleNamespace(image=painted(THIRD, 0), valid=np.ones((64, 64), bool))
    monkeypatch.setattr(Capture, "frame", lambda self, name, t: frame)
    found = evaluate(ball, capture, "third", timesteps=[0])
    known = evaluate(ball, FakeCapture((LEFT, RIGHT, THIRD), painted), "third", timesteps=[0])
    assert found["resected"]["landmark_pixels"] < 0.02 and "resected" not in known
    assert found["methods"]["full"]["psnr"] == pytest.approx(known["methods"]["full"]["psnr"], abs=0.3)


def test_too_few_landmarks_are_refused(ball, tmp_path):
    capture = uncalibrated(tmp_path, ball)
    for path in tmp_path.glob("third_*.json"):
        stored = json.loads(path.read_text())
        path.write_text(json.dumps({**stored, "visible": [True] * 5 + [False] * 63}))
    with pytest.raises(InputError, match="not calibrated, and no fitted timestep has 6 visible landmarks"):
        resect(ball, Capture.load(tmp_path), "third")
    assert RADIUS > 0 and not needs_resection(replace(ball, cameras=(THIRD,)), capture, "third")
