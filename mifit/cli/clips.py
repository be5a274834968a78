"""From clips, folders of frames or photographs to a capture with landmarks, in the result's own folder."""

from __future__ import annotations

import os
import shutil
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mifit.cli.arguments import console_progress, given, say
from mifit.core.files import Document, read_json, write_json
from mifit.core.limits import MAX_DOCUMENT_BYTES
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture.sources import Source
    from mifit.progress import Progress

ORIGIN = "origin.json"


def is_capture(path: Path) -> bool:
    """Whether a path is a capture folder or its file, not a clip, a folder of frames or a photograph."""
    return path.suffix == ".json" or (path / "transforms.json").exists() or not path.exists()


def capture_of(arguments: Namespace) -> Path:
    """The capture folder of ``fit``'s arguments: the one given, or one made of clips in the result's folder.

    A capture that an earlier run made of the same clips in the same way is taken as it is.
    """
    paths: list[Path] = arguments.capture
    if len(paths) == 1 and is_capture(paths[0]):
        for option in ("calibration", "board", "offset", "trim", "every"):
            if getattr(arguments, option) is not None:
                raise InputError(f"--{option}: found with the capture {paths[0]}, expected it with clips")
        return paths[0]
    from mifit.capture.detect import available
    from mifit.capture.face_networks import missing
    from mifit.result.ownership import add_folder, clear

    if not any(available().values()):
        raise InputError(missing())
    out, folder = arguments.out, arguments.out / "capture"
    if (out / "result.json").exists() and not (arguments.resume or arguments.force):
        raise InputError(f"--out {out}: holds a result already; --resume goes on with it, --force replaces it")
    origin = _origin(arguments)
    if os.path.lexists(folder):
        file = folder / ORIGIN
        if file.is_file() and read_json(file, MAX_DOCUMENT_BYTES) == origin:
            say(arguments, f"Capture: {folder}, as an earlier run made it of these clips")
            return folder
        if not arguments.force:
            raise InputError(f"{folder}: holds a capture of something else; --force replaces it, or name another --out")
        clear(folder)

    def make(made: Path) -> None:
        _make(arguments, paths, made)
        write_json(made / ORIGIN, origin)

    add_folder(out, folder.name, make, arguments.force)
    say(arguments, f"Capture: {folder}")
    return folder


def _origin(arguments: Namespace) -> Document:
    """What decides what a capture made of clips holds, as JSON values."""
    files = [*arguments.capture, *(arguments.board or []), *([arguments.calibration] if arguments.calibration else [])]
    known = {}
    for path in files:
        if not path.exists():
            raise InputError(f"{path}: no such clip, folder of frames, photograph or calibration")
        inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        known[str(path.absolute())] = [[p.name, p.stat().st_size, p.stat().st_mtime_ns] for p in inside]
    options = given(arguments, "pattern", "offset", "every") | {"trim": str(arguments.trim)}
    return {"files": known, "clips": len(arguments.capture), **options}


def _make(arguments: Namespace, paths: Sequence[Path], folder: Path) -> None:
    """Import, with cameras from a calibration or a board where there is one, and find landmarks."""
    from mifit.capture import detect_landmarks, import_capture
    from mifit.capture.clips import aligned
    from mifit.capture.sources import open_sources

    progress = console_progress(arguments.quiet)
    if arguments.calibration and arguments.board:
        raise InputError(f"--board: found with --calibration {arguments.calibration}, expected one of the two")
    kinds = _kinds(paths)
    sources = open_sources(**kinds)
    starts = start_times(arguments, sources, arguments.offset or "auto", progress)
    if arguments.board:
        kinds["transforms"] = _calibrated(arguments, sources, folder.with_name("calibration"), progress)
    elif arguments.calibration:
        kinds["transforms" if arguments.calibration.suffix == ".json" else "calibration"] = arguments.calibration
    length = aligned(sources, starts, arguments.trim)[0].length
    every = arguments.every or max(-(-length // 24), 1)
    import_capture(folder, **kinds, every=every, starts=starts, trim=arguments.trim, progress=progress)
    if arguments.board:
        shutil.copytree(folder.with_name("calibration"), folder / "calibration")
        shutil.rmtree(folder.with_name("calibration"))
    say(arguments, detect_landmarks(folder, progress=progress))


def start_times(
    arguments: Namespace, sources: Sequence[Source], offset: list[float] | str | None, progress: Progress
) -> list[float]:
    """Seconds by which each video begins after the first: the ``offset`` given, or where it is ``auto`` found.

    What was found and rates that differ are said on stderr.
    """
    from mifit.capture.clips import aligned, describe, synchronise
    from mifit.capture.sources import Video

    videos = [source for source in sources if isinstance(source, Video)]
    if len(videos) < 2:
        return []
    starts = synchronise(videos, progress) if offset == "auto" else []
    seconds = offset if isinstance(offset, list) else [start.seconds for start in starts]
    for line in describe(aligned(sources, seconds), starts):
        say(arguments, line)
    return seconds


def _calibrated(arguments: Namespace, sources: Sequence[Source], folder: Path, progress: Progress) -> Path:
    """Cameras from clips of a board, one for each of the clips, as a file to import."""
    from mifit.capture.clips import aligned
    from mifit.capture.sources import open_sources
    from mifit.extras.board_calibration import calibrate_boards, write_calibration
    from mifit.extras.boards import Board

    names = [source.name for source in sources]
    if len(arguments.board) != len(names):
        raise InputError(f"--board: found {len(arguments.board)} clips, expected {len(names)}, one for each camera")
    shown = open_sources(**_kinds(arguments.board), names=names)
    moments = aligned(shown, start_times(arguments, shown, "auto", progress))
    found = calibrate_boards(moments, Board.parse(arguments.pattern), "cm", progress)
    shutil.rmtree(folder, ignore_errors=True)
    write_calibration(found, folder, "cm")
    say(arguments, found.summary())
    return folder / "transforms.json"


def _kinds(paths: Sequence[Path]) -> Document:
    """The paths as videos, or as images where they are folders of frames or photographs."""
    from mifit.core.image import SUFFIXES

    frames = any(path.is_dir() or path.suffix.lower() in SUFFIXES for path in paths)
    return {"videos": () if frames else paths, "images": paths if frames else ()}
