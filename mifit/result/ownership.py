"""Whose a folder is: what mifit has written into it, who writes now, and files that come all together or not at all.

The folder ``.mifit`` marks one of ours. In it are ``files.json`` (every file that we wrote, with a digest of its
content), the lock of the process that writes, checkpoints, and, while files are being replaced, the new ones.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mifit.core.files import write_text
from mifit.errors import InputError

MARK = ".mifit"
CHECKPOINTS = f"{MARK}/checkpoints"
_FILES, _LOCK, _NEW, _COMMIT = "files.json", "lock", "new", "commit.json"


def check_ours(folder: Path, force: bool = False) -> None:
    """Refuse a folder that holds what mifit did not write.

    Raises
    ------
    InputError
        A file, or without ``force`` a folder that isn't empty and has neither the mark nor a result in it.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise InputError(f"{folder}: found a file, expected a folder or nothing")
    inside = sorted(p.name for p in folder.iterdir())
    if force or not inside or (folder / MARK).is_dir() or _holds_a_result(folder):
        return
    raise InputError(
        f"{folder}: found a folder that mifit did not make (it holds {', '.join(inside[:3])}"
        f"{', ...' if len(inside) > 3 else ''}); expected a new or an empty one, or --force to write beside that"
    )


def claim(folder: Path, force: bool = False) -> None:
    """Make a folder and mark it as ours, so that what stops work later is found before it; see `check_ours`."""
    check_ours(folder, force)
    (folder / MARK).mkdir(parents=True, exist_ok=True)
    if not (folder / MARK / _FILES).exists():
        write_text(folder / MARK / _FILES, "{}\n")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing into a claimed folder.

    Raises
    ------
    InputError
        Another one does.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(folder / MARK / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"{folder}: another mifit is writing into it; wait until it has ended, or name another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def written(folder: Path) -> dict[str, str]:
    """Files that mifit wrote, relative to the folder, with the digests of what it wrote."""
    try:
        known = json.loads((folder / MARK / _FILES).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {str(k): str(v) for k, v in known.items()} if isinstance(known, dict) else {}


def files_in(folder: Path) -> list[str]:
    """Files and links in a folder and those in it, relative to it, without what is in ``.mifit``."""
    found = (p for p in sorted(folder.rglob("*")) if p.is_symlink() or not p.is_dir())
    names = (p.relative_to(folder).as_posix() for p in found)
    return [name for name in names if not name.startswith(f"{MARK}/")]


def remember(folder: Path, names: Iterable[str]) -> None:
    """Add files of a claimed folder to those that mifit wrote."""
    known = written(folder) | {name: _digest(folder / name) for name in names}
    write_text(folder / MARK / _FILES, json.dumps(known, indent=1, sort_keys=True) + "\n")


def remove_written(folder: Path, names: Iterable[str]) -> None:
    """Delete those of the named files that are as mifit wrote them, and folders that are empty then."""
    known = written(folder)
    for name in filter(lambda name: _inside(folder, name), names):
        path = folder / name
        if name in known and path.is_file() and not path.is_symlink() and _digest(path) == known[name]:
            path.unlink()
            for parent in Path(name).parents:
                try:
                    if parent != Path():
                        (folder / parent).rmdir()
                except OSError:  # not empty
                    break


def clear(folder: Path) -> None:
    """Delete a folder that holds nothing but what mifit wrote; one that is missing is clear.

    Raises
    ------
    InputError
        Files that mifit did not write, or that were changed since; nothing is deleted then.
    """
    if not os.path.lexists(folder):
        return
    check_ours(folder)
    known = written(folder)
    foreign = [
        name
        for name in files_in(folder)
        if not (folder / name).is_file() or name not in known or _digest(folder / name) != known[name]
    ]
    if foreign:
        raise InputError(
            f"{folder}: found {foreign[0]}, which mifit did not write as it is; move the folder away, or name another"
        )
    shutil.rmtree(folder)


@contextmanager
def replacing_files(folder: Path, only: bool = False) -> Iterator[Path]:
    """Yield a folder for new files that take the places of the old ones when the block ends well, all of them.

    When the block raises, everything stays as it was. When the process is killed the next one that reads or writes the
    folder either drops the new files or, if all were there, moves the rest to their places (`finish`).

    Parameters
    ----------
    folder : path
        A claimed folder.
    only : bool
        Files that mifit wrote earlier and that aren't among the new ones go; what the user has changed or added stays
        in any case.
    """
    finish(folder)
    new = folder / MARK / _NEW
    shutil.rmtree(new, ignore_errors=True)  # what an unfinished process left
    new.mkdir(parents=True)
    try:
        yield new
        made = {str(p.relative_to(new).as_posix()): _digest(p) for p in sorted(new.rglob("*")) if p.is_file()}
        stale = [name for name in written(folder) if only and name not in made]
        write_text(folder / MARK / _COMMIT, json.dumps({"made": made, "stale": stale}))
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    finish(folder)


def finish(folder: Path) -> None:
    """Move new files to their places where a process got as far as having them all; harmless otherwise."""
    path, new = folder / MARK / _COMMIT, folder / MARK / _NEW
    try:
        commit: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        made, stale = dict(commit["made"]), list(commit["stale"])
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return
    made = {str(name): str(digest) for name, digest in made.items() if _inside(folder, name)}
    for name in sorted(made, key=lambda name: name == "result.json"):  # which names the others: last
        if (new / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(new / name, folder / name)
    remove_written(folder, stale)
    known = {k: v for k, v in written(folder).items() if k not in stale} | made
    write_text(folder / MARK / _FILES, json.dumps(known, indent=1, sort_keys=True) + "\n")
    path.unlink(missing_ok=True)
    shutil.rmtree(new, ignore_errors=True)


def _inside(folder: Path, name: str) -> bool:
    """Whether a name that a file gives stays in the folder, links followed."""
    parent = (folder / name).parent.resolve()
    root = folder.resolve()
    return not Path(name).is_absolute() and ".." not in Path(name).parts and (parent == root or root in parent.parents)


def _holds_a_result(folder: Path) -> bool:
    """Whether ``result.json`` is one that mifit wrote, before it marked folders."""
    try:
        document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(document, dict) and "mifit_version" in document


def _digest(path: Path) -> str:
    with open(path, "rb") as stream:
        state = hashlib.blake2b(digest_size=16)
        while block := stream.read(1 << 20):
            state.update(block)
    return state.hexdigest()
