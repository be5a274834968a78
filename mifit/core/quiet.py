"""Silence for C libraries that print to standard error by themselves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def silenced_stderr() -> Iterator[None]:
    """Drop what is written to file descriptor 2 inside the block.

    Decoders (libpng, OpenEXR, FFmpeg) print about damaged input; mifit says the same in one line of its own. The
    descriptor belongs to the whole process, so keep the block around one decoder call.
    """
    try:
        saved = os.dup(2)
    except OSError:  # no standard error at all
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)
