"""Files that are written whole or not at all."""

from __future__ import annotations

import functools
import os
import platform
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MACHINE = re.sub(r"[^A-Za-z0-9-]", "-", platform.node()) or "here"
_PART = re.compile(r"\..+\." + re.escape(_MACHINE) + r"-(\d+)\.part(\.[^.]+)?")


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` (same suffix) that takes its place when the block ends well.

    The folder is made when it is missing. When the block raises, the temporary file goes and ``path`` stays
    as it was. A process that is killed can't clean up: the next one that writes into the folder does it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned(path.parent)
    temporary = _part(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """As `replacing`, for a folder that is missing or empty so far; the block makes the temporary one."""
    path = Path(path)
    for folder in _abandoned(path.parent):
        if folder.is_dir() and folder.name.startswith(f".{path.name}.{_MACHINE}-"):
            shutil.rmtree(folder, ignore_errors=True)
    temporary = path.with_name(f".{path.name}.{_MACHINE}-{os.getpid()}.part")
    try:
        yield temporary
        if path.exists():
            path.rmdir()
        os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@functools.lru_cache(maxsize=256)
def remove_abandoned(folder: Path) -> None:
    """Remove what `replacing` left in a folder when its process was killed; once a process and folder.

    Only temporary files of this machine whose process is gone: another machine that shares the folder, or another
    process of this one, may be writing the others.
    """
    for path in _abandoned(folder):
        if path.is_file():
            path.unlink(missing_ok=True)


def _abandoned(folder: Path) -> list[Path]:
    """Temporary files and folders of processes of this machine that are gone; none where that can't be told."""
    if sys.platform == "win32" or not folder.is_dir():  # there asking after a process ends it
        return []
    with os.scandir(folder) as entries:
        parts = [(entry, _PART.fullmatch(entry.name)) for entry in entries if not entry.is_symlink()]
    return [Path(entry.path) for entry, match in parts if match and not _runs(int(match.group(1)))]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another user's
        return True
    return True


def _part(path: Path) -> Path:
    return path.with_name(f".{path.stem}.{_MACHINE}-{os.getpid()}.part{path.suffix}")
