"""The iBUG points of models."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import read_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

IBUG_MIRROR = np.array(
    [
        *range(16, -1, -1),
        *range(26, 16, -1),
        *range(27, 31),
        *range(35, 30, -1),
        *(45, 44, 43, 42, 47, 46, 39, 38, 37, 36, 41, 40),
        *(54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55),
        *(64, 63, 62, 61, 60, 67, 66, 65),
    ]
)
"""The iBUG point that is the mirror image of each iBUG point."""


def read_landmark_file(path: Path) -> NDArray[np.int64]:
    """Read a JSON list of 68 vertex indices, 0-based, in iBUG order."""
    try:
        values = json.loads(read_text(path, MAX_SETTINGS_BYTES, "landmark file"))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON: {error}") from None
    if not isinstance(values, list) or len(values) != 68 or not all(type(v) is int for v in values):
        raise InputError(f"{path}: expected a list of 68 vertex indices in iBUG order")
    return np.array(values)
