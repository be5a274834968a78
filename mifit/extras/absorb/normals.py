"""Normals from the sums of many frames: albedos eliminated, neighbours tied together where the images say little."""

from __future__ import annotations

import numpy as np
import scipy.sparse.linalg as spl
from numpy.typing import NDArray

from mifit.extras.absorb.information import Information
from mifit.solve import Outcome

BEND = 0.10
"""Standard deviation of a correction, radians."""
ROUGH = 0.05
"""Standard deviation of the difference of neighbouring corrections at 512 texels a side, radians."""
ALBEDO_PLAY, SPECULAR_PLAY = 0.05, 0.01
"""Standard deviations of what one texel's albedos may still give way while its normal is found."""
INDEPENDENT = 0.01
"""Independent measurements per observation: errors of pose and light are shared by neighbours and frames."""
TOLERANCE = 1e-3
ITERATIONS = 300


def reduced(
    information: Information, diffuse: NDArray, specular: NDArray, noise: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Systems (N, 2, 2) and right-hand sides (N, 2) of the offsets with the albedos eliminated.

    ``diffuse`` (N, 3) and ``specular`` (N,) are what the albedos are near to, in units of the noise's variance.
    """
    n = len(specular)
    own, right = np.zeros((n, 4, 4)), np.empty((n, 4))
    channels = np.arange(3)
    own[:, channels, channels] = information.dd + noise / ALBEDO_PLAY**2
    own[:, channels, 3] = own[:, 3, channels] = information.ds
    own[:, 3, 3] = information.ss + noise / SPECULAR_PLAY**2
    right[:, :3] = information.dr + noise / ALBEDO_PLAY**2 * diffuse
    right[:, 3] = information.sr + noise / SPECULAR_PLAY**2 * specular
    cross = np.concatenate([information.dx, information.sx[:, None]], axis=1)  # (N, 4, 2)
    solved = np.linalg.solve(own, np.concatenate([cross, right[..., None]], axis=2))
    system = information.xx[:, [0, 1, 1, 2]].reshape(n, 2, 2) - np.einsum("nai,naj->nij", cross, solved[..., :2])
    return system / noise, (information.xr - np.einsum("nai,na->ni", cross, solved[..., 2])) / noise


def solve_offsets(
    system: NDArray, right: NDArray, neighbours: NDArray, size: int, start: NDArray
) -> tuple[NDArray[np.float64], Outcome]:
    """Offsets (N, 2) that minimise ``x A x - 2 b x`` with their own size and their differences held small.

    Parameters
    ----------
    system : (N, 2, 2), right : (N, 2)
        A and b in units of the noise's variance.
    neighbours : (N, 4)
        `core.bend.texel_neighbours`.
    size : int
        Texels along one side of the map: finer ones lie closer to each other.
    start : (N, 2)

    Returns
    -------
    offsets, and how conjugate gradients ended.
    """
    pull, tie = 1.0 / BEND**2, (size / 512.0) ** 2 / ROUGH**2
    blocks = INDEPENDENT * system + pull * np.eye(2)
    own = np.arange(len(right))
    degree = (neighbours != own[:, None]).sum(1)[:, None]
    inverse = np.linalg.inv(blocks + tie * degree[..., None] * np.eye(2))

    def apply(flat: NDArray) -> NDArray:
        x = flat.reshape(-1, 2)
        out = np.einsum("nij,nj->ni", blocks, x)
        for k in range(4):
            out += tie * (x - x[neighbours[:, k]])
        return out.ravel()

    def precondition(flat: NDArray) -> NDArray:
        return np.einsum("nij,nj->ni", inverse, flat.reshape(-1, 2)).ravel()

    n = right.size
    found, left = spl.cg(
        spl.LinearOperator((n, n), apply, dtype=np.float64),
        INDEPENDENT * right.ravel(),
        start.astype(np.float64).ravel(),
        rtol=TOLERANCE,
        maxiter=ITERATIONS,
        M=spl.LinearOperator((n, n), precondition, dtype=np.float64),
    )
    return found.reshape(-1, 2), Outcome.CONVERGED if left == 0 else Outcome.MAX_ITERATIONS
