"""Eyeballs behind their lids.

A morphable model has its eyeballs follow the lids only as well as its modes allow. Where a fit closes the lids or
widens the face, an eyeball may come through the skin beside them, and shows as a white crescent that no camera saw.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import normalize
from mifit.core.process import blocks, on_all_cores
from mifit.morphable import MorphableModel
from mifit.morphable.openings import GAP_MM, RADIUS_MM, eyeballs, leading_faces


def behind_lids(model: MorphableModel, geometry: GeometryEstimate) -> GeometryEstimate:
    """The geometry with those parts of the eyeballs that stand out of the skin moved behind it.

    A vertex stands out where the way from it to the eyeball's middle meets the skin's front. It moves along that way;
    what shows between the lids stays.
    """
    eyes = eyeballs(model)
    if not eyes:
        return geometry
    # The tissue behind the lids that comes with added eyes is meant to lie behind the balls.
    lids = leading_faces(model, min(int(eye.min()) for eye in eyes))
    unit = float(geometry.scale) / model.unit_mm  # of world length in a millimetre
    vertices = geometry.vertices.copy()

    def place(world: NDArray[np.float32]) -> None:
        """Move one timestep's eyeballs, in place."""
        for eye in eyes:
            points = world[eye].astype(np.float64)
            outward = normalize(points - _middle(points))
            own = np.isin(model.faces[:, 0], eye)
            near = np.linalg.norm(world - points.mean(axis=0), axis=1) < np.ptp(points, axis=0).max()
            covering = ~own & near[model.faces].any(axis=1)
            skin = model.faces[covering if lids is None else covering & lids]
            depth = _depth_outside(points, outward, world.astype(np.float64), skin, RADIUS_MM * unit)
            # Its neighbours go with a vertex: an edge from one behind the skin to one at it may cut the skin.
            inner = np.searchsorted(eye, model.faces[own])
            deepest = depth.copy()
            np.maximum.at(deepest, inner, depth[inner].max(axis=1, keepdims=True))
            moved = np.where(deepest > 0, deepest + GAP_MM * unit, 0.0)
            world[eye] = (points - moved[:, None] * outward).astype(np.float32)

    on_all_cores(place, list(vertices))
    return replace(geometry, vertices=vertices)


def _middle(points: NDArray) -> NDArray[np.float64]:
    """(3,) middle of the sphere that points (n, 3) lie on, by least squares."""
    origin = points.mean(axis=0)
    local = points - origin
    rows = np.column_stack([2.0 * local, np.ones(len(local))])
    return np.asarray(origin + np.linalg.lstsq(rows, (local**2).sum(axis=1), rcond=None)[0][:3])


def _depth_outside(points: NDArray, normals: NDArray, vertices: NDArray, faces: NDArray, reach: float) -> NDArray:
    """(n,) distance from points against their unit directions to the deepest front of the faces within reach; 0: none.

    Moeller and Trumbore (1997) for rays from p along -n, its triple products taken apart into what belongs to the ray
    and what to the face: all rays against all faces are products of matrices.
    """
    centre = points.mean(axis=0)  # far from the origin the products would cancel
    points = points - centre
    a, b, c = (vertices[faces[:, i]] - centre for i in range(3))
    e1, e2 = b - a, c - a
    outward, across, along = np.cross(e1, e2), np.cross(e2, a), np.cross(a, e1)
    turned, height = np.cross(normals, points), (a * outward).sum(axis=1)
    depth = np.zeros(len(points))
    for rays in blocks(len(points), 8 * len(faces)):
        n, p, m = normals[rays], points[rays], turned[rays]
        det = n @ outward.T
        u, v = m @ e2.T + n @ across.T, n @ along.T - m @ e1.T
        t = p @ outward.T - height
        hit = (det > 0) & (u >= 0) & (v >= 0) & (u + v <= det) & (t > 0) & (t < reach * det)
        depth[rays] = np.divide(t, det, out=np.zeros_like(t), where=hit).max(axis=1, initial=0.0)
    return depth
