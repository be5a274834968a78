"""Acceptances: judge a step by what it promised and what it brought, and size the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Acceptance(Protocol):
    """Decides on a step and on the size of the next."""

    @property
    def initial_size(self) -> float:
        """Size of the first step."""
        ...

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """Whether to take the step, and the next size.

        Parameters
        ----------
        predicted, actual : float
            Decrease of the energy by the linear model, and as evaluated (NaN when not finite).
        size : float
            Size the step was made with.
        rejections : int
            Steps rejected in a row before this one.
        """
        ...


@dataclass(frozen=True)
class TrustRatio:
    """Trust by the ratio of actual to predicted decrease.

    Nielsen's rule (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares problems", 2004): the damping
    1 / size shrinks smoothly with the ratio, at most by 3, and grows by 2, 4, 8, ... over successive rejections.
    """

    initial_size: float = 1e3
    minimum_ratio: float = 1e-4

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """See `Acceptance`."""
        ratio = actual / predicted if predicted > 0 else -1.0
        if ratio >= self.minimum_ratio:  # False for NaN
            return True, min(size / max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e12)
        return False, size / 2.0 ** (rejections + 1)


@dataclass(frozen=True)
class Backtracking:
    """Armijo's rule on the linear model's promise: halve until enough of it is kept; then start from full again."""

    initial_size: float = 1.0
    minimum_ratio: float = 1e-4

    def judge(self, predicted: float, actual: float, size: float, rejections: int) -> tuple[bool, float]:
        """See `Acceptance`."""
        if predicted > 0 and actual >= self.minimum_ratio * predicted:
            return True, min(2.0 * size, 1.0)
        return False, size / 2.0
