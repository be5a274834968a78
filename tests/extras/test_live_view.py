"""The live view: its cameras and lights, and the page itself in a real browser."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.extras.live_view import FitView, LiveView, Picture, Shown, browser_camera, under, vertical
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


@pytest.mark.slow
@pytest.mark.skipif(browser.CHROMIUM is None, reason="needs Chromium")
def test_a_fit_is_shown_while_it_is_fitted(variant, tiny_capture, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="needs the extra mifit[view]")
    import mifit
    from mifit.progress import silent

    config = mifit.FitConfig(
        geometry=mifit.GeometryConfig(rounds=1),
        reflectance=mifit.ReflectanceConfig(texture_size=64, shading="prefiltered", bands=4, exponent=100),
    )
    capture, model = mifit.Capture.load(tiny_capture), mifit.MorphableModel.load("builtin:coarse")
    seen: list[np.ndarray] = []
    problems: list[str] = []
    visits: list[threading.Thread] = []
    shown: list[tuple[str, ...]] = []
    steps: list[np.ndarray] = []

    def part(image: np.ndarray) -> np.ndarray:
        """Beside the controls and notices."""
        return image[200:, :560].astype(int)

    def look(address: str) -> None:
        def visit() -> None:
            with browser.opened(address, Path(tmp_path)) as page:
                while fitting.is_set():
                    seen.append(page.screenshot())
                seen.append(page.settled())
                problems.extend(page.problems)

        visits.append(threading.Thread(target=visit))
        visits[0].start()

    fitting = threading.Event()
    fitting.set()
    view = FitView(silent, look, "127.0.0.1", 0)

    def watch(result):
        shown.append(result.methods)
        view.watch(result)
        taken, limit = len(seen), time.monotonic() + 30

        def is_shown() -> bool:
            return len(seen) > taken + 1 and part(seen[-1]).std() > 10

        view.live.run(until=lambda: is_shown() or time.monotonic() > limit)  # the page shows this step
        steps.append(part(seen[-1]))

    watched = mifit.fit(capture, model, timesteps=[0], config=config, progress=view.progress, watch=watch)
    fitting.clear()
    view.live.run(until=lambda: not visits[0].is_alive())
    view.live.close()
    assert problems == []
    assert shown[0] == ("pca",) and "full" in shown[-1] and len(shown) >= 4
    for name, image in (("while", seen[len(seen) // 2]), ("after", seen[-1])):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    left = [part(image) for image in seen]
    assert left[-1].std() > 10
    assert np.abs(left[-1] - steps[1]).mean() > 0.3  # not the second step's still; the page opens during the first
    changes = [np.abs(a - b).mean() for a, b in itertools.pairwise(left)]
    assert sum(change > 0.3 for change in changes) >= 2  # pictures came while the fit went on
    alone = mifit.fit(capture, model, timesteps=[0], config=config)  # watching changes nothing
    for part, name in (("geometry", "vertices"), ("reflectance", "diffuse"), ("normals", "normal_object")):
        np.testing.assert_array_equal(getattr(getattr(watched, part), name), getattr(getattr(alone, part), name))
