"""Meshes that were drawn lately, with their shadows."""

from __future__ import annotations

import hashlib
from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.occlusion import OccludingMesh
from mifit.render.gbuffer import SurfaceScene

KEPT_MESHES = 8
"""Meshes whose shadows are remembered: the timesteps of a result whose views are drawn one after the other."""
_kept: OrderedDict[bytes, OccludingMesh] = OrderedDict()


def occluding_mesh(vertices: NDArray, faces: NDArray) -> OccludingMesh:
    """A mesh to send rays at and its traced shadows; the same one for equal arrays, as long as it is among the last.

    Reports, evaluations and turning lights draw the same few meshes again and again, and their shadows cost
    more than all else in a picture.
    """
    import mitsuba as mi

    # A fit holds its vertices in double precision, its result in single: the same mesh, whose shadows are traced once.
    vertices = np.asarray(vertices, dtype=np.float64)
    digest = hashlib.blake2b((mi.variant() or "").encode())
    for array in (vertices, faces):
        digest.update(f"{array.shape}{array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    key = digest.digest()
    mesh = _kept.pop(key, None) or OccludingMesh(SurfaceScene(np.array(vertices), np.array(faces)))
    _kept[key] = mesh
    while len(_kept) > KEPT_MESHES:
        _kept.popitem(last=False)
    return mesh
