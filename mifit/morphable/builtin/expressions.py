"""Expression modes of the built-in head: action units drawn as displacements of named points.

Each point's influence is a biharmonic function on the surface: one at the point, zero at all others and on the
back of the head, and cut at the slits of eyes and mouth, so that lids and lips move apart. Lids move along
spheres and are set directly.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from mifit.core.mesh import face_cross
from mifit.core.mesh_solve import cotangent_laplacian
from mifit.morphable.builtin import action_units, sculpt
from mifit.morphable.builtin.landmarks import PointFinder
from mifit.morphable.builtin.template import Template

ACTION_BOUND = 2.0
"""Full activation of an action unit, in standard deviations."""

_TMJ = np.array([0.0, -6.0, 6.0])  # axis of the jaw joints


def expression_modes(template: Template) -> tuple[NDArray[np.float32], tuple[str, ...], NDArray[np.float32]]:
    """Modes (V, 3, 77) in mm, premultiplied by their deviations, with their names and bounds (77, 2)."""
    influence, names = _influences(template)
    index = {n: k for k, n in enumerate(names)}
    v = template.vertices
    anchors = v[list(_anchor_vertices(template).values())]
    left = sculpt.smooth_step(v[:, 0], -9.0, 9.0)[:, None]
    modes: dict[str, NDArray] = {}
    bounds: dict[str, tuple[float, float]] = {}

    def displaced(motion: action_units.Motion) -> NDArray:
        d = np.zeros((len(names), 3))
        for point, vector in motion.items():
            for side in (1, -1):
                name = f"{point}{'+' if side > 0 else '-'}"
                if name in index:
                    d[index[name]] = np.asarray(vector) * (side, 1, 1)
            if point in index:
                d[index[point]] = vector
        return influence @ d

    for name, motion in action_units.PAIRED.items():
        field = displaced(motion)
        modes[f"{name}_L"], modes[f"{name}_R"] = field * left, field * (1 - left)
    for name, motion in action_units.CENTRAL.items():
        modes[name] = displaced(motion)
    for name in modes:
        bounds[name] = (0.0, ACTION_BOUND)

    share = np.array([action_units.JAW_SHARE.get(n.rstrip("+-"), 0.0) for n in names])
    (x, y, z), c, s = (anchors - _TMJ).T, np.cos(np.radians(17.0)), np.sin(np.radians(17.0))
    opened = np.stack([x, c * y - s * z, s * y + c * z], axis=1)  # about the x axis, front downwards
    modes["jawOpen"] = influence @ (share[:, None] * (opened + _TMJ - anchors))
    bounds["jawOpen"] = (0.0, ACTION_BOUND)
    modes["jawForward"] = influence @ (share[:, None] * np.array([0.0, 0.0, 5.0]))
    # lips that touch slide together
    upper = np.array([n.startswith(("up_", "in_up")) for n in names])
    modes["jawSideways"] = influence @ (np.where(upper, 0.75, share)[:, None] * np.array([5.0, 0.0, 0.0]))
    mouth = np.array([n.startswith(("up_", "in_", "low_", "corner", "beyond")) for n in names])
    modes["mouthSideways"] = influence @ (mouth[:, None] * np.array([5.0, 0.4, 0.0]))
    for name in ("jawForward", "jawSideways", "mouthSideways"):
        bounds[name] = (-ACTION_BOUND, ACTION_BOUND)

    for name, up, low in (("blink", 0.86, 0.12), ("squint", 0.2, 0.25), ("eyeWide", -0.22, -0.05)):
        field = _lid_motion(template, up, low)
        modes[f"{name}_L"], modes[f"{name}_R"] = field * left, field * (1 - left)
        bounds[f"{name}_L"] = bounds[f"{name}_R"] = (0.0, ACTION_BOUND)

    out = {n: m / ACTION_BOUND for n, m in modes.items()}
    for point, axis, parity in action_units.LOCALISED:
        name = f"local_{point}_{axis}{'' if parity == 1 else '_odd'}"
        lips = axis == "y" and point == "up_out"
        vector = (action_units.LOCAL_LIPS if lips else action_units.LOCAL) * np.eye(3)["xyz".index(axis)]
        d = np.zeros((len(names), 3))
        if point in index:
            d[index[point]] = vector
        else:
            sign = np.array([-1.0, 1.0, 1.0]) * (1 if parity == 1 else -1)
            d[index[point + "+"]], d[index[point + "-"]] = vector, vector * sign
        out[name] = influence @ d
        bounds[name] = (-3.0, 3.0)
    limits = np.array([bounds[n] for n in out], dtype=np.float32)
    return np.stack(list(out.values()), axis=2).astype(np.float32), tuple(out), limits


def _anchor_vertices(template: Template) -> dict[str, int]:
    """Vertex of each named point; paired points end in ``+`` (x > 0) or ``-``."""
    find = PointFinder(template)
    rows = {"eye": template.eye_row, "mouth": template.mouth_row}
    out: dict[str, int] = {}
    for name, place in action_units.POINTS.items():
        if isinstance(place[0], str):
            k = find.in_row(rows[place[0]] + place[1], place[2])
        else:
            k = find.at(*place)
        if template.symmetry[k] == k:
            out[name] = k
        else:
            out[name + "-"], out[name + "+"] = k, int(template.symmetry[k])
    return out


def _influences(template: Template) -> tuple[NDArray[np.float64], list[str]]:
    """(V, A) biharmonic influence of every named point, and the points' names."""
    anchors = _anchor_vertices(template)
    v = template.vertices
    faces = template.faces
    weights = cotangent_laplacian(v, faces, (-5.0, 50.0))
    area = np.zeros(len(v))
    np.add.at(area, faces.ravel(), np.repeat(np.linalg.norm(face_cross(v, faces), axis=1) / 6.0, 3))
    bilaplacian = (weights @ sp.diags(1.0 / np.maximum(area, 1e-6)) @ weights).tocsc()

    still = (v[:, 2] < 6.0) | (v[:, 1] > 66.0) | (v[:, 1] < -150.0)
    points = np.array(list(anchors.values()))
    fixed = still.copy()
    fixed[points] = True
    free = np.flatnonzero(~fixed)
    rhs = -bilaplacian[free][:, points].toarray()
    out = np.zeros((len(v), len(points)))
    out[free] = splu(bilaplacian[free][:, free].tocsc()).solve(rhs)
    out[points, np.arange(len(points))] = 1.0
    # the margins that are rolled inwards follow the visible rows beside them
    for margin, row in ((template.upper_lip, -1), (template.lower_lip, 1)):
        columns = np.searchsorted(template.grid[template.mouth_row], template.upper_lip)
        out[margin] = out[template.grid[template.mouth_row + row, columns]]
    return out, list(anchors)


def _lid_motion(template: Template, upper: float, lower: float) -> NDArray[np.float64]:
    """Displacement that moves both margins towards each other by shares of the aperture."""
    v = template.vertices
    grid, er = template.grid, template.eye_row
    half = grid.shape[1] // 2
    out = np.zeros_like(v)
    x = np.abs(v[:, 0])
    top, bottom = sculpt.lid_curves(x)
    skin_up, skin_down = np.zeros(len(v), dtype=bool), np.zeros(len(v), dtype=bool)
    front = slice(half - half // 2, half + half // 2 + 1)
    span = len(grid) // 8
    skin_up[grid[er - span : er + 1, front]] = True
    skin_down[grid[er + 1 : er + span, front]] = True
    skin_down[template.lower_lids] = True
    skin_up &= ~skin_down
    height = v[:, 1]
    for select, share, margin, reach in ((skin_up, -upper, top, 11.0), (skin_down, lower, bottom, 8.0)):
        away = np.clip(np.abs(height - margin) / reach, 0, 1)
        dy = share * (top - bottom)
        fade = (1 - away) ** 2 * (1 + 2 * away)
        out[:, 1] += np.where(select, dy * fade, 0.0)
        # stay on the eyeball
        r2 = (x - sculpt.EYE[0]) ** 2
        radius2 = np.maximum((v - sculpt.EYE * np.stack([np.sign(v[:, 0]), *np.ones((2, len(v)))], 1)) ** 2, 0).sum(1)
        new = np.sqrt(np.maximum(radius2 - r2 - (height + out[:, 1] - sculpt.EYE[1]) ** 2, 1.0)) + sculpt.EYE[2]
        near = (1 - sculpt.smooth_step(np.sqrt(radius2), 14.5, 18.0)) * fade
        out[:, 2] += np.where(select & (v[:, 2] > 60), near * (new - v[:, 2]), 0.0)
    return out
