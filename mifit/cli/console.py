"""Progress on stderr: a bar on a terminal, plain lines elsewhere; and what C libraries print there, dropped."""

from __future__ import annotations

import os
import sys
import time
from typing import TextIO

from mifit.core.process import no_chatter, set_decoding_context
from mifit.progress import Progress, silent


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
