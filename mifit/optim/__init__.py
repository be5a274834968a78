"""Nonlinear least squares by Levenberg and Marquardt's method, independent of faces and rendering."""

from mifit.optim.minimize import DenseSystem, Outcome, Solution, geman_mcclure, minimize

__all__ = ["DenseSystem", "Outcome", "Solution", "geman_mcclure", "minimize"]
