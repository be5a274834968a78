"""True geometry of a capture as if stage 1 had found it, and errors on a view that was not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.estimate import GeometryEstimate, Report
from mifit.morphable import MorphableModel


def true_geometry(capture: Capture, model: MorphableModel, timesteps: Sequence[int]) -> GeometryEstimate:
    """The capture's own vertices and poses, with the mean albedo of the model that was rendered."""
    frames = [np.load(Path(capture.path) / "truth" / f"{t:04d}.npz") for t in timesteps]
    return GeometryEstimate(
        timesteps=tuple(timesteps),
        identity=np.zeros(model.n_identity),
        albedo=np.zeros(model.n_albedo),
        expression=np.zeros((len(frames), model.n_expression)),
        rotation=np.stack([f["R"] for f in frames]),
        translation=np.stack([f["t"] for f in frames]),
        scale=1.0,
        vertices=np.stack([f["vertices"] for f in frames]),
        vertex_albedo=model.mean_albedo,
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report("converged"),
    )


def true_maps(capture: Capture, size: int) -> dict[str, NDArray]:
    """Painted albedo, specular lobe weight and roughness of the capture, averaged down to ``size`` texels a side."""
    with np.load(Path(capture.path) / "truth" / "maps.npz") as stored:
        out = {}
        for key in ("albedo", "specular", "roughness"):
            image = stored[key].astype(np.float32)
            k = image.shape[0] // size
            out[key] = image.reshape(size, k, size, k, *image.shape[2:]).mean((1, 3))
    return out
