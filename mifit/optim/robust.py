"""Robust penalties rho(r) and their weights w = rho'(r) / 2r for iteratively reweighted least squares.

Both equal r^2 to second order at zero, so a scale is the residual at which they begin to differ from least squares.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def huber(squared: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Huber's penalty of squared residuals: quadratic up to ``scale``, then linear.

    Returns
    -------
    rho, weight : arrays like ``squared``
    """
    r = np.sqrt(squared)
    beyond = r > scale
    rho = np.where(beyond, 2.0 * scale * r - scale * scale, squared)
    return rho, np.where(beyond, scale / np.where(beyond, r, 1.0), 1.0)


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
