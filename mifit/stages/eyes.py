"""Eyeballs behind their lids.

A morphable model has its eyeballs follow the lids only as well as its modes allow. Where a fit closes the lids or
widens the face, an eyeball may come through the skin beside them, and shows as a white crescent that no camera saw.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import face_cross, vertex_normals
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeballs

SEARCH_MM = 12.0
"""Depth of an eyeball outside the skin up to which it is found."""
GAP_MM = 0.5
"""Distance that is left between lid and eyeball."""
PASSES = 2
"""Vertices that have moved have other normals, along which a few more stand out."""


def behind_lids(model: MorphableModel, geometry: GeometryEstimate) -> GeometryEstimate:
    """The geometry with those parts of the eyeballs that stand out of the skin moved behind it.

    A vertex stands out where the way from it towards the eyeball's inside meets the skin's front. It moves along its
    normal; what shows between the lids stays.
    """
    eyes = eyeballs(model)
    if not eyes:
        return geometry
    unit = float(geometry.scale) / model.unit_mm  # of world length in a millimetre
    vertices = geometry.vertices.copy()
    for world in (world for world in vertices for _ in range(PASSES)):
        normals = vertex_normals(world, model.faces)
        for eye in eyes:
            points = world[eye].astype(np.float64)
            own = np.isin(model.faces[:, 0], eye)
            near = np.linalg.norm(world - points.mean(axis=0), axis=1) < np.ptp(points, axis=0).max()
            skin = model.faces[~own & near[model.faces].any(axis=1)]
            depth = _depth_outside(points, normals[eye], world.astype(np.float64), skin, SEARCH_MM * unit)
            # Its neighbours go with a vertex: an edge from one behind the skin to one at it may cut the skin.
            inner = np.searchsorted(eye, model.faces[own])
            deepest = depth.copy()
            np.maximum.at(deepest, inner, depth[inner].max(axis=1, keepdims=True))
            moved = np.where(deepest > 0, deepest + GAP_MM * unit, 0.0)
            world[eye] = (points - moved[:, None] * normals[eye]).astype(np.float32)
    return replace(geometry, vertices=vertices)


def _depth_outside(points: NDArray, normals: NDArray, vertices: NDArray, faces: NDArray, reach: float) -> NDArray:
    """(n,) distance from points along minus their normals to the deepest front of the faces within reach; 0: none."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    e1, e2, outward = b - a, c - a, face_cross(vertices, faces)
    depth = np.zeros(len(points))
    for i, (p, n) in enumerate(zip(points, normals, strict=True)):
        # Moeller and Trumbore (1997), for the ray from p along -n.
        h = np.cross(-n, e2)
        det = np.einsum("fk,fk->f", e1, h)
        s = p - a
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.einsum("fk,fk->f", s, h) / det
            q = np.cross(s, e1)
            v = q @ -n / det
            t = np.einsum("fk,fk->f", e2, q) / det
        front = outward @ n > 0
        hit = front & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < reach)
        if hit.any():
            depth[i] = t[hit].max()
    return depth
