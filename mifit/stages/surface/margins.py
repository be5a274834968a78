"""The margins of mouth and eyes, and the skin about them that moves with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from mifit.core.mesh import edges, vertex_normals
from mifit.morphable.topology import closed_borders
from mifit.stages.surface.displace import bending_energy

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel

NEAR_MM = 4.0
"""Distance of a landmark from the margins at the most, and of what lies behind these and moves with them."""
COLUMNS = np.linspace(0.03, 0.97, 61)
"""Places along an opening, from corner to corner, at which images are read."""
REACH_MM = 14.0
"""Distance from the margins along the surface up to which it moves with them."""
HELD_MM = 8.0
"""Wavelength above which the movement stays on the found surface."""
CLEAR_MM = 0.3
"""Height that the rims behind closed margins keep from these, each on its side; other pieces' vertices nearer than this
move with what they touch."""
ELSEWHERE = 0.1
"""Weight of a vertex away from the margins against one on them where expressions are found."""
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Margins:
    """Vertices along both margins of an opening, from corner to corner; the corners are in both."""

    upper: NDArray[np.int64]
    lower: NDArray[np.int64]

    @property
    def both(self) -> NDArray[np.int64]:
        """Vertices of the upper margin, and then of the lower one."""
        return np.concatenate([self.upper, self.lower])

    @classmethod
    def of(cls, model: MorphableModel, marks: slice) -> Margins | None:
        """The border of the face area along some landmarks, parted at its ends; None for a model without one."""
        around = model.mean[model.landmarks[marks]]
        for loop in closed_borders(model.faces[model.face_mask]):
            points = model.mean[loop]
            off = np.linalg.norm(points[None] - around[:, None], axis=2).min(axis=1) * model.unit_mm
            if off.max() > NEAR_MM:
                continue
            start = int(points[:, 0].argmin())
            loop = np.roll(loop, -start)
            end = int(model.mean[loop, 0].argmax())
            ways = loop[: end + 1], np.append(loop[end:], loop[0])[::-1]
            upper = int(np.argmax([model.mean[way, 1].mean() for way in ways]))
            return cls(ways[upper], ways[1 - upper]) if min(map(len, ways)) > 2 else None
        return None


@dataclass(frozen=True)
class Gap:
    """Both margins at one timestep, object space.

    Attributes
    ----------
    corners : (2, 3)
    upper, lower : (C, 3)
        Points of the margins at `COLUMNS`.
    """

    corners: NDArray[np.float64]
    upper: NDArray[np.float64]
    lower: NDArray[np.float64]

    @classmethod
    def of(cls, vertices: NDArray, margins: Margins) -> Gap:
        """Of vertices (V, 3) in object space."""
        corners = vertices[margins.upper[[0, -1]]]
        at = [_at(vertices[way], _along(vertices[way], corners), COLUMNS) for way in (margins.upper, margins.lower)]
        return cls(corners, at[0], at[1])

    @property
    def middle(self) -> NDArray[np.float64]:
        """(C, 3) points between the margins."""
        return 0.5 * (self.upper + self.lower)

    def height(self, unit_mm: float) -> float:
        """Median of the opening, mm."""
        return float(np.median((self.upper - self.lower) @ UP)) * unit_mm


def _along(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Where points lie between the corners of an opening, 0..1."""
    axis = corners[1] - corners[0]
    return np.clip((points - corners[0]) @ axis / (axis @ axis), 0.0, 1.0)


def _at(points: NDArray, along: NDArray, places: NDArray) -> NDArray[np.float64]:
    """Points of a line at places along an opening."""
    order = np.argsort(along, kind="stable")
    return np.stack([np.interp(places, along[order], points[order, k]) for k in range(points.shape[1])], axis=1)


@dataclass(frozen=True)
class Region:
    """The part of the surface around the margins that moves with them.

    Attributes
    ----------
    vertices : (V, 3)
        Object space, with the margins apart.
    model : MorphableModel
    skin, inside : (n,) int
        Vertices within reach of the margins, in the face area and behind it.
    ends : (n, 2) int
        Vertices where what lies behind the margins ends, each with the vertex of the margins that it moves with.
    touching : (n, 2) int
        Vertices of other pieces of the mesh that touch the margins or what lies behind, each with what it touches.
    """

    vertices: NDArray[np.float64]
    model: MorphableModel
    margins: Margins
    skin: NDArray[np.int64]
    inside: NDArray[np.int64]
    ends: NDArray[np.int64]
    touching: NDArray[np.int64]

    @classmethod
    def of(cls, vertices: NDArray, model: MorphableModel, margins: Margins) -> Region:
        """What lies within reach on a surface (V, 3), object space."""
        links, count = edges(model.faces)
        length = np.linalg.norm(vertices[links[:, 0]] - vertices[links[:, 1]], axis=1) * model.unit_mm
        graph = sp.csr_matrix((length, (links[:, 0], links[:, 1])), (len(vertices),) * 2)
        margin = margins.both
        distance = sp.csgraph.dijkstra(graph, directed=False, indices=margin, min_only=True, limit=REACH_MM)
        in_face = np.zeros(len(vertices), bool)
        in_face[model.faces[model.face_mask]] = True
        skin = np.flatnonzero(in_face & (distance < REACH_MM))
        behind = np.flatnonzero(~in_face & (distance < NEAR_MM))
        inside = np.setdiff1d(behind, links[count == 1])
        ends = np.setdiff1d(behind, inside)
        ends = np.stack([ends, margin[cKDTree(model.mean[margin]).query(model.mean[ends])[1]]], axis=1)
        near = np.union1d(margin, behind)
        away, nearest = cKDTree(model.mean[near]).query(model.mean)
        touching = np.flatnonzero((away < CLEAR_MM / model.unit_mm) & np.isinf(distance))
        touching = np.stack([touching, near[nearest[touching]]], axis=1)
        return cls(vertices, model, margins, skin, inside, ends, touching)

    def movement(self, shape: NDArray, gap: Gap, line: NDArray, apart: float) -> NDArray[np.float64]:
        """(m, 3) what takes the margins, upper and then lower, onto a line (C, 3) along the opening."""
        parts = []
        for way, sign in ((self.margins.upper, 1.0), (self.margins.lower, -1.0)):
            points = shape[way]
            place = _along(points, gap.corners)
            target = _at(line, COLUMNS, place) + sign * apart * UP
            parts.append((target - points) * (0.0, 1.0, 1.0))
        movement = np.concatenate(parts)
        count = len(self.margins.upper)
        for first, second in ((0, count), (count - 1, -1)):  # both margins share the corners
            movement[[first, second]] = movement[[first, second]].mean(axis=0)
        return movement

    def fade(self, moved: NDArray) -> NDArray[np.float64]:
        """(V, 3) movement of the margins (m, 3) that fades into the skin with least bending, along the surface found.

        Behind the margins the surface is spanned anew as a net of springs is. A net lies between what holds it, so
        that the sheets behind lips, whose way from one to the other may narrow before it widens, don't cross.
        """
        out = np.zeros_like(self.vertices)
        out[self.margins.both] = moved
        out[self._free] = self._bend(-(self._bending[0] @ out).ravel()).reshape(-1, 3)
        place = self.vertices + out
        place[self.ends[:, 0]] += out[self.ends[:, 1]] + self._out_of_the_way(out)
        net, springs, spanned = self._net
        place[net] = 0.0
        if len(net):
            place[net] = spanned(-(springs @ place)).reshape(-1, 3)
        movement = place - self.vertices
        movement[self.touching[:, 0]] = movement[self.touching[:, 1]]
        return movement

    def _out_of_the_way(self, moved: NDArray) -> NDArray[np.float64]:
        """(n, 3) further movement of the `ends`: where the margins meet, none of them reaches past.

        Rims of lids slant into the opening, and those of closed ones would cross.
        """
        before, after = (Gap.of(v, self.margins).height(1.0) for v in (self.vertices, self.vertices + moved))
        closed = float(np.clip(1.0 - after / before, 0.0, 1.0)) if before > 0 else 0.0
        sign = np.where(np.isin(self.ends[:, 1], self.margins.upper), 1.0, -1.0)
        apart = (self.vertices[self.ends[:, 0]] - self.vertices[self.ends[:, 1]]) @ UP
        past = np.maximum(CLEAR_MM / self.model.unit_mm - sign * apart, 0.0)
        return (closed * sign * past)[:, None] * UP

    @cached_property
    def _shown(self) -> NDArray[np.int64]:
        """(F', 3) faces of the face area."""
        return self.model.faces[self.model.face_mask].astype(np.int64)

    @cached_property
    def _free(self) -> NDArray[np.int64]:
        return np.setdiff1d(self.skin, self.margins.both)

    @cached_property
    def _bending(self) -> tuple[sp.csr_matrix, NDArray[np.float64]]:
        """Rows of the bending energy's matrix at the free vertices, and the area of each."""
        matrix, area = bending_energy(self.vertices, self._shown)
        return matrix.tocsr()[self._free], area[self._free]

    @cached_property
    def _bend(self) -> Callable[[NDArray], NDArray]:
        """Solver of the bending of the surface, held along its normals."""
        free, (bending, area) = self._free, self._bending
        normal = vertex_normals(self.vertices, self._shown)[free]
        rows = sp.csr_matrix(
            (normal.ravel(), np.arange(3 * len(free)), np.arange(0, 3 * len(free) + 1, 3)),
            shape=(len(free), 3 * len(free)),
        )
        held = rows.T @ sp.diags((2.0 * np.pi / (HELD_MM / self.model.unit_mm)) ** 4 * area) @ rows
        return spl.factorized((sp.kron(bending[:, free], sp.identity(3)) + held).tocsc())

    @cached_property
    def _net(self) -> tuple[NDArray[np.int64], sp.csr_matrix, Callable[[NDArray], NDArray]]:
        """Vertices of the net behind the margins, rows of its springs, and their solver."""
        net = np.setdiff1d(self.inside, self.margins.both)
        links, _ = edges(self.model.faces.astype(np.int64))
        length = np.linalg.norm(self.vertices[links[:, 0]] - self.vertices[links[:, 1]], axis=1)
        half = sp.coo_matrix((1.0 / np.maximum(length, 1e-9), (links[:, 0], links[:, 1])), (len(self.vertices),) * 2)
        tied = (half + half.T).tocsr()
        springs = (sp.diags(np.asarray(tied.sum(axis=1)).ravel()) - tied).tocsr()[net]
        return net, springs, spl.factorized(springs[:, net].tocsc()) if len(net) else np.copy

    def adjusted(self, expression: NDArray, movement: NDArray) -> NDArray[np.float64]:
        """Expression coefficients that move the surface by (V, 3) as well as they can."""
        model = self.model
        rows = np.unique(model.faces[model.face_mask])
        weight = np.full(model.n_vertices, ELSEWHERE)
        weight[self.margins.both] = 1.0
        scale = model.unit_mm * np.repeat(weight[rows], 3)
        basis = model.expression[rows].reshape(3 * len(rows), -1) * scale[:, None]
        wanted = movement[rows].ravel() * scale
        low, high = (model.expression_bounds.T - expression).astype(np.float64)
        system = basis.T.astype(np.float64) @ basis + 0.05 * np.eye(basis.shape[1])
        root = np.linalg.cholesky(system).T
        right = np.linalg.solve(root.T, basis.T @ wanted)
        return expression + lsq_linear(root, right, (np.minimum(low, -1e-9), np.maximum(high, 1e-9))).x
