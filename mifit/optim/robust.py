"""Robust penalties rho(r) and their weights w = rho'(r) / 2r for iteratively reweighted least squares.

Both equal r^2 to second order at zero, so a scale is the residual at which they begin to differ from least squares.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def geman_mcclure(squared: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Geman and McClure's penalty s^2 r^2 / (s^2 + r^2): bounded, so that a gross outlier has no pull.

    Returns
    -------
    rho, weight : arrays like ``squared``
        An infinite ``scale`` gives least squares.
    """
    if np.isinf(scale):
        return squared, np.ones_like(squared)
    q = scale * scale / (scale * scale + squared)
    return squared * q, q * q
