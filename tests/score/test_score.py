"""`mifit score`: files of any program against a capture's photographs and truth."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from mifit.capture import Capture
from mifit.cli import main
from mifit.core.arrays import write_ply
from mifit.core.image import read_image, write_image
from mifit.core.mesh import vertex_normals
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.output.compare import Errors, pass_region, separation
from mifit.output.score import score
from mifit.output.truth import landmarks_of, relit_truths, true_passes
from mifit.synth import synthesize

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def folder(variant, tmp_path_factory):
    """A small capture with meshes, passes and a relit view as truth."""
    out = tmp_path_factory.mktemp("score") / "capture"
    synthesize(out, model="builtin:coarse", width=320, height=240, spp=16, timesteps=1, seed=3)
    model = MorphableModel.load("builtin:coarse")
    with np.load(out / "truth" / "0000.npz") as stored:
        vertices = stored["vertices"]
    (out / "truth" / "0000.npz").unlink()
    uv = np.zeros((len(vertices), 2), np.float32)
    normals = vertex_normals(vertices, model.faces).astype(np.float32)
    write_ply(out / "truth" / "0000.ply", vertices, model.faces, normals, uv, np.full_like(vertices, 0.5))
    photograph = read_image(out / "images" / "third" / "0000.png")
    ramp = np.linspace(0, 0.2, photograph.shape[1], dtype=np.float32)[None, :, None] * photograph.mean(
        -1, keepdims=True
    )
    for name, image in (("diffuse", photograph - ramp), ("full", photograph), ("relit", 0.5 * photograph[..., ::-1])):
        target = "relit_blue" if name == "relit" else f"{name}_third"
        write_image(out / "truth" / f"{target}.exr", image / 2.0)
    (out / "truth" / "meta.json").write_text('{"exposure": 2.0}')
    return out


def scored(folder, images, *options):
    """What the command writes."""
    target = images.parent / f"{images.name}.json"
    assert main(["score", str(folder), "--images", str(images), "--json", str(target), "--quiet", *options]) == 0
    return json.loads(target.read_text())


def run(program, folder, out):
    subprocess.run(
        [sys.executable, HERE / program, folder, out, "left,right", "third", "0"], check=True, cwd=out.parent
    )
    return out


def test_two_strangers_programs_are_scored_and_the_better_one_wins(folder, tmp_path):
    flat = scored(folder, run("flat_colour.py", folder, tmp_path / "flat"))
    near = scored(folder, run("nearest_view.py", folder, tmp_path / "near"))
    for found in (flat, near):
        assert set(found["views"]) == {"third", "held_out"} and found["ignored"] == []
        assert set(found["views"]["third"]) == {"skin", "face", "whole"}
    skin = [found["views"]["held_out"]["skin"] for found in (flat, near)]
    assert skin[1]["psnr"] > skin[0]["psnr"] + 1 and skin[1]["ssim"] > skin[0]["ssim"]
    assert skin[1]["flip"] < skin[0]["flip"] and skin[0]["pixels"] == skin[1]["pixels"] > 1000


def test_the_truth_itself_scores_best_in_everything(folder, tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    capture = Capture.load(folder)
    shutil.copy(folder / "images" / "third" / "0000.png", images / "third_0000.png")
    shutil.copy(folder / "truth" / "0000.ply", images / "0000.ply")
    write_image(images / "relit_blue.exr", 7.0 * relit_truths(capture)["blue"].image)  # in any exposure
    passes = true_passes(capture, "third")
    photograph = capture.frame("third", 0).image
    np.testing.assert_allclose(passes.diffuse + passes.specular, photograph, atol=1e-3)  # in its exposure
    for name in ("diffuse", "specular"):
        write_image(images / f"{name}_third.exr", getattr(passes, name))
    (images / "notes.txt").write_text("not scored")
    found = scored(folder, images)
    assert found["views"]["third"]["face"]["rmse"] == 0 and found["views"]["third"]["skin"]["flip"] == 0
    assert found["meshes"]["p90_mm"] < 1e-3 and found["meshes"]["points"] > 1000
    assert found["relit"]["blue"] > 80 and found["relit"]["mean"] == found["relit"]["blue"]
    one = found["passes"]["third"]
    assert one["correlation"] > 0.999 and one["error"] < 0.01 and one["diffuse_psnr"] > 80
    assert one["share"] == pytest.approx(one["share_truth"], rel=1e-3) and one["diffuse_psnr_unseparated"] < 50
    assert found["ignored"] == ["notes.txt"] and "notes.txt: its name says nothing" in capsys.readouterr().err


def test_a_mesh_beside_the_truth_is_as_far_off_as_it_was_moved(folder, tmp_path):
    mesh = trimesh.load(folder / "truth" / "0000.ply", process=False)
    mesh.vertices = mesh.vertices * 1.02
    (tmp_path / "x").mkdir()
    mesh.export(tmp_path / "x" / "0000.obj")
    found = score(Capture.load(folder), tmp_path / "x")["meshes"]
    assert 0.5 < found["mean_mm"] < 3.0 and found["median_mm"] < found["p90_mm"]


def test_regions_are_the_same_whatever_is_scored_and_do_not_read_the_images_scored(folder, tmp_path):
    black, white = tmp_path / "black", tmp_path / "white"
    for out, value in ((black, 0.0), (white, 1.0)):
        write_image(out / "third_0000.png", np.full((240, 320, 3), value, np.float32))
    counts = [
        {k: v["pixels"] for k, v in score(Capture.load(folder), out)["views"]["third"].items()}
        for out in (black, white)
    ]
    assert counts[0] == counts[1] and counts[0]["skin"] < counts[0]["face"] < counts[0]["whole"]


@pytest.mark.parametrize(
    "files, message",
    [
        ({}, "found no file to score, expected names such as third_0000.png"),
        ({"third_0000.png": (20, 30)}, "found 30 x 20 pixels, expected 320 x 240"),
        ({"relit_green.exr": (240, 320)}, "has no view relit by 'green'; it has blue"),
        ({"diffuse_third.exr": (240, 320)}, "found without specular_third.exr"),
        ({"diffuse_left.exr": (240, 320), "specular_left.exr": (240, 320)}, "no passes of camera 'left'"),
        ({"third_0000.png": (240, 320), "third_0000.exr": (240, 320)}, "means the same"),
    ],
)
def test_files_that_can_not_be_scored_are_named(folder, tmp_path, files, message, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for name, shape in files.items():
        write_image(images / name, np.zeros((*shape, 3), np.float32))
    assert main(["score", str(folder), "--images", str(images), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


def test_damaged_meshes_and_missing_folders_are_named(folder, tmp_path, capsys):
    assert main(["score", str(folder), "--images", str(tmp_path / "none"), "--quiet"]) == 2
    (tmp_path / "0000.ply").write_text("ply\nnonsense")
    assert main(["score", str(folder), "--images", str(tmp_path), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "no such folder" in said and "0000.ply: not a readable mesh" in said


def test_a_truth_of_vertices_alone_needs_the_model_for_meshes_only(folder, tmp_path):
    other = shutil.copytree(folder, tmp_path / "other")
    mesh = trimesh.load(other / "truth" / "0000.ply", process=False)
    for name in ("0000.ply", "mesh.npz"):
        (other / "truth" / name).unlink()
    np.savez(other / "truth" / "0000.npz", vertices=np.asarray(mesh.vertices))
    images = run("nearest_view.py", other, tmp_path / "near")
    assert score(Capture.load(other), images)["views"]["third"]["skin"]["psnr"] > 15
    mesh.export(images / "0000.ply")
    with pytest.raises(InputError, match="name the model"):
        score(Capture.load(other), images)
    model = MorphableModel.load("builtin:coarse")
    assert score(Capture.load(other), images, model=model)["meshes"]["p90_mm"] < 1e-3


def test_errors_pool_over_pixels_not_over_images():
    rng = np.random.default_rng(0)
    one, two = Errors(), Errors()
    pair = rng.integers(0, 255, (2, 64, 64, 3)).astype(np.uint8)
    left = np.zeros((64, 64), bool)
    left[:, :20] = True
    one.add(*pair, np.ones((64, 64), bool))
    two.add(*pair, left)
    two.add(*pair, ~left)
    assert two.figures()["psnr"] == pytest.approx(one.figures()["psnr"])
    assert one.figures()["psnr"] == pytest.approx(20 * np.log10(255 / one.figures()["rmse"]))
    darker = Errors()
    smooth = np.repeat(np.linspace(20, 120, 64).astype(np.uint8)[None, :, None], 3, 2).repeat(64, 0)
    from mifit.core.image import srgb_to_linear, to_8_bit

    darker.add(to_8_bit(0.5 * srgb_to_linear(smooth / 255.0)), smooth, np.ones((64, 64), bool))
    assert darker.figures()["psnr_matched"] > 40 > darker.figures()["psnr"]


def test_separation_is_blind_to_exposure_and_sees_what_is_not_separated():
    rng = np.random.default_rng(1)
    diffuse, specular = rng.random((40, 40, 3)), rng.random((40, 40, 1)).repeat(3, -1) ** 4
    everywhere = np.ones((40, 40), bool)
    same = separation(0.3 * diffuse, 0.3 * specular, diffuse, specular, everywhere)
    assert same["correlation"] > 0.9999 and same["error"] < 1e-6 and same["share"] == pytest.approx(same["share_truth"])
    none = separation(diffuse + specular, 0 * specular, diffuse, specular, everywhere)
    assert none["correlation"] == 0 and none["error"] == pytest.approx(1) and none["share"] == 0
    assert none["diffuse_psnr"] == pytest.approx(none["diffuse_psnr_unseparated"])
    with pytest.raises(InputError, match="region is empty"):
        separation(diffuse, specular, diffuse, specular, ~everywhere)


def test_bare_skin_leaves_out_eyes_mouth_and_brows(folder):
    capture = Capture.load(folder)
    marks, camera = landmarks_of(capture, "third", 0), capture.camera("third")
    region = pass_region(marks, camera)
    assert region.sum() > 500
    for part in (slice(17, 27), slice(36, 48), slice(60, 68)):
        at = marks[part].astype(int)
        assert not region[at[:, 1], at[:, 0]].any()
    with pytest.raises(InputError, match="has no landmarks, by which the face is found"):
        shot = replace(capture.shots["third", 0], landmarks=None)
        landmarks_of(replace(capture, shots={**capture.shots, ("third", 0): shot}), "third", 0)
