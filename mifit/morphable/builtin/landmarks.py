"""The 68 iBUG points on the built-in head, and named anchor points for its expressions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.morphable.builtin import sculpt
from mifit.morphable.builtin.template import Template
from mifit.morphable.topology import IBUG_MIRROR

_PLACES: dict[int, list[tuple[float, ...]]] = {
    0: [
        (70, 0, 15), (69.5, -17, 18), (67, -34, 22), (62, -52, 27), (55, -67, 33),
        (45, -82, 45), (31, -95, 62), (16, -104, 80), (0, -108.5, 86),
    ],
    17: [(54, 14), (46, 20.5), (36, 23.5), (24, 22.5), (13, 18.5)],
    27: [(0, 1), (0, -12), (0, -24), (0, -38)],
    31: [(13, -46), (7, -48.5), (0, -50)],
}  # fmt: skip
"""Jaw, brow, nose and nostrils on the side x > 0 in mm, by their first landmarks; mirrored for x < 0."""


class PointFinder:
    """Finds template vertices by position; always on the side x <= 0, the other side follows by symmetry."""

    def __init__(self, template: Template) -> None:
        self._t = template
        v = template.vertices
        self._half = template.grid.shape[1] // 2
        lids, lips = (template.upper_lids, template.lower_lids), (template.upper_lip, template.lower_lip)
        slits = np.concatenate([margin.ravel() for margin in (*lids, *lips)])  # which lie inside
        self._candidates = np.setdiff1d(np.flatnonzero(v[:, 0] <= 1e-9), slits)
        front = self._candidates[v[self._candidates, 2] > 20.0]
        self._front, self._tree_front = front, cKDTree(v[front, :2])
        self._tree = cKDTree(v[self._candidates])
        self._midline = template.grid[:, self._half]

    def at(self, *position: float) -> int:
        """Vertex nearest to (x, y) on the visible front, or to (x, y, z); x >= 0 means distance from the midline."""
        target = np.array(position, dtype=float) * ([-1, 1, 1][: len(position)])
        if position[0] == 0:
            line = self._midline
            visible = line[self._t.vertices[line, 2] > 20.0]
            v = self._t.vertices[visible]
            return int(visible[np.linalg.norm(v[:, 1 : len(position)] - target[1:], axis=1).argmin()])
        if len(position) == 2:
            return int(self._front[self._tree_front.query(target)[1]])
        return int(self._candidates[self._tree.query(target)[1]])

    def in_row(self, row: int, x: float) -> int:
        """Vertex of a grid row nearest to distance ``x`` from the midline, in front."""
        line = self._t.grid[row, self._half // 2 : self._half + 1]
        return int(line[np.abs(self._t.vertices[line, 0] + x).argmin()])


def landmark_vertices(template: Template) -> NDArray[np.int32]:
    """(68,) vertices of the iBUG points; the subject's right side (x < 0) is the image's left."""
    find = PointFinder(template)
    er, mr = template.eye_row, template.mouth_row
    canthi = sculpt.CANTHI
    right = {first + k: find.at(*p) for first, places in _PLACES.items() for k, p in enumerate(places)}
    right |= {36: find.in_row(er, canthi[1]), 39: find.in_row(er, canthi[0])}
    right |= {37: find.in_row(er - 1, 36.0), 38: find.in_row(er - 1, 27.0)}
    right |= {40: find.in_row(er + 1, 27.0), 41: find.in_row(er + 1, 36.0)}
    right[48] = find.in_row(mr, sculpt.MOUTH_HALF)
    for k, x in ((49, 14.0), (50, 5.5), (51, 0.0)):
        right[k] = find.at(x, float(sculpt.lip_borders(np.array(x))[0]))
    for k, x in ((57, 0.0), (58, 6.5), (59, 14.5)):
        right[k] = find.at(x, float(sculpt.lip_borders(np.array(x))[1]))
    right[60] = find.in_row(mr - 1, sculpt.MOUTH_HALF - 3.0)
    right |= {61: find.in_row(mr - 1, 9.0), 62: find.in_row(mr - 1, 0.0)}
    right |= {66: find.in_row(mr + 1, 0.0), 67: find.in_row(mr + 1, 9.0)}
    found = [right[k] if k in right else template.symmetry[right[int(IBUG_MIRROR[k])]] for k in range(68)]
    return np.array(found, dtype=np.int32)
