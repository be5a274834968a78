"""Whose a folder is: what mifit has written into it, who writes now, and files that come all together or not at all.

The folder ``.mifit`` marks one of ours. In it are ``files.json`` (every file that we wrote, with a digest of its
content), the lock of the process that writes, checkpoints, and, while files are being replaced, the new ones.

A result may come from a stranger. Who reads one changes nothing in it; who writes holds the lock, follows no link in
it, and touches nothing outside.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from mifit.core.files import at_place, check_no_links, overwriting, read_json, write_json
from mifit.core.limits import MAX_DOCUMENT_BYTES
from mifit.errors import InputError

MARK = ".mifit"
CHECKPOINTS = f"{MARK}/checkpoints"
_FILES, _LOCK, _NEW, _COMMIT = "files.json", "lock", "new", "commit.json"
_FOLDERS = (MARK, "geometry", "refined", "maps", "masks")
"""Folders of a result: ours, never links."""


def check_ours(folder: Path, force: bool = False) -> None:
    """Refuse a folder that holds what mifit did not write.

    InputError for a file; a link where a result has a folder, or in ``.mifit``; or without ``force`` a folder that
    isn't empty and doesn't have the mark.
    """
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise InputError(f"{folder}: found a file, expected a folder or nothing")
    for place in (*(folder / name for name in _FOLDERS), *(folder / MARK).rglob("*")):
        check_no_links(folder, place)
    for place in filter(os.path.lexists, (folder / name for name in _FOLDERS)):
        if not place.is_dir():
            raise InputError(f"{place}: found a file, expected a folder or nothing; move it away")
    inside = sorted(p.name for p in folder.iterdir())
    if force or not inside or (folder / MARK).is_dir():
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
        write_json(folder / MARK / _FILES, {})


@contextmanager
def locked(folder: Path, force: bool = False) -> Iterator[None]:
    """Claim a folder, keep others from writing into it, and finish what an interrupted write left in it.

    Who holds the lock may take it again. InputError where another one writes into it, or as `claim`.
    """
    from filelock import FileLock, Timeout

    new = [place for place in (folder / MARK, folder, *folder.parents) if not os.path.lexists(place)]
    claim(folder, force)
    lock = FileLock(folder.resolve() / MARK / _LOCK, is_singleton=True)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(
            f"{folder}: another mifit is writing into it; wait until it has ended, or name another folder"
        ) from None
    try:
        with overwriting(None):  # these rules hold here
            _finish(folder)
            yield
    except Exception:
        if new and sorted(os.listdir(folder / MARK)) == sorted((_FILES, _LOCK)) and not written(folder):
            for name in (_FILES, _LOCK):  # refused before anything was made
                (folder / MARK / name).unlink()
            for place in new:
                with suppress(OSError):
                    place.rmdir()
        raise
    finally:
        lock.release()


def finish(folder: Path) -> None:
    """Finish an interrupted write into a result; called by what is about to read it and then to write into it."""
    if _interrupted(folder):
        with locked(folder):
            pass


@contextmanager
def unchanging(folder: Path) -> Iterator[None]:
    """Read a result in the block as one write has left it; nothing is written.

    InputError where a write was interrupted, or another process writes meanwhile.
    """

    def state() -> dict[str, str]:
        if _interrupted(folder):
            raise InputError(
                f"{folder}: files are being written into it, or that was interrupted; wait for the mifit that writes, "
                "or run the `mifit fit` or `mifit track` that wrote again, with --resume: it finishes that"
            )
        return written(folder)

    before = state()
    try:
        yield
    finally:
        if state() != before:
            raise InputError(f"{folder}: another mifit has written into it meanwhile; try again")


def written(folder: Path) -> dict[str, str]:
    """Files that mifit wrote, relative to the folder, with the digests of what it wrote."""
    try:
        known = read_json(folder / MARK / _FILES, MAX_DOCUMENT_BYTES)
    except InputError:
        return {}
    return {str(k): str(v) for k, v in known.items()} if isinstance(known, dict) else {}


def changed(folder: Path) -> list[str]:
    """Meshes and maps of a result that are there and no longer as mifit wrote them."""
    known = {k: v for k, v in written(folder).items() if k.endswith((".ply", ".exr", ".npz")) and "/" in k}
    return [name for name in known if _inside(name) and _digest_inside(folder, name) not in (known[name], None)]


def files_in(folder: Path) -> list[str]:
    """Files and links in a folder and those in it, relative to it, without what is in ``.mifit``."""
    found = (p for p in sorted(folder.rglob("*")) if p.is_symlink() or not p.is_dir())
    names = (p.relative_to(folder).as_posix() for p in found)
    return [name for name in names if not name.startswith(f"{MARK}/")]


def remember(folder: Path, names: Iterable[str]) -> None:
    """Add files of a claimed folder to those that mifit wrote."""
    known = written(folder) | {name: _digest(folder / name) for name in names}
    write_json(folder / MARK / _FILES, known, sort_keys=True)


def remove_written(folder: Path, names: Iterable[str]) -> None:
    """Delete those of the named files that are as mifit wrote them, and folders that are empty then."""
    known = written(folder)
    for name in sorted(set(names) & set(known)):
        if not _inside(name) or _digest_inside(folder, name) != known[name]:
            continue
        for place in (name, *map(str, PurePosixPath(name).parents[:-1])):
            try:
                with at_place(folder, place) as (last, at):
                    os.unlink(last, dir_fd=at) if place == name else os.rmdir(last, dir_fd=at)
            except OSError:  # not empty
                break


def clear(folder: Path) -> None:
    """Delete a folder that holds nothing but what mifit wrote; one that is missing is clear.

    InputError for files that mifit did not write, or that were changed since; nothing is deleted then.
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


def add_folder(folder: Path, name: str, make: Callable[[Path], object], force: bool = False) -> Path:
    """A folder within a claimed one, all of whose files ``make`` writes; it takes its name when all are there."""
    claim(folder, force)
    made = folder / MARK / name
    shutil.rmtree(made, ignore_errors=True)  # of a process that was killed
    make(made)
    claim(made, force=True)
    remember(made, files_in(made))
    return made.rename(folder / name)


@contextmanager
def replacing_files(folder: Path, only: bool = False, force: bool = False) -> Iterator[Path]:
    """Yield a folder for new files that take the places of the old ones when the block ends well, all of them.

    When the block raises, everything stays as it was. When the process is killed the next one that writes into the
    folder either drops the new files or, if all were there, moves the rest to their places. The folder is claimed and
    locked meanwhile. With ``only``, files that mifit wrote earlier and that aren't among the new ones go; what the
    user has changed or added stays in any case.
    """
    with locked(folder, force):
        new = folder / MARK / _NEW
        _remove_new(folder)  # what an unfinished process left
        new.mkdir()
        try:
            yield new
            made = {p.relative_to(new).as_posix(): _digest(p) for p in sorted(new.rglob("*")) if p.is_file()}
            stale = [name for name in written(folder) if only and name not in made]
            write_json(folder / MARK / _COMMIT, {"made": made, "stale": stale})
        except BaseException:
            _remove_new(folder)
            raise
        _finish(folder)


def _interrupted(folder: Path) -> bool:
    return os.path.lexists(folder / MARK / _COMMIT)


def _remove_new(folder: Path) -> None:
    new = folder / MARK / _NEW
    if new.is_dir():
        shutil.rmtree(new, ignore_errors=True)  # follows no link
    else:
        new.unlink(missing_ok=True)


def _finish(folder: Path) -> None:
    """Move new files to their places where a process got as far as having them all; of a locked folder."""
    if not _interrupted(folder):
        return
    for place in (folder / MARK / _NEW, folder / MARK / _COMMIT, folder / MARK / _FILES):
        check_no_links(folder, place)
    try:
        commit = read_json(folder / MARK / _COMMIT, MAX_DOCUMENT_BYTES)
        made = {str(name): str(digest) for name, digest in commit["made"].items() if _inside(name)}
        stale = [str(name) for name in commit["stale"]]
    except (ValueError, TypeError, KeyError, AttributeError):  # InputError is a ValueError
        made, stale = {}, []
    for name in sorted(made, key=lambda name: name == "result.json"):  # which names the others: last
        with suppress(FileNotFoundError), at_place(folder, f"{MARK}/{_NEW}/{name}") as (source, source_at):
            if stat.S_ISREG(os.stat(source, dir_fd=source_at, follow_symlinks=False).st_mode):
                with at_place(folder, name, make=True) as (target, target_at):
                    os.replace(source, target, src_dir_fd=source_at, dst_dir_fd=target_at)
    remove_written(folder, stale)
    known = {k: v for k, v in written(folder).items() if k not in stale} | made
    write_json(folder / MARK / _FILES, known, sort_keys=True)
    _remove_new(folder)
    (folder / MARK / _COMMIT).unlink()


def _inside(name: str) -> bool:
    """Whether a name that a file gives is one of a file of a result: below its folder, and not in ``.mifit``."""
    path = PurePosixPath(name)
    inside = bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name
    return inside and path.parts[0] != MARK


def _digest_inside(folder: Path, name: str) -> str | None:
    """Digest of a regular file below a folder, no links followed; None where there is none."""
    try:
        with at_place(folder, name) as (last, at):
            if not stat.S_ISREG(os.stat(last, dir_fd=at, follow_symlinks=False).st_mode):
                return None
            return _digest(os.open(last, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0), dir_fd=at))
    except (OSError, InputError):
        return None


def _digest(path: Path | int) -> str:
    with open(path, "rb") as stream:
        state = hashlib.blake2b(digest_size=16)
        while block := stream.read(1 << 20):
            state.update(block)
    return state.hexdigest()
