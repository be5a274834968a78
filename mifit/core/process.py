"""What a process may use and print: processor cores, and what C libraries say while they decode."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

from threadpoolctl import threadpool_limits

from mifit.errors import InputError

T = TypeVar("T")
R = TypeVar("R")

OURS = "MIFIT_THREADS"
VARIABLES = (OURS, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Read by libraries when they are loaded, and by processes that this one starts."""


BLOCK = 1 << 20
"""Numbers that are worked on at a time: they stay in a core's cache, and bound what is held beside the result."""


def blocks(count: int, width: int = 1) -> list[slice]:
    """Slices that cut ``count`` rows of ``width`` numbers into `BLOCK` numbers each."""
    step = max(BLOCK // max(width, 1), 1)
    return [slice(at, min(at + step, count)) for at in range(0, count, step)]


def set_threads(count: int) -> None:
    """Use so many threads, at least 1; before ``set_variant``, which gives Dr.Jit its number.

    Dr.Jit takes 2 where 1 is asked for: with one it waits for itself when images are read.
    """
    if count < 1:
        raise InputError(f"threads: found {count}, expected a whole number of at least 1")
    for name in VARIABLES:
        os.environ[name] = str(count)
    threadpool_limits(count)  # of what is loaded already
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(count)


def threads() -> int:
    """Threads to use: as set here or by ``MIFIT_THREADS``, else one for each core that this process may run on."""
    named = os.environ.get(OURS, "")
    if named.isdecimal() and int(named) > 0:
        return int(named)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_all_cores(function: Callable[[T], R], parts: Sequence[T]) -> list[R]:
    """What a function makes of each part, in their order; for work in NumPy, OpenCV or BLAS, which let go of the
    interpreter. A single part is no matter for another thread.
    """
    count = min(len(parts), threads())
    if count < 2:
        return [function(part) for part in parts]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, parts))


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Linear algebra on one core, as a context or a decorator; what else is set before holds again afterwards.

    A fit makes many products that take milliseconds. OpenBLAS's threads wait for the next one by spinning, which takes
    the cores from Dr.Jit and OpenCV: two threads double a fit's processor time and make it no faster.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


_around: Callable[[], AbstractContextManager[None]] = nullcontext


def decoding() -> AbstractContextManager[None]:
    """Context for one call of a decoder that may print about damaged input."""
    return _around()


def set_decoding_context(around: Callable[[], AbstractContextManager[None]]) -> None:
    """Say what surrounds every decoder call; for programs that own their standard error."""
    global _around
    _around = around


@contextlib.contextmanager
def no_chatter() -> Iterator[None]:
    """Send descriptor 2 and Python's standard output nowhere inside the block."""
    try:
        saved = os.dup(2)
    except OSError:  # no standard error at all
        yield
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)
