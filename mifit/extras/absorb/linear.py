"""The image of texels and its derivative by their normals, for one view (Dr.Jit's forward mode)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import aligned, on_device, stored
from mifit.stages.normals.chart import bent_normal


def linear_shading(
    shade: Callable[[Any, Any], tuple[Any, Any]],
    normals: NDArray,
    tangents: NDArray,
    offsets: NDArray,
    view: NDArray,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Diffuse and specular radiance at unit albedo of bent normals, and their derivatives by the offsets.

    Parameters
    ----------
    shade : callable
        `Appearance.shader` about the base normals.
    normals : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents, world space.
    offsets : (N, 2)
        Of `core.bend`.
    view : (N, 3)
        Unit directions towards the camera.

    Returns
    -------
    diffuse, specular : (N, 3)
    diffuse_slope, specular_slope : (N, 3, 2)
    """
    import drjit as dr
    import mitsuba as mi

    count = len(normals)
    if not count:
        return (np.zeros((0, 3), np.float32),) * 2 + (np.zeros((0, 3, 2), np.float32),) * 2
    frame = tuple(on_device(mi.Vector3f, v) for v in (normals, tangents[:, 0], tangents[:, 1]))
    v = on_device(mi.Vector3f, view)
    columns: list[Any] = []
    for i in range(2):
        x = [mi.Float(aligned(offsets[:, k])) for k in range(2)]
        dr.enable_grad(x[i])
        d, s = (mi.Color3f(part) for part in shade(bent_normal(frame, *x), v))  # type: ignore[arg-type]
        dr.set_grad(x[i], 1.0)
        dr.enqueue(dr.ADMode.Forward, x[i])
        dr.traverse(dr.ADMode.Forward)
        if not i:
            columns += [*dr.detach(d), *dr.detach(s)]
        columns += [*dr.grad(d), *dr.grad(s)]
    both = stored(columns, count)
    first, second = both[:, 6:12], both[:, 12:18]
    return (
        both[:, :3],
        both[:, 3:6],
        np.stack([first[:, :3], second[:, :3]], axis=2),
        np.stack([first[:, 3:], second[:, 3:]], axis=2),
    )
