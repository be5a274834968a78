"""Morphable face models: the built-in one and every format that users own."""

from mifit.morphable.model import MorphableModel, provide
from mifit.morphable.recognise import automatic_model, load_model

provide("automatic", automatic_model)
provide("load", load_model)

__all__ = ["MorphableModel"]
