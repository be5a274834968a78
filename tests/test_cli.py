"""The command line: exit codes, one-line errors, the whole path from a capture to a figure."""

import argparse
import importlib
import json
import math
import re
import shutil
from argparse import Namespace

import cv2
import numpy as np
import pytest

from mifit.cli import build_parser, main
from mifit.cli.arguments import tell
from mifit.cli.options import COMMANDS as TABLE
from mifit.core.diagnostics import Diagnostic
from mifit.result.ownership import remove_written, written

COMMANDS = (
    "doctor demo synth import landmarks fit track evaluate render turntable view relight export run model".split()
)


def run(capsys, *arguments):
    """Exit code, stdout and stderr of one command."""
    try:
        code = main([str(a) for a in arguments])
    except SystemExit as stop:
        code = stop.code
    out, err = capsys.readouterr()
    return code, out, err


def refused(capsys, *arguments):
    """The one line that a refused command prints."""
    code, _, err = run(capsys, *arguments, "--quiet")
    assert code == 2, err
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize("command", COMMANDS)
def test_help(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0
    assert "usage: mifit" in out


def test_every_command_has_its_function():
    for paragraph in TABLE.strip().split("\n\n"):
        module, name = re.split("  +", paragraph, maxsplit=2)[1].split(".")
        assert callable(getattr(importlib.import_module(f"mifit.cli.{module}"), name)), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit"], "required: capture, --out"),
        (["nonsense"], "invalid choice: 'nonsense'"),
        (["fit", "x", "--out", "y", "--timesteps", "a"], "expected numbers such as"),
        (["fit", "x", "--out", "y", "--cameras", ","], "expected names separated by commas"),
        (["evaluate", "x", "--capture", "y", "--camera", "a", "b"], "b; the names of an option are joined by commas"),
        (["synth", "--out", "x", "--spp", "0"], "expected a whole number from 1 to 100000"),
        (["relight", "x", "--env", "e", "--out", "y", "--rotate", "nan"], "expected a finite number"),
    ],
)
def test_bad_usage(capsys, arguments, message):
    assert message in refused(capsys, *arguments)


@pytest.fixture
def capture(tiny_capture, tmp_path):
    """A copy of the tiny capture to spoil."""
    return shutil.copytree(tiny_capture, tmp_path / "capture")


def edit(capture, change):
    path = capture / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_missing_capture(capsys, tmp_path):
    assert str(tmp_path / "none") in refused(capsys, "fit", tmp_path / "none", "--out", tmp_path / "out")


def test_image_of_another_size(capsys, capture, tmp_path):
    path = capture / json.loads((capture / "transforms.json").read_text())["frames"][0]["file_path"]
    cv2.imwrite(str(path), np.zeros((30, 40, 3), np.uint8))
    line = refused(capsys, "fit", capture, "--out", tmp_path / "out", "--model", "builtin:coarse")
    assert path.name in line
    assert "40" in line and "200" in line


def test_nan_in_a_transform(capsys, capture, tmp_path):
    edit(capture, lambda c: c["frames"][1]["transform_matrix"][0].__setitem__(3, math.nan))
    assert "transform_matrix" in refused(capsys, "fit", capture, "--out", tmp_path / "out")


def test_camera_that_misses_a_timestep(capsys, capture, tmp_path):
    gone = {"camera_id": "right", "timestep_index": 1}
    keep = lambda f: any(f[k] != v for k, v in gone.items())  # noqa: E731
    edit(capture, lambda c: c.__setitem__("frames", [f for f in c["frames"] if keep(f)]))
    line = refused(capsys, "fit", capture, "--out", tmp_path / "out")
    assert "right" in line and "1" in line


def test_too_few_landmarks(capsys, capture, tmp_path):
    for path in capture.glob("landmarks/*/*.json"):
        content = json.loads(path.read_text())
        content["visible"] = [i < 2 for i in range(68)]
        path.write_text(json.dumps(content))
    line = refused(capsys, "fit", capture, "--out", tmp_path / "out", "--model", "builtin:coarse")
    assert "landmark" in line and "6" in line


def test_empty_model_file(capsys, capture, tmp_path):
    model = tmp_path / "model.npz"
    model.touch()
    assert "model.npz" in refused(capsys, "fit", capture, "--out", tmp_path / "out", "--model", model)


def test_unknown_config_key(capsys, capture, tmp_path):
    config = tmp_path / "c.toml"
    config.write_text("[reflectance]\nexponnent = 3\n")
    line = refused(capsys, "fit", capture, "--out", tmp_path / "out", "--config", config)
    assert "exponnent" in line and "'exponent'" in line


def test_unknown_camera(capsys, capture, tmp_path):
    line = refused(capsys, "fit", capture, "--out", tmp_path / "out", "--cameras", "left,top")
    assert "'top'" in line and "left" in line


def test_doctor(capsys, variant):
    code, out, _ = run(capsys, "doctor", "--json")
    checks = json.loads(out)
    assert code == 0
    assert {"check", "ok", "found", "fix", "required"} <= set(checks[0])


@pytest.mark.slow
def test_from_capture_to_figures(capsys, tiny_capture, tmp_path):
    out = tmp_path / "result"
    config = tmp_path / "c.toml"
    config.write_text("reflectance.texture_size = 64\nsurface.finest = 1\n")
    fit = ["fit", tiny_capture, "--out", out, "--model", "builtin:coarse", "--cameras", "left,right", "--quiet"]
    code, _, err = run(capsys, *fit, "--timesteps", "0,1", "--config", config)
    assert code == 0, err
    for name in ("result.json", "report.html", "scene.xml", "lighting.exr", "maps/diffuse.exr", "maps/specular.exr"):
        assert (out / name).stat().st_size > 0
    assert "result.json" not in refused(capsys, *fit[:-1])  # an existing result isn't overwritten unasked
    code, table, err = run(
        capsys, "evaluate", out, "--capture", tiny_capture, "--camera", "third", "--json", out / "third.json", "--quiet"
    )
    assert code == 0, err
    figures = json.loads((out / "third.json").read_text())
    assert figures["camera"] == "third"
    assert figures["region_pixels"] > 500
    pca, full = (figures["methods"][name]["psnr"] for name in ("pca", "full"))
    # Decibels: what the stages after the first are for. 16 samples a pixel leave the held-out image itself with noise
    # of about 27 dB, so that a perfect fit would gain little more here; the benchmarks hold clean captures to more.
    assert full > 20 and full > pca + 0.5
    assert "full" in table
    report = (out / "report.html").read_text()
    assert "image based nearest" in report and "baseline" not in figures
    judged = ["evaluate", out, "--capture", tiny_capture, "--quiet", "--timesteps", "0", "--camera"]
    assert "was fitted, so this is no held-out error; name another one, or --fitted" in refused(capsys, *judged, "left")
    assert run(capsys, *judged, "left", "--fitted")[0] == 0
    assert (out / "report.html").read_text() == report  # which keeps the held-out view
    code, table, err = run(capsys, *judged, "third", "--region", "skin", "--baseline")
    assert code == 0 and "image_based_nearest" in table, err
    code, _, err = run(
        capsys, "render", out, "--capture", tiny_capture, "--camera", "third", "--timestep", "0",
        "--out", tmp_path / "x.png", "--quiet",
    )  # fmt: skip
    assert code == 0, err
    assert cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_UNCHANGED).shape == (150, 200, 4)


@pytest.mark.slow
def test_an_uncalibrated_capture_is_fitted_and_reported(capsys, capture, tmp_path):
    known = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "transform_matrix")
    edit(capture, lambda c: [part.pop(key, None) for part in (c, *c["frames"]) for key in known])
    out, shot = tmp_path / "result", tmp_path / "left.png"
    code, _, err = run(
        capsys, "fit", capture, "--out", out, "--model", "builtin:coarse", "--cameras", "left,right",
        "--timesteps", 0, "--until", "geometry", "--quiet",
    )  # fmt: skip
    assert code == 0, err
    assert "uncalibrated" in json.loads((out / "result.json").read_text())["warnings"][0]["text"]
    assert "uncalibrated" in (out / "report.html").read_text()
    code, _, err = run(
        capsys,
        "render",
        out,
        "--capture",
        capture,
        "--camera",
        "left",
        "--timestep",
        0,
        "--method",
        "pca",
        "--out",
        shot,
    )
    assert code == 0, err
    assert (cv2.imread(str(shot), cv2.IMREAD_UNCHANGED)[..., 3] > 0).mean() > 0.05
    judged = ("evaluate", out, "--capture", capture, "--camera", "third", "--quiet")
    code, _, err = run(capsys, *judged)
    assert code == 2 and "camera 'third' has no intrinsics" in err and "mifit calibrate" in err
    code, table, err = run(capsys, "calibrate", capture, "--model", "builtin:coarse", "--timesteps", 0, "--quiet")
    assert code == 0 and "third: placed" in table, err
    code, table, err = run(capsys, *judged)
    assert code == 0 and "third" in table, err


def test_warnings_are_lines_on_stderr_the_worst_first(capsys):
    found = [Diagnostic("a", "one"), Diagnostic("b", "two"), Diagnostic("c", "three", "fault", "left")]
    notes = [Diagnostic("d", "four", "note")]
    assert tell(Namespace(quiet=True, strict=False), [*notes, *found, found[0]]) == 0
    assert capsys.readouterr().err.splitlines() == [
        "mifit: fault: three",
        "mifit: warning: one",
        "mifit: warning: two",
    ]
    assert tell(Namespace(quiet=False, strict=True), notes) == 0
    assert capsys.readouterr().err == "mifit: note: four\n"
    assert tell(Namespace(quiet=True, strict=True), found) == 3
    assert len(capsys.readouterr().err.splitlines()) == 3
    assert tell(Namespace(quiet=True, strict=True), found, told=found[1:]) == 3
    assert capsys.readouterr().err == "mifit: warning: one\n"


def options(parser, name=""):
    """(command, option) of every option and argument of a parser and its commands, with its help."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command, child in action.choices.items():
                yield from options(child, f"{name} {command}")
        else:
            yield f"{name} {'/'.join(action.option_strings) or action.dest}".strip(), action


def test_every_option_says_what_it_is_and_what_it_is_by_default():
    listed = dict(options(build_parser()))
    assert len(listed) > 150
    assert [name for name, action in listed.items() if not action.help] == []
    silent = []
    for name, action in listed.items():
        numbers = isinstance(action.default, (int, float)) and not isinstance(action.default, bool)
        if (numbers or action.choices) and action.default is not None and "default" not in action.help:
            silent.append(name)
    assert silent == []


@pytest.mark.slow
def test_a_demo_runs_again_where_it_ran_before(variant, tmp_path, monkeypatch) -> None:
    """The second one clears away what the first one left, but not what it has written itself."""

    def fit_into(out, *_, watch, cameras, **__):
        watch(Namespace(cameras=cameras, timesteps=(0,)))
        remove_written(out, [name for name in written(out) if not name.startswith("capture")])

    small = {"model": "builtin:coarse", "width": 120, "height": 90, "spp": 16, "timesteps": 1}
    monkeypatch.setattr("mifit.cli.fits.DEMO", small)
    monkeypatch.setattr("mifit.cli.fits.judge", lambda *_: None)
    monkeypatch.setattr("mifit.fitting.fit_into", fit_into)
    monkeypatch.setattr("mifit.output.views.beside", lambda *_: np.zeros((4, 4, 3), np.uint8))
    for _ in range(2):
        assert main(["demo", "--out", str(tmp_path / "demo"), "--quiet"]) == 0
        assert "first.png" in written(tmp_path / "demo") and (tmp_path / "demo" / "first.png").exists()
