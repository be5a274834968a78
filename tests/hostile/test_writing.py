"""What mifit writes stays where the user said, and what was there before is never lost."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mifit.capture import Capture, detect_landmarks, import_capture
from mifit.capture.landmark_files import read_landmarks
from mifit.cli import main
from mifit.core.image import encode_png, write_image
from mifit.errors import InputError

BAD_NAMES = [
    "../../evil", "/tmp/evil", "..", ".", "", " ", "a/b", "a\\b", "C:evil", "CON", "nul.txt", ".hidden", "-rf",
    "x" * 300, "\u202egnp", "a\nb", "a\0b", "\ud800", "é" * 200, "$HOME", "~root", "a;b", "*", "site-packages/evil.pth",
]  # fmt: skip


def files_below(folder: Path) -> dict[str, bytes]:
    """Relative path -> content of every file; links are followed nowhere."""
    return {
        str(p.relative_to(folder)): b"" if p.is_symlink() else p.read_bytes()
        for p in folder.rglob("*")
        if p.is_symlink() or p.is_file()
    }


def test_file_names_are_names_of_files(tmp_path: Path) -> None:
    from mifit.core.files import file_name

    made = [file_name(text) for text in BAD_NAMES]
    assert len({name.casefold() for name in made}) == len(BAD_NAMES)
    for name in made:
        assert name and os.path.basename(name) == name and name not in (".", "..") and not name.startswith((".", "-"))
        assert len(name.encode()) <= 100
        (tmp_path / name).write_text("")
    for plain in ("left", "third_view", "Kamera-3", "cam=1.5", "左", "links+rechts"):
        assert file_name(plain) == plain


def scene(folder: Path, camera: str, image: str = "a.png", **more: object) -> Path:
    write_image(folder / "a.png", np.random.default_rng(0).random((20, 20, 3)))
    (folder / "l.json").write_text(json.dumps({"points": [[i, i] for i in range(68)]}))
    frame = {"file_path": image, "landmark_path": "l.json", "camera_id": camera, "w": 20, "h": 20, **more}
    path = folder / "transforms.json"
    path.write_text(json.dumps({"frames": [frame]}))
    return path


@pytest.mark.parametrize("name", [n for n in BAD_NAMES if n and "\0" not in n and "\ud800" not in n])
def test_an_import_writes_below_its_folder(tmp_path: Path, name: str) -> None:
    outside = tmp_path / "home"
    source, out = outside / "in", outside / "deep" / "er" / "out"
    transforms = scene(source, name)
    before = files_below(outside)
    import_capture(out, transforms=transforms)
    capture = Capture.load(out)
    assert capture.cameras == (name,) and capture.landmarks(name, 0) is not None
    capture.frame(name, 0)
    new = set(files_below(tmp_path)) - {f"home/{n}" for n in before}
    assert new and all(n.startswith("home/deep/er/out/") for n in new)


def test_imported_images_are_called_by_what_they_are(tmp_path: Path) -> None:
    """A picture with a suffix that Python runs at start-up, in a folder that Python looks into."""
    source = tmp_path / "in"
    transforms = scene(source, "a", image="evil.pth", mask_path="evil.pth")
    codes = np.full((20, 20, 3), 255, np.uint8)
    (source / "evil.pth").write_bytes(encode_png(codes) + b"\nimport os; os.system('touch /tmp/evil')\n")
    out = import_capture(tmp_path / "out", transforms=transforms)
    assert {Path(n).suffix for n in files_below(out)} == {".png", ".json"}


def test_a_failed_import_leaves_nothing(tmp_path: Path) -> None:
    transforms = scene(tmp_path / "in", "a", mask_path="m.png")
    (tmp_path / "in" / "m.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"m\.png"):
        import_capture(tmp_path / "out" / "deep", transforms=transforms)
    assert not (tmp_path / "out" / "deep").exists() and not list(tmp_path.rglob(".*"))


def test_runs_of_a_sweep_have_folders_below_the_experiment() -> None:
    from mifit.experiments import Run
    from mifit.experiments.plan import Experiment

    for key, value in (("render.parameters.a/../../../evil", 1), ("fit.model", "../" * 9), ("x", "é" * 300)):
        folder = Run(Experiment("e"), {key: value}, "0123456789ab").folder
        assert os.path.basename(folder) == folder and len(folder.encode()) < 200 and folder.endswith("0123456789")


# -- landmarks ------------------------------------------------------------------------------------------------------


class Fake:
    """A detector that always finds the same points."""

    name, scatter = "fake", 0.0

    def detect(self, image: np.ndarray) -> np.ndarray:
        return np.stack([np.arange(68) / 4 + 1, np.arange(68) % 17 + 1.0], axis=1)


def test_landmarks_keep_what_they_do_not_know_and_what_was_there(tmp_path: Path) -> None:
    path = scene(tmp_path, "../a", applied_transform=[1, 2], colmap_im_id=7)
    document = json.loads(path.read_text())
    document |= {"ply_file_path": "x.ply", "aabb_scale": 4}
    path.write_text(json.dumps(document))
    (tmp_path / "landmarks" / "mine").mkdir(parents=True)
    (tmp_path / "landmarks" / "mine" / "0.json").write_text("by hand")
    said = detect_landmarks(tmp_path, Fake())
    after = json.loads(path.read_text())
    frame = after["frames"][0]
    assert after["ply_file_path"] == "x.ply" and after["aabb_scale"] == 4
    assert frame["applied_transform"] == [1, 2] and frame["colmap_im_id"] == 7
    assert {k: v for k, v in frame.items() if k != "landmark_path"}.items() <= document["frames"][0].items()
    assert (tmp_path / frame["landmark_path"]).resolve().is_relative_to(tmp_path / "landmarks")
    assert read_landmarks(tmp_path / frame["landmark_path"]).visible.all()
    assert (tmp_path / "landmarks.before" / "mine" / "0.json").read_text() == "by hand"
    assert "landmarks.before" in said
    detect_landmarks(tmp_path, Fake())
    assert (tmp_path / "landmarks.before2").is_dir()


def test_landmarks_of_a_named_file_go_into_that_file(tmp_path: Path) -> None:
    path = scene(tmp_path, "a")
    train = path.rename(tmp_path / "transforms_train.json")
    detect_landmarks(train, Fake())
    assert json.loads(train.read_text())["frames"][0]["landmark_path"] == "landmarks/a/0000.json"
    assert not path.exists()


def test_landmarks_are_not_written_through_links(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    scene(tmp_path / "capture", "a")
    (tmp_path / "capture" / "landmarks").symlink_to(home)
    with pytest.raises(InputError, match="found a symbolic link"):
        detect_landmarks(tmp_path / "capture", Fake())
    assert not any(home.iterdir())


def test_synth_keeps_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "transforms.json").write_text("mine")
    assert main(["synth", "--out", str(tmp_path / "out"), "--timesteps", "1", "--width", "32", "--height", "32"]) == 2
    assert "is there already and not empty; --force" in capsys.readouterr().err
    assert files_below(tmp_path) == {"out/transforms.json": b"mine"}


# -- files that are there -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture, a result of it and an environment."""
    from tests.hostile.cases import make_base

    return make_base(tmp_path_factory.mktemp("base") / "work")


OUTPUTS = {
    "render": ("render", "result", "--capture", "capture", "--camera", "left", "--timestep", "0", "--out"),
    "evaluate": (
        "evaluate",
        "result",
        "--capture",
        "capture",
        "--camera",
        "left",
        "--fitted",
        "--timesteps",
        "0",
        "--json",
    ),
    "export": ("export", "result", "--format", "ply", "--out"),
    "convert": ("model", "convert", "ball.npz"),
    "turntable": ("turntable", "result", "--steps", "1", "--out"),
    "relight": ("relight", "result", "--env", "env.hdr", "--out"),
}
MINE = {
    "render": "x.png", "evaluate": "x.json", "export": "x.ply", "convert": "x.npz",
    "turntable": "x/turntable.png", "relight": "x/left.png",
}  # fmt: skip
READ = {
    "render": ("capture/images/left/0000.png", "capture/images/right/0001.png"),
    "evaluate": ("capture/transforms.json", "result/result.json"),
    "export": ("result/geometry/0000.ply", "ball.npz"),
    "convert": ("ball.npz",),
}


@pytest.mark.parametrize("command", OUTPUTS)
def test_files_that_are_there_stay(variant: str, work: Path, tmp_path: Path, monkeypatch, capfd, command: str) -> None:
    """Without --force all of them, with it those that the command reads."""
    home = shutil.copytree(work, tmp_path / "home")
    document = json.loads((home / "result" / "result.json").read_text())
    document["model"]["source"] = str(home / "ball.npz")
    (home / "result" / "result.json").write_text(json.dumps(document))
    monkeypatch.chdir(home)
    mine = home / MINE[command]
    out = mine if mine.parent == home else mine.parent
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    before = files_below(home)
    options = ("--quiet", "--variant", variant)
    if command == "convert":
        options = ()
    assert main([*OUTPUTS[command], str(out), *options]) == 2
    assert f"{out}: is there already" in capfd.readouterr().err
    for name in READ.get(command, ()):
        for path in (home / name, tmp_path / "link"):
            if path.name == "link":
                path.symlink_to(home / name)
            assert main([*OUTPUTS[command], str(path), "--force", *options]) == 2
            error = capfd.readouterr().err
            assert "this command reads it" in error or "found suffix" in error or "expected" in error, error
        path.unlink()
    assert files_below(home) == before
    if command != "evaluate":  # which judges a camera that isn't held out
        assert main([*OUTPUTS[command], str(out), "--force", *options]) == 0
        assert mine.read_bytes() != b"mine"


# -- no room --------------------------------------------------------------------------------------------------------

VIDEO = """
import numpy as np
from pathlib import Path
try:
    from mifit.output.views import write_video
except ImportError:
    from mifit.output.video import write_video
frames = (np.random.default_rng(i).integers(0, 255, (64, 96, 3)).astype(np.uint8) for i in range(40))
write_video(Path("v.mp4"), frames, 12.0)
"""


def with_room_for(size: int, code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python code that may write files of at most ``size`` bytes, as on a disk that fills up."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size)),
    )


def test_a_video_is_whole_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"old")
    for size in (100, 40_000):
        done = with_room_for(size, VIDEO, tmp_path)
        assert done.returncode and "v.mp4: can't be written" in done.stderr.splitlines()[-1]
        assert files_below(tmp_path) == {"v.mp4": b"old"}
    assert with_room_for(1 << 30, VIDEO, tmp_path).returncode == 0
    assert (tmp_path / "v.mp4").stat().st_size > 40_000


def test_no_room_is_one_line_and_bad_input(tmp_path: Path) -> None:
    arguments = ["model", "convert", "builtin:coarse", "m.npz", "--force"]
    convert = f"import sys; from mifit.cli import main; sys.exit(main({arguments}))"
    (tmp_path / "m.npz").write_bytes(b"old")
    for size in (0, 1000, 300_000):
        done = with_room_for(size, convert, tmp_path)
        assert done.returncode == 2 and done.stderr.count("\n") == 1
        assert "m.npz: can't be written: File too large; what was there is unchanged" in done.stderr
        assert files_below(tmp_path) == {"m.npz": b"old"}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_full_disk_behind_standard_output(unbuffered: str) -> None:
    code = "import sys; from mifit.cli import main; sys.exit(main(['model', 'info', 'builtin:coarse']))"
    surroundings = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=surroundings
        )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left" in done.stderr


@pytest.mark.parametrize(("limit", "said"), [(400_000, "not enough memory")])
def test_no_room_for_addresses_is_one_line(limit: int, said: str) -> None:
    code = "import sys; from mifit.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "model", "info", "builtin:coarse"],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit << 10, limit << 10)),
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and said in done.stderr, done.stderr


def test_a_closed_standard_output_is_one_line(tmp_path: Path) -> None:
    code = "import sys; from mifit.cli import main; sys.exit(main())"
    shell = f"exec '{sys.executable}' -c '{code}' model info builtin:coarse"
    for closed, said in ((">&-", "standard output is closed"), (">&- <&-", "standard output is closed")):
        done = subprocess.run(f"{shell} {closed}", shell=True, capture_output=True, text=True, check=False)
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and said in done.stderr
    done = subprocess.run(f"{shell} 2>&-", shell=True, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "vertices" in done.stdout


def test_a_long_name_takes_no_time() -> None:
    from mifit.core.files import file_name

    start = time.monotonic()
    for text in ("x" * 10**7, "\u0301\u0323" * 10**6):
        assert len(file_name(text).encode()) <= 100
    assert time.monotonic() - start < 2.0


# -- the cache folder -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["", "somewhere/else"])
def test_the_cache_is_never_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    from mifit.core.files import cache_folder

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MIFIT_CACHE", value)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if value:
        with pytest.raises(InputError, match="MIFIT_CACHE: found 'somewhere/else', expected an absolute path"):
            cache_folder()
    else:
        assert cache_folder() == tmp_path / "cache" / "mifit"
