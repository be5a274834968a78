"""Nonlinear least squares by Levenberg and Marquardt's method, independent of faces and rendering.

A *problem* linearises itself into a *system* (normal equations with their structure); `minimize` takes damped steps and
returns a `Solution` that says in an enumerated `Outcome` how it ended.
"""

from mifit.optim.minimize import Outcome, Solution, minimize
from mifit.optim.robust import geman_mcclure
from mifit.optim.systems import ArrowSystem, DenseSystem

__all__ = ["ArrowSystem", "DenseSystem", "Outcome", "Solution", "geman_mcclure", "minimize"]
