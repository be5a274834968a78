"""Files: read within bounds, named from text safely, written whole or not at all."""

from __future__ import annotations

import errno
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import sys
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from mifit.core.limits import MAX_NAME_BYTES
from mifit.errors import InputError

Document = dict[str, Any]
"""A JSON object."""
FULL = {errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC)}
"""Error numbers that say that there is no room for what is written."""

_MACHINE = re.sub(r"[^A-Za-z0-9-]", "-", platform.node()) or "here"
_PART = re.compile(r"\..+\." + re.escape(_MACHINE) + r"-(\d+)\.part(\.[^.]+)?")


_read: set[str] = set()
_overwriting: bool | None = None


@contextmanager
def overwriting(force: bool | None) -> Iterator[None]:
    """Say what `replacing` may do in the block to a file that is there: by default, and with None, replace it.

    With False it is refused, and with True it is replaced unless the block has read it (`opened`, `note_read`) or it is
    no regular file. A command that writes where its user says runs in such a block.
    """
    global _overwriting
    before = _overwriting
    if before is None:
        _read.clear()
    _overwriting = force
    try:
        yield
    finally:
        _overwriting = before


def note_read(paths: Iterable[str | Path]) -> None:
    """Count files as read before they are; see `overwriting`."""
    _read.update(os.path.abspath(path) for path in paths)


def check_overwriting(path: str | Path) -> None:
    """Refuse a file that may not be written, see `overwriting`; InputError names it and the remedy."""
    if _overwriting is None or not os.path.lexists(path):
        return
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"{path}: found {'a folder' if os.path.isdir(path) else 'a device'}, expected a file to write")
    if any(_is_same(path, read) for read in _read):
        raise InputError(f"{path}: this command reads it, so it can't be written; name another file")
    if not _overwriting:
        raise InputError(f"{path}: is there already; --force replaces it, or name another file")


def _is_same(path: str | Path, other: str) -> bool:
    try:
        return os.path.samefile(path, other)
    except OSError:
        return False


@contextmanager
def opened(path: str | Path, limit: float, what: str = "file") -> Iterator[tuple[BinaryIO, int]]:
    """Open an input file of at most ``limit`` bytes; yields the stream and its size.

    A pipe, a device or a folder is refused without waiting for it, and a file that is too large before it is read, by
    InputError, as is one that is missing or can't be read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise InputError(f"{path}: can't be read: {getattr(error, 'strerror', None) or error}") from None
    note_read([path])
    found = os.fstat(descriptor)
    problem = None
    if not stat.S_ISREG(found.st_mode):
        problem = f"found {'a folder' if stat.S_ISDIR(found.st_mode) else 'a pipe or device'}, expected a {what}"
    elif found.st_size > limit:
        problem = f"found {found.st_size} bytes, expected a {what} of at most {limit}"
    if problem:
        os.close(descriptor)
        raise InputError(f"{path}: {problem}")
    with os.fdopen(descriptor, "rb") as stream:
        try:
            yield stream, found.st_size
        except OSError as error:
            if error.filename is not None or error.errno in FULL:
                raise
            raise InputError(f"{path}: can't be read: {error.strerror or error}") from None


def check_file(path: str | Path, limit: float, what: str = "file") -> int:
    """Size in bytes of an input file that a library will open; InputError as `opened` raises it."""
    with opened(path, limit, what) as (_, size):
        return size


def read_bytes(path: str | Path, limit: int, what: str = "file") -> bytes:
    """Content of a file of at most ``limit`` bytes; InputError as `opened` raises it."""
    with opened(path, limit, what) as (stream, size):
        return stream.read(size)


def read_text(path: str | Path, limit: int, what: str = "file") -> str:
    """UTF-8 text of a file of at most ``limit`` bytes; InputError as `opened` raises it, or when it is no text."""
    try:
        return read_bytes(path, limit, what).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not readable as UTF-8 text: {error}") from None


def file_digest(path: str | Path, limit: int, what: str = "file") -> bytes:
    """SHA-256 of a file's content, read block by block; InputError as `opened` raises it."""
    result = hashlib.sha256()
    with opened(path, limit, what) as (stream, _):
        while block := stream.read(2**20):
            result.update(block)
    return result.digest()


def file_name(text: str) -> str:
    """Make the name of a file or folder from any text, such as a camera's name in somebody's capture.

    Letters and digits of any script, ``.``, ``-``, ``_``, ``+`` and ``=`` stay; text that is a name already is returned
    as it is. Anything else is replaced and a digest of the text appended, so that different texts have different
    names. The name is never empty, hidden, a path, one that Windows reserves, or longer than `MAX_NAME_BYTES`.
    """
    plain = unicodedata.normalize("NFC", text[: 4 * MAX_NAME_BYTES])
    plain = "".join(c if c.isalnum() or c in ".-_+=" else "-" for c in plain).strip(".-")
    plain = plain.encode("utf-8")[:MAX_NAME_BYTES].decode("utf-8", "ignore")
    reserved = _RESERVED.match(plain) is not None
    if plain == text and plain and not reserved:
        return plain
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    short = plain.encode("utf-8")[: MAX_NAME_BYTES - 10].decode("utf-8", "ignore").rstrip(".-")
    return f"{'_' if reserved else ''}{short}-{digest}" if short else f"x-{digest}"


_RESERVED = re.compile(r"(CON|PRN|AUX|NUL|(COM|LPT)[1-9])(\.|$)", re.IGNORECASE)


def check_no_links(folder: str | Path, path: str | Path) -> None:
    """Refuse to write ``path`` through symbolic links below ``folder``: a folder from elsewhere may point anywhere.

    ``folder`` is where the user said to write; it may be a link itself.
    """
    folder, path = Path(folder), Path(path)
    inside = folder
    for part in path.relative_to(folder).parts:
        inside = inside / part
        if inside.is_symlink():
            raise InputError(f"{inside}: found a symbolic link, expected a file or folder of its own; remove the link")


@contextmanager
def at_place(folder: str | Path, name: str, make: bool = False) -> Iterator[tuple[str | Path, int | None]]:
    """Yield the last part of ``name`` and a descriptor of the folder that it is in, for functions with ``dir_fd``.

    ``name`` is a path below ``folder``, with ``/``; the folders between are no links, also if somebody changes them
    meanwhile; ``make`` makes those that are missing. FileNotFoundError for a missing folder, InputError for a link or a
    file in its place.
    """
    *parents, last = PurePosixPath(name).parts
    if os.open not in os.supports_dir_fd:  # Windows, where links need an administrator
        check_no_links(folder, Path(folder, name))
        if make:
            Path(folder, *parents).mkdir(parents=True, exist_ok=True)
        yield Path(folder, name), None
        return
    at = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for part in parents:
            if make:
                with suppress(FileExistsError):
                    os.mkdir(part, dir_fd=at)
            try:
                inner = os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=at)
            except OSError as error:
                if error.errno not in (errno.ENOTDIR, errno.ELOOP):
                    raise
                raise InputError(f"{folder}: found a link or a file as a folder in {name}; remove it") from None
            os.close(at)
            at = inner
        yield last, at
    finally:
        os.close(at)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` (same suffix) that takes its place when the block ends well.

    The folder is made when it is missing. When the block raises, the temporary file goes and ``path`` stays as it was.
    A process that is killed can't clean up: the next one that writes into the folder does it. InputError, which names
    ``path``: the disk is full, the place can't be written, or `overwriting` forbids it.
    """
    path = Path(path)
    check_overwriting(path)
    temporary = path.with_name(f".{path.stem}.{_MACHINE}-{os.getpid()}.part{path.suffix}")
    with _room(path, temporary):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(path.parent)
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
    with _room(path, temporary):
        try:
            yield temporary
            if path.exists():
                path.rmdir()
            os.replace(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _room(path: Path, temporary: Path) -> Iterator[None]:
    """Name the target, not the temporary file, when there is no room or no right to write."""
    try:
        yield
    except OSError as error:
        name = str(error.filename)
        own = name in (str(temporary), str(path.parent)) or name.startswith(f"{temporary}{os.sep}")
        if error.errno in FULL or own:
            raise InputError(f"{path}: can't be written: {error.strerror}; what was there is unchanged") from None
        raise


def cache_folder() -> Path:
    """Where mifit keeps what it makes once: ``MIFIT_CACHE``, else ``mifit`` in the user's cache folder.

    Variables that are empty count as unset. InputError for one that isn't an absolute path: the place would depend on
    where a program runs.
    """
    named, base = os.environ.get("MIFIT_CACHE"), os.environ.get("XDG_CACHE_HOME")
    try:
        folder = Path(named) if named else (Path(base) if base else Path.home() / ".cache") / "mifit"
    except RuntimeError:  # no home folder
        folder = Path(os.devnull).absolute() / "mifit"
    if not folder.is_absolute():
        name = "MIFIT_CACHE" if named else "XDG_CACHE_HOME"
        raise InputError(f"{name}: found {named or base!r}, expected an absolute path")
    return folder


def read_json(path: str | Path, limit: int, what: str = "file") -> Any:
    """Content of a JSON file of at most ``limit`` bytes; InputError as `opened` raises it, or when it is no JSON."""
    text = read_text(path, limit, what)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON: {error}") from None


def write_json(path: str | Path, document: Mapping[str, object], **options: Any) -> None:
    """Write a JSON file whole or not at all; ``options`` are those of ``json.dumps``."""
    write_text(path, json.dumps(document, **{"indent": 1, **options}) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file whole or not at all."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


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
