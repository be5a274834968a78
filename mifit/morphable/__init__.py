"""Morphable face models: the built-in one and every format that users own."""

from mifit.morphable import recognise
from mifit.morphable.model import MorphableModel

PROVIDERS = (recognise,)
"""Modules that enter themselves as what the methods of `MorphableModel` call (``model.provides``)."""

__all__ = ["MorphableModel"]
