"""Simple eyes and the inside of the mouth for models that have holes there.

Many head models are skin alone: renders of them look through the eyes. Here each eye gets the front of a ball of an
eye's size, which lies on the rims of the lids and moves with the corners of the eye, and the mouth gets a dark
sheet from lip to lip where the teeth are. Both have a place in the maps, so that photographs show iris, sclera and
teeth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mifit.core.mesh import face_cross
from mifit.errors import InputError
from mifit.morphable.model import VERSION, MorphableModel
from mifit.morphable.topology import EYES_AND_MOUTH, adjacency, closed_borders

RADIUS_MM = 12.0
"""Of an eyeball; people differ by less than a millimetre."""
GAP_MM = 0.3
"""Between the rims of the lids and the ball."""
FRONT = np.radians(85.0)
"""Part of the ball from the optical axis on: the rest is never seen."""
RINGS, SEGMENTS = 18, 36
IRIS, PUPIL = np.radians(28.5), np.radians(10.5)
SCLERA_ALBEDO, IRIS_ALBEDO, PUPIL_ALBEDO = (0.62, 0.58, 0.54), (0.09, 0.055, 0.03), (0.01, 0.01, 0.01)
MOUTH_ALBEDO = (0.12, 0.03, 0.025)
TEETH_MM, MOUTH_LINES = 2.0, 8
"""Distance of the sheet between the lips behind their rims, about that of front teeth, and its lines from either lip to
the middle. Farther back photographs from two sides would paint the teeth at two places, in the shade of the lips."""
BEHIND_MM = 0.01
"""Distance of the rims of sheet and corners behind those of lips and lids."""
STRIP = 0.09
"""Height of the strip at the bottom of the maps that holds eyes and mouth; what was there moves up."""
MARGIN = 0.004
SMALLEST = 50
"""Vertices of an eyeball at the least: more than those of a rim, each of which the tissue in the corners meets."""
SUFFIX = "+eyes"
"""After a model's file: with these pieces."""


@dataclass(frozen=True)
class _Piece:
    """Vertices (n, 3) with the rows that their modes are means of, faces, texture coordinates, albedo."""

    points: NDArray[np.float64]
    identity: sp.csr_matrix
    expression: sp.csr_matrix
    faces: NDArray[np.int64]
    uv: NDArray[np.float64]
    albedo: NDArray[np.float64]
    mirror: NDArray[np.int64]  # of a vertex in the piece that mirrors this one


def eyeballs(model: MorphableModel) -> list[NDArray[np.int64]]:
    """Vertices (n,) of each eyeball: pieces of the mesh that are joined to nothing else and lie at an eye."""
    piece = sp.csgraph.connected_components(adjacency(model.faces, model.n_vertices), directed=False)[1]
    sizes = np.bincount(piece)
    low, high = (np.full((len(sizes), 3), sign * np.inf) for sign in (1.0, -1.0))
    np.minimum.at(low, piece, model.mean)
    np.maximum.at(high, piece, model.mean)
    balls = sizes >= SMALLEST
    balls[sizes.argmax()] = False  # the skin
    balls &= np.isin(np.arange(len(sizes)), piece[model.faces[~model.face_mask].ravel()])
    found = []
    for eye in EYES_AND_MOUTH[:2]:
        around = model.mean[model.landmarks[eye]]
        centre, reach = around.mean(axis=0), np.ptp(around[:, 0])
        near = np.linalg.norm(0.5 * (low + high) - centre, axis=1) < reach
        small = high[:, 0] - low[:, 0] < 2.5 * reach
        found += [np.flatnonzero(piece == k) for k in np.flatnonzero(balls & near & small)]
    return found


def lacks_eyes(model: MorphableModel) -> bool:
    """Whether both eyes are holes, without an eyeball behind."""
    return not eyeballs(model) and len(openings(model)[0]) == 2


def with_eyes(model: MorphableModel) -> MorphableModel:
    """The model with eyeballs in the holes of its eyes and a sheet in that of its mouth.

    New vertices come after the old ones, whose order, shape and modes stay; texture coordinates move up by a strip.
    `MorphableModel.load` makes the same of ``"FILE+eyes"``, which is the ``source`` of the model returned. InputError
    where the model has no hole at an eye.
    """
    eyes, mouth = openings(model) if not eyeballs(model) else ([], None)
    if len(eyes) < 2:
        raise InputError(f"{model.name}: found {len(eyes)} eyes that are holes, expected 2; it has eyes, or is no skin")
    pieces = _pieces(model, eyes, mouth)
    own, sizes = model.n_vertices, [len(piece.points) for piece in pieces]
    starts = own + np.cumsum([0, *sizes])
    placed = list(zip(pieces, starts, strict=False))
    mirror = [piece.mirror + starts[(1, 0, 3, 2, 4)[k]] for k, piece in enumerate(pieces)]
    faces = np.concatenate([piece.faces + start for piece, start in placed])
    modes = model.albedo_modes
    uv = model.uv.astype(np.float64) * (1.0, 1.0 - STRIP) + (0.0, STRIP)
    found = replace(
        model,
        name=f"{model.name} with eyes",
        mean=np.concatenate([model.mean, *(piece.points for piece in pieces)]),
        identity=np.concatenate([model.identity, *(_carried(piece.identity, model.identity) for piece in pieces)]),
        expression=np.concatenate(
            [model.expression, *(_carried(piece.expression, model.expression) for piece in pieces)]
        ),
        faces=np.concatenate([model.faces, faces]),
        faces_uv=np.concatenate([model.faces_uv, faces - own + len(uv)]),
        uv=np.concatenate([uv, *(piece.uv for piece in pieces)]),
        mean_albedo=np.concatenate([model.mean_albedo, *(piece.albedo for piece in pieces)]),
        albedo_modes=np.concatenate([modes, np.zeros((sum(sizes), *modes.shape[1:]), modes.dtype)]),
        face_mask=np.concatenate([model.face_mask, np.zeros(len(faces), bool)]),
        symmetry=None if model.symmetry is None else np.concatenate([model.symmetry, *mirror]),
        # The ball's centre is searched for, whose last digit differs between machines.
        fingerprint=f"{model.digest}-eyes{VERSION}",
    )
    if model.source:
        found._set("_source", model.source + SUFFIX)
    return found


@lru_cache(maxsize=2)  # stages ask for those of the same model
def skin_weights(model: MorphableModel) -> sp.csr_matrix | None:
    """(V, V') weighted means of the first V' vertices that all vertices move with; None for a model that got no eyes.

    The first rows are the identity: pieces that were added go along with the skin and hold none of it back.
    """
    balls = eyeballs(model)
    count = min((int(ball.min()) for ball in balls), default=0)
    own = leading_faces(model, count)
    if len(balls) != 2 or own is None:
        return None
    kept = {name: getattr(model, name)[:count] for name in ("mean", "identity", "expression", "mean_albedo")}
    kept |= {name: getattr(model, name)[own] for name in ("faces", "faces_uv", "face_mask")}
    symmetry = None if model.symmetry is None else model.symmetry[:count]
    skin = replace(model, **kept, albedo_modes=model.albedo_modes[:count], symmetry=symmetry, fingerprint="")
    eyes, mouth = openings(skin)
    pieces = _pieces(skin, eyes, mouth) if len(eyes) == 2 else []
    added = np.concatenate([np.zeros((0, 3)), *(piece.points for piece in pieces)])
    rest = model.mean[count:]
    if len(added) != len(rest) or np.abs(added - rest).max(initial=0.0) * model.unit_mm > 0.01:
        return None  # eyes of the model's own
    return sp.vstack([sp.identity(count), *(piece.identity for piece in pieces)]).tocsr()


def _pieces(model: MorphableModel, eyes: Sequence[NDArray], mouth: NDArray | None) -> list[_Piece]:
    """Eyeballs, corners and the mouth's sheet for the borders of openings, with their places in the strip."""
    width = STRIP - 2 * MARGIN
    pieces = [_eyeball(model, loop, k, np.array([MARGIN + k * STRIP, MARGIN]), width) for k, loop in enumerate(eyes)]
    pieces += [_corner(model, loop, np.array([0.7 + k * STRIP, MARGIN]), width) for k, loop in enumerate(eyes)]
    if mouth is not None:
        pieces.append(_mouth(model, mouth, np.array([2 * STRIP + MARGIN, MARGIN]), np.array([0.5, width])))
    return pieces


def skin_faces(model: MorphableModel) -> NDArray[np.bool_]:
    """(F,) faces of the model's own skin, without eyes and what else was added to it."""
    weights = skin_weights(model)
    own = None if weights is None else leading_faces(model, weights.shape[1])
    return np.ones(len(model.faces), bool) if own is None else own


def leading_faces(model: MorphableModel, count: int) -> NDArray[np.bool_] | None:
    """(F,) faces of the first ``count`` vertices, where those are the model or what it was before it got eyes.

    None where some face joins them to later vertices, where the face area goes on beyond them, or where there are
    fewer vertices.
    """
    later = model.faces >= count
    whole, cut = later.all(axis=1), later.any(axis=1)
    if count > model.n_vertices or (whole != cut).any() or (whole & model.face_mask).any():
        return None
    return np.logical_not(whole)


def openings(model: MorphableModel) -> tuple[list[NDArray[np.int64]], NDArray[np.int64] | None]:
    """Borders around the eyes, at x < 0 and x > 0, and around the mouth."""
    marks = model.mean[model.landmarks].astype(np.float64)
    borders = [loop for loop in closed_borders(model.faces) if len(loop) >= 8]  # vertices around an eye or the mouth

    def at(part: range) -> NDArray[np.int64] | None:
        centre, extent = marks[part].mean(axis=0), float(np.ptp(marks[part][:, 0]))
        for loop in borders:
            points = model.mean[loop]
            near = float(np.linalg.norm(points.mean(axis=0) - centre)) < 0.6 * extent
            if near and float(np.ptp(points[:, 0])) < 2.0 * extent:
                return loop
        return None

    eyes = [loop for part in EYES_AND_MOUTH[:2] if (loop := at(part)) is not None]
    return eyes, at(EYES_AND_MOUTH[2])


def _eyeball(model: MorphableModel, loop: NDArray, which: int, corner: NDArray, width: float) -> _Piece:
    unit = 1.0 / model.unit_mm
    radius, rim = RADIUS_MM * unit, model.mean[loop].astype(np.float64)
    start = rim.mean(axis=0) - (0.0, 0.0, 0.9 * radius)
    centre = least_squares(
        lambda c: np.linalg.norm(rim - c, axis=1) - radius - GAP_MM * unit, start, loss="soft_l1", f_scale=0.5 * unit
    ).x
    angle = np.linspace(0.0, FRONT, RINGS + 1)[1:, None]
    around = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)[None]
    across = np.cos(around) * (1 - 2 * which)  # the second eye is numbered as the first in a mirror
    flat = np.stack([angle * across, angle * np.sin(around)], axis=-1).reshape(-1, 2) / FRONT
    ring = np.stack(np.broadcast_arrays(np.sin(angle) * across, np.sin(angle) * np.sin(around), np.cos(angle)), axis=-1)
    points = centre + radius * np.concatenate([[[0.0, 0.0, 1.0]], ring.reshape(-1, 3)])
    uv = corner + 0.5 * width * (1.0 + np.concatenate([[[0.0, 0.0]], flat]))
    angles = np.concatenate([[0.0], np.broadcast_to(angle, (RINGS, SEGMENTS)).ravel()])[:, None]
    albedo = np.where(angles < PUPIL, PUPIL_ALBEDO, np.where(angles < IRIS, IRIS_ALBEDO, SCLERA_ALBEDO))
    first, turn = np.arange(SEGMENTS) + 1, np.roll(np.arange(SEGMENTS), -1) + 1
    faces = [np.stack([np.zeros_like(first), first, turn], axis=1)]
    for k in range(RINGS - 1):
        a, b = first + k * SEGMENTS, turn + k * SEGMENTS
        faces += [np.stack([a, a + SEGMENTS, b + SEGMENTS], axis=1), np.stack([a, b + SEGMENTS, b], axis=1)]
    found = _facing(points, np.concatenate(faces), points - centre)
    corners = model.landmarks[list(((36, 39), (45, 42))[which])]  # from the outer to the inner one
    return _Piece(
        points, _means(loop, len(points), model.n_vertices), _means(corners, len(points), model.n_vertices),
        found, uv, albedo, np.arange(len(points)),
    )  # fmt: skip


def _corner(model: MorphableModel, loop: NDArray, corner: NDArray, width: float) -> _Piece:
    """A funnel from the lids' rims into the ball, of fewer vertices than a ball has (`SMALLEST`)."""
    outer = int(np.argmax(np.abs(model.mean[loop, 0])))
    rim = np.roll(loop, -outer)
    if model.mean[rim[len(rim) // 4], 1] < model.mean[rim[0], 1]:  # over the upper lid first, on both sides
        rim = np.roll(rim[::-1], 1)
    rim = rim[np.round(np.linspace(0, len(rim), min(len(rim), SMALLEST - 2), endpoint=False)).astype(int)]
    n, unit = len(rim), 1.0 / model.unit_mm
    points = model.mean[rim].astype(np.float64) - (0.0, 0.0, BEHIND_MM * unit)
    tip = points.mean(axis=0) - (0.0, 0.0, RADIUS_MM * unit)
    points = np.concatenate([points, [tip]])
    own = sp.csr_matrix((np.ones(n), (np.arange(n), rim)), (n, model.n_vertices))
    rows = sp.vstack([own, _means(loop, 1, model.n_vertices)]).tocsr()
    around = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    disc = np.concatenate([np.stack([np.cos(around), np.sin(around)], axis=1), [[0.0, 0.0]]])
    first = np.arange(n)
    faces = np.stack([first, np.roll(first, -1), np.full(n, n)], axis=1)
    forward = np.tile([0.0, 0.0, 1.0], (n + 1, 1))
    uv, albedo = corner + 0.5 * width * (1.0 + disc), np.tile((0.4, 0.17, 0.14), (n + 1, 1))
    return _Piece(points, rows, rows, _facing(points, faces, forward), uv, albedo, np.arange(n + 1))


def _mouth(model: MorphableModel, loop: NDArray, corner: NDArray, extent: NDArray) -> _Piece:
    """A sheet between the lips, in lines that run from each of them to the middle between both."""
    symmetry = np.arange(model.n_vertices) if model.symmetry is None else model.symmetry
    loop = np.roll(loop, -int(np.argmax(symmetry[loop] == loop)))
    rim = np.append(loop, loop[0])  # its texture has two ends, which mirror each other
    n, unit = len(rim), 1.0 / model.unit_mm
    depth = np.linspace(0.0, 1.0, MOUTH_LINES)
    own = sp.csr_matrix((np.ones(n), (np.arange(n), rim)), (n, model.n_vertices))
    across = _other_lip(model.mean[loop])
    other = sp.csr_matrix(np.append(across, across[:1], axis=0)) @ own[:-1]
    rows = sp.kron((1.0 - 0.5 * depth)[:, None], own) + sp.kron((0.5 * depth)[:, None], other)
    rows = sp.vstack([rows, 0.5 * (own[:1] + other[:1])]).tocsr()
    back = BEHIND_MM + (TEETH_MM - BEHIND_MM) * np.append(np.repeat(depth, n), 1.0)
    lines = rows @ model.mean.astype(np.float64) - [0.0, 0.0, unit] * back[:, None]
    place = np.stack(np.broadcast_arrays(np.arange(n)[None] / (n - 1), 0.9 * depth[:, None]), axis=-1).reshape(-1, 2)
    uv = corner + extent * np.concatenate([place, [[0.5, 1.0]]])
    first = np.arange(n - 1)
    last = (MOUTH_LINES - 1) * n + first
    # The sheet goes on from the skin, whose edges run along the loop: so it faces outward however closed the lips are.
    faces = [np.stack([last + 1, last, 0 * first + len(lines) - 1], axis=1)]
    for k in range(MOUTH_LINES - 1):
        a, b = first + k * n, first + k * n + 1
        faces += [np.stack([a, a + n, b + n], axis=1), np.stack([a, b + n, b], axis=1)]
    place_of = {int(vertex): i for i, vertex in enumerate(loop)}
    mirror = np.array([place_of.get(int(symmetry[vertex]), i) for i, vertex in enumerate(rim)])
    mirror[[0, -1]] = n - 1, 0
    mirror = np.append((np.arange(MOUTH_LINES)[:, None] * n + mirror).ravel(), len(lines) - 1)
    albedo = np.tile(MOUTH_ALBEDO, (len(lines), 1))
    found = np.concatenate(faces)
    found = found[(face_cross(lines, found) ** 2).sum(axis=1) > 0]  # lips that mirror each other meet in the middle
    return _Piece(lines, rows, rows, found, uv, albedo, mirror)


def _other_lip(rim: NDArray) -> NDArray[np.float64]:
    """(n, n) weights of the vertices of a closed rim (n, 3) that lie opposite each of them, on the other lip."""
    left, right = sorted((int(np.argmin(rim[:, 0])), int(np.argmax(rim[:, 0]))))
    lips = np.arange(left, right + 1), np.append(np.arange(right, len(rim)), np.arange(left + 1))
    weights = np.zeros((len(rim), len(rim)))
    for one, two in (lips, lips[::-1]):
        two = two[np.argsort(rim[two, 0])]
        for column, vertex in zip(np.eye(len(two)), two, strict=True):
            weights[one, vertex] = np.interp(rim[one, 0], rim[two, 0], column)
    return weights


def _carried(rows: sp.csr_matrix, modes: NDArray) -> NDArray:
    """Modes (n, 3, K) of vertices that move with weighted means (n, V) of others."""
    return np.asarray(rows @ modes.reshape(len(modes), -1)).reshape(-1, 3, modes.shape[2])


def _means(rows: NDArray, count: int, total: int) -> sp.csr_matrix:
    """(count, total) matrix whose every row is the mean over some rows."""
    line = sp.csr_matrix((np.full(len(rows), 1.0 / len(rows)), (np.zeros(len(rows), int), rows)), (1, total))
    return sp.vstack([line] * count).tocsr()


def _facing(points: NDArray, faces: NDArray, outward: NDArray) -> NDArray[np.int64]:
    """The faces turned so that their fronts look along ``outward`` (n, 3) at their first corners."""
    away = np.einsum("fk,fk->f", face_cross(points, faces), outward[faces[:, 0]]) < 0
    return np.where(away[:, None], faces[:, ::-1], faces)
