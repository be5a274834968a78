"""Shading of a surface with refined normals, by the same function that refined them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import ReflectanceEstimate
from mifit.render.refine import NormalView, material_shade


def shade_bent(
    normals: NDArray,
    base: NDArray,
    view: NDArray,
    diffuse: NDArray,
    specular: NDArray,
    reflectance: ReflectanceEstimate,
    traced: NDArray | None = None,
) -> NDArray[np.float32]:
    """Radiance (N, 3) of points, ambient included.

    Parameters
    ----------
    normals, base : (N, 3)
        Refined normals, and the mesh's, for which shadows were traced; unit, world axes.
    view : (N, 3)
        Unit directions towards the camera.
    diffuse : (N, 3), specular : (N,)
        Albedos, 0..1.
    reflectance : ReflectanceEstimate
        Lighting, ambient term, exponent and shading model; its maps aren't used.
    traced : (N, B*B), optional
        Shadowed diffuse transfer at the mesh's normals; ``shadowed`` needs it.
    """
    import drjit as dr
    import mitsuba as mi

    count = len(normals)
    if not count:
        return np.zeros((0, 3), np.float32)
    nothing = np.zeros(count, np.float32)
    points = NormalView(nothing, nothing, view, base, nothing)
    n, v = (mi.Vector3f(np.ascontiguousarray(x.T, dtype=np.float32)) for x in (normals, view))
    shade = material_shade(reflectance, diffuse, specular, [points], None if traced is None else [traced])
    colour = mi.Color3f(shade(n, v, 0))
    dr.eval(colour)
    return np.stack([np.array(c, dtype=np.float32) for c in (colour.x, colour.y, colour.z)], axis=1)
