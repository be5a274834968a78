"""What is assumed of albedos while the lighting is found, and the albedos that follow a lighting.

Light and albedo share a scale, which the mean diffuse albedo fixes. Bands of the light that only the specular lobe
shows share another with the specular albedo; so the specular albedo is expected relative to an unknown e, which is the
same for all texels. Texels that else are independent are tied by both: each is one row beside their blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.stages.reflectance.maps import TexelSystems

SPECULAR_SPREAD = 0.15
"""Standard deviation of the specular albedo over a face, relative to its median."""
BRIGHTEST = 1.5
"""Diffuse albedo at the most, while the lighting is found: the gauge may be off."""
ROUNDS = 3
"""Solutions at the most, each with those albedos held that the last one had beyond their bounds."""

Tie = tuple[NDArray[np.floating], NDArray[np.floating]]
"""Coefficients of diffuse (n, 3) and specular albedos (n,) in a row that ties texels together."""


def specular_pull(expected: float, sigma: float) -> float:
    """Weight that ties a texel's specular albedo to the expected one, beside squared residuals of deviation `sigma`."""
    return (sigma / (SPECULAR_SPREAD * max(expected, 1e-3))) ** 2


@dataclass(frozen=True)
class AlbedoPriors:
    """Squared penalties of the albedos x (n, 3) and y (n,) about those of a state, whose mean x stays as it is.

    The specular one is ``specular (y / e - 1)^2 e0^2``, linearised about the state. Differences from an e that is held
    would draw all y to zero, and make light brighter for it.

    Attributes
    ----------
    albedo : (n, 3)
        Diffuse albedo to expect.
    diffuse : (3,), specular : float
        Weights.
    expected : float
        e0, the specular albedo that is expected in the state.
    shape : (n,)
        The state's specular albedos, relative to e0.
    least, most : float
        Bounds of e.
    level : (n, 3), mean : float
        Weights of the mean diffuse albedo, and that mean.
    """

    albedo: NDArray[np.float32]
    diffuse: NDArray[np.float64]
    specular: float
    expected: float
    shape: NDArray[np.float64]
    least: float
    most: float
    level: NDArray[np.float64]
    mean: float

    @property
    def stiffness(self) -> float:
        """Weight of the squared change of e while albedos are held; a little more, as nothing else may show it."""
        return (1.0 + 1e-6) * self.specular * float(self.shape @ self.shape) + 1e-12

    def ties(self, free: bool = True) -> list[Tie]:
        """Rows of the mean that is held, and of e where it is free."""
        held: Tie = self.level, np.zeros(len(self.level))
        drawn: Tie = np.zeros_like(self.level), -self.specular * self.shape
        return [held, drawn] if free else [held]

    def wanted(self, expected: float) -> NDArray[np.float64]:
        """(n,) specular albedos that cost nothing where e is this."""
        return self.expected + self.shape * (expected - self.expected)

    def cost(self, diffuse: NDArray, specular: NDArray, expected: float) -> float:
        """Penalty of albedos (n, 3), (n,) and e."""
        off = specular - self.wanted(expected)
        return float((self.diffuse * (diffuse - self.albedo) ** 2).sum()) + self.specular * float((off**2).sum())

    def solve(self, texels: TexelSystems) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
        """Albedos (n, 3), (n,) within bounds, and e, that minimise the blocks and the penalties."""
        system = texels.with_priors((self.diffuse, self.specular), self.albedo, self.expected)
        ties = self.ties()
        known = self.expected * float(ties[1][1].sum())
        for left in range(ROUNDS)[::-1]:
            plain = system.inverse(system.dr, system.sr)
            moves, core = borders(system, ties, self.stiffness)
            side = np.array([self.mean, known]) - [row_sum(tie, plain) for tie in ties]
            more = float(np.clip(np.linalg.solve(core, side)[1] + self.expected, self.least, self.most)) - self.expected
            scale = (side[0] - core[0, 1] * more) / core[0, 0]
            x, y = (p - scale * a - more * b for p, a, b in zip(plain, *moves, strict=True))
            bounded = np.clip(x, 0.0, BRIGHTEST), np.clip(y, 0.0, 1.0)
            beyond = bounded[0] != x, bounded[1] != y
            if not left or not (beyond[0].any() or beyond[1].any()):
                break
            system = system.with_priors((1e6 * system.dd * beyond[0], 1e6 * system.ss * beyond[1]), *bounded)
        return bounded[0].astype(np.float32), bounded[1].astype(np.float32), self.expected + more


def row_sum(tie: Tie, albedos: Tie) -> float:
    """A row times albedos."""
    return float((tie[0] * albedos[0]).sum() + tie[1] @ albedos[1])


def borders(texels: TexelSystems, ties: Sequence[Tie], stiffness: float) -> tuple[list[Tie], NDArray[np.float64]]:
    """What the texels' inverse makes of the ties, and the ties' own system once the texels are eliminated."""
    moves = [texels.inverse(*tie) for tie in ties]
    core = -np.array([[row_sum(tie, move) for move in moves] for tie in ties])
    if len(ties) > 1:
        core[1, 1] += stiffness
    return moves, core
