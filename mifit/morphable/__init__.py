"""Morphable face models: the built-in one and every format that users own."""

from mifit.morphable.model import MorphableModel

__all__ = ["MorphableModel"]
