"""Stage 1c: the surface that explains shading and highlights, once the light is roughly known.

Matches between views leave bumps of some tenths of a millimetre, a centimetre wide, on skin without texture and where
highlights move over it. Their normals are off by degrees, which shading shows and highlights show even more. The
surface moves by h along its normals:

    min_h  sum_texels min_{x,y} sum_j w rho(I_j(h) - x D_j(n(h)) - y S_j(n(h))) + h' Q h

with the images I_j read where the moved surface is seen, diffuse and specular radiance D and S at unit albedo, normals
``n(h)``, and albedos x, y that follow exactly at every step, as they do while the lighting is found (variable
projection, `reflectance.lighting`). Albedos that are held would keep what wrong normals had put into them. ``Q`` is the
precision of a Gaussian field with Matern's covariance about what the views' matches found (Lindgren et al. 2011).

Light that is modelled a little wrong, such as a lamp near by, leaves residuals that vary slowly over a face and would
bend the surface. So each image's residuals lose their mean over a window of some millimetres (`LIGHT_MM`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import cv2
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
from numpy.typing import NDArray

from mifit.appearance.formation import BentImage, form_image
from mifit.config import ReflectanceConfig
from mifit.core.calls import checked
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import face_cross, interpolate, normalize, vertex_normals
from mifit.core.mesh_solve import cotangent_laplacian, interior_vertices
from mifit.core.metrics import INDEPENDENT, median_deviation
from mifit.core.process import on_all_cores, one_blas_thread
from mifit.core.uv import tangent_plane
from mifit.errors import ConvergenceError
from mifit.progress import Progress, silent
from mifit.sampling.observations import Observations, Surface
from mifit.stages.find_surface import NARROWEST, neighbours
from mifit.stages.geometry.points import corner_matrix
from mifit.stages.reflectance.albedo_priors import BRIGHTEST, specular_pull
from mifit.stages.reflectance.als import MAP_PASSES, expected_albedo, find_forward, lighting_of_subset
from mifit.stages.reflectance.forward import Forward, surface_points
from mifit.stages.reflectance.lighting import CAUCHY, MISFIT, LightingSolution, noise_weight
from mifit.stages.reflectance.maps import TexelSystems
from mifit.stages.surface.displace import MOST_ITERATIONS, RELATIVE, bending_energy, symmetric_factor
from mifit.stages.surface.views import Resolution, texture_size

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

LARGEST_MAP = 256
"""Texels along the side of the map at most; they are as large as two pixels, or larger."""
DEVIATION, DEVIATION_MM, RANGE_MM = 0.5, 0.3, 20.0
"""Standard deviation of what matches leave, in pixels of parallax, and its limit; the distance over which it is alike.
From 0.3 to 0.6 mm and from 20 to 40 mm little changes on the scan of scan_city under two suns; in images of the demo's
size 0.8 mm leave creases."""
LIGHT_MM = 10.0
"""Standard deviation of the Gaussian window over which the mean of the residuals is taken out. Chosen on Emily c3,c4,
scan_city, and its scan under two suns; 5 to 15 mm are alike."""
ROUNDS, ITERATIONS = 2, 3
"""Lightings, and Gauss-Newton steps under each. Chosen on the scan of scan_city under two suns and in two rooms."""
LINEAR_MM = 0.2
"""Height over which images are taken for linear: they are differentiated over it, and no step is larger."""


@checked
@one_blas_thread()
def refine_surface(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: ReflectanceConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> GeometryEstimate:
    """The surface whose shading and highlights the images show.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Where to start, as `find_surface` leaves it; the result stays within some tenths of a millimetre.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : ReflectanceConfig, optional
        How the light is found.
    seed : int
        Chooses the texels that determine the lighting.
    progress : Progress

    Returns
    -------
    GeometryEstimate
        With another ``displacement`` of the face area, the vertices that follow, and ``lights``. With one view, views
        from nearly one place, or without robust weights, ``geometry`` as it is.
    """
    began = time.perf_counter()
    config = config or ReflectanceConfig()
    views, centre = [capture.camera(name) for name in cameras], geometry.vertices[0].mean(axis=0, dtype=np.float64)
    pairs = neighbours(views, centre)
    resolution = Resolution.of(views, centre, pairs) if pairs else None
    if resolution is None or resolution.parallax < NARROWEST or not config.robust:
        return geometry
    deviation = DEVIATION * resolution.pixel / (resolution.parallax * geometry.scale)
    deviation = min(deviation, DEVIATION_MM / model.unit_mm)
    field, start = Field.of(model, geometry, deviation), geometry
    progress("refine surface", 0, ROUNDS)
    size = texture_size(model, geometry.vertices[0].astype(np.float64), 2.0 * resolution.pixel, LARGEST_MAP)
    surface = Surface(capture, model, geometry, cameras, size)
    albedo = expected_albedo(model, surface.texels, geometry)
    forward, first = find_forward(surface, albedo, config, seed)
    height, moved, noise = np.zeros(len(field.free)), 0.0, None if first is None else first.sigma
    for number in range(ROUNDS):
        if number:
            progress("refine surface", number, ROUNDS)
            surface = Surface(capture, model, geometry, cameras, size, texels=surface.texels)
            forward = replace(forward, meshes=surface.meshes)
        found, _ = lighting_of_subset(surface, forward, albedo, config, seed, noise)
        height, moved = _settle(Patch.of(surface, forward, found, model.unit_mm), field, height)
        geometry = field.moved(start, height)
    progress("refine surface", ROUNDS, ROUNDS)
    seconds = time.perf_counter() - began
    phase = {
        "name": "shading",
        "moved_mm": float(np.sqrt(np.mean(height**2))) * field.millimetres,
        "moved_last_mm": moved * field.millimetres,
        "seconds": seconds,
    }
    lights = forward.appearance.illumination.lights if forward.model.needs_shadows else None
    return replace(geometry, lights=lights, report=geometry.report.after(seconds, phase))


@dataclass(frozen=True)
class Field:
    """Heights of the face's vertices along its normals, in object space.

    Attributes
    ----------
    free : (n,) int
        The vertices inside the face area.
    normal : (V, 3)
        Directions in which vertices move; 0 for those that stay.
    slope : three of (V, n) sparse
        Change of the vertices' normals by heights, a component each.
    precision : (n, n) sparse
        Q of the heights.
    millimetres : float
        Per unit of the model.
    """

    free: NDArray[np.intp]
    normal: NDArray[np.float64]
    slope: tuple[sp.csr_matrix, ...]
    precision: sp.csr_matrix
    millimetres: float

    @classmethod
    def of(cls, model: MorphableModel, geometry: GeometryEstimate, deviation: float) -> Field:
        """About the mean surface of a geometry's timesteps; ``deviation`` of the heights in units of the model."""
        shapes = [model.shape(geometry.identity, e).astype(np.float64) for e in geometry.expression]
        rest = np.mean(shapes, axis=0) + (0.0 if geometry.displacement is None else geometry.displacement)
        faces, count = model.faces, len(rest)
        free = np.flatnonzero(interior_vertices(faces, model.face_mask, count))
        cross = face_cross(rest, faces)
        double = np.maximum(np.linalg.norm(cross, axis=1), 1e-12)
        corners = rest[faces]
        # The gradient of a height over a face, averaged over the faces about a vertex, tilts its normal.
        rows, columns = np.repeat(np.arange(len(faces)), 3), faces.ravel()
        opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
        gradient = np.cross(cross[:, None], opposite) / (double**2)[:, None, None]
        share = sp.csr_matrix((np.repeat(double, 3), (columns, rows)), shape=(count, len(faces)))
        share = sp.diags(1.0 / np.maximum(np.asarray(share.sum(1)).ravel(), 1e-12)) @ share
        slope = tuple(
            (-share @ sp.csr_matrix((gradient[..., k].ravel(), (rows, columns)), shape=(len(faces), count)))[:, free]
            for k in range(3)
        )
        # (kappa^2 - Laplacian)^2 / (4 pi kappa^2 sigma^2): smoothness 1.
        kappa = np.sqrt(8.0) * model.unit_mm / RANGE_MM
        bending, area = bending_energy(rest, faces)
        precision = bending + 2.0 * kappa**2 * cotangent_laplacian(rest, faces) + kappa**4 * sp.diags(area)
        precision = precision.tocsr() / (4.0 * np.pi * (kappa * deviation) ** 2)
        normal = np.zeros_like(rest)
        normal[free] = vertex_normals(rest, faces)[free]
        return cls(free, normal, slope, precision[free][:, free], model.unit_mm)

    def displacement(self, height: NDArray) -> NDArray[np.float64]:
        """(V, 3) movement of the vertices by heights (n,)."""
        moved = np.zeros_like(self.normal)
        moved[self.free] = height[:, None] * self.normal[self.free]
        return moved

    def moved(self, geometry: GeometryEstimate, height: NDArray) -> GeometryEstimate:
        """A geometry whose surface has moved by heights (n,)."""
        by = self.displacement(height)
        world = geometry.scale * by @ geometry.rotation.transpose(0, 2, 1)
        before = 0.0 if geometry.displacement is None else geometry.displacement
        return replace(
            geometry,
            displacement=(before + by).astype(np.float32),
            vertices=(geometry.vertices + world).astype(np.float32),
        )


@dataclass(frozen=True)
class Patch:
    """Texels that two images or more measure, under a light; what each image sees of them stays.

    Attributes
    ----------
    surface : Surface
    seen : Observations
        N texels, J images.
    images : sequence of BentImage
        Diffuse and specular radiance at unit albedo, by the normals.
    gloss : bool
        Whether there is specular reflection.
    expected, sigma : float
        Specular albedo to expect, and the robust deviation of the residuals to start from.
    tangents : (N, 2, 3)
        Object-space directions in which normals tilt.
    window : float
        `LIGHT_MM` in texels.
    """

    surface: Surface
    seen: Observations
    images: Sequence[BentImage]
    gloss: bool
    expected: float
    sigma: float
    tangents: NDArray[np.float64]
    window: float

    @classmethod
    def of(cls, surface: Surface, forward: Forward, found: LightingSolution, millimetres: float) -> Patch:
        """Of a surface under a lighting; ``millimetres`` per unit of the model."""
        every = surface.observe(np.arange(len(surface)))
        rows = np.flatnonzero((every.measured > 0).sum(axis=1) > 1)
        seen, appearance = every.take(rows), forward.under(found.light)
        shadows = [appearance.trace(mesh, surface_points(seen, t)) for t, mesh in enumerate(surface.meshes)]
        images = [
            BentImage(appearance, seen.normal[:, t], seen.view[:, j], shadows[t]) for j, t in enumerate(seen.step)
        ]
        tangents = tangent_plane(seen.normal[:, 0] @ surface.geometry.rotation[0])
        known = bool(forward.gloss), found.expected, max(found.sigma, 1e-4)
        area = 0.5 * np.linalg.norm(face_cross(surface.vertices[0], surface.faces), axis=1)
        texel = np.sqrt(area[np.unique(surface.texels.face)].sum() / len(surface)) / surface.geometry.scale
        return cls(surface, seen, images, *known, tangents, LIGHT_MM / float(texel * millimetres))

    def equations(self, moved: NDArray, way: NDArray, probe: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gauss-Newton's matrices (N, 3, 3) and right-hand sides (N, 3) of two tilts of the normal and the height.

        Albedos are eliminated. ``moved`` (V, 3) is how far vertices have moved, ``way`` (V, 3) their way per unit of
        height, both in object space; images are differentiated over a ``probe`` to either side.
        """
        seen, surface = self.seen, self.surface
        colour, ahead, behind = (surface.colours(seen, self._at(moved + k * probe * way)) for k in (0.0, 1.0, -1.0))
        corners = surface.faces, seen.face, seen.barycentric
        normals = [normalize(interpolate(vertex_normals(v, surface.faces), *corners)) for v in self._at(moved)]
        bent = np.stack(normals, axis=1).astype(np.float32)
        radiance, tilts = np.empty((*bent[:, seen.step].shape[:2], 6), np.float32), []
        for j, t in enumerate(seen.step):
            turns = [self.tangents[:, a] @ surface.geometry.rotation[t].T for a in (0, 1)]
            radiance[:, j], of_image = self.images[j](bent[:, t], turns)
            tilts.append(of_image)
        diffuse, specular = radiance[..., :3], radiance[..., 3:] * np.float32(self.gloss)
        texels, (x, y), residual, weight = self._follow(colour, diffuse, specular)

        # Slopes of the residuals, and what is left to explain; what the albedos take of them goes.
        columns = np.zeros((*colour.shape, 4), np.float32)
        columns[..., 2] = (ahead - behind) / (2.0 * probe)
        columns[..., 3] = self._mean_about(residual, weight) - residual
        for j, of_image in enumerate(tilts):
            for a, slope in enumerate(of_image):
                columns[:, j, :, a] = -form_image(0.0, x, slope[:, :3], self.gloss * y[:, None], slope[:, 3:])
        weighted = weight[..., None] * columns
        taken = np.einsum("njc,njca->nca", diffuse, weighted), np.einsum("njc,njca->na", specular, weighted)
        system = np.einsum("njca,njcb->nab", weighted[..., :3], columns).astype(np.float64)
        for b in range(4):
            followed = texels.inverse(taken[0][..., b], taken[1][:, b])
            system[:, :, b] -= np.einsum("nca,nc->na", taken[0][..., :3], followed[0])
            system[:, :, b] -= taken[1][:, :3] * followed[1][:, None]
        matrix = system[..., :3]
        return 0.5 * (matrix + matrix.transpose(0, 2, 1)), system[..., 3]

    def _at(self, moved: NDArray) -> list[NDArray[np.float64]]:
        """World-space vertices of each timestep that have moved by (V, 3) in object space."""
        fit = self.surface.geometry
        return [v + fit.scale * moved @ r.T for v, r in zip(self.surface.vertices, fit.rotation, strict=True)]

    def _mean_about(self, values: NDArray, weight: NDArray) -> NDArray[np.float32]:
        """(N, J, 3) weighted mean of values in a window around each texel, image by image."""
        texels, rows, mean = self.surface.texels, self.seen.texel, np.empty_like(values)

        def blurred(of: NDArray) -> NDArray:
            every = np.zeros((len(self.surface), 3), np.float32)
            every[rows] = of
            return texels.from_map(cv2.GaussianBlur(texels.to_map(every), (0, 0), self.window))[rows]

        def fill(j: int) -> None:
            mean[:, j] = blurred(weight[:, j] * values[:, j]) / np.maximum(blurred(weight[:, j]), 1e-12)

        on_all_cores(fill, range(values.shape[1]))
        return mean

    def _follow(
        self, colour: NDArray, diffuse: NDArray, specular: NDArray
    ) -> tuple[TexelSystems, tuple[NDArray, NDArray], NDArray, NDArray]:
        """Blocks of the texels, their albedos, and residuals (N, J, 3) with their robust weights, over the noise."""
        measured = self.seen.measured
        plain = measured[..., None] * noise_weight(colour, True)
        plain /= max(float(np.median(plain[measured > 0])), 1e-12) if measured.any() else 1.0
        weight, sigma, none = plain, self.sigma, np.zeros((0, 2), int)

        def blocks() -> TexelSystems:
            texels = TexelSystems.accumulate(colour, weight, diffuse, specular, none, 0.0)
            gloss = specular_pull(self.expected, MISFIT * sigma)
            return texels.with_priors((1e-6 * np.median(texels.dd, axis=0) + 1e-12, gloss), np.zeros(3), self.expected)

        for _ in range(MAP_PASSES):
            texels = blocks()
            x, y = texels.inverse(texels.dr, texels.sr)
            albedos = np.clip(x, 0.0, BRIGHTEST).astype(np.float32), np.clip(y, 0.0, 1.0).astype(np.float32)
            residual = colour - form_image(0.0, albedos[0][:, None], diffuse, albedos[1][:, None, None], specular)
            sigma = max(median_deviation(residual[measured > 0]), 1e-4)
            weight = plain / (1.0 + (residual / np.float32(CAUCHY * sigma)) ** 2)
        texels, factor = blocks(), INDEPENDENT / sigma**2
        scaled = TexelSystems(*(factor * getattr(texels, each.name) for each in fields(texels)))
        return scaled, albedos, residual, np.asarray(factor * weight, np.float32)


def _settle(patch: Patch, field: Field, height: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Heights (n,) under a lighting, and the root mean square of the last step, by Gauss-Newton.

    The patch's surface has moved by the heights given already.
    """
    seen, faces = patch.seen, patch.surface.faces
    if not len(seen.texel):
        return height, 0.0
    corners = corner_matrix(faces, seen.face, seen.barycentric, len(field.normal))
    tilts = [corners @ slope for slope in field.slope]
    along = [sum(sp.diags(patch.tangents[:, a, k]) @ tilt for k, tilt in enumerate(tilts)) for a in (0, 1)]
    ways = [*along, corners[:, field.free]]
    start, moved, factor, step = height, np.zeros_like(height), None, LINEAR_MM / field.millimetres
    for _ in range(ITERATIONS):
        blocks, sides = patch.equations(field.displacement(height - start), field.normal, step)
        matrix, right = field.precision, -field.precision @ height
        pairs = list(combinations_with_replacement(range(3), 2))
        parts = on_all_cores(_product, [(ways[a], blocks[:, a, b], ways[b]) for a, b in pairs])
        for (a, b), part in zip(pairs, parts, strict=True):
            matrix = matrix + (part if a == b else part + part.T)
        for way, side in zip(ways, sides.T, strict=True):
            right += way.T @ side
        if not np.isfinite(right).all():
            raise ConvergenceError("stage 1 (surface): shading is not finite; see the images' range")
        factor = factor or symmetric_factor(matrix)
        near = spl.LinearOperator(matrix.shape, lambda r, f=factor: f.solve(r.astype(np.float32)).astype(np.float64))
        moved = np.clip(spl.cg(matrix, right, rtol=RELATIVE, maxiter=MOST_ITERATIONS, M=near)[0], -step, step)
        height = height + moved
    return height, float(np.sqrt(np.mean(moved**2)))


def _product(given: tuple[sp.csr_matrix, NDArray, sp.csr_matrix]) -> sp.csr_matrix:
    """A' diag(w) B."""
    return given[0].T @ sp.diags(given[1]) @ given[2]
