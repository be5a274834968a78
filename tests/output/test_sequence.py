"""Moving pictures of a tracked sequence: videos and animated glTF."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mifit.core.image import to_8_bit
from mifit.core.mesh import part_of, split_at_seams
from mifit.errors import InputError
from mifit.output.evaluate import rgba_8_bit
from mifit.output.export import export
from mifit.output.figures import overlay
from mifit.output.gltf import STEP
from mifit.output.views import (
    write_moving_pictures,
    write_overlay,
    write_video,
)
from mifit.result.ownership import replacing_files
from tests.output.test_export import read_glb
from tests.output.test_render_evaluate import FakeCapture


def read_video(path):
    reader = cv2.VideoCapture(str(path))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1])
    return np.array(frames), reader.get(cv2.CAP_PROP_FPS)


@pytest.fixture(scope="module")
def backwards(ball):
    """The ball with its later timestep first, as tracking back in time leaves it."""
    return replace(ball, geometry=ball.geometry.at((3, 0)))


@pytest.fixture(scope="module")
def capture(ball):
    return FakeCapture(ball.cameras, lambda c, t: np.full((c.height, c.width, 3), 0.05 + 0.1 * t))


def test_video_holds_its_frames(tmp_path):
    shades = [20, 120, 220]
    write_video(tmp_path / "a.mp4", (np.full((49, 64, 3), s, np.uint8) for s in shades), 25)
    frames, rate = read_video(tmp_path / "a.mp4")
    assert frames.shape == (3, 48, 64, 3) and rate == 25
    np.testing.assert_allclose(frames.mean((1, 2, 3)), shades, atol=4)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_video_that_can_not_be_leaves_nothing(tmp_path):
    for frames, fps, message in (([], 12, "found no frame"), ([np.zeros((8, 8, 3), np.uint8)], 0, "fps: found 0")):
        with pytest.raises(InputError, match=message):
            write_video(tmp_path / "a.mp4", frames, fps)
    with pytest.raises(InputError, match=r"expected '\.mp4'"):
        write_video(tmp_path / "a.avi", [], 12)

    def broken():
        yield np.zeros((16, 16, 3), np.uint8)
        raise ValueError("render failed")

    with pytest.raises(ValueError, match="render failed"):
        write_video(tmp_path / "a.mp4", broken(), 12)
    assert not list(tmp_path.iterdir())


def test_overlay_shows_input_and_render_in_order_of_time(backwards, capture, variant, tmp_path):
    write_overlay(backwards, capture, "right", tmp_path / "o.mp4")
    frames, rate = read_video(tmp_path / "o.mp4")
    assert frames.shape == (2, 64, 128, 3) and rate == 12
    for frame, timestep in zip(frames.astype(float), (0, 3), strict=True):
        photograph = to_8_bit(capture.frame("right", timestep).image)
        render = rgba_8_bit(backwards.render(capture.camera("right"), timestep, samples=1))
        assert np.abs(frame[:, :64] - photograph).mean() < 3
        assert np.abs(frame[:, 64:] - overlay(photograph, render)).mean() < 6


def test_tracking_leaves_an_overlay_per_camera_and_an_animation(ball, capture, variant, tmp_path):
    names = {"overlay_left.mp4", "overlay_right.mp4", "sequence.glb"}
    with replacing_files(tmp_path) as new:
        write_moving_pictures(new, ball, capture)
    assert {p.name for p in tmp_path.iterdir()} == {".mifit", *names}
    ball.save(tmp_path)  # a new fit in the folder: pictures of the old one go
    assert not names & {p.name for p in tmp_path.iterdir()}


def test_animation_moves_every_vertex_to_where_it_was_tracked(backwards, ball, tmp_path):
    export(backwards, "glb", tmp_path / "a.glb", animate=True, fps=6.0)
    document, read, _ = read_glb(tmp_path / "a.glb")
    animation = document["animations"][0]
    inputs = {s["input"] for s in animation["samplers"]}
    times = read(inputs.pop())[:, 0]
    assert not inputs and times.tolist() == [0.0, 0.5]
    values = {c["target"]["path"]: read(animation["samplers"][c["sampler"]]["output"]) for c in animation["channels"]}
    node = document["nodes"][animation["channels"][0]["target"]["node"]]
    assert node["name"] == "a" and "matrix" not in node
    part = part_of(split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv), ball.model.face_mask)
    primitive = document["meshes"][0]["primitives"][0]
    base, target = read(primitive["attributes"]["POSITION"]), read(primitive["targets"][0]["POSITION"])
    for k in range(2):
        turn = Rotation.from_quat(values["rotation"][k]).as_matrix()
        world = (base + values["weights"][k] * target) @ turn.T + values["translation"][k]
        # The timestep at rest is exact; another is off by the rounding of the targets, half a step at full weight.
        rounding = 0.5 * STEP * np.abs(values["weights"][k] - document["meshes"][0]["weights"]).sum()
        np.testing.assert_allclose(world, ball.geometry.vertices[k][part.origin] / 100, atol=1e-6 + rounding)
    assert np.sum(values["rotation"][0] * values["rotation"][1]) > 0
    scene = trimesh.load(tmp_path / "a.glb")
    assert sum(len(g.faces) for g in scene.geometry.values()) == len(ball.model.faces)
    with pytest.raises(InputError, match="animate: found format 'ply', expected 'glb'"):
        export(ball, "ply", tmp_path / "a.ply", animate=True)


def test_quaternions_turn_the_short_way(ball, tmp_path):
    """A head that turns all around: each step's quaternion is the nearer of the two."""
    angles = np.radians(np.arange(0, 360, 60))
    geometry = replace(
        ball.geometry.at((0,) * len(angles)),
        timesteps=tuple(range(len(angles))),
        rotation=Rotation.from_rotvec(angles[:, None] * [[0.0, 1.0, 0.0]]).as_matrix(),
    )
    export(replace(ball, geometry=geometry), "glb", tmp_path / "a.glb", animate=True)
    document, read, _ = read_glb(tmp_path / "a.glb")
    animation = document["animations"][0]
    q = read(animation["samplers"][1]["output"])
    assert animation["channels"][1]["target"]["path"] == "rotation"
    np.testing.assert_allclose(np.sum(q[1:] * q[:-1], axis=1), np.cos(np.radians(30)), atol=1e-6)
