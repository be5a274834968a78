"""Nonlinear least squares: Gauss-Newton and Levenberg-Marquardt; knows nothing of faces or rendering.

A *problem* linearises itself into a *system* (normal equations with their structure); a *descent* turns a system
into a step; an *acceptance* judges the step and sets the size of the next one; `minimize` drives the three and
returns a `Solution` that says in an enumerated `Outcome` how it ended.
"""

from mifit.optim.minimize import Backtracking, GaussNewton, LevenbergMarquardt, Outcome, Solution, TrustRatio, minimize
from mifit.optim.robust import geman_mcclure, huber
from mifit.optim.systems import ArrowSystem, DenseSystem, RowSystem

__all__ = [
    "ArrowSystem",
    "Backtracking",
    "DenseSystem",
    "GaussNewton",
    "LevenbergMarquardt",
    "Outcome",
    "RowSystem",
    "Solution",
    "TrustRatio",
    "geman_mcclure",
    "huber",
    "minimize",
]
