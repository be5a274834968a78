"""Results are values: changed copies, equality, a short text, light from anything, cameras from anywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit import cli
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.core.image import read_image
from mifit.core.sh import SHLighting
from mifit.errors import InputError
from mifit.result import Reconstruction
from tests.output.conftest import ball_camera
from tests.output.test_views import smooth_environment
from tests.variant import VARIANT


def test_changed_copies(ball, variant):
    albedo = 0.5 * ball.reflectance.diffuse
    darker = ball.with_albedo(albedo)
    assert type(darker) is Reconstruction and darker != ball and ball.reflectance.diffuse.max() > 0.5
    np.testing.assert_array_equal(darker.reflectance.diffuse, albedo)
    camera = ball.cameras[0]
    ratio = darker.with_specular(0).render(camera, 0) / np.maximum(ball.with_specular(0).render(camera, 0), 1e-6)
    ambient = ball.illumination.ambient
    assert 0.5 < np.median(ratio[28:36, 28:36, 0]) < 0.5 + ambient
    matt = ball.with_specular(0.0)
    np.testing.assert_allclose(matt.render(camera, 0), ball.render(camera, 0, method="diffuse"), atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.with_albedo(np.zeros((8, 8, 3))), r"diffuse: found shape \(8, 8, 3\)"),
        (lambda r: r.with_albedo(2 * np.ones_like(r.reflectance.diffuse)), "values 2 to 2, expected"),
        (lambda r: r.with_specular(-0.1), "expected .* with reflectances 0 to 1"),
        (lambda r: r.with_specular(np.full_like(r.reflectance.specular, np.nan)), "with reflectances"),
        (lambda r: replace(r, reflectance=None).with_specular(0.1), "has no reflectance"),
        (lambda r: replace(r, reflectance=None).with_illumination(Illumination(np.ones((9, 3)))), "no reflectance"),
        (lambda r: r.relight(smooth_environment(), rotate=np.ones((3, 3))), "expected degrees about"),
        (lambda r: r.relight(smooth_environment(), rotate=np.diag([1.0, 1.0, -1.0])), "expected degrees about"),
        (lambda r: r.relight(smooth_environment(), rotate=float("nan")), "finite angle"),
        (lambda r: r.relight(SHLighting(np.zeros((9, 3)))), "mean luminance of 0"),
        (lambda r: r.relight(smooth_environment(), exposure=0.0), "exposure: found 0.0"),
    ],
)
def test_what_is_refused(ball, change, message):
    with pytest.raises(InputError, match=message):
        change(ball)


def test_equality_and_text(ball, stage_1_ball):
    assert ball == replace(ball) and ball != stage_1_ball and ball != 3
    assert ball == replace(ball, model=replace(ball.model, name="renamed"))
    assert ball != replace(ball, model=replace(ball.model, mean=1.1 * ball.model.mean))
    assert ball != replace(ball, warnings=(Diagnostic("one", "text"),))
    assert repr(ball) == (
        "Reconstruction(model ball; timesteps 0, 3; cameras left, right; 32 x 32 maps; prefiltered shading, 3 bands)"
    )
    assert repr(stage_1_ball) == "Reconstruction(model ball; timesteps 0, 3; cameras left, right)"
    lit = ball.relight(smooth_environment())
    assert repr(lit).endswith("; relit)") and len(repr(lit)) < 200
    camera = ball_camera()
    assert camera == ball_camera() and camera != ball_camera(angle=3) and hash(camera) == hash(ball_camera())


def test_light_from_anything(ball):
    environment = smooth_environment()
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # 90 degrees about +y
    harmonics = SHLighting.from_envmap(environment, 3)
    by_image = ball.relight(environment, rotate=90, exposure=1.0)
    by_harmonics = ball.relight(harmonics, rotate=turn)
    np.testing.assert_allclose(by_harmonics.illumination.radiance, by_image.illumination.radiance, atol=1e-6)
    assert by_harmonics.illumination.ambient == pytest.approx(by_image.illumination.ambient)
    assert by_image.environment is not None and by_harmonics.environment is None
    sun = DistantLight(np.array([0.0, 0.0, 1.0]), 0.0, np.ones(3))
    light = Illumination(harmonics.coefficients, (sun,), 0.3)
    whole = ball.relight(light, rotate=90)
    assert whole.illumination.ambient == 0.3
    np.testing.assert_allclose(whole.illumination.lights[0].direction, [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(whole.illumination.radiance, by_image.illumination.radiance, atol=1e-6)
    np.testing.assert_allclose(ball.relight(light, exposure=2.0).illumination.ambient, 0.6)
    assert ball.with_illumination(ball.illumination) == ball


def test_many_rotations_read_and_project_once(ball, monkeypatch):
    count = [0]
    project = SHLighting.from_envmap.__func__

    def counted(cls, *arguments):
        count[0] += 1
        return project(cls, *arguments)

    monkeypatch.setattr(SHLighting, "from_envmap", classmethod(counted))
    lit = ball.relight(smooth_environment(), rotations=range(0, 360, 10))
    assert len(lit) == 36 and count[0] == 1
    assert lit[0].environment is lit[35].environment  # one image, turned by whoever shows it
    single = ball.relight(smooth_environment(), rotate=50)
    np.testing.assert_allclose(lit[5].illumination.radiance, single.illumination.radiance, atol=1e-12)


def test_a_turned_image_is_turned_in_the_scene_as_its_harmonics_are(ball, variant):
    import mitsuba as mi

    turn = Camera.look_at((1.0, 2.0, 3.0)).rotation  # any rotation
    lit = ball.relight(smooth_environment(), rotate=turn, exposure=1.0)
    (emitter,) = lit.scene("path").emitters()
    directions = np.random.default_rng(0).standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(*(-directions.T).astype(np.float32))
    shown = np.array(emitter.eval(si)).T
    expected = SHLighting.from_envmap(smooth_environment(), 10).rotate(turn).evaluate(directions)
    assert np.abs(shown - expected).mean() < 0.02 * expected.mean() < np.abs(shown - shown[::-1]).mean()


def test_look_at():
    camera = Camera.look_at((0, 0, 50), (0, 0, 0), width=200, height=100, fov=30)
    np.testing.assert_allclose(camera.project(np.zeros(3)), [100, 50], atol=1e-9)
    edge = 50 * np.tan(np.radians(15))
    np.testing.assert_allclose(camera.project(np.array([edge, 0, 0])), [200, 50], atol=1e-9)
    assert camera.project(np.array([0, 1.0, 0]))[1] < 50  # up is up
    np.testing.assert_allclose(camera.position, [0, 0, 50], atol=1e-12)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    for bad in ({"eye": (0, 0, 0)}, {"eye": (0, 5, 0)}, {"eye": (0, 0, 5), "fov": 0}, {"eye": (0, 0, 5), "fov": 180}):
        with pytest.raises(InputError):
            Camera.look_at(**bad)


def test_orbit():
    target = np.array([1.0, 2.0, 3.0])
    camera = ball_camera(angle=0)
    right, up = camera.rotation[0], -camera.rotation[1]
    before = camera.project(target)
    moved = camera.orbit(yaw=10, target=target)
    np.testing.assert_allclose(moved.project(target), before, atol=1e-9)
    assert (moved.position - camera.position) @ right > 5
    assert (camera.orbit(pitch=10, target=target).position - camera.position) @ up > 5
    near = camera.orbit(20, 10, target, distance=30)
    assert np.linalg.norm(near.position - target) == pytest.approx(30)
    np.testing.assert_allclose(camera.orbit(360, 0, target).world_to_camera, camera.world_to_camera, atol=1e-9)
    assert near.name == "left+20+10" and (near.fx, near.width) == (camera.fx, camera.width)
    with pytest.raises(InputError, match="distance: found -1"):
        camera.orbit(distance=-1)


def test_the_command_renders_from_any_side(ball, variant, tmp_path, capsys):
    ball.model.save(tmp_path / "ball.npz")
    replace(ball, model_source=str(tmp_path / "ball.npz")).save(tmp_path / "result")
    start = ["render", str(tmp_path / "result"), "--quiet", "--variant", VARIANT]
    image = tmp_path / "a.exr"
    assert cli.main([*start, "--yaw", "25", "--pitch", "10", "--distance", "60", "--out", str(image)]) == 0
    expected = ball.render(ball.orbit(25, 10, 60), 0)
    np.testing.assert_allclose(np.asarray(read_image(image)), expected[..., : np.asarray(read_image(image)).shape[2]])
    assert cli.main([*start, "--camera", "left", "--timestep", "3", "--out", str(image), "--force"]) == 0
    assert cli.main([*start, "--camera", "left", "--yaw", "3", "--out", str(tmp_path / "b.exr")]) == 2
    assert "found --yaw beside it" in capsys.readouterr().err
