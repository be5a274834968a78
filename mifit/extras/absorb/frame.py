"""One frame of a video, read at the texels and added to their sums (`absorb.information`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.occlusion import MeshPoints
from mifit.core.bend import texel_neighbours, unbend
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate
from mifit.core.mesh import normalize
from mifit.extras.absorb.information import Information
from mifit.extras.absorb.linear import linear_shading
from mifit.stages.normals.carried import CarriedTangents
from mifit.stages.observations import Surface
from mifit.stages.reflectance.lighting import active_weight
from mifit.stages.reflectance.trials import noise_weight

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


@dataclass(frozen=True)
class FrameFit:
    """How well a frame agrees with what was known before it.

    Attributes
    ----------
    residual : float
        Robust standard deviation of observed from predicted colour over the face, linear.
    outliers : float
        Part of the observations beyond three deviations, against those of a normal distribution 0.003.
    measured : float
        Part of the face's texels that the frame measures.
    detail : float
        Contrast of the observed detail, texel against texel, relative to that of the whole face: falls with blur.
    """

    residual: float
    outliers: float
    measured: float
    detail: float


class Absorber:
    """Reads frames about a fixed starting point: maps, light and normals of a result.

    Weights depend on the starting point and the frame alone, so that frames can come in any order.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    reflectance : ReflectanceEstimate
        Maps and light to linearise about.
    offsets : (N, 2)
        Corrections of the normals to linearise about, in `CarriedTangents` of the texels.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    surface : Surface
        Any surface of the model with maps of this size: says which texels there are.
    seed : int
        Of the tracing of shadows.
    """

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        reflectance: ReflectanceEstimate,
        offsets: NDArray,
        cameras: Sequence[str],
        surface: Surface,
        seed: int = 0,
    ) -> None:
        self._capture, self._model, self._cameras, self._seed = capture, model, tuple(cameras), seed
        self.reflectance, self.offsets = reflectance, offsets
        self.texels, self.facial = surface.texels, surface.facial
        self.carried = CarriedTangents(model, self.texels)
        self._near = texel_neighbours(self.texels)
        self.diffuse, self.specular = (self.texels.from_map(m) for m in (reflectance.lit_diffuse, reflectance.specular))

    def absorb(
        self,
        information: Information,
        geometry: GeometryEstimate,
        disagrees: Callable[[FrameFit], object] = lambda fit: False,
    ) -> FrameFit:
        """Add the frame of a geometry's one timestep to the sums, in place, unless it disagrees."""
        size = self.texels.size
        surface = Surface(self._capture, self._model, geometry, self._cameras, size, whole=True, texels=self.texels)
        every = surface.observe(np.arange(len(self.texels.index)))
        rows = np.flatnonzero((every.weight > 0).any(axis=1))
        seen = every.take(rows)
        rotation, facial, offsets = geometry.rotation[0], self.facial[rows], self.offsets[rows]
        base, tangents = (part @ rotation.T for part in self.carried.frame(geometry, rows))
        diffuse, specular = self.diffuse[rows], self.specular[rows]
        points = MeshPoints(seen.point[:, 0], base, seen.face, seen.barycentric)
        appearance = Appearance.of(self.reflectance, self.reflectance.lobe.at(lambda m: self.texels.from_map(m)[rows]))
        occlusion = appearance.trace(surface.meshes[0], points, self._seed)
        images, residuals = [], []
        for j in range(len(seen.step)):
            shade = appearance.shader(base, seen.view[:, j], occlusion, points.position)
            d, s, d_slope, s_slope = linear_shading(shade, base, tangents, offsets, seen.view[:, j])
            target = seen.colour[:, j] - np.float32(appearance.illumination.ambient)
            residuals.append(target - form_image(0.0, diffuse, d, specular[:, None], s))
            slope = form_image(0.0, diffuse[..., None], d_slope, specular[:, None, None], s_slope)
            slope[~facial] = 0.0
            images.append((target, d, s, slope))
        weight = seen.weight[..., None] * noise_weight(seen.colour, True)
        residual = np.stack(residuals, axis=1)
        robust, sigma = active_weight(weight, seen.clipped, residual, True)
        shown = (seen.measured > 0) & facial[:, None]
        far = np.abs(residual[shown]) > 3.0 * max(sigma, 1e-6)
        measured = float(shown.any(1).sum() / self.facial.sum())
        observed = np.stack([target for target, *_ in images], axis=1)
        detail = min(self._detail(rows, observed[:, j], shown[:, j]) for j in range(len(images)))
        fit = FrameFit(sigma, float(far.mean()) if far.size else 0.0, measured, detail)
        if disagrees(fit):
            return fit
        cosine = np.einsum("njk,njk->nj", seen.image_normal, seen.view)
        cosine = np.where(seen.measured > 0, np.clip(cosine, 0.0, 1.0) * seen.right, 0.0)
        for j, (target, d, s, slope) in enumerate(images):
            # What was linearised about x0 is a function of x itself.
            shift = np.einsum("nci,ni->nc", slope, offsets)
            information.add(rows, target + shift, robust[:, j], d, s, slope, cosine[:, j])
        information.frames[rows] += (seen.measured > 0).any(1)
        return fit

    def _detail(self, rows: NDArray, observed: NDArray, shown: NDArray) -> float:
        """Deviation of one image's texels (n, 3) from their neighbours' mean, relative to that from the face's mean."""
        values, known = np.zeros(len(self.texels.index)), np.zeros(len(self.texels.index), dtype=bool)
        values[rows], known[rows] = observed.mean(-1), shown
        inside = known & known[self._near].all(axis=1)
        if not inside.any():
            return 0.0
        fine = (values[self._near].mean(axis=1) - values)[inside]
        return float(np.sqrt(np.mean(fine**2)) / max(float(values[inside].std()), 1e-12))


def carried_offsets(
    carried: CarriedTangents, geometry: GeometryEstimate, normals: NormalsEstimate | None, size: int, index: NDArray
) -> NDArray[np.float64]:
    """(N, 2) mean correction of a result's normals, in tangents that move with the face; 0 where there is none."""
    total = np.zeros((len(index), 2))
    count = np.zeros((len(index), 1))
    for timestep in geometry.timesteps if normals is None else normals.timesteps:
        if normals is None:
            break
        found = normals.normal_object[normals.timesteps.index(timestep)].reshape(size * size, 3)[index]
        known = np.linalg.norm(found, axis=1) > 0.5
        offsets = unbend(*carried.frame(geometry.at((timestep,))), normalize(found.astype(np.float64)))
        total[known] += offsets[known]
        count[known] += 1
    return total / np.maximum(count, 1)
