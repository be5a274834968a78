"""Synthetic captures: they load, agree with their ground truth, and repeat for a seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mifit.capture import Capture
from mifit.core.mesh import split_at_seams
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.synth.compose import FULL_WELL, READ_NOISE, expose, place_cameras
from mifit.synth.head import wrap_uv
from mifit.synth.procedural import smooth_noise, studio_environment
from mifit.synth.skin import SkinStyle


@pytest.mark.slow
def test_a_small_capture_agrees_with_its_ground_truth(variant: str, tmp_path: Path) -> None:
    from mifit.render.gbuffer import SurfaceScene
    from mifit.synth import synthesize

    model, seen = MorphableModel.load("builtin:coarse"), []
    out = synthesize(
        tmp_path / "c",
        timesteps=1,
        model="builtin:coarse",
        width=120,
        height=85,
        spp=16,
        progress=lambda *a: seen.append(a),
    )
    assert seen[-1] == ("Rendering", 2, 2)
    capture = Capture.load(out)
    assert (capture.cameras, capture.timesteps, capture.calibrated) == (("left", "right", "third"), (0,), True)
    truth = np.load(out / "truth/0000.npz")
    np.testing.assert_allclose(truth["R"] @ truth["R"].T, np.eye(3), atol=1e-9)
    for name in capture.cameras:
        camera, frame = capture.camera(name), capture.frame(name, 0)
        assert frame.landmarks is not None
        error = np.linalg.norm(frame.landmarks - camera.project(truth["vertices"][model.landmarks]), axis=1)
        assert np.median(error) < 0.5  # 0.8 px at a width of 680
        assert 30 <= frame.visible.sum() < 68
        # the picture shows the true mesh: lit where the mesh is, black where it isn't
        mask = SurfaceScene(truth["vertices"], model.faces).gbuffer(camera).mask
        bright = frame.image.max(axis=2) > 0.01
        assert (bright & mask).sum() > 0.9 * mask.sum()
        assert (bright & ~mask).sum() < 0.05 * mask.sum()
    maps = np.load(out / "truth/maps.npz")
    assert set(maps) == {"albedo", "specular", "roughness", "bump", "cover"}
    inside = maps["cover"]
    assert 0.0 < maps["albedo"][inside].min() <= maps["albedo"][inside].max() < 1.0
    assert maps["specular"][inside].std() > 0.02


def test_sensor_noise_has_the_stated_spread_and_range() -> None:
    rng = np.random.default_rng(0)
    for level in (0.0, 0.05, 0.5):
        shot = expose(np.full((200, 200, 3), level), rng)
        expected = np.sqrt(level / FULL_WELL + READ_NOISE**2)
        if level:  # at zero the lower half is clipped
            assert shot.std() == pytest.approx(expected, rel=0.03)
        assert shot.min() >= 0.0
    assert expose(np.full((9, 9, 3), 5.0), rng).max() == 1.0


def test_cameras_look_at_the_head_from_where_they_should() -> None:
    left, right, third = place_cameras(680, 480)
    for camera in (left, right, third):
        np.testing.assert_allclose(camera.project(np.zeros(3)), (340, 240), atol=1e-9)
        assert np.linalg.norm(camera.position) == pytest.approx(72.0)
        assert np.linalg.det(camera.rotation) == pytest.approx(1.0)
        assert camera.project(np.array([0.0, 5.0, 0.0]))[1] < 240  # up is up
    assert np.degrees(np.arctan2(right.position[0], right.position[2])) == pytest.approx(20.0)
    assert left.position[0] == pytest.approx(-right.position[0])
    assert third.position[1] > 5


def test_the_studio_repeats_for_a_seed_and_lights_the_front() -> None:
    image = studio_environment(3)
    assert image.shape == (128, 256, 3)
    np.testing.assert_array_equal(image, studio_environment(3))
    assert np.abs(image - studio_environment(4)).max() > 0.5
    assert image.min() > 0
    assert image.max() > 10 * np.median(image)
    front = image[:, 64:192].sum()  # u = 1/4 is +x, u = 1/2 is +z
    assert front > 0.5 * image.sum()


def test_smooth_noise_is_smooth_and_of_unit_size() -> None:
    points = np.random.default_rng(1).uniform(0, 200, (4000, 3))
    here = smooth_noise(points, 20.0, np.random.default_rng(5))
    near = smooth_noise(points + 0.1, 20.0, np.random.default_rng(5))
    assert here.std() == pytest.approx(1.0, abs=0.35)
    assert np.abs(here - near).max() < 0.2


def test_a_given_tone_changes_nothing_else_of_a_subject() -> None:
    own, fair, deep = SkinStyle.draw(5), SkinStyle.draw(5, 0.0), SkinStyle.draw(5, 1.0)
    assert (deep.tone < 0.45 * fair.tone).all()
    for name in ("stubble", "wrinkles", "oil", "freckles", "moles"):
        assert getattr(own, name) == getattr(fair, name) == getattr(deep, name)


def test_seams_are_split_and_tiles_wrapped() -> None:
    faces, faces_uv = np.array([[0, 1, 2], [2, 1, 3]]), np.array([[0, 1, 2], [4, 3, 5]])
    uv = np.array([[0, 0], [1, 0], [0, 1], [1.2, 0.1], [1.1, 0.9], [1.9, 0.9]], dtype=np.float32)
    mesh = split_at_seams(faces, faces_uv, uv)
    assert len(mesh.origin) == 6
    np.testing.assert_array_equal(mesh.origin[mesh.faces], faces)
    np.testing.assert_array_equal(mesh.uv[mesh.faces], uv[faces_uv])
    wrapped, index = wrap_uv(uv, faces_uv)
    centres = wrapped[index].mean(axis=1)
    assert ((centres >= 0) & (centres < 1)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"timesteps": 0}, "timesteps: found 0, expected a whole number from 1 to"),
        ({"width": 8}, "width: found 8, expected a whole number from 16 to"),
        ({"spp": 0}, "spp: found 0"),
        ({"tone": 1.5}, "tone: found 1.5, expected 0"),
        ({"env": "none.hdr", "model": "builtin:coarse"}, "none.hdr: no such image file"),
    ],
)
def test_bad_requests(tmp_path: Path, options: dict, message: str) -> None:
    from mifit.synth import synthesize

    with pytest.raises(InputError, match=message):
        synthesize(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()
