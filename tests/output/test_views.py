"""Turntables, sequences and relighting."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmarks.table1 import evaluate_relit
from mifit.core.image import write_image
from mifit.core.sh import SHLighting, latlong_directions
from mifit.errors import InputError
from mifit.output.views import orbit_camera, write_turntable
from tests.output.conftest import ball_camera
from tests.output.test_render_evaluate import FakeCapture


def test_orbit_keeps_distance_and_looks_at_the_face(ball):
    vertices = ball.geometry.vertices[1][np.unique(ball.model.faces[ball.model.face_mask])]
    centre = (vertices.min(0) + vertices.max(0)) / 2
    front = ball.geometry.rotation[1][:, 2]
    seen = {}
    for degrees in (-35.0, 0.0, 35.0):
        camera = orbit_camera(ball, 3, degrees)
        np.testing.assert_allclose(camera.project(centre), (32, 32), atol=1e-3)
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        np.testing.assert_allclose(camera.rotation[1], (0, -1, 0), atol=1e-6)
        seen[degrees] = (camera.position - centre) / np.linalg.norm(camera.position - centre)
    np.testing.assert_allclose(seen[0.0], front, atol=1e-6)
    assert np.degrees(np.arccos(seen[35.0] @ front)) == pytest.approx(35, abs=1e-3)
    # A positive angle shows the head's left side, +x in object space.
    assert seen[35.0] @ ball.geometry.rotation[1][:, 0] > 0.5 > seen[-35.0] @ ball.geometry.rotation[1][:, 0]


def test_turntable_writes_views_sheet_and_animation(ball, variant, tmp_path):
    write_turntable(ball, tmp_path, steps=3)
    names = {p.name for p in tmp_path.iterdir()}
    views = {f"{m}_{k:02d}.png" for m in ("full", "diffuse") for k in range(3)}
    assert names == views | {"turntable.png", "turntable.webp"}
    full, diffuse = (np.asarray(Image.open(tmp_path / f"{m}_01.png"), float) for m in ("full", "diffuse"))
    assert (full[..., :3] - diffuse[..., :3]).max() > 2 and (full[..., 3] == diffuse[..., 3]).all()
    with Image.open(tmp_path / "turntable.webp") as animation:
        assert animation.n_frames == 4


def smooth_environment(height=64):
    d = latlong_directions(height, 2 * height)
    return (np.exp(3 * (d @ np.array([0.6, 0.48, 0.64]) - 1))[..., None] * (1.0, 0.8, 0.6)).astype(np.float32)


def test_relighting_projects_the_environment_at_its_own_or_the_captures_level(ball):
    environment = smooth_environment()
    lit = ball.relight(environment, exposure="auto")
    expected = SHLighting.from_envmap(environment, 3).coefficients
    ratio = lit.lighting.coefficients / expected
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-3)
    luminance = np.array([0.2126, 0.7152, 0.0722])
    assert lit.lighting.coefficients[0] @ luminance == pytest.approx(ball.lighting.coefficients[0] @ luminance)
    assert lit.illumination.ambient == pytest.approx(ball.illumination.ambient)
    plain = ball.relight(environment)
    np.testing.assert_allclose(plain.lighting.coefficients, expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(plain.environment, environment)
    # The ambient term goes with the mean radiance.
    brighter = plain.lighting.coefficients[0] @ luminance / (ball.lighting.coefficients[0] @ luminance)
    assert plain.illumination.ambient == pytest.approx(ball.illumination.ambient * brighter)
    assert not 0.9 < brighter < 1.1


@pytest.mark.parametrize("degrees", [30.0, -107.3])
def test_rotation_turns_harmonics_and_image_alike(ball, degrees):
    lit = ball.relight(smooth_environment(), rotate=degrees, exposure=1.0)
    from_image = SHLighting.from_envmap(lit.environment, 3).rotate(lit.environment_rotation)
    np.testing.assert_allclose(lit.lighting.coefficients, from_image.coefficients, atol=2e-3)
    # The light was at azimuth atan2(x, z); turning about +y by a positive angle moves +z towards +x.
    before = ball.relight(smooth_environment(), exposure=1.0).lighting.dominant_direction()
    after = lit.lighting.dominant_direction()
    turned = np.degrees(np.arctan2(after[0], after[2]) - np.arctan2(before[0], before[2]))
    assert (turned - degrees + 180) % 360 - 180 == pytest.approx(0, abs=0.1)


def test_relit_views_change_and_files_are_read(ball, variant, tmp_path):
    write_image(tmp_path / "studio.hdr", smooth_environment())
    lit = ball.relight(tmp_path / "studio.hdr", rotate=90)
    camera = ball.cameras[0]
    assert np.abs(lit.render(camera, 0) - ball.render(camera, 0)).max() > 0.02


def test_relit_error_needs_one_factor_and_no_more(ball, variant):
    """Photographs are renders under the environment, 1.7 times as bright: full is exact, diffuse is not."""
    lit = ball.relight(smooth_environment())
    cameras = (*ball.cameras, ball_camera("third", 5.0))
    capture = FakeCapture(cameras, lambda c, t: 1.7 * lit.render(c, t)[..., :3])
    found = evaluate_relit(ball, smooth_environment(), capture, "third")
    assert found["methods"]["full"]["exposure"] == pytest.approx(1.7, rel=1e-4)
    assert found["methods"]["full"]["psnr"] > 60 > found["methods"]["diffuse"]["psnr"]
    assert found["timesteps"] == [0, 3]
    with pytest.raises(InputError, match="camera left: was fitted"):
        evaluate_relit(ball, smooth_environment(), capture, "left")


def test_bad_environments_are_refused(ball, stage_1_ball, tmp_path):
    with pytest.raises(InputError, match="ended after the geometry stage"):
        stage_1_ball.relight(smooth_environment())
    with pytest.raises(InputError, match="no such image file"):
        ball.relight(tmp_path / "none.hdr")
    for bad in (np.zeros((32, 64, 3)), np.full((32, 64, 3), np.nan), np.ones((32, 64))):
        with pytest.raises(InputError, match="environment: found"):
            ball.relight(bad)
    with pytest.raises(InputError, match="exposure: found -1"):
        ball.relight(smooth_environment(), exposure=-1)
    with pytest.raises(InputError, match="no cameras"):
        orbit_camera(replace(ball, cameras=()), 0, 0.0)


def test_rendering_without_a_variant_names_the_call() -> None:
    code = (
        "from tests.output.conftest import ball_result; from mifit.errors import VariantError\n"
        "ball = ball_result()\n"
        "for integrator in ('local', 'path'):\n"
        "    try: ball.render(ball.cameras[0], 0, integrator=integrator)\n"
        "    except VariantError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.count("call mifit.set_variant('auto') first") == 2
