"""Descents: from a linearisation and a step size to a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.solve.systems import System


class Descent(Protocol):
    """``descent(system, size, frozen, gradient)`` gives a step.

    ``size`` shrinks after rejections; ``gradient`` replaces the system's own when parameters are moved by hand.
    ``regularizes`` tells whether a smaller size can make a step of a system that is singular.
    """

    regularizes: ClassVar[bool]

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose a step."""
        ...


@dataclass(frozen=True)
class GaussNewton:
    """The minimiser of the linear model, shortened by ``size`` (1 = the full step)."""

    regularizes: ClassVar[bool] = False

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose ``size`` times the Gauss-Newton step."""
        return min(size, 1.0) * system.solve(0.0, frozen, gradient)


@dataclass(frozen=True)
class LevenbergMarquardt:
    """The minimiser of the linear model plus ``1 / size`` times Marquardt's diagonal."""

    regularizes: ClassVar[bool] = True

    def __call__(
        self, system: System, size: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None
    ) -> NDArray[np.float64]:
        """Propose the step damped by ``1 / size``."""
        return system.solve(1.0 / size, frozen, gradient)
