"""How the C library hands memory back to the system."""

from __future__ import annotations

import ctypes

TRIM, MAP = -1, -3
"""glibc's ``M_TRIM_THRESHOLD`` and ``M_MMAP_THRESHOLD``."""
KEPT = 1 << 30
LARGEST = 1 << 25
"""Arrays of more bytes still come from the system and go back to it."""


def keep_freed_memory() -> bool:
    """Keep what is freed for the arrays that come next; for programs that own their process. True where it took effect.

    NumPy asks for each intermediate array anew. glibc gets those above some hundred kilobytes from the system and gives
    them back: the system clears the pages every time, which takes longer than most sums over them.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # another C library
        return False
    return bool(mallopt(TRIM, KEPT)) and bool(mallopt(MAP, LARGEST))
