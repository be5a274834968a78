"""Lips that touch where the images show a closed mouth.

Detectors place the points of the inner lips with a bias, and windows that span the mouth measure nothing between the
lips: a fit leaves a slit, through which the inside of the mouth shows. Where the fitted images show a closed mouth
(`lip_line`), both margins move onto the lip line.

What the closed timesteps have in common moves the neutral surface; what remains goes into their expressions, and the
expressions of the other timesteps undo the movement there, so that an open mouth stays as open as it was found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import edges, face_cross, vertex_normals
from mifit.core.mesh_update import cotangent_laplacian
from mifit.morphable.openings import closed_borders
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.geometry.displaced import moved_by, object_shapes
from mifit.stages.surface.lip_line import heights, read_strip, sample

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

INNER_LIPS = slice(60, 68)
"""iBUG points along the margins of the lips."""
NEAR_MM = 4.0
"""Distance of each of them from the margins at the most."""
COLUMNS = np.linspace(0.03, 0.97, 61)
"""Places along the mouth, from corner to corner, at which images are read."""
WIDEST_MM = 6.0
"""Opening above which a mouth is open without a look: no detector is that wrong."""
SMALLEST_PIXELS = 4.5
"""Opening up to which the lips stay: a lip line and lips that are a little apart look alike in so few pixels."""
REACH_MM, INSIDE_MM = 14.0, 4.0
"""Distance from the margins along the surface up to which it moves with them, on the lips and behind them."""
HELD_MM, STEPS = 8.0, 2
"""Wavelength above which the movement stays on the found surface, and steps in which it follows that one's normals."""
APART_MM = 0.04
"""Half of what is left between the lips."""
DEPTH_MM, HEIGHT_MM = 0.5, 0.15
"""Standard deviations of the line's depth about the middle between the margins, and of its height in an image."""
FORWARD_MM = 3.0
"""A column is seen where the point so far in front of it is."""
ELSEWHERE = 0.1
"""Weight of a vertex away from the margins against one on them where expressions are found."""
UP, FORWARD = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Margins:
    """Vertices along the margins of both lips, from corner to corner; the corners are in both."""

    upper: NDArray[np.int64]
    lower: NDArray[np.int64]

    @classmethod
    def of(cls, model: MorphableModel) -> Margins | None:
        """The border of the face area around the mouth, parted at its ends; None for a model without one."""
        marks = model.mean[model.landmarks[INNER_LIPS]]
        for loop in closed_borders(model.faces[model.face_mask]):
            points = model.mean[loop]
            off = np.linalg.norm(points[None] - marks[:, None], axis=2).min(axis=1) * model.unit_mm
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
class _Mouth:
    """The margins of one timestep in object space."""

    corners: NDArray[np.float64]
    upper: NDArray[np.float64]
    lower: NDArray[np.float64]

    @classmethod
    def of(cls, vertices: NDArray, margins: Margins) -> _Mouth:
        corners = vertices[margins.upper[[0, -1]]]
        at = [_at(vertices[way], _along(vertices[way], corners), COLUMNS) for way in (margins.upper, margins.lower)]
        return cls(corners, at[0], at[1])

    @property
    def middle(self) -> NDArray[np.float64]:
        return 0.5 * (self.upper + self.lower)


def _along(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Where points lie between the corners of the mouth, 0..1."""
    axis = corners[1] - corners[0]
    return np.clip((points - corners[0]) @ axis / (axis @ axis), 0.0, 1.0)


def _at(points: NDArray, along: NDArray, places: NDArray) -> NDArray[np.float64]:
    """Points of a line at places along the mouth."""
    order = np.argsort(along, kind="stable")
    return np.stack([np.interp(places, along[order], points[order, k]) for k in range(points.shape[1])], axis=1)


def close_lips(
    capture: Capture, model: MorphableModel, geometry: GeometryEstimate, cameras: Sequence[str]
) -> tuple[GeometryEstimate, dict]:
    """Close the mouth in the timesteps whose images show it closed.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Fit, with or without displacement.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.

    Returns
    -------
    geometry : GeometryEstimate
        With ``displacement``, ``expression`` and ``vertices`` changed where there was something to close; otherwise
        the input.
    details : dict
        ``closed`` and ``opening_mm``: timesteps seen closed, and the median opening of each timestep before.
    """
    margins = Margins.of(model)
    if margins is None:
        return geometry, {}
    shapes = object_shapes(model, geometry)
    mouths = [_Mouth.of(shape, margins) for shape in shapes]
    opening = [float(np.median((mouth.upper - mouth.lower) @ UP)) * model.unit_mm for mouth in mouths]
    scene = SurfaceScene(geometry.vertices[0].astype(np.float64), model.faces)
    lines: dict[int, NDArray[np.float64]] = {}
    pixel = np.inf
    for k, mouth in enumerate(mouths):
        if k:
            scene.update(geometry.vertices[k].astype(np.float64))
        line, length = _lip_line(capture, scene, geometry, k, mouth, cameras, opening[k], model.unit_mm)
        pixel = min(pixel, length)
        if line is not None:
            lines[k] = line
    timesteps = geometry.timesteps
    details = {
        "closed": [int(timesteps[k]) for k in lines],
        "opening_mm": dict(zip(map(str, timesteps), opening, strict=True)),
    }
    if not lines or np.mean([opening[k] for k in lines]) < SMALLEST_PIXELS * pixel:
        return geometry, details
    region = _Region.of(np.mean([shapes[k] for k in lines], axis=0), model, margins)
    wanted = {k: region.movement(shapes[k], mouths[k], line, APART_MM / model.unit_mm) for k, line in lines.items()}
    mean = np.mean(list(wanted.values()), axis=0)
    shared = region.fade(mean)
    expression = geometry.expression.copy()
    for k in range(len(timesteps)):
        rest = region.fade(wanted[k] - mean) if k in wanted else -shared
        expression[k] = region.adjusted(model, expression[k], rest)
    return moved_by(model, replace(geometry, expression=expression), shared), details


def _lip_line(
    capture: Capture,
    scene: SurfaceScene,
    geometry: GeometryEstimate,
    k: int,
    mouth: _Mouth,
    cameras: Sequence[str],
    opening_mm: float,
    unit_mm: float,
) -> tuple[NDArray[np.float64] | None, float]:
    """(C, 3) lip line in object space, None where the images don't show a closed mouth; and mm of a pixel there."""
    rotation, middle = geometry.rotation[k], mouth.middle
    height = heights(opening_mm) / unit_mm

    def world(points: NDArray) -> NDArray:
        return geometry.scale * points @ rotation.T + geometry.translation[k]

    column_mm = float(np.linalg.norm(np.diff(middle, axis=0), axis=1).mean()) * unit_mm
    points = world(middle[:, None] + height[None, :, None] * UP)
    front = world(middle + FORWARD_MM / unit_mm * FORWARD)
    votes, rows, pixel = [], [], np.inf
    for name in cameras:
        camera, frame = capture.camera(name), capture.frame(name, geometry.timesteps[k])
        pixels = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
        spacing = float(np.median(np.linalg.norm(np.diff(pixels, axis=1), axis=2)))
        pixel = min(pixel, (height[1] - height[0]) * unit_mm / max(spacing, 1e-9))
        if opening_mm > WIDEST_MM:
            continue
        x, y = pixels[..., 0], pixels[..., 1]
        inside = np.all((x > 1) & (x < camera.width - 1) & (y > 1) & (y < camera.height - 1), axis=1)
        seen = inside & scene.visible_from(front, camera.position)
        good = (frame.valid & ~frame.clipped).astype(np.float32)[..., None].repeat(3, axis=2)
        seen &= sample(good, np.where(inside[:, None, None], pixels, 1.0))[..., 0].mean(axis=1) > 0.5
        read = read_strip(sample(frame.image, pixels), seen, opening_mm, column_mm)
        if read.closed is None:
            continue
        votes.append(read.closed)
        # Depth moves what a view shows at a height: by how much, across the line.
        at, up, deep = (camera.project(world(middle + d * 0.1 / unit_mm)) for d in (0.0 * UP, UP, FORWARD))
        tangent = np.gradient(at, axis=0)
        across = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        rows.append((read.height, read.weight, ((deep - at) * across).sum(1) / ((up - at) * across).sum(1)))
    if not votes or 2 * sum(votes) <= len(votes):
        return None, pixel
    h, weight, slope = (np.stack(part) for part in zip(*rows, strict=True))
    precision = weight / weight.max() / HEIGHT_MM**2
    a, b, c = (precision.sum(0) + 1e-6, (precision * slope).sum(0), (precision * slope**2).sum(0) + DEPTH_MM**-2.0)
    p, q = (precision * h).sum(0), (precision * slope * h).sum(0)
    determinant = a * c - b**2
    up, deep = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    clear = np.flatnonzero(precision.sum(0) > 0)
    up, deep = (np.interp(np.arange(len(v)), clear, v[clear]) / unit_mm for v in (up, deep))
    return middle + up[:, None] * UP + deep[:, None] * FORWARD, pixel


@dataclass(frozen=True)
class _Region:
    """The part of the surface around the margins that moves with them.

    Attributes
    ----------
    vertices : (V, 3)
        Object space, with the lips apart.
    shown : (F', 3) int
        Faces of the face area.
    lips, inside : (n,) int
        Vertices within reach of the margins, in the face area and behind the lips.
    held : float
        `HELD_MM` in the model's units.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    shown: NDArray[np.int64]
    margins: Margins
    lips: NDArray[np.int64]
    inside: NDArray[np.int64]
    held: float

    @classmethod
    def of(cls, vertices: NDArray, model: MorphableModel, margins: Margins) -> _Region:
        links, count = edges(model.faces)
        length = np.linalg.norm(vertices[links[:, 0]] - vertices[links[:, 1]], axis=1) * model.unit_mm
        graph = sp.csr_matrix((length, (links[:, 0], links[:, 1])), (len(vertices),) * 2)
        margin = np.concatenate([margins.upper, margins.lower])
        distance = sp.csgraph.dijkstra(graph, directed=False, indices=margin, min_only=True, limit=REACH_MM)
        shown = model.faces[model.face_mask].astype(np.int64)
        in_face = np.zeros(len(vertices), bool)
        in_face[shown] = True
        lips = np.flatnonzero(in_face & (distance < REACH_MM))
        inside = np.setdiff1d(np.flatnonzero(~in_face & (distance < INSIDE_MM)), links[count == 1])
        return cls(vertices, model.faces.astype(np.int64), shown, margins, lips, inside, HELD_MM / model.unit_mm)

    def movement(self, shape: NDArray, mouth: _Mouth, line: NDArray, apart: float) -> NDArray[np.float64]:
        """(m, 3) what takes the margins, upper and then lower, onto a line (C, 3) along the mouth."""
        parts = []
        for way, sign in ((self.margins.upper, 1.0), (self.margins.lower, -1.0)):
            points = shape[way]
            place = _along(points, mouth.corners)
            target = _at(line, COLUMNS, place) + sign * apart * UP
            parts.append((target - points) * (0.0, 1.0, 1.0))
        movement = np.concatenate(parts)
        count = len(self.margins.upper)
        for first, second in ((0, count), (count - 1, -1)):  # both lips share the corners
            movement[[first, second]] = movement[[first, second]].mean(axis=0)
        return movement

    def fade(self, movement: NDArray) -> NDArray[np.float64]:
        """(V, 3) movement of the margins that fades into the lips with the least bending, along the surface found.

        Behind the margins the surface is spanned anew as a net of springs is. A net lies between what holds it, so
        that the sheets behind the lips, whose way from one to the other may narrow before it widens, don't cross.
        """
        margin = np.concatenate([self.margins.upper, self.margins.lower])
        free = np.setdiff1d(self.lips, margin)
        laplacian = cotangent_laplacian(self.vertices, self.shown)
        size = np.linalg.norm(face_cross(self.vertices, self.shown), axis=1) / 6.0
        area = np.bincount(self.shown.ravel(), np.repeat(size, 3), minlength=len(self.vertices))
        area = np.maximum(area, 1e-3 * max(float(np.median(area)), 1e-12))
        bending = (laplacian.T @ sp.diags(1.0 / area) @ laplacian).tocsr()[free]
        plate = sp.kron(bending[:, free], sp.identity(3), format="csc")
        out = np.zeros_like(self.vertices)
        for _ in range(STEPS):
            step = np.zeros_like(out)
            step[margin] = movement / STEPS
            normal = vertex_normals(self.vertices + out, self.shown)[free]
            rows = sp.csr_matrix(
                (normal.ravel(), np.arange(3 * len(free)), np.arange(0, 3 * len(free) + 1, 3)),
                shape=(len(free), 3 * len(free)),
            )
            held = rows.T @ sp.diags((2.0 * np.pi / self.held) ** 4 * area[free]) @ rows
            step[free] = spl.spsolve((plate + held).tocsc(), -(bending @ step).ravel()).reshape(-1, 3)
            out += step
        links, _ = edges(self.faces)
        length = np.linalg.norm(self.vertices[links[:, 0]] - self.vertices[links[:, 1]], axis=1)
        half = sp.coo_matrix((1.0 / np.maximum(length, 1e-9), (links[:, 0], links[:, 1])), (len(out),) * 2)
        tied = (half + half.T).tocsr()
        springs = (sp.diags(np.asarray(tied.sum(axis=1)).ravel()) - tied).tocsr()
        net, place = np.setdiff1d(self.inside, margin), self.vertices + out
        place[net] = 0.0
        if len(net):
            place[net] = spl.spsolve(springs[net][:, net].tocsc(), -(springs[net] @ place)).reshape(-1, 3)
        return place - self.vertices

    def adjusted(self, model: MorphableModel, expression: NDArray, movement: NDArray) -> NDArray[np.float64]:
        """Expression coefficients that move the surface by (V, 3) as well as they can."""
        rows = np.unique(model.faces[model.face_mask])
        weight = np.full(model.n_vertices, ELSEWHERE)
        weight[np.concatenate([self.margins.upper, self.margins.lower])] = 1.0
        scale = model.unit_mm * np.repeat(weight[rows], 3)
        basis = model.expression[rows].reshape(3 * len(rows), -1) * scale[:, None]
        wanted = movement[rows].ravel() * scale
        low, high = (model.expression_bounds.T - expression).astype(np.float64)
        system = basis.T.astype(np.float64) @ basis + 0.05 * np.eye(basis.shape[1])
        root = np.linalg.cholesky(system).T
        right = np.linalg.solve(root.T, basis.T @ wanted)
        return expression + lsq_linear(root, right, (np.minimum(low, -1e-9), np.maximum(high, 1e-9))).x
