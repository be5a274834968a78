"""The model on a surface beyond its span."""

from __future__ import annotations

from dataclasses import replace

from mifit.core.estimate import GeometryEstimate
from mifit.morphable import MorphableModel


def displaced(model: MorphableModel, geometry: GeometryEstimate) -> MorphableModel:
    """The model whose mean lies on the found surface: its coefficients add to that."""
    if geometry.displacement is None:
        return model
    return replace(model, mean=model.mean + geometry.displacement)
