"""Types of command-line arguments: each reads a text, or says in one line what was expected."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from mifit.core.limits import MAX_TIMESTEPS


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
        if len(steps) > MAX_TIMESTEPS or (steps and steps[-1] > sys.maxsize):
            raise argparse.ArgumentTypeError(f"found {text[:60]!r}, expected at most {MAX_TIMESTEPS} timesteps")
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
    if not 1 <= found <= MAX_TIMESTEPS:
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


def at_least(low: int) -> Callable[[str], int]:
    """A reader of counts from ``low``."""
    return whole(low, MAX_TIMESTEPS)


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
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a finite number")
    return value


def rate(text: str) -> float:
    """A number above 0."""
    value = real(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a number above 0")
    return value
