"""What commands share: readers of arguments, which say in one line what was expected, progress and messages."""

from __future__ import annotations

import argparse
import functools
import math
import os
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import NoReturn, TextIO

from mifit.core.diagnostics import Diagnostic, worst_first
from mifit.core.files import Document, check_overwriting, overwriting
from mifit.core.limits import MAX_COUNT, MAX_NUMBER
from mifit.core.process import no_chatter, set_decoding_context
from mifit.errors import InputError
from mifit.progress import Progress, silent

Command = Callable[[Namespace], "int | None"]
"""A command: given its arguments, it returns the exit code; None is 0."""


class Parser(argparse.ArgumentParser):
    """Reports bad usage in one line."""

    def error(self, message: str) -> NoReturn:
        """Print the message and leave with code 2."""
        if message.startswith("unrecognized arguments: ") and " -" not in message:
            message += "; the names of an option are joined by commas, as left,right"
        self.exit(2, f"{self.prog}: {one_line(message)}; see {self.prog} --help\n")


def one_line(text: str) -> str:
    """A message as one line of a terminal: no control characters, and not without end."""
    line = " ".join(text.split())
    line = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return line if len(line) <= 1000 else f"{line[:500]} ... {line[-500:]}"


def writes(*options: str, outside: str = "") -> Callable[[Command], Command]:
    """Make a command refuse to write over files: without ``--force`` all, with it those that it reads.

    ``options`` name what its user says to write; a file, or a folder with something in it, is refused before any work.
    Outside the folder of the option ``outside`` a PNG with coverage may be replaced: whoever scores results renders
    into one file again and again.
    """

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def run(arguments: Namespace) -> int | None:
            home = getattr(arguments, outside, None) if outside else None
            free = (
                home is not None and _is_render(arguments.out) and home.resolve() not in arguments.out.resolve().parents
            )
            with overwriting(arguments.force or free):
                for out in filter(None, (getattr(arguments, option, None) for option in options)):
                    check_empty(out, arguments.force) if out.is_dir() else check_overwriting(out)
                return command(arguments)

        return run

    return decorate


def _is_render(path: Path) -> bool:
    """Whether a file is a PNG with an alpha channel."""
    if not path.is_file() or path.is_symlink():
        return False
    with open(path, "rb") as stream:
        head = stream.read(26)
    return head[:8] == b"\x89PNG\r\n\x1a\n" and head[25:] == b"\x06"


def check_empty(folder: Path, force: bool = False) -> None:
    """Refuse to write into a folder with something in it, or a file in its place, unless ``force``."""
    if folder.exists() and not force and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is there already and not empty; --force writes into it, or name another folder")


def given(arguments: Namespace, *names: str) -> Document:
    """The arguments of these names, to hand on to a function whose parameters are called alike."""
    return {name: getattr(arguments, name) for name in names}


def use_variant(arguments: Namespace) -> str:
    """Activate the variant that ``--variant`` names; returns its name. VariantError where it can't fit."""
    from mifit.render.variant import set_fitting_variant

    return set_fitting_variant(arguments.variant)


def tell(arguments: Namespace, found: Iterable[Diagnostic], told: Collection[Diagnostic] = ()) -> int:
    """Print diagnostics but those already ``told`` on standard error, a line each, the worst first.

    Notes are not printed with ``--quiet``.

    Returns the command's exit code: 3 with ``--strict`` where one of them is a named fault, else 0.
    """
    found = worst_first(found)
    for one in found:
        if one not in told and (one.severity != "note" or not arguments.quiet):
            print(f"mifit: {one.severity}: {one_line(one.text)}", file=sys.stderr, flush=True)
    return 3 if arguments.strict and any(one.severity == "fault" for one in found) else 0


def say(arguments: Namespace, text: str) -> None:
    """Print a line on standard error unless ``--quiet``."""
    if not arguments.quiet:
        print(text, file=sys.stderr, flush=True)


# Progress on stderr: a bar on a terminal, plain lines elsewhere ---------------------------------------------------


def console_progress(quiet: bool = False) -> Progress:
    """Progress callable for the command line; silent when ``quiet``."""
    if quiet:
        return silent
    return _bars(sys.stderr) if sys.stderr.isatty() else _lines(sys.stderr)


def drop_chatter() -> None:
    """Keep decoders (OpenEXR, FFmpeg, OpenCV) from printing about damaged input: mifit says it in one line of its own.

    For the ``mifit`` command, which owns its process; a library must leave standard error alone.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when FFmpeg is first used
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # read when OpenCV is loaded
    if "cv2" in sys.modules:
        sys.modules["cv2"].utils.logging.setLogLevel(0)
    set_decoding_context(no_chatter)


def _lines(out: TextIO) -> Progress:
    started: dict[str, float] = {}
    spoken: dict[str, float] = {}

    def report(label: str, done: int, total: int) -> None:
        now = time.monotonic()
        if done == 0 or label not in started:
            started[label] = now
        last = done >= total
        if not last and now - spoken.get(label, -5.0) < 5.0:
            return
        spoken[label] = now
        print(f"{label}: {done}/{total}, {now - started[label]:.1f} s", file=out, flush=True)

    return report


def _bars(out: TextIO) -> Progress:
    from tqdm import tqdm

    bars: dict[str, tqdm] = {}

    def report(label: str, done: int, total: int) -> None:
        if label not in bars:
            bars[label] = tqdm(total=total, desc=label, file=out, leave=True, dynamic_ncols=True)
        bar = bars[label]
        bar.total = total
        bar.n = done
        bar.refresh()
        if done >= total:
            bar.close()
            del bars[label]

    return report


# Readers ---------------------------------------------------------------------------------------------------------


def listed(text: str) -> list[str]:
    """``left,right`` -> names."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected names separated by commas")
    return names


def timesteps(text: str) -> list[int]:
    """``0,1,5-8`` -> [0, 1, 5, 6, 7, 8]."""
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        try:
            steps = range(int(first), int(last if dash else first) + 1)
        except ValueError:
            raise argparse.ArgumentTypeError(f"found {text[:60]!r}, expected numbers such as 0,1,2 or 0-7") from None
        if len(steps) > MAX_COUNT or (steps and steps[-1] > sys.maxsize):
            raise argparse.ArgumentTypeError(f"found {text[:60]!r}, expected at most {MAX_COUNT} timesteps")
        found.extend(steps)
    if not found:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a first number not above the last, such as 0-7")
    return found


def timesteps_or_auto(text: str) -> list[int] | int:
    """As `timesteps`; ``auto`` -> 4 and ``auto:6`` -> 6, a number of timesteps to choose."""
    kind, colon, count = text.strip().partition(":")
    if kind != "auto":
        return timesteps(text)
    try:
        found = int(count) if colon else 4
    except ValueError:
        found = 0
    if not 1 <= found <= MAX_COUNT:
        raise argparse.ArgumentTypeError(f"found {text[:60]!r}, expected auto or a number of timesteps, such as auto:4")
    return found


def whole(low: int, high: int) -> Callable[[str], int]:
    """A reader of whole numbers from ``low`` to ``high``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"found {text[:60]!r}, expected a whole number from {low} to {high}")
        return value

    return parse


def path(text: str) -> Path:
    """A file or folder."""
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a file or folder")
    return Path(text)


def real(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= MAX_NUMBER:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a finite number within {MAX_NUMBER:g}")
    return value


def positive(text: str) -> float:
    """A number above 0."""
    value = real(text)
    if value < 1.0 / MAX_NUMBER:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number above 0")
    return value


def rate(text: str) -> float:
    """Frames per second."""
    value = positive(text)
    if not 1e-3 <= value <= 1e3:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected frames per second from 0.001 to 1000")
    return value


def exposure(text: str) -> float | str:
    """``auto``, or a number above 0."""
    return text if text == "auto" else positive(text)


def offsets(text: str) -> list[float] | str:
    """``0,0.4`` -> [0.0, 0.4], or ``auto``."""
    return text if text == "auto" else [real(part) for part in listed(text)]


def span(text: str) -> tuple[float, float]:
    """``1.5:8`` -> (1.5, 8.0); an end that is left out is open."""
    begin, colon, end = text.partition(":")
    found = (real(begin) if begin else -math.inf, real(end) if end else math.inf)
    if not colon or not found[0] < found[1]:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected BEGIN:END in seconds, such as 1.5:8")
    return found


READERS: dict[str, Callable[[str], object]] = {
    "text": str,
    "path": path,
    "names": listed,
    "steps": timesteps,
    "auto_steps": timesteps_or_auto,
    "real": real,
    "positive": positive,
    "rate": rate,
    "exposure": exposure,
    "offsets": offsets,
    "span": span,
}
"""Readers of arguments by the kind that `cli.options` names."""
