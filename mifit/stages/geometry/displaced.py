"""The model on a surface beyond its span."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.morphable import MorphableModel


def displaced(model: MorphableModel, geometry: GeometryEstimate) -> MorphableModel:
    """The model whose mean lies on the found surface: its coefficients add to that."""
    if geometry.displacement is None:
        return model
    return replace(model, mean=model.mean + geometry.displacement)


def moved_by(model: MorphableModel, geometry: GeometryEstimate, movement: NDArray) -> GeometryEstimate:
    """The fit with its neutral surface moved by (V, 3), object space; vertices follow at all timesteps."""
    before = 0.0 if geometry.displacement is None else geometry.displacement
    found = replace(geometry, displacement=(before + movement).astype(np.float32))
    objects = object_shapes(model, found)
    world = found.scale * objects @ found.rotation.transpose(0, 2, 1) + found.translation[:, None]
    return replace(found, vertices=world.astype(np.float32))


def object_shapes(model: MorphableModel, geometry: GeometryEstimate) -> NDArray[np.float64]:
    """(T, V, 3) vertices of each timestep in object space."""
    carried = displaced(model, geometry)
    return np.stack([carried.shape(geometry.identity, x) for x in geometry.expression]).astype(np.float64)
