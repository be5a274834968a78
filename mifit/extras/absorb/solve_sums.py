"""Maps and normals from the sums of all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.core.uv import TexelMap
from mifit.extras.absorb.information import Information
from mifit.extras.absorb.normals import reduced, solve_offsets
from mifit.solve import Outcome
from mifit.stages.reflectance.lighting_equations import specular_pull
from mifit.stages.reflectance.maps import Smoothness, Splits, TexelSystems, solve_maps
from mifit.stages.reflectance.told import find_told

ROUNDS = 4
"""Of maps and normals in turn."""
IMAGES = 60.0
"""Independent images at the most: what further ones add is their poses, not weight against the maps' smoothness, as the
errors of normals and light are the same in all of them. Chosen by how well every second frame
predicts the others."""


@dataclass(frozen=True)
class Solved:
    """What all frames say.

    Attributes
    ----------
    maps : (S, S, 4) float32
        Diffuse and specular albedo.
    offsets : (N, 2)
        Corrections of the normals.
    sigma : float
        Standard deviation of the residuals, linear colour.
    outcome : Outcome
        Of the normals' last solve.
    told : (N,) float32
        Share of the images in the specular albedo (`told.find_told`).
    """

    maps: NDArray[np.float32]
    offsets: NDArray[np.float64]
    sigma: float
    outcome: Outcome
    told: NDArray[np.float32]


def solve_sums(
    information: Information,
    texels: TexelMap,
    facial: NDArray[np.bool_],
    neighbours: NDArray,
    prior: NDArray,
    smoothness: Smoothness,
    maps: NDArray,
    offsets: NDArray,
    images: int,
) -> Solved:
    """Find maps and normals in turn; in finding the normals, the albedos of a texel give way to them.

    Parameters
    ----------
    information : Information
    texels : TexelMap
    facial : (N,) bool
        Texels whose normals are to be found.
    neighbours : (N', 4)
        Of the facial ones.
    prior : (S, S, 4)
        Albedo of the model, and the specular albedo expected, as `solve_maps` takes it.
    smoothness : Smoothness
    maps : (S, S, 4), offsets : (N, 2)
        To start from.
    images : int
        How many were added.
    """
    rows, splits = np.flatnonzero(facial), Splits()
    share = min(1.0, IMAGES / max(images, 1))
    counted = 3.0 * max(float(information.weight.sum()), 1e-12)
    face = take(information, rows)
    noise, outcome, expected = 0.0, Outcome.MAX_ITERATIONS, float(prior[..., 3].max())
    for _ in range(ROUNDS):
        texel = maps.reshape(-1, 4)[texels.index].astype(np.float64)
        squares = information.residual(texel[:, :3], texel[:, 3], offsets)
        noise = float(squares.sum()) / counted
        system, right = reduced(face, texel[rows, :3], texel[rows, 3], max(noise, 1e-8))
        offsets = offsets.copy()
        offsets[rows], outcome = solve_offsets(system, right, neighbours, texels.size, offsets[rows])
        systems = TexelSystems(
            *(
                (share * part).astype(np.float32)
                for part in (
                    information.dd,
                    information.ds,
                    information.dr - np.einsum("nci,ni->nc", information.dx, offsets),
                    information.ss,
                    information.sr - (information.sx * offsets).sum(1),
                )
            )
        )
        pull = specular_pull(expected, float(np.sqrt(noise)))
        maps = solve_maps(systems, texels.index, prior, smoothness, maps, specular_pull=pull, splits=splits)
    sigma = float(np.sqrt(noise))
    errors = np.sqrt(squares / np.maximum(3.0 * information.weight, 1e-12))
    told = find_told(texels, systems, errors, information.weight, expected, sigma)
    return Solved(maps, offsets, sigma, outcome, told)


def take(information: Information, rows: NDArray) -> Information:
    """The sums of some of the texels."""
    return Information(*(getattr(information, name)[rows] for name in information.__dataclass_fields__))
