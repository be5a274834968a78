"""Values that are known on part of a mesh, continued over the rest of it without a seam."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mifit.core.mesh_update import cotangent_laplacian

GROUND = 1e-8
"""Pull to zero, relative to the membrane's own stiffness: decides for pieces of which nothing is known."""


def membrane(
    vertices: NDArray,
    faces: NDArray,
    where: sp.spmatrix,
    values: NDArray,
    weight: NDArray,
    stiffness: float,
) -> NDArray[np.float64]:
    """Vertex values that fit known ones and otherwise are as flat as possible.

    Minimises ``sum_i weight_i |(where x)_i - values_i|^2 + stiffness * tr(x' L x)`` with the cotangent Laplacian L of
    the mesh: an elastic sheet over the surface, whatever the atlas. A piece of the mesh without known values gets 0.

    Parameters
    ----------
    vertices : (V, 3), faces : (F, 3)
        The mesh that says how far apart vertices are; only its shape counts, not its size.
    where : (N, V) sparse
        Interpolation from vertices to the points where values are known.
    values : (N, C), weight : (N,)
    stiffness : float
        Weight of the sheet: the values about a vertex are followed where their weights are well above it.

    Returns
    -------
    (V, C) float64
    """
    return factored_membrane(vertices, faces, where, weight, stiffness)(values)


def factored_membrane(
    vertices: NDArray, faces: NDArray, where: sp.spmatrix, weight: NDArray, stiffness: float
) -> Callable[[NDArray], NDArray[np.float64]]:
    """`membrane` as a function of the values alone: nearly all of its time goes into what doesn't depend on them."""
    weighted = where.T @ sp.diags(np.asarray(weight, dtype=np.float64))
    flat = cotangent_laplacian(np.asarray(vertices, dtype=np.float64), faces)
    floor = GROUND * float(flat.diagonal().max())
    system = weighted @ where + stiffness * (flat + floor * sp.identity(len(vertices)))
    factor = splu(sp.csc_matrix(system))
    return lambda values: factor.solve(np.asarray(weighted @ values, dtype=np.float64))
