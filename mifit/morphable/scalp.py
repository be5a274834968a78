"""Where a model's scalp is, from its landmarks: for hair, which no model has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.model import MorphableModel

FOREHEAD = 0.75
"""Heights of forehead and ears, in thirds of a face, the part between the base of the nose and the brows."""


def scalp_depth(model: MorphableModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(V,) how far vertices lie behind the hairline, and above the ears, in thirds of a face; negative outside.

    Seen from the side the hairline is straight: from `FOREHEAD` above the brows to the upper end of the jaw. Ears reach
    up to the outer ends of the brows, and back as far behind the jaw. Behind them the scalp ends as low as the nose.
    """
    points = model.mean.astype(np.float64)
    marks = points[model.landmarks]
    nose, brow, jaw = marks[33, 1], marks[17:27, 1].max(), marks[[0, 16], 1:].mean(axis=0)
    third = max(brow - nose, 1e-9)
    height = min(brow + FOREHEAD * third, points[:, 1].max())
    line = np.array([height, points[points[:, 1] >= height, 2].max()]) - jaw
    behind = (points[:, 1:] - jaw) @ np.array([line[1], -line[0]]) / max(np.linalg.norm(line) * third, 1e-9)
    beyond = np.minimum(points[:, 1] - nose, jaw[1] - FOREHEAD * third - points[:, 2])
    return behind, np.maximum(points[:, 1] - marks[[17, 26], 1].mean(), beyond) / third
