"""The built-in head: a procedural template, its modes, and their cache."""

from mifit.morphable.builtin.head import builtin_model

__all__ = ["builtin_model"]
