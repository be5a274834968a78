"""Every command line in the README, the docs and the scenes: taken by the parser, and run in a reduced size."""

from __future__ import annotations

import importlib.util
import re
import shlex
import shutil
from collections import Counter
from pathlib import Path

import cv2
import pytest

from mifit.capture import Capture
from mifit.capture.stereo import write_stereo
from mifit.cli import build_parser, main
from mifit.config import read_toml
from mifit.core.image import to_8_bit
from mifit.experiments import load_plan
from mifit.extras.boards import Board
from mifit.output.views import write_video
from tests.extras.board_video import Studio, pair, poses
from tests.extras.photogrammetry import write_colmap
from tests.here import run_here

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += [ROOT / "scenes" / "README.md", *sorted((ROOT / "scenes").glob("*/experiment.toml"))]
COMMAND = re.compile(r"^(?:#\s+|\s*)((?:mifit|make|python -m|pip install|\.venv/bin/\S+) .*?)(?:\s{2,}#.*)?$")
SMALL = {
    "geometry.rounds": 1, "geometry.pixels": 300,
    "geometry.max_iterations": 5, "surface.enabled": "false", "normals.max_iterations": 3,
    "reflectance.texture_size": 32, "reflectance.bands": 4, "reflectance.shading": '"prefiltered"',
    "reflectance.exponent": 50, "reflectance.max_iterations": 3,
}  # fmt: skip
"""Settings of fits that take seconds: what the steps find is tested elsewhere, here that they run as the pages say."""
SIZES = ["--model", "builtin:coarse", "--width", "120", "--height", "90", "--spp", "16"]


def commands() -> list[tuple[str, str]]:
    """(page, command line) of every code block and of the heads of experiment files, in order."""
    found = []
    for page in PAGES:
        fenced = ""
        for line in page.read_text(encoding="utf-8").splitlines():
            if line.startswith("```"):
                fenced = "" if fenced else (line[3:] or "text")
                continue
            code = (
                fenced in ("text", "sh", "bash") or (not fenced and line.startswith("    ")) or page.suffix == ".toml"
            )
            match = COMMAND.match(line)
            if code and match:
                found.append((str(page.relative_to(ROOT)), match.group(1).strip()))
    return found


COMMANDS = commands()


def test_enough_commands_are_found():
    """The patterns above still find them: fewer than were there would mean that pages changed their form."""
    kinds = Counter(command.split()[0] for _, command in COMMANDS)
    assert kinds["mifit"] >= 25 and kinds["make"] >= 6 and len(COMMANDS) >= 35, kinds


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_a_documented_command_is_understood(page: str, command: str) -> None:
    words = shlex.split(command.replace(".venv/bin/", ""))
    if words[0] == "mifit":
        build_parser().parse_args(words[1:])  # ends the process with usage where it isn't
    elif words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]) is not None
    else:
        assert words[:2] == ["pip", "install"]
        extras = read_toml(ROOT / "pyproject.toml")["project"]["optional-dependencies"]
        assert all(extra in extras for extra in re.findall(r"\[(\w+)\]", command))


def test_every_target_of_make_has_a_recipe() -> None:
    text = (ROOT / "Makefile").read_text()
    named = {*re.search(r"^\.PHONY: (.*)$", text, re.MULTILINE)[1].split(), *re.findall(r'"make ([\w-]+) ', text)}
    assert named == set(re.findall(r"^([\w-]+):.*\n\t", text, re.MULTILINE))


@pytest.fixture(scope="module")
def workspace(variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the commands name: footage, calibrations, environments, a result."""
    folder = tmp_path_factory.mktemp("commands")
    (folder / "small.toml").write_text("".join(f"{key} = {value}\n" for key, value in SMALL.items()))
    head = folder / "footage"
    assert main(["synth", "--out", str(head), "--timesteps", "5", *SIZES, "--quiet"]) == 0
    capture = Capture.load(head)
    for name in ("left", "right"):
        frames = [to_8_bit(capture.frame(name, t).image) for t in capture.timesteps]
        write_video(folder / f"{name}.mp4", frames * 8, 25.0)
        (folder / name).mkdir()
        for t, frame in enumerate(frames):
            cv2.imwrite(str(folder / name / f"{t:04d}.png"), frame[..., ::-1])
    write_stereo(folder / "stereo.yml", capture.camera("left"), capture.camera("right"))
    write_colmap(folder / "sparse" / "0", [(capture.camera(n), f"{n}/0000.png") for n in ("left", "right")])
    _film_a_board(folder / "filmed")
    shutil.copytree(head, folder / "scene")
    shutil.copytree(head, folder / "CAPTURE")
    shutil.copytree(ROOT / "scenes" / "relighting", folder / "scenes" / "relighting")
    fit = ["fit", "CAPTURE", "--out", "RESULT", "--cameras", "left,right", "--timesteps", "0", "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*fit, "--model", "builtin:coarse", "--config", "small.toml"]) == 0
    shutil.copytree(folder / "RESULT", folder / "out" / "face")
    shutil.copytree(head, folder / "out" / "head")
    return folder


def _film_a_board(folder: Path) -> None:
    """A calibration board before two cameras."""
    board = Board.parse("charuco:9x6:30:22")
    places = poses(10, board, 470.0)
    for name, camera in zip(("left", "right"), pair(), strict=True):
        studio = Studio(board, camera)
        (folder / name).mkdir(parents=True)
        for i, place in enumerate(places):
            cv2.imwrite(str(folder / name / f"{i:04d}.png"), studio.render(place, i))


NOT_HERE = {
    "landmarks": "needs a detector and its networks",
    "view": "serves until it is stopped: tests/extras/test_live_view.py",
    "demo": "make demo, and every part of it above",
}
"""Commands that are understood, but not run."""


def once() -> list[tuple[str, str]]:
    """All commands, but an experiment of the scenes in the first of its commands only, and in that with a capture."""
    runs = [one for one in COMMANDS if one[1].startswith("mifit run")]
    kept = {(one[1].split()[2], "--set fit.capture" in one[1]): one for one in reversed(runs)}
    return [one for one in COMMANDS if one not in runs or one in kept.values()]


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted({page for page, command in once() if command.startswith("mifit ")}))
def test_documented_commands_run(page: str, workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workspace)
    run_here(monkeypatch)
    for _, command in (c for c in once() if c[0] == page):
        words = shlex.split(command)[1:]
        if not command.startswith("mifit ") or words[0] in NOT_HERE or {"--install", "fetch"} & {*words}:
            continue
        if words[1].endswith(".mp4") or any(word.startswith("out/me") for word in words):
            continue  # no detector finds the workspace's small heads: tests/test_film.py
        out = Path(words[words.index("--out") + 1]) if "--out" in words else None
        if words[0] in ("import", "synth", "fit") and out is not None:
            shutil.rmtree(out, ignore_errors=True)
        if words[0] == "synth":
            words += SIZES
        if words[0] == "fit":
            words += ["--model", "builtin:coarse", "--config", "small.toml"]
        if words[0] == "run":
            words = reduced(words, workspace)
        assert main([*words, "--quiet"]) == 0, command
        assert out is None or out.exists(), command
        if words[0] == "import":  # the films are a few frames again and again: go on with the capture that they show
            shutil.rmtree(out)
            shutil.copytree(workspace / "footage", out)


def reduced(words: list[str], workspace: Path) -> list[str]:
    """An experiment's command with one small run in place of its sweep."""
    path = ROOT / words[1]
    assert load_plan(path).runs  # as it stands, every run of the sweep
    kept = ["--set", f"fit.capture={workspace / 'CAPTURE'}"] if "fit.capture=" in " ".join(words) else []
    changes = ["sweep={}", "outputs.report=false"]
    document = read_toml(path)
    if "fit" in document:
        changes += [
            "fit.model=builtin:coarse",
            "fit.timesteps=[0]",
            *(f"fit.{key}={value}" for key, value in SMALL.items()),
        ]
        synth = {"timesteps": 1, "width": 120, "height": 90, "spp": 16, "model": '"builtin:coarse"'}
        if not kept:
            changes += [f"fit.synth.{key}={value}" for key, value in synth.items()]
    else:
        changes += ["render.spp=1", "reference.spp=4", "render.parameters.width=32", "render.parameters.height=24"]
    options = [option for change in changes for option in ("--set", change)]
    return ["run", str(path), *options, *kept, "--out", str(workspace / "runs" / path.parent.name)]
