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

from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.reconstruction import Reconstruction
from mifit.result import ownership, writing


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


def test_results_from_before_folders_were_marked_are_replaced(ball, other, tmp_path):
    ball.save(tmp_path)
    shutil.rmtree(tmp_path / ownership.MARK)
    other.save(tmp_path)
    assert Reconstruction.load(tmp_path, ball.model).timesteps == (0,)


@pytest.mark.parametrize("after", range(0, 12, 3))
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
    """Killed after any number of them: the next that reads has all of the new result, never a mix."""
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

        def dying(a, b, limit=limit):
            if ownership.MARK + os.sep + "new" in str(a) and ".part" not in Path(a).name:
                if moves[0] == limit:
                    raise Killed
                moves[0] += 1
            replace(a, b)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "replace", dying)
            try:
                other.save(folder)
                ended = True
            except Killed:
                pass
        assert Reconstruction.load(folder, ball.model).timesteps == (0,)
        assert tree(folder) == expected
        limit += 1
    assert limit > 10


def test_names_in_a_foreign_result_stay_inside(ball, tmp_path):
    folder, outside = tmp_path / "result", tmp_path / "outside"
    ball.save(folder)
    outside.mkdir()
    (outside / "victim").write_text("mine")
    (folder / "link").symlink_to(outside)
    digest = ownership._digest(outside / "victim")
    names = ["../outside/victim", str(outside / "victim"), "link/victim"]
    mark = folder / ownership.MARK
    (mark / "files.json").write_text(json.dumps(dict.fromkeys(names, digest)))
    (mark / "new" / "link").mkdir(parents=True)
    (mark / "new" / "link" / "victim").write_text("theirs")
    (mark / "commit.json").write_text(json.dumps({"made": dict.fromkeys(names, ""), "stale": names}))
    Reconstruction.load(folder, ball.model)
    assert (outside / "victim").read_text() == "mine"
    assert not (mark / "commit.json").exists()


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
