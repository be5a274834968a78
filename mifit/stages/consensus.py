"""Colours of a face that all its images agree on, and the shading under which they do.

Every point of the face has one colour, whatever image shows it, times a shading that depends on its normal alone: both
are found robustly from all images together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.process import on_all_cores
from mifit.core.sh import basis
from mifit.stages.trust import DARKEST

if TYPE_CHECKING:
    from mifit.stages.observations import Surface

OPPONENT = np.array([[1 / 3, 1 / 3, 1 / 3], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]])
"""Logarithms of colour to brightness and two differences, which shading changes little."""
FLOOR = np.array([0.12, 0.03, 0.03])
"""Least standard deviations of the three: texture that a fitted mesh shifts, and shading beyond the normals'."""
ROUNDS = 6
SETTLING = 2
"""Rounds with a shading that is known."""
SAMPLES = 20_000
AGREEING = 20_000
"""Texels that tell the shading, and that are looked at at a time afterwards."""
SMOOTH = 1e-3
"""Weight of the shading's coefficients against running off where few normals are seen."""
COVERED = (0.9, 0.45)
"""Difference in brightness and in chroma (logarithms) from the face's skin that no plain skin has."""


@dataclass(frozen=True)
class Consensus:
    """Colours that the images agree on.

    Attributes
    ----------
    colour : (S, S, 3) float32
        `OPPONENT` logarithms without shading.
    known : (S, S) float32
        1 where some image measures the texel.
    shading : (9, 3) float64
        Of `core.sh.basis` of the world normal.
    deviation : (3,) float64
        Robust standard deviations of what an image shows.
    skin : (3,) float64
        Median colour of the face.
    """

    colour: NDArray[np.float32]
    known: NDArray[np.float32]
    shading: NDArray[np.float64]
    deviation: NDArray[np.float64]
    skin: NDArray[np.float64]


@dataclass(frozen=True)
class _Levels:
    """Texels (N,) in J images: `OPPONENT` logarithms (3, N, J), basis of the normals (9, N, T), weights (N, J)."""

    level: NDArray[np.float32]
    waves: NDArray[np.float32]
    weight: NDArray[np.float32]
    step: NDArray[np.int64]

    def agreed(self, shading: NDArray, share: NDArray) -> tuple[NDArray, NDArray]:
        """What the images agree on (3, N) under a shading, and how far each is from it."""
        flat = self.level - np.tensordot(shading.T.astype(np.float32), self.waves, 1)[..., self.step]
        trust = self.weight * share
        middle = np.stack([_median(channel, trust) for channel in flat])
        flat -= middle[..., None]
        return middle, flat


def _share(departure: NDArray, deviation: NDArray) -> NDArray[np.float32]:
    """(N, J) Cauchy's weights of departures (3, N, J) from what images agree on."""
    far = departure / deviation.astype(np.float32)[:, None, None]
    return np.asarray(1.0 / (1.0 + np.einsum("kij,kij->ij", far, far) / np.float32(3)))


def consensus(surface: Surface, seed: int = 0) -> Consensus:
    """What all images together say about the face's colours.

    Per texel the weighted median over the images of its colour without shading, in turns with the shading (second
    order, shared by all images) fitted to what remains, weighted by a Cauchy function.
    """
    texels, levels, weights, normals = [], [], [], []
    for part in surface.chunks():
        rows = part[surface.facial[part]]
        seen = surface.observe(rows)
        texels.append(rows)
        levels.append(np.log(np.maximum(seen.colour, DARKEST)) @ OPPONENT.T.astype(np.float32))
        weights.append(seen.measured)
        normals.append(basis(seen.normal.astype(np.float32), 3).astype(np.float32))
        step = seen.step
    # Channels first: medians and sums along three neighbours in memory are slow.
    level, waves = (np.ascontiguousarray(np.concatenate(parts).transpose(2, 0, 1)) for parts in (levels, normals))
    weight = np.concatenate(weights)
    shading, deviation = np.zeros((9, 3)), FLOOR
    some = slice(None, None, max(1, weight.shape[0] // AGREEING))
    few = _Levels(level[:, some], waves[:, some], weight[some], step)
    share = np.ones_like(few.weight)
    places, rng = np.argwhere(few.weight > 0), np.random.default_rng(seed)
    for _ in range(ROUNDS if len(places) else 0):
        centre, departure = few.agreed(shading, share)
        # What lies before the face in every image is neither shaded by the face's normals nor spread as skin is.
        bare = (few.weight > 0).any(axis=1)
        bare &= ~no_skin(centre.T, np.median(centre[:, bare], axis=1))
        apart = np.abs(departure[:, bare[:, None] & (few.weight > 0)])
        deviation = np.maximum(1.4826 * np.median(apart, axis=1).astype(np.float64), FLOOR)
        share = _share(departure, deviation)
        i, j = places[rng.choice(len(places), min(SAMPLES, len(places)), replace=False)].T
        scale = (bare[i] * share[i, j] * np.sqrt(few.weight[i, j])).astype(np.float64)
        rows = (few.waves[:, i, step[j]] * scale).T
        damping = SMOOTH * float(scale.sum()) * np.eye(9)
        shading = np.linalg.solve(
            rows.T @ rows + damping, rows.T @ ((few.level[:, i, j] - centre[:, i]) * scale).T.astype(np.float64)
        )
        shading[0] = 0.0  # a constant belongs to the colours

    def settled(rows: slice) -> NDArray:
        """What the images agree on at some of the texels, under the shading that is known now."""
        part = _Levels(level[:, rows], waves[:, rows], weight[rows], step)
        trust = np.ones_like(part.weight)
        for _ in range(SETTLING):
            middle, departure = part.agreed(shading, trust)
            trust = _share(departure, deviation)
        return middle

    every = [slice(at, at + AGREEING) for at in range(0, len(weight), AGREEING)]
    centre = np.concatenate([np.zeros((3, 0), np.float32), *on_all_cores(settled, every)], axis=1).T
    known = (weight > 0).any(axis=1)
    size = surface.texels.size
    colour, mask = np.zeros((size * size, 3), np.float32), np.zeros(size * size, np.float32)
    index = surface.texels.index[np.concatenate(texels)][known]
    colour[index], mask[index] = centre[known], 1.0
    skin = np.median(centre[known].astype(np.float64), axis=0) if known.any() else np.zeros(3)
    return Consensus(colour.reshape(size, size, 3), mask.reshape(size, size), shading, deviation, skin)


def no_skin(flat: NDArray, skin: NDArray) -> NDArray[np.bool_]:
    """Colours without shading, (..., 3) `OPPONENT` logarithms, that are far from those of the face's skin."""
    unlike = flat - skin
    return np.asarray((unlike[..., 0] < -COVERED[0]) | (np.hypot(unlike[..., 1], unlike[..., 2]) > COVERED[1]))


def agreed_colour(agreed: Consensus, uv: NDArray) -> tuple[NDArray, NDArray]:
    """How well texture coordinates (H, W, 2) are known, and the colour there."""
    size = len(agreed.known)
    x, y = (uv[..., 0] * size - 0.5).astype(np.float32), ((1.0 - uv[..., 1]) * size - 0.5).astype(np.float32)
    known = cv2.remap(agreed.known, x, y, cv2.INTER_LINEAR)
    colour = cv2.remap(agreed.colour, x, y, cv2.INTER_LINEAR)
    return known, (colour / np.maximum(known, 1e-3)[..., None]).astype(np.float32)


def _median(values: NDArray, weights: NDArray) -> NDArray:
    """(N,) weighted median of the rows of (N, J) values."""
    order = np.argsort(values, axis=1)
    total = np.cumsum(np.take_along_axis(weights, order, axis=1) + 1e-12, axis=1)
    middle = (total >= 0.5 * total[:, -1:]).argmax(axis=1)
    return np.asarray(np.take_along_axis(values, order, axis=1)[np.arange(len(values)), middle])
