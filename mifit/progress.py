"""Progress reports of long work: a callable that stages are given and call as they go."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""``progress(label, done, total)``; called with ``done`` from 0 to ``total``."""


def silent(label: str, done: int, total: int) -> None:
    """Report nothing."""
