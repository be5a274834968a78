"""What a user is promised, by the commands that a user types: one test or more for each promise.

Nothing but the command line is used, so that the tests can be run against any version of the package.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mifit.cli import main
from mifit.core.image import write_image

COARSE = ("--model", "builtin:coarse", "--quiet")
CONFIG = """
[geometry]
rounds = 1
[surface]
enabled = false
[reflectance]
texture_size = 32
shading = "prefiltered"
bands = 4
exponent = 40
max_iterations = 3
[normals]
max_iterations = 3
"""
SIZE = ("--timesteps", "3", "--width", "120", "--height", "90", "--spp", "16")


def run(*arguments: str | Path) -> int:
    """Exit code of ``mifit ARGUMENTS``."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder but the marks and notes of mifit itself."""
    files = {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    return {name: data for name, data in files.items() if not name.startswith(".")}


def change(path: Path, edit: Any) -> None:
    """Rewrite a JSON file."""
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """A folder with a capture of 120 x 90 pixels, a fit of its first timestep, and a configuration of tiny maps."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "fit.toml").write_text(CONFIG)
    assert run("synth", "--out", folder / "capture", *SIZE, *COARSE) == 0
    assert fit(folder, folder / "capture", folder / "result") == 0
    return folder


def fit(made: Path, capture: Path, out: Path, *more: str) -> int:
    """Fit the first timestep of a capture in seconds."""
    return run("fit", capture, "--out", out, "--config", made / "fit.toml", "--timesteps", "0", *COARSE, *more)


@pytest.fixture
def capture(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made / "capture", tmp_path / "capture")


@pytest.fixture
def result(made: Path, tmp_path: Path) -> Path:
    return shutil.copytree(made / "result", tmp_path / "result")


# -- cameras as they are calibrated ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_pixels_that_are_not_square_are_fitted_and_saved(made: Path, capture: Path, result: Path) -> None:
    def edit(document: dict) -> None:
        for frame in (document, *document["frames"]):
            if "fl_y" in frame:
                frame["fl_y"] *= 1.003

    change(capture / "transforms.json", edit)
    assert fit(made, capture, result, "--force") == 0
    camera = json.loads((result / "result.json").read_text())["capture"]["cameras"][0]
    assert camera["fy"] == pytest.approx(1.003 * camera["fx"])
    assert run("export", result, "--format", "mitsuba", "--out", result.parent / "x" / "f.xml", "--quiet") == 0


@pytest.mark.slow
def test_any_name_of_a_camera_makes_a_scene(made: Path, capture: Path, tmp_path: Path) -> None:
    import mitsuba as mi

    from mifit import register_plugins

    names = {"left": "skin", "right": "$x"}

    def edit(document: dict) -> None:
        for frame in document["frames"]:
            frame["camera_id"] = names.get(frame["camera_id"], "face")

    change(capture / "transforms.json", edit)
    assert fit(made, capture, tmp_path / "out", "--cameras", "skin,$x") == 0
    register_plugins()
    assert len(mi.load_file(str(tmp_path / "out" / "scene.xml")).sensors()) == 2


# -- names out of files ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_names_in_a_result_are_no_paths(result: Path, made: Path, tmp_path: Path) -> None:
    def edit(document: dict) -> None:
        document["capture"]["cameras"][0]["name"] = "../../evil"

    change(result / "result.json", edit)
    (tmp_path / "a" / "b").mkdir(parents=True)
    write_image(tmp_path / "lamp.exr", np.ones((20, 40, 3), np.float32))
    out = tmp_path / "a" / "b" / "out"
    assert run("relight", result, "--env", tmp_path / "lamp.exr", "--out", out, "--quiet") == 0
    made_up = list(tmp_path.rglob("*evil*"))
    assert made_up and all(p.is_relative_to(out) for p in made_up)


# -- files of the user ----------------------------------------------------------------------------------------------


def test_a_demo_into_a_folder_with_a_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("mifit.synth.synthesize", stop)
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "mine.png").write_text("mine")
    assert run("demo", "--out", tmp_path, "--quiet") != 0
    assert tree(tmp_path) == {"capture/mine.png": b"mine"}


@pytest.mark.slow
def test_a_fit_into_a_folder_with_other_files(made: Path, tmp_path: Path) -> None:
    for name in ("maps", "geometry"):
        (tmp_path / "out" / name).mkdir(parents=True)
        (tmp_path / "out" / name / "mine.png").write_text("mine")
    (tmp_path / "out" / "scene.xml").write_text("mine")
    before = tree(tmp_path / "out")
    assert fit(made, made / "capture", tmp_path / "out", "--until", "geometry") == 2
    assert tree(tmp_path / "out") == before
    fit(made, made / "capture", tmp_path / "out", "--until", "geometry", "--force")
    after = tree(tmp_path / "out")
    assert {"maps/mine.png", "geometry/mine.png"} <= set(after)


@pytest.mark.slow
def test_a_shorter_fit_leaves_what_a_longer_one_made(made: Path, result: Path) -> None:
    before = tree(result)
    fit(made, made / "capture", result, "--resume", "--until", "geometry")
    assert {name for name in before if name not in tree(result)} == set()


@pytest.mark.slow
def test_going_on_with_a_fit_leaves_tracked_frames(made: Path, result: Path) -> None:
    assert run("track", made / "capture", "--result", result, "--timesteps", "1", "--quiet") == 0
    tracked = {name: data for name, data in tree(result).items() if "0001" in name}
    assert tracked
    fit(made, made / "capture", result, "--resume")
    assert tracked.items() <= tree(result).items()


# -- stale data -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_changed_model_is_fitted_anew(made: Path, tmp_path: Path) -> None:
    def go(*more: str) -> bytes:
        arguments = ("fit", made / "capture", "--out", tmp_path / "out", "--timesteps", "0", "--until", "geometry")
        options = ("--model", tmp_path / "m.npz", "--config", made / "fit.toml", "--quiet")
        assert run(*arguments, *options, *more) == 0
        return (tmp_path / "out" / "geometry" / "0000.ply").read_bytes()

    assert run("model", "convert", "builtin:coarse", tmp_path / "m.npz") == 0
    first = go()
    with np.load(tmp_path / "m.npz") as data:
        arrays = dict(data)
    np.savez(tmp_path / "m.npz", **{**arrays, "mean": arrays["mean"] * np.float32(1.02)})
    assert go("--resume") != first


@pytest.mark.slow
def test_frames_whose_images_changed_are_tracked_anew(capture: Path, result: Path) -> None:
    track = ("track", capture, "--result", result, "--timesteps", "1", "--quiet")
    assert run(*track) == 0
    before = tree(result)
    document = json.loads((capture / "transforms.json").read_text())
    for frame in document["frames"]:
        if frame["timestep_index"] == 1:
            shutil.copy(capture / frame["file_path"].replace("0001", "0002"), capture / frame["file_path"])
    assert run(*track, "--resume") == 0
    after = tree(result)
    name = next(n for n in before if n.endswith("0001.ply"))
    assert after[name] != before[name]


@pytest.mark.slow
def test_another_capture_is_said(made: Path, result: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run("synth", "--out", tmp_path / "other", *SIZE, *COARSE, "--seed", "9") == 0
    evaluate = ("evaluate", result, "--camera", "third", "--timesteps", "0", "--capture")
    capfd.readouterr()
    assert run(*evaluate, made / "capture") == 0
    own = capfd.readouterr()
    run(*evaluate, tmp_path / "other")
    said = capfd.readouterr()
    assert "isn't the capture that was fitted" in said.err and "isn't the capture" not in own.err


@pytest.mark.slow
def test_two_fits_into_one_folder(made: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = ["fit", made / "capture", "--out", out, "--config", made / "fit.toml", "--timesteps", "0", *COARSE]
    with subprocess.Popen([sys.executable, "-m", "mifit", *map(str, command)], stderr=subprocess.PIPE) as first:
        start = time.monotonic()
        while not out.is_dir() and first.poll() is None and time.monotonic() - start < 60:
            time.sleep(0.005)
        code = run(*command, "--force", "--seed", "5")
        codes = (first.wait(), code)
    assert sorted(codes) == [0, 2]
    assert json.loads((out / "result.json").read_text())["config"]["seed"] == (0 if codes[0] == 0 else 5)


# -- settings -------------------------------------------------------------------------------------------------------

SETTINGS = [
    "reflectance.texture_size=1000000000", "reflectance.texture_size=0", "reflectance.bands=99",
    "reflectance.exponent=-1.0", "reflectance.smoothness_weight=-1.0", "reflectance.max_iterations=-1",
    "geometry.prior_weight=-1.0", "geometry.landmark_weight=nan", "geometry.pixels=-5", "geometry.rounds=-1",
    "geometry.max_iterations=0", "normals.laplacian_weight=-1.0", "normals.max_iterations=-3",
    "mesh.detail=-1.0", "seed=-1",
]  # fmt: skip


@pytest.mark.parametrize("setting", SETTINGS)
def test_settings_out_of_range_are_refused_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], setting: str
) -> None:
    (tmp_path / "e.toml").write_text('name = "e"\n[fit]\ncapture = "nowhere"\n[evaluate]\ncamera = "third"\n')
    out = tmp_path / "out"
    assert run("run", tmp_path / "e.toml", "--set", f"fit.{setting}", "--out", out, "--quiet") == 2
    error = capsys.readouterr().err
    assert setting.partition("=")[0].rpartition(".")[2] in error and "expected" in error and error.count("\n") == 1
    assert not out.exists()


# -- nothing comes unasked ------------------------------------------------------------------------------------------


def test_landmarks_install_nothing_and_nothing_here(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[object] = []

    def record(*command: object, **_: object) -> None:
        started.append(command)
        raise FileNotFoundError(2, "not here", "python")

    for name in ("run", "Popen", "check_call", "check_output", "call"):
        monkeypatch.setattr(subprocess, name, record)
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setenv("MIFIT_CACHE", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    run("landmarks", capture, "--detector", "mediapipe", "--quiet")
    assert started == [] and not any(here.iterdir())


@pytest.mark.skipif(not hasattr(os, "chown") or os.getuid() != 0, reason="gives a folder away, which root alone may")
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root gives files away")
def test_networks_in_a_folder_of_others_are_not_run(capture: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("ai_edge_litert", reason="without the runtime no network can run")
    cache = tmp_path / "cache"
    for folder in ("face-networks-0.6.0", "face-mesh", "mediapipe"):
        (cache / folder).mkdir(parents=True)
        for name in ("face_detection_full_range", "face_landmark", "iris_landmark"):
            (cache / folder / f"{name}.tflite").write_bytes(b"theirs")
    for path in (cache, *cache.rglob("*")):
        os.chown(path, 65534, 65534)
    monkeypatch.setenv("MIFIT_CACHE", str(cache))
    before = tree(capture)
    assert run("landmarks", capture, "--detector", "mediapipe", "--quiet") != 0
    assert "expected" in capsys.readouterr().err and tree(capture) == before
