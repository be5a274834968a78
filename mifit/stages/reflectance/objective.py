"""The paper's objective, term by term, for any lighting and maps: the judge of every solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import form_image
from mifit.config import ReflectanceConfig
from mifit.stages.observations import Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.maps import laplacian


def energies(
    surface: Surface,
    forward: Forward,
    light: NDArray,
    ambient: float,
    maps: NDArray,
    albedo: NDArray,
    config: ReflectanceConfig,
) -> dict[str, float]:
    """Data, specular difference and smoothness terms (paper, section 5), weighted by their lambdas.

    Every measured pixel has the weight of its area, clipped ones have none, nothing is robust.

    Parameters
    ----------
    surface : Surface
    forward : Forward
    light : (K, 3)
        The lighting unknowns.
    ambient : float
    maps : (S, S, 4)
        Diffuse and specular albedo.
    albedo : (N, 3)
        Diffuse albedo of the model, from which the offset is counted.
    config : ReflectanceConfig
        Its lambdas.
    """
    values = maps.reshape(-1, 4)[surface.texels.index]
    data = difference = 0.0
    for chunk in surface.chunks():
        seen = surface.observe(chunk)
        diffuse_light, specular_light = forward.shade(seen, light)
        weight = seen.measured[..., None]
        x, y = values[chunk, None, :3], values[chunk, 3, None, None]
        data += float(
            (weight * (seen.colour - form_image(np.float32(ambient), x, diffuse_light, y, specular_light)) ** 2).sum()
        )
        for a, b in surface.pairs:
            both = np.minimum(weight[:, a], weight[:, b])
            shown = y[:, 0] * (specular_light[:, a] - specular_light[:, b])
            difference += float((both * (seen.colour[:, a] - seen.colour[:, b] - shown) ** 2).sum())
    offset = maps.copy()
    offset[..., :3] -= surface.texels.to_map(albedo.astype(maps.dtype))
    mask = surface.texels.mask
    rough = np.abs(laplacian(offset))[mask].sum(0)
    smooth = config.smoothness_weight * (rough[:3].sum() + config.specular_smoothness * rough[3])
    return {
        "data": data,
        "difference": config.specular_difference_weight * difference,
        "smoothness": float(smooth),
    }
