"""Maps between landmark sets."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import read_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

MEDIAPIPE_TO_IBUG68 = np.array(
    [
        *(127, 234, 93, 132, 58, 136, 150, 176, 152, 400, 379, 365, 288, 361, 323, 454, 356),  # jaw
        *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300),  # brows
        *(168, 197, 5, 4, 240, 97, 2, 326, 460),  # nose
        *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),  # eyes
        *(61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181),  # outer lips
        *(78, 82, 13, 312, 308, 317, 14, 87),  # inner lips
    ]
)
"""The MediaPipe face-mesh point (of 468 or 478) nearest to each of the 68 iBUG points."""

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
