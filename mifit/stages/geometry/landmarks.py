"""The landmark term: projected key vertices against detected points, and the fit by landmarks alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.mesh import face_cross
from mifit.morphable import MorphableModel
from mifit.optim import geman_mcclure
from mifit.optim.systems import System
from mifit.stages.geometry.normal import NormalEquations, prior_energy
from mifit.stages.geometry.parameters import Frames, Layout, Pose
from mifit.stages.geometry.points import PointBasis, geometry_columns, project

JAW = np.arange(17)  # iBUG-68: the face contour, which a detector draws where it sees the silhouette
SLIDE_LIMIT = 40.0  # pixels; a contour point farther than this from any silhouette vertex is dropped


@dataclass(frozen=True)
class LandmarkView:
    """Detected points of one image.

    Attributes
    ----------
    step : int
        Position of the timestep.
    camera : Camera
    index : (n,) int
        Which of the 68 landmarks.
    vertices : (n,) int
        Model vertex that each is compared with.
    pixels : (n, 2)
    weight : float
        Factor of the squared pixel distances.
    basis : PointBasis
        Of ``vertices``.
    """

    step: int
    camera: Camera
    index: NDArray
    vertices: NDArray
    pixels: NDArray
    weight: float
    basis: PointBasis


@dataclass(frozen=True)
class LandmarkTerm:
    """Sum over images of ``weight * sum rho(|pixel distance|^2)`` with Geman and McClure's rho.

    Attributes
    ----------
    views : tuple of LandmarkView
    scale : float
        Pixel distance at which a landmark counts as an outlier.
    """

    views: tuple[LandmarkView, ...]
    scale: float

    def energy(self, layout: Layout, frames: Frames, x: NDArray) -> float:
        """Value of the term."""
        total = 0.0
        for view in self.views:
            squared = (self.distances(view, layout, frames, x) ** 2).sum(1)
            total += view.weight * float(geman_mcclure(squared, self.scale)[0].sum())
        return total

    def distances(self, view: LandmarkView, layout: Layout, frames: Frames, x: NDArray) -> NDArray:
        """(n, 2) projected minus detected pixels."""
        points = view.basis.evaluate(x[layout.at("identity")], x[layout.at("expression", view.step)])
        pose = frames.pose(layout, x, view.step)
        return project(view.camera, pose, points, derivatives=False).pixels - view.pixels

    def accumulate(self, equations: NormalEquations, layout: Layout, frames: Frames, x: NDArray) -> None:
        """Add the linearised term to the normal equations."""
        for view in self.views:
            points = view.basis.evaluate(x[layout.at("identity")], x[layout.at("expression", view.step)])
            projection = project(view.camera, frames.pose(layout, x, view.step), points)
            distance = projection.pixels - view.pixels
            weight = view.weight * geman_mcclure((distance**2).sum(1), self.scale)[1]
            by_pixel = np.broadcast_to(np.eye(2), (len(points), 2, 2))
            shared, local = geometry_columns(layout, view.basis, projection, by_pixel)
            equations.add(view.step, shared, local, distance.reshape(-1), np.repeat(weight, 2))


@dataclass(frozen=True)
class LandmarkProblem:
    """Landmarks and prior only: no image is looked at."""

    layout: Layout
    frames: Frames
    term: LandmarkTerm
    priors: dict[str, float]

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        return {
            "landmarks": self.term.energy(self.layout, self.frames, x),
            "prior": prior_energy(self.layout, x, self.priors),
        }

    def linearize(self, x: NDArray) -> System:
        """Normal equations at x."""
        equations = NormalEquations(self.layout)
        self.term.accumulate(equations, self.layout, self.frames, x)
        equations.add_priors(x, self.priors)
        return equations.system()


def slide_contour(
    model: MorphableModel, views: tuple[LandmarkView, ...], vertices: NDArray, poses: list[Pose]
) -> tuple[LandmarkView, ...]:
    """Let jaw-line points whose model vertex faces away slide to the silhouette.

    A detector that calls a contour point visible while the model's own vertex is turned away has drawn it on the
    silhouette; it is then compared with the nearest silhouette vertex in the image.

    Parameters
    ----------
    vertices : (T, V, 3)
        Object-space vertices per timestep.
    poses : list of Pose
        Per timestep.
    """
    out = []
    for view in views:
        pose = poses[view.step]
        world = pose.apply(vertices[view.step].astype(np.float64))
        normal = face_cross(world, model.faces)
        centre = world[model.faces].mean(1)
        front = np.einsum("ij,ij->i", normal, view.camera.position - centre) > 0
        seen = np.bincount(model.faces[front].ravel(), minlength=len(world)) > 0
        around = np.bincount(model.faces[~front].ravel(), minlength=len(world)) > 0
        in_face = np.bincount(model.faces[model.face_mask].ravel(), minlength=len(world)) > 0
        contour = np.flatnonzero(seen & around & in_face)
        own = model.landmarks[view.index]
        turned_away = np.isin(view.index, JAW) & ~seen[own]
        chosen, keep = own.copy(), np.ones(len(own), dtype=bool)
        if turned_away.any() and len(contour):
            pixels = view.camera.project(world[contour])
            for k in np.flatnonzero(turned_away):
                distance = np.linalg.norm(pixels - view.pixels[k], axis=1)
                nearest = int(np.nanargmin(distance))
                chosen[k], keep[k] = contour[nearest], distance[nearest] < SLIDE_LIMIT
        if (chosen[keep] == view.vertices[keep]).all() and keep.all():
            out.append(view)
            continue
        out.append(
            replace(
                view,
                index=view.index[keep],
                vertices=chosen[keep],
                pixels=view.pixels[keep],
                basis=PointBasis.at_vertices(model, chosen[keep]),
            )
        )
    return tuple(out)
