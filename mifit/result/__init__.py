"""The result of a fit, and its folder. What shows it is in `mifit.output`."""

from mifit.result.reconstruction import METHODS, Method, Reconstruction

__all__ = ["METHODS", "Method", "Reconstruction"]
