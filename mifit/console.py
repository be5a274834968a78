"""Progress on stderr: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from mifit.progress import Progress, silent

LINE_SECONDS = 5.0
"""On a stream that is no terminal, at most one line of progress per label in this time."""


def console_progress(quiet: bool = False, stream: TextIO | None = None) -> Progress:
    """Progress callable for the command line; silent when ``quiet``."""
    if quiet:
        return silent
    out = stream or sys.stderr
    return _bars(out) if out.isatty() else _lines(out)


def _lines(out: TextIO) -> Progress:
    started: dict[str, float] = {}
    spoken: dict[str, float] = {}

    def report(label: str, done: int, total: int) -> None:
        now = time.monotonic()
        if done == 0 or label not in started:
            started[label] = now
        last = done >= total
        if not last and now - spoken.get(label, -LINE_SECONDS) < LINE_SECONDS:
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
