"""What a pixel of a photograph shows."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Label(IntEnum):
    """Grey value of each kind of pixel in a mask's file; those above mid-grey are used, as in ``mask_path``."""

    BACKGROUND = 0
    OCCLUDER = 32
    CLOTH = 64
    HAIR = 96
    MOUTH = 160
    EYES = 208
    SKIN = 255


HIDDEN = (Label.OCCLUDER, Label.CLOTH, Label.HAIR)
"""What hides the face."""


def hidden(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels (H, W) at which something hides the face."""
    return np.isin(labels, HIDDEN)
