"""The template mesh of the built-in head: a grid around the head with slits for eyes and mouth.

Rows run from the crown to the neck, columns around the head from the nose's midline. Along the slits vertices
are double, so lids and lips can part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.builtin import sculpt

Slits = tuple[int, int, tuple[int, int, int]]
"""Rows of the slits of eyes and mouth, and columns of the inner and outer corners of an eye and of the mouth's."""


@dataclass(frozen=True)
class Template:
    """Vertices (V, 3) in mm with their place on the grid; faces and the rest as a `MorphableModel` has them.

    ``grid`` (R, N) has the vertex of each row and column; columns run from the back's midline through x < 0 to the
    front and on, and along slits it holds the upper vertices. ``upper_lids`` and ``lower_lids`` (2, K) are vertices on
    either side of the slits of the eyes at x < 0 and x > 0, corners left out, ``upper_lip`` and ``lower_lip`` (L,)
    those of the mouth, ``eye_row`` and ``mouth_row`` the rows of the slits.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    uv: NDArray[np.float32]
    faces_uv: NDArray[np.int32]
    symmetry: NDArray[np.int32]
    grid: NDArray[np.int32]
    upper_lids: NDArray[np.int32]
    lower_lids: NDArray[np.int32]
    upper_lip: NDArray[np.int32]
    lower_lip: NDArray[np.int32]
    eye_row: int
    mouth_row: int


def make_template(density: float, step: int = 1) -> Template:
    """Build the head with a part of the lines that are drawn; ``step`` 2 keeps every second row and column."""
    upper, lower, (eye_row, mouth_row, corners) = _half_surfaces(density)
    upper, lower = upper[::step, ::step], lower[::step, ::step]
    eye_row, mouth_row = eye_row // step, mouth_row // step
    inner, outer, corner = (c // step for c in corners)
    rows, half = upper.shape[0], upper.shape[1] - 1
    n = 2 * half

    # the grid: column k holds angle index |k - half|, column 0 is the back's midline
    index = np.abs(np.arange(n) - half)
    side = np.where(np.arange(n) < half, -1.0, 1.0)[:, None]
    side[[0, half]] = 1.0
    vertices = upper[:, index] * np.concatenate([side, np.ones((n, 2))], axis=1)
    vertices[:, [0, half], 0] = 0.0
    grid = np.arange(rows * n).reshape(rows, n)

    def mirrored(k: NDArray) -> NDArray:
        return (n - k) % n

    lid_columns = np.stack([half - np.arange(inner + 1, outer), half + np.arange(inner + 1, outer)])
    lip_columns = np.arange(half - corner + 1, half + corner)
    copies, copy_of = [], []
    below = grid.copy()  # what the faces under a slit use
    count = grid.size
    for row, columns in ((eye_row, lid_columns[0]), (eye_row, lid_columns[1]), (mouth_row, lip_columns)):
        below[row, columns] = count + np.arange(len(columns))
        points = lower[row, index[columns]] * np.concatenate([side[columns], np.ones((len(columns), 2))], axis=1)
        copies.append(points)
        copy_of.append(below[row, columns])
        count += len(columns)
    copies[2][:, 0][lip_columns == half] = 0.0

    symmetry = [grid[:, mirrored(np.arange(n))].ravel(), copy_of[1], copy_of[0], copy_of[2][::-1]]
    faces, faces_uv, uv = _grid_faces(grid, below)
    points = [vertices.reshape(-1, 3), *copies]

    # crown
    pole, top = count, grid[0]
    faces.append(np.stack([np.full(n, pole), top, np.roll(top, -1)], axis=1))
    faces_uv.append(np.stack([len(uv) + np.arange(n), np.arange(n), np.arange(1, n + 1)], axis=1))
    uv = np.concatenate([uv, np.stack([(np.arange(n) + 0.5) / n, np.full(n, 1.0)], axis=1)])
    points.append(np.array([[0.0, vertices[0, 0, 1] + 0.4, vertices[0, [0, half], 2].mean()]]))
    symmetry.append(np.array([pole]))

    return Template(
        vertices=np.concatenate(points),
        faces=np.concatenate(faces).astype(np.int32),
        uv=uv.astype(np.float32),
        faces_uv=np.concatenate(faces_uv).astype(np.int32),
        symmetry=np.concatenate(symmetry).astype(np.int32),
        grid=grid.astype(np.int32),
        upper_lids=grid[eye_row, lid_columns].astype(np.int32),
        upper_lip=grid[mouth_row, lip_columns].astype(np.int32),
        lower_lids=np.stack(copy_of[:2]).astype(np.int32),
        lower_lip=copy_of[2].astype(np.int32),
        eye_row=eye_row,
        mouth_row=mouth_row,
    )


def _half_surfaces(density: float) -> tuple[NDArray, NDArray, Slits]:
    """Points (rows, angles, 3) of the half at x >= 0, above and below the slits, and where the slits are."""
    rows, angles, eye_row, mouth_row = sculpt.grid_lines(density)
    slits = eye_row, mouth_row, sculpt.opening_columns(angles, rows, eye_row, mouth_row)
    angle, position = np.meshgrid(angles, rows)
    plain = sculpt.loft(angle, position)
    row = np.arange(len(rows))[:, None]
    out = []
    for above in (True, False):
        over_eye = row <= eye_row if above else row < eye_row
        over_mouth = row <= mouth_row if above else row < mouth_row
        warped = sculpt.loft(angle, _warp(plain, position, slits, over_eye, density))
        points = sculpt.lips(sculpt.lids(sculpt.features(warped), np.broadcast_to(over_eye, angle.shape)), over_mouth)
        out.append(sculpt.ears(_roll(points, slits, over_mouth, density)))
    return out[0], out[1], slits


def _warp(plain: NDArray, position: NDArray, slits: Slits, over: NDArray, density: float) -> NDArray:
    """Slide grid rows along the loft so that the slits lie on the lids' margins and on the mouth's line."""
    eye_row, mouth_row, (inner, outer, _) = slits
    x, y = plain[..., 0], plain[..., 1]
    columns = x.shape[1]
    front = np.arange(columns) < columns // 2
    upper, lower = sculpt.lid_curves(x[eye_row])
    beyond = np.maximum(x[eye_row, inner] - x[eye_row], x[eye_row] - x[eye_row, outer])
    fade = front * (1 - sculpt.smooth_step(beyond, 0.0, 14.0))
    height = np.where(over, upper, lower) - y[eye_row]
    y_new = y + fade * height * np.clip(1 - np.abs(y - y[eye_row]) / 18.0, 0, 1) ** 2
    fade = front * (1 - sculpt.smooth_step(x[mouth_row] - sculpt.MOUTH_HALF, 0.0, 14.0))
    height = sculpt.mouth_line(x[mouth_row]) - y[mouth_row]
    y_new += fade * height * np.clip(1 - np.abs(y - y[mouth_row]) / 22.0, 0, 1) ** 2
    out = position.copy()
    span = slice(eye_row - int(40 * density), mouth_row + int(24 * density))
    for k in np.flatnonzero(front):
        out[span, k] = np.interp(-y_new[span, k], -y[span, k], position[span, k])
    return out


def _roll(points: NDArray, slits: Slits, over_mouth: NDArray, density: float) -> NDArray:
    """Turn the margins of lids and lips inwards, which gives them thickness."""
    eye_row, mouth_row, (inner, outer, corner) = slits
    rows, columns = points.shape[:2]
    row, column = np.arange(rows)[:, None], np.arange(columns)
    at_eye = (column > inner) & (column < outer)
    at_mouth = column < corner
    out = points.copy()
    x = np.abs(points[..., 0])
    middle = np.sin(np.pi * np.clip((column - inner) / (outer - inner), 0, 1)) ** 0.5
    depth = np.interp(np.abs(row - eye_row) / density, (0, 1, 2), (2.2, 0.4, 0.0))
    out[..., 2] -= np.where(at_eye, depth * middle, 0.0)
    taper = np.clip(1 - (x / sculpt.MOUTH_HALF) ** 2, 0, 1) ** 0.5
    depth = np.interp(np.abs(row - mouth_row) / density, (0, 1, 2, 3), (6.0, 2.2, 0.5, 0.0))
    out[..., 2] -= np.where(at_mouth, depth * taper, 0.0)
    gap = np.where(at_mouth & (row == mouth_row), 0.15 * taper, 0.0)
    out[..., 1] += np.where(over_mouth, gap, -gap)
    return out


def _grid_faces(grid: NDArray, below: NDArray) -> tuple[list[NDArray], list[NDArray], NDArray]:
    """Faces of the skin grid, split mirror-symmetrically, with texture indices and texture vertices."""
    rows, n = grid.shape
    wrap = np.arange(n + 1) % n
    texture = np.arange(rows * (n + 1)).reshape(rows, n + 1)
    faces: list[NDArray] = []
    faces_uv: list[NDArray] = []
    for flip in (False, True):
        part = slice(n // 2, n + 1) if flip else slice(0, n // 2 + 1)
        top, bottom = below[:, wrap][:-1, part], grid[:, wrap][1:, part]
        tt, tb = texture[:-1, part], texture[1:, part]
        for store, (u, w) in ((faces, (top, bottom)), (faces_uv, (tt, tb))):
            a, b, c, d = (q.ravel() for q in (u[:, :-1], u[:, 1:], w[:, 1:], w[:, :-1]))
            if flip:
                store.append(np.concatenate([np.stack([a, d, b], axis=1), np.stack([d, c, b], axis=1)]))
            else:
                store.append(np.concatenate([np.stack([a, d, c], axis=1), np.stack([a, c, b], axis=1)]))
    v = 0.005 + 0.99 * (1 - np.arange(rows) / (rows - 1))
    u = np.arange(n + 1) / n
    return faces, faces_uv, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
