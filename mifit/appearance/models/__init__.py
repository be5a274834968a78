"""Shading models: one file each, objects with one interface in one registry.

Adding one: derive from `ShadingModel`, name it, say what a point sends to the eye (`transfer`), and `register_model` an
instance. Fits, renders, relighting and the ``shdirect`` plugin then know it by its name.
"""

from __future__ import annotations

from mifit.appearance.models.base import ShadingModel, Transfer
from mifit.appearance.models.paper import PaperModel, PrintedModel
from mifit.appearance.models.prefiltered import PrefilteredModel
from mifit.appearance.models.shadowed import ShadowedModel
from mifit.config import SHADINGS
from mifit.errors import InputError

__all__ = ["ShadingModel", "Transfer", "get", "names", "register_model"]

_MODELS: dict[str, ShadingModel] = {}


def register_model(model: ShadingModel) -> None:
    """Make a shading model known by its name; one of the same name is replaced."""
    _MODELS[model.name] = model
    if model.name not in SHADINGS:
        SHADINGS.append(model.name)


def names() -> tuple[str, ...]:
    """Names of all models, in the order in which they were registered."""
    return tuple(_MODELS)


def get(name: str | ShadingModel) -> ShadingModel:
    """The model of a name; InputError lists those that there are."""
    if isinstance(name, ShadingModel):
        return name
    if name not in _MODELS:
        raise InputError(f"shading model: found {name!r}, expected one of {', '.join(_MODELS)}")
    return _MODELS[name]


for _model in (PaperModel(), PrintedModel(), PrefilteredModel(), ShadowedModel()):
    register_model(_model)
