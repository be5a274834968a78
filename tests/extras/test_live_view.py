"""The live view: its cameras and lights, and the page itself in a real browser."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.extras.live_view import LiveView, Picture, Shown, browser_camera, under, vertical
from mifit.output.views import orbit_camera
from tests.output import browser
from tests.output.conftest import ball_result


def test_the_browsers_camera_is_ours(ball):
    camera = orbit_camera(ball, 0, 20.0)
    wxyz = np.roll(Rotation.from_matrix(camera.rotation.T).as_quat(), 1)
    fov = 2 * np.arctan(0.5 * camera.height / camera.fy)
    again = browser_camera(wxyz, camera.position, fov, camera.width / camera.height, camera.height)
    assert (again.width, again.height) == (camera.width, camera.height)
    points = ball.geometry.vertices[0]
    np.testing.assert_allclose(again.project(points), camera.project(points), atol=1e-6)


def test_turning_the_light_turns_it_about_the_vertical(ball):
    lit = under(ball, 90.0, None)
    turn = Rotation.from_rotvec(0.5 * np.pi * vertical(ball)).as_matrix()
    before, after = ball.lighting.dominant_direction(), lit.lighting.dominant_direction()
    np.testing.assert_allclose(after, turn @ before, atol=1e-6)
    assert under(ball, 0.0, None) is ball


def test_pictures_follow_the_controls(ball, variant, tmp_path):
    picture, camera = Picture(ball), orbit_camera(ball, 0, 0.0)
    steps = ball.timesteps
    full = picture.render(Shown("full", steps[0]), camera)
    assert full.shape == (camera.height, camera.width, 3) and full.dtype == np.uint8
    lamp = np.full((16, 32, 3), 0.01, np.float32)
    lamp[4:6, 3:6] = 50.0
    write_image(tmp_path / "lamp.hdr", lamp)
    others = [
        Shown("diffuse", steps[0]), Shown("pca", steps[0]), Shown("full", steps[0], turn=90.0),
        Shown("full", steps[0], environment=tmp_path / "lamp.hdr"),
    ]  # fmt: skip
    for shown in others:
        assert np.abs(picture.render(shown, camera).astype(int) - full).mean() > 0.2, shown
    np.testing.assert_array_equal(picture.render(Shown("full", steps[0]), camera), full)
    with pytest.raises(InputError, match="no such image file"):
        picture.render(Shown("full", steps[0], environment=tmp_path / "none.hdr"), camera)


@pytest.mark.slow
@pytest.mark.skipif(browser.CHROMIUM is None, reason="needs Chromium")
def test_the_page_shows_the_head_and_what_the_controls_ask_for(variant, tmp_path):
    pytest.importorskip("viser", reason="needs the extra mifit[view]")
    live = LiveView(ball_result(), port=0)
    seen: dict[str, np.ndarray] = {}
    problems: list[str] = []

    def look() -> None:
        with browser.opened(live.address, Path(tmp_path)) as page:
            seen["first"] = page.settled()
            x, y = page.evaluate(
                "(() => { const s = document.querySelectorAll('[role=slider]'); const b = s[s.length - 1].parentElement"
                ".getBoundingClientRect(); return [b.left + 0.8 * b.width, b.top + b.height / 2]; })()"
            )
            page.drag((x, y), (x, y))
            seen["light"] = page.settled()
            page.drag((300, 300), (420, 300))
            seen["head"] = page.settled()
            problems.extend(page.problems)

    visit = threading.Thread(target=look)
    visit.start()
    live.run(until=lambda: not visit.is_alive())
    live.close()
    assert problems == []
    assert set(seen) == {"first", "light", "head"}
    for name, image in seen.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    left = {name: image[200:, :560].astype(int) for name, image in seen.items()}  # beside the controls and notices
    assert left["first"].std() > 10
    assert np.abs(left["light"] - left["first"]).mean() > 1.0
    assert np.abs(left["head"] - left["light"]).mean() > 1.0
