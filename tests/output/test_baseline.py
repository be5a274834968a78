"""The image-based figure beside ours, and views that can't be judged."""

import json

import numpy as np
import pytest

from mifit.capture import Capture
from mifit.errors import InputError
from mifit.output.evaluate import compare, evaluate
from tests.output.conftest import ball_camera
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


def test_a_camera_without_calibration_and_a_timestep_without_a_fit_are_refused(ball, photographs, tmp_path, variant):
    frames = [
        {"file_path": "x.png", "camera_id": camera.name, "timestep_index": t, "w": 64, "h": 64}
        for camera in (LEFT, THIRD)
        for t in ball.timesteps
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(InputError, match=r"camera 'third' has no .*; estimate it with mifit calibrate"):
        evaluate(ball, Capture.load(tmp_path), "third", timesteps=[0])
    with pytest.raises(InputError, match="timestep 7 is not in"):
        evaluate(ball, photographs, "third", timesteps=[7])
