"""Images of Mitsuba scene files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def render_scene(
    path: str | Path, parameters: Mapping[str, Any], spp: int, seed: int = 0, sensor: int = 0
) -> NDArray[np.float32]:
    """Render a scene file that may use mifit's plugins.

    Parameters
    ----------
    path : path
        Mitsuba XML.
    parameters : mapping
        Values of the file's ``<default>`` names.
    spp, seed, sensor : int
        Samples per pixel, seed of the sampler, and which of the scene's sensors.

    Returns
    -------
    (H, W, C) float32
        What the sensor's film holds: linear radiance on black, and coverage where it has alpha.
    """
    import mitsuba as mi

    from mifit.render.scene import load_scene

    scene = load_scene(path, **parameters)
    image = mi.render(scene, sensor=sensor, spp=spp, seed=seed)  # type: ignore[arg-type]
    return np.array(image, dtype=np.float32)
