"""The record of a fit, and its folder. Nothing here renders."""

from mifit.result.record import METHODS, Method, Result

__all__ = ["METHODS", "Method", "Result"]
