"""Files appear whole or not at all, and what a killed process left goes."""

import os
import signal
import subprocess
import sys

import pytest

from mifit.core import files
from mifit.core.files import replacing, replacing_folder, write_text

WRITER = """
import sys, time
from mifit.core.files import replacing, replacing_folder
with {how}(sys.argv[1]) as part:
    part.mkdir() if {folder} else part.write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def killed_in_the_middle(path, how="replacing"):
    command = [sys.executable, "-c", WRITER.format(how=how, folder=how == "replacing_folder"), str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        yield process
        process.send_signal(signal.SIGKILL)


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
@pytest.mark.parametrize("how", ["replacing", "replacing_folder"])
def test_what_a_killed_process_left_goes_with_the_next_one_and_nothing_else_does(tmp_path, how):
    for _ in killed_in_the_middle(tmp_path / "x.txt", how):
        # It still runs: its temporary file is not ours to remove.
        assert len(files._abandoned(tmp_path)) == 0
        (left,) = [p for p in tmp_path.iterdir() if ".part" in p.name]
    others = [".x.12345678.part.txt", ".x.otherhost-99999999.part.txt", "x.part.txt", ".hidden"]
    for name in others:
        (tmp_path / name).write_text("the user's")
    assert files._abandoned(tmp_path) == [left]
    if how == "replacing":
        write_text(tmp_path / "y.txt", "new")
    else:
        with replacing_folder(tmp_path / "x.txt") as part:
            part.mkdir()
    assert not left.exists()
    assert all((tmp_path / name).read_text() == "the user's" for name in others)


def test_a_block_that_raises_leaves_what_was_there(tmp_path):
    path = tmp_path / "new" / "a.txt"
    write_text(path, "first")
    with pytest.raises(ValueError), replacing(path) as part:
        part.write_text("second")
        raise ValueError
    assert path.read_text() == "first" and [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_a_folder_takes_the_place_of_an_empty_one_only(tmp_path):
    (tmp_path / "out").mkdir()
    with replacing_folder(tmp_path / "out") as part:
        part.mkdir()
        (part / "a").touch()
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["a"]
    with pytest.raises(OSError), replacing_folder(tmp_path / "out") as part:
        part.mkdir()
    assert [p.name for p in tmp_path.iterdir()] == ["out"] and (tmp_path / "out" / "a").exists()


def test_a_link_is_left_alone(tmp_path):
    target = tmp_path / "target"
    target.write_text("kept")
    link = tmp_path / f".x.{files._MACHINE}-99999999.part.txt"
    os.symlink(target, link)
    write_text(tmp_path / "y.txt", "")
    assert link.is_symlink() and target.read_text() == "kept"
