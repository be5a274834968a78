"""`output.evaluate`'s squared error of the held-out view for many fits of one capture, without its repeated work.

Photograph, region and visible surface are found once per geometry, and only samples inside the region are shaded.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mifit import Capture, Reconstruction
from mifit.core.estimate import GeometryEstimate
from mifit.core.metrics import psnr_from_rmse
from mifit.output.deferred import VisibleSurface, shade_methods, visible_surface
from mifit.output.evaluate import compare, rgba_8_bit
from mifit.result import Method


@dataclass(frozen=True)
class Error:
    """Mean squared error (8-bit steps) over a number of pixels of one timestep."""

    squared: float
    pixels: int


def pooled_psnr(errors: Iterable[Error]) -> float:
    """PSNR in dB over all pixels together, as `evaluate` pools timesteps."""
    found = list(errors)
    total = sum(e.squared * e.pixels for e in found)
    return psnr_from_rmse((total / sum(e.pixels for e in found)) ** 0.5)


class ThirdView:
    """The held-out camera of a capture, judged over the face area of the true mesh.

    `evaluate` takes 2 x 2 samples per pixel; one makes a table four times as fast and moves its figures by about
    a tenth of a decibel, alike for all rows.
    """

    def __init__(
        self,
        capture: Capture,
        camera: str = "third",
        region: Literal["model", "truth"] = "truth",
        oversampling: int = 1,
    ) -> None:
        self._capture, self._camera, self._region, self._oversampling = capture, camera, region, oversampling
        self._geometry: GeometryEstimate | None = None
        self._truth: dict[int, tuple[NDArray, NDArray]] = {}
        self._surfaces: dict[int, VisibleSurface] = {}

    def errors(
        self, result: Reconstruction, timesteps: Sequence[int] | None = None, method: Method = "full"
    ) -> dict[int, Error]:
        """Error per timestep; default: those that were fitted."""
        if result.geometry is not self._geometry:
            self._geometry, self._surfaces = result.geometry, {}
        out = {}
        for timestep in result.timesteps if timesteps is None else timesteps:
            photograph, region = self._photograph(result, timestep)
            surface = self._surface(result, timestep, region)
            image = rgba_8_bit(shade_methods(result, surface, timestep, (method,))[method])
            difference = image[region][:, :3].astype(np.float64) - photograph[region].astype(np.float64)
            out[timestep] = Error(float(np.mean(difference**2)), int(region.sum()))
        return out

    def _photograph(self, result: Reconstruction, timestep: int) -> tuple[NDArray, NDArray]:
        """Photograph and region: the true mesh's, so the same for all fits."""
        if timestep not in self._truth:
            found = compare(result, self._capture, self._camera, timestep, self._region, ("pca",), 1)
            self._truth[timestep] = found.photograph, found.region
        return self._truth[timestep]

    def _surface(self, result: Reconstruction, timestep: int, region: NDArray) -> VisibleSurface:
        if timestep not in self._surfaces:
            whole = visible_surface(result, self._capture.camera(self._camera), timestep, self._oversampling)
            width = region.shape[1]
            row, column = np.divmod(whole.index, width * self._oversampling)
            inside = region[row // self._oversampling, column // self._oversampling]
            self._surfaces[timestep] = replace(
                whole,
                index=whole.index[inside],
                face=whole.face[inside],
                weights=whole.weights[inside],
                points=whole.points[inside],
                view=whole.view[inside],
            )
        return self._surfaces[timestep]
