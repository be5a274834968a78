"""What cameras do to colours: their gains and the exposures of their images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import Document


@dataclass(frozen=True)
class Photometry:
    """Factors that the linear colours of images are divided by when a capture is read (`Capture.with_photometry`).

    ``gain`` is each camera's (r, g, b) over the first camera's: exposure and white balance; ``exposure`` an image's
    factor, by camera and timestep, over those of its camera's first timestep. What isn't named has 1.

    >>> Photometry({"right": (1.2, 1.0, 0.9)}, {("right", 3): 0.5}).factor("right", 3)
    array([0.6 , 0.5 , 0.45], dtype=float32)
    """

    gain: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    exposure: Mapping[tuple[str, int], float] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.gain or self.exposure)

    def factor(self, camera: str, timestep: int) -> NDArray[np.float32]:
        """(3,) factor of one image's linear colours."""
        gain = np.array(self.gain.get(camera, (1.0, 1.0, 1.0)), dtype=np.float32)
        return gain * np.float32(self.exposure.get((camera, timestep), 1.0))

    def document(self) -> Document:
        """As JSON values: ``gain`` by camera, ``exposure`` by camera and timestep."""
        exposure: dict[str, dict[str, float]] = {}
        for (camera, timestep), factor in self.exposure.items():
            exposure.setdefault(camera, {})[str(timestep)] = float(factor)
        return {"gain": {name: list(map(float, rgb)) for name, rgb in self.gain.items()}, "exposure": exposure}

    @classmethod
    def from_document(cls, document: Document) -> Photometry:
        """What `document` wrote; ValueError, TypeError, KeyError or AttributeError for values of another kind, or
        factors that aren't positive and finite.
        """
        gain = {name: tuple(map(float, rgb)) for name, rgb in document.get("gain", {}).items()}
        exposure = {
            (name, int(timestep)): float(factor)
            for name, factors in document.get("exposure", {}).items()
            for timestep, factor in factors.items()
        }
        values = [v for rgb in gain.values() for v in rgb] + list(exposure.values())
        if any(len(rgb) != 3 for rgb in gain.values()) or not all(0 < v < float("inf") for v in values):
            raise ValueError("expected gains (r, g, b) and exposures that are positive and finite")
        return cls({name: (rgb[0], rgb[1], rgb[2]) for name, rgb in gain.items()}, exposure)
