"""What C libraries print by themselves while they decode: left alone by the library, dropped by the command line.

Standard error belongs to the program. Redirecting its descriptor from a library would race with the program's other
threads, so decoders only mark where they run; `mifit.cli.console` decides what that means for the ``mifit`` command.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

_around: Callable[[], AbstractContextManager[None]] = nullcontext


def decoding() -> AbstractContextManager[None]:
    """Context for one call of a decoder that may print about damaged input."""
    return _around()


def set_decoding_context(around: Callable[[], AbstractContextManager[None]]) -> None:
    """Say what surrounds every decoder call; for programs that own their standard error."""
    global _around
    _around = around
