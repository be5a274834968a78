"""Captures of scanned heads."""

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from benchmarks import judge
from mifit.capture import Capture
from mifit.cli import main
from mifit.core.image import read_image, write_image
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.output.truth import relit_truths, true_mesh
from mifit.synth import head as heads
from mifit.synth.scanned import ScannedHead, rigid_motion

MAP = 64


def egg(path: Path) -> Path:
    """A head-sized egg with a nose at +z, in decimetres, with a map of its own per half."""
    sphere = trimesh.creation.uv_sphere(count=[24, 24])
    vertices = sphere.vertices * (0.8, 1.2, 0.9)
    nose = np.argmax(vertices[:, 2])
    vertices[nose, 2] += 0.2
    uv = np.stack([0.5 + 0.3 * vertices[:, 0], 0.5 + 0.3 * vertices[:, 1]], axis=1)
    visual = trimesh.visual.TextureVisuals(uv=uv)
    trimesh.Trimesh(vertices, sphere.faces, visual=visual, process=False).export(path)
    return path


@pytest.fixture
def files(tmp_path):
    colour = np.zeros((MAP, MAP, 3), np.uint8)
    colour[: MAP // 2] = (40, 40, 200)  # BGR: the upper half is red
    colour[MAP // 2 :] = (200, 40, 40)
    cv2.imwrite(str(tmp_path / "albedo.png"), colour)
    cv2.imwrite(str(tmp_path / "specular.png"), np.full((MAP, MAP), 128, np.uint8))
    write_image(tmp_path / "light.exr", np.ones((8, 16, 3), np.float32))
    write_image(tmp_path / "other.exr", np.full((8, 16, 3), 3.0, np.float32))
    return egg(tmp_path / "egg.ply"), tmp_path


def test_a_scan_is_placed_in_centimetres_with_its_maps_the_right_way_up(files):
    mesh, folder = files
    found = ScannedHead.load(mesh, {"albedo": folder / "albedo.png"}, unit_mm=100.0)
    assert np.ptp(found.vertices[:, 1]) == pytest.approx(24, abs=0.1)
    nose = found.vertices[np.argmax(found.vertices[:, 2])]
    assert nose[2] == pytest.approx(9.0) and abs(nose[1]) < 1e-9
    top = sample_map(found.maps["albedo"], found.uv[[np.argmax(found.vertices[:, 1])]])[0]
    assert top[0] > 4 * top[2]
    turned = ScannedHead.load(mesh, {"albedo": folder / "albedo.png"}, unit_mm=100.0, flip_v=True)
    top = sample_map(turned.maps["albedo"], turned.uv[[np.argmax(turned.vertices[:, 1])]])[0]
    assert top[2] > 4 * top[0]
    assert set(found.maps) == {"albedo", "specular", "roughness", "displacement"}


@pytest.mark.parametrize(
    "maps, unit, message",
    [({}, 100.0, "expected albedo"), ({"albedo": "a", "gloss": "b"}, 100.0, "expected albedo, and of"),
     ({"albedo": "a"}, 1.0, "0.239 cm high at 1 mm per unit, expected 10 to 100")],
)  # fmt: skip
def test_scans_that_can_not_be_used_are_refused(files, maps, unit, message):
    with pytest.raises(InputError, match=message):
        ScannedHead.load(files[0], maps, unit)
    bare = files[1] / "bare.ply"
    trimesh.creation.box().export(bare)
    with pytest.raises(InputError, match="no triangles with texture coordinates"):
        ScannedHead.load(bare, {"albedo": "a"}, unit)


def test_the_motion_is_rigid_smooth_and_starts_straight_ahead():
    poses = rigid_motion(6, 3)
    assert all(np.allclose(r @ r.T, np.eye(3)) for r, _ in poses)
    angles = [math.degrees(math.acos(min(1.0, (np.trace(r) - 1) / 2))) for r, _ in poses]
    assert angles[0] < 3 and max(angles) > 5
    assert [np.array_equal(a[0], b[0]) for a, b in zip(poses, rigid_motion(6, 3), strict=True)] == [True] * 6


def test_a_scan_becomes_a_capture_with_truth(files, variant):
    mesh, folder = files
    out = folder / "out"
    arguments = ["synth", "--out", out, "--head", mesh, "--unit-mm", 100, "--maps", f"albedo={folder / 'albedo.png'}",
                 f"specular={folder / 'specular.png'}", "--env", folder / "light.exr", "--relit", folder / "other.exr",
                 "--timesteps", 2, "--width", 96, "--height", 72, "--spp", 16, "--quiet"]  # fmt: skip
    assert main([str(a) for a in arguments]) == 0
    capture = Capture.load(out)
    assert capture.cameras == ("left", "right", "third") and capture.timesteps == (0, 1)
    truth = [true_mesh(capture, t) for t in (0, 1)]
    maps, uv = judge.scan_maps(capture)
    assert len(uv) == len(truth[0].vertices) and maps["albedo"].shape == (MAP, MAP, 3)
    gap = [np.linalg.norm(t.vertices[7] - t.vertices[-1]) for t in truth]
    assert gap[0] == pytest.approx(gap[1], rel=1e-5) and np.abs(truth[0].vertices - truth[1].vertices).max() > 0.3
    # The upper half is red, the lower one blue, and the truth says so of the same pixels.
    camera = capture.camera("third")
    for t in (0, 1):
        front = truth[t].vertices[:, 2] > 5
        for part, channel in ((truth[t].vertices[:, 1] > 3, 0), (truth[t].vertices[:, 1] < -3, 2)):
            pixel = camera.project(truth[t].vertices[front & part].mean(0)).astype(int)
            colour = capture.frame("third", t).image[pixel[1], pixel[0]]
            assert colour[channel] > 2 * colour[2 - channel]
    (relit,) = relit_truths(capture).values()
    assert 0.5 < np.percentile(relit.image.max(axis=-1)[relit.image.sum(-1) > 0], 95) < 0.9
    assert relit.environment.name == "environment_other.exr"
    full, diffuse = (read_image(out / "truth" / f"{name}_third.exr") for name in ("full", "diffuse"))
    photograph = capture.frame("third", 0).image
    exposure = json.loads((out / "truth" / "meta.json").read_text())["exposure"]
    lit = photograph.sum(-1) > 0.2
    assert np.median(np.abs(full * exposure - photograph)[lit]) < 0.02
    assert 0.5 < diffuse[lit].sum() / full[lit].sum() < 0.97  # some of the light is specular reflection
    assert main([str(a) for a in arguments]) == 2  # the folder holds something


def test_options_of_scans_and_of_models_do_not_mix(files, capsys):
    mesh, folder = files
    common = ["synth", "--out", str(folder / "x"), "--quiet"]
    assert main([*common, "--maps", "albedo=a.png"]) == 2
    assert main([*common, "--head", str(mesh), "--maps", "albedo"]) == 2
    assert main([*common, "--head", str(mesh), "--maps", "albedo=a.png", "--tone", "1"]) == 2
    said = capsys.readouterr().err
    assert "belong to --head" in said and "NAME=FILE" in said and "--tone: found with --head" in said


@pytest.fixture(scope="module")
def coarse():
    return MorphableModel.load("builtin:coarse")


def test_a_detectors_bias_is_the_same_in_all_images_of_a_head(coarse, variant):
    from mifit.render.gbuffer import SurfaceScene
    from mifit.synth import head as detector
    from mifit.synth.compose import place_cameras

    bias = detector.draw_bias(5, 0.2)
    assert np.array_equal(bias, detector.draw_bias(5, 0.2)) and not np.array_equal(bias, detector.draw_bias(6, 0.2))
    world = coarse.mean.astype(float) * coarse.unit_mm / 10
    scene, pixels = SurfaceScene(world, coarse.faces), {}
    for camera in place_cameras(680, 480):
        off = [detector.mark(coarse, world, camera, scene, np.random.default_rng(i), bias).points for i in range(40)]
        true = camera.project(world[coarse.landmarks])
        pixels[camera.name] = np.mean(off, axis=0) - true
        scatter = np.std(off, axis=0).mean()
        assert scatter == pytest.approx(detector.LANDMARK_NOISE, rel=0.1)
    shown = np.linalg.norm(pixels["third"], axis=1).mean()
    assert shown == pytest.approx(1.25 * 0.2 * 1530 / 72, rel=0.15)
    # One displacement in space explains what all cameras show.
    for camera in place_cameras(680, 480):
        expected = camera.project(world[coarse.landmarks] + bias) - camera.project(world[coarse.landmarks])
        assert np.abs(pixels[camera.name] - expected).max() < 0.8


def test_heads_leave_the_model_by_the_stated_length(coarse):
    near, far = (heads.neutral_shape(coarse, 2, outside) for outside in (0.0, 2.0))
    gap = np.linalg.norm(far - near, axis=1) * coarse.unit_mm
    assert np.sqrt((gap**2).mean()) == pytest.approx(2.0, rel=0.35)
    rest = near - coarse.mean
    modes = coarse.identity.reshape(-1, coarse.n_identity).astype(float)
    assert np.abs(rest.ravel() - modes @ np.linalg.lstsq(modes, rest.ravel(), rcond=None)[0]).max() < 1e-4
