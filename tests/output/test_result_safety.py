"""Nothing of a user's is lost by writing a result, and a result is whole or the old one."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mifit.cli import main
from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.result import Reconstruction, ownership, writing


def tree(folder: Path) -> dict[str, bytes]:
    """Every file with its content, apart from the folder's own notes."""
    files = (p for p in folder.rglob("*") if p.is_file() and ownership.MARK not in p.relative_to(folder).parts)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


@pytest.fixture
def other(ball):
    """The same face with another diffuse map and the first timestep alone."""
    reflectance = dataclasses.replace(ball.reflectance, diffuse=0.5 * ball.reflectance.diffuse)
    normals = dataclasses.replace(ball.normals, timesteps=(0,), normal_object=ball.normals.normal_object[:1])
    return dataclasses.replace(
        ball, reflectance=reflectance, geometry=ball.geometry.at([0]), normals=normals, mesh=None
    )


def test_a_folder_with_other_files_is_refused(ball, tmp_path):
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "notes.txt").write_text("mine")
    before = tree(tmp_path)
    with pytest.raises(InputError, match=r"did not make \(it holds maps\)"):
        ball.save(tmp_path)
    assert tree(tmp_path) == before and not (tmp_path / ownership.MARK).exists()
    with pytest.raises(InputError, match="found a file"):
        ball.save(tmp_path / "maps" / "notes.txt")
    ball.save(tmp_path, force=True)
    assert (tmp_path / "maps" / "notes.txt").read_text() == "mine"


def test_only_our_own_files_go_and_only_as_we_wrote_them(ball, other, tmp_path):
    ball.save(tmp_path)
    (tmp_path / "geometry" / "mine.ply").write_text("mine")
    (tmp_path / "overlay_me.mp4").write_text("mine")
    edited = tmp_path / "maps" / "normal_object_0003.exr"
    write_image(edited, np.ones((4, 4, 3), np.float32))
    content = edited.read_bytes()
    other.save(tmp_path)
    names = set(tree(tmp_path))
    assert edited.read_bytes() == content
    assert {"geometry/mine.ply", "overlay_me.mp4", "geometry/0000.ply"} <= names
    assert not names & {"geometry/0003.ply", "maps/normal_tangent_0003.png", "refined/0000.ply"}
    assert not (tmp_path / "refined").exists()
    assert Reconstruction.load(tmp_path, ball.model).timesteps == (0,)


@pytest.mark.parametrize("after", range(0, 9, 3))
def test_a_save_that_fails_leaves_the_old_result(ball, other, tmp_path, monkeypatch, after):
    ball.save(tmp_path)
    before, count = tree(tmp_path), [0]
    write = writing.write_image

    def full(path, values):
        count[0] += 1
        if count[0] > after:
            raise OSError(28, "No space left on device", str(path))
        write(path, values)

    with monkeypatch.context() as patch:
        patch.setattr(writing, "write_image", full)
        patch.setattr("mifit.output.scene.write_image", full)
        with pytest.raises(OSError, match="No space left"):
            other.save(tmp_path)
    assert tree(tmp_path) == before
    assert not (tmp_path / ownership.MARK / "new").exists()
    other.save(tmp_path)
    assert Reconstruction.load(tmp_path, ball.model).timesteps == (0,)


def test_killed_while_files_change_places(ball, other, tmp_path):
    """Killed after any number of them: none reads a mix, and the next that writes has all of the new result."""
    ball.save(tmp_path / "start")
    other.save(tmp_path / "end")
    expected = tree(tmp_path / "end")
    replace, moves = os.replace, [0]

    class Killed(BaseException):
        pass

    limit, ended = 0, False
    while not ended:
        folder = shutil.copytree(tmp_path / "start", tmp_path / f"run{limit}")
        moves[0] = 0

        def dying(a, b, limit=limit, **at):
            if at:
                if moves[0] == limit:
                    raise Killed
                moves[0] += 1
            replace(a, b, **at)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "replace", dying)
            try:
                other.save(folder)
                ended = True
            except Killed:
                before = {name: (folder / name).stat() for name in tree(folder)}
                with pytest.raises(InputError, match="`mifit fit` or `mifit track`"):
                    Reconstruction.load(folder, ball.model)
                assert {name: (folder / name).stat() for name in tree(folder)} == before
        ownership.finish(folder)
        assert Reconstruction.load(folder, ball.model).timesteps == (0,)
        assert tree(folder) == expected
        limit += 1
    assert limit > 10


def everything(folder: Path) -> dict[str, tuple]:
    """All below a folder, links followed nowhere, with what tells that it was moved or changed."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        found[str(path.relative_to(folder))] = status.st_mode, status.st_ino, status.st_mtime_ns, content
    return found


def plant(result: Reconstruction, tmp_path: Path, new: str) -> Path:
    """A result folder from a stranger whose notes say that files of the user's home were about to become its own."""
    folder, home = tmp_path / "result", tmp_path / "home"
    (home / ".ssh").mkdir(parents=True)
    (home / ".ssh" / "id_rsa").write_text("mine")
    (home / "victim").write_text("mine")
    result.model.save(tmp_path / "ball.npz")
    dataclasses.replace(result, model_source=str(tmp_path / "ball.npz")).save(folder)
    (folder / "link").symlink_to(home)
    mark, digest = folder / ownership.MARK, ownership._digest(home / "victim")
    names = [".ssh/id_rsa", "victim", "../home/victim", str(home / "victim"), "link/victim", "id_rsa"]
    known = json.loads((mark / "files.json").read_text())
    (mark / "files.json").write_text(json.dumps(known | dict.fromkeys(names, digest)))
    if new == "link":
        (mark / "new").symlink_to(home)
    elif new == "link inside":
        (mark / "new").mkdir()
        (mark / "new" / ".ssh").symlink_to(home / ".ssh")
        (mark / "new" / "id_rsa").symlink_to(home / ".ssh" / "id_rsa")
    else:
        (mark / "new" / "link").mkdir(parents=True)
        (mark / "new" / "link" / "victim").write_text("theirs")
    (mark / "commit.json").write_text(json.dumps({"made": dict.fromkeys(names, ""), "stale": names}))
    return folder


@pytest.mark.parametrize("new", ["link", "link inside", "folder"])
def test_reading_moves_nothing(ball, tmp_path, monkeypatch, capsys, new):
    folder = plant(ball, tmp_path, new)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    before = everything(tmp_path)
    with pytest.raises(InputError, match="finishes"):
        Reconstruction.load(folder)
    for arguments in (
        ("export", "--format", "obj", "--out", str(tmp_path / "x.obj")),
        ("render", "--out", str(tmp_path / "x.png")),
        ("evaluate", "--capture", str(tmp_path / "capture"), "--camera", "third"),
        ("view", "--port", "0"),
        ("turntable", "--out", str(tmp_path / "x")),
        ("relight", "--env", str(tmp_path / "x.hdr"), "--out", str(tmp_path / "x")),
    ):
        assert main([arguments[0], str(folder), *arguments[1:]]) == 2
        assert "finishes" in capsys.readouterr().err
        assert everything(tmp_path) == before


@pytest.mark.parametrize("new", ["link", "link inside", "folder"])
def test_writing_moves_nothing_from_or_to_elsewhere(ball, tmp_path, new):
    folder = plant(ball, tmp_path, new)
    before = everything(tmp_path / "home")
    if new == "folder":
        with pytest.raises(InputError, match="found a link or a file as a folder in link/victim"):
            ball.save(folder, force=True)
        (folder / "link").unlink()
        ball.save(folder)
        assert Reconstruction.load(folder, ball.model).timesteps == ball.timesteps
    else:
        with pytest.raises(InputError, match="found a symbolic link"):
            ball.save(folder, force=True)
    assert everything(tmp_path / "home") == before


@pytest.mark.parametrize("place", [".mifit", "maps", "geometry", ".mifit/new", ".mifit/checkpoints", ".mifit/lock"])
def test_a_link_in_place_of_a_folder_of_ours_is_refused(ball, tmp_path, place):
    folder, outside = tmp_path / "result", tmp_path / "outside"
    for name in ("new", "checkpoints", "maps"):
        (outside / name).mkdir(parents=True)
        (outside / name / "victim").write_text("mine")
    (folder / place).parent.mkdir(parents=True)
    (folder / place).symlink_to(outside)
    before = everything(tmp_path)
    with pytest.raises(InputError, match="found a symbolic link"):
        ball.save(folder, force=True)
    assert everything(tmp_path) == before


def test_a_map_that_was_changed_is_said(ball, tmp_path):
    ball.save(tmp_path)
    write_image(tmp_path / "maps" / "diffuse.exr", 0.5 * ball.reflectance.diffuse)
    with pytest.warns(UserWarning, match=r"maps/diffuse\.exr: has changed since mifit wrote it"):
        Reconstruction.load(tmp_path, ball.model)


def test_a_lock_that_is_left_at_once_leaves_no_folder(tmp_path):
    with pytest.raises(InputError), ownership.locked(tmp_path / "a" / "b"):
        raise InputError("refused")
    assert not any(tmp_path.iterdir())
    with pytest.raises(InputError), ownership.locked(tmp_path / "c"):
        ownership.remember(tmp_path / "c", [])
        (tmp_path / "c" / ownership.MARK / "checkpoints").mkdir()
        raise InputError("later")
    assert (tmp_path / "c" / ownership.MARK / "checkpoints").is_dir()


def test_a_result_that_changes_while_it_is_read_is_refused(ball, other, tmp_path, monkeypatch):
    from mifit.result import reading

    ball.save(tmp_path)
    read = reading.read_image

    def slow(path):
        if path.name == "specular.exr":
            other.save(tmp_path)
        return read(path)

    monkeypatch.setattr(reading, "read_image", slow)
    with pytest.raises(InputError, match="another mifit has written into it meanwhile; try again"):
        Reconstruction.load(tmp_path, ball.model)


def test_one_process_writes_at_a_time(tmp_path):
    ownership.claim(tmp_path)
    code = (
        "import sys, time; from pathlib import Path; from mifit.result import ownership\n"
        "with ownership.locked(Path(sys.argv[1])): print('ready', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        with pytest.raises(InputError, match="another mifit is writing into it"), ownership.locked(tmp_path):
            pass
        process.send_signal(signal.SIGKILL)
        process.wait()
    with ownership.locked(tmp_path):  # a killed process leaves no lock
        pass


def test_clear_deletes_what_we_wrote_alone(tmp_path):
    folder = tmp_path / "capture"
    ownership.clear(folder)
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "a.png").write_text("a")
    with pytest.raises(InputError, match="did not make"):
        ownership.clear(folder)
    ownership.claim(folder, force=True)
    with pytest.raises(InputError, match=r"found images/a\.png, which mifit did not write"):
        ownership.clear(folder)
    ownership.remember(folder, ownership.files_in(folder))
    (folder / "images" / "a.png").write_text("changed")
    with pytest.raises(InputError, match="did not write as it is"):
        ownership.clear(folder)
    (folder / "images" / "a.png").write_text("a")
    ownership.clear(folder)
    assert not folder.exists()
