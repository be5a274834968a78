"""What the photographs of a timestep show beyond the model: kept as radiance on the surface, for that timestep alone.

Edges of shadows, interreflection and scattering are no albedo, and no smooth light makes them. They do lie on the skin,
though, and a camera between the fitted ones sees them as well. So each texel keeps, per timestep, the weighted mean of
what its views show beyond ambient, diffuse and specular reflection, held towards 0 by a prior (ridge regression), since
one view's residual is its own noise and highlight as much as the skin's. Image-based rendering keeps all of a
photograph in this way; here only what nothing else explains is left to it. It belongs to the capture's own light and to
the timesteps that were fitted: another light or another albedo has none.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import ResidualConfig
from mifit.core.calls import checked
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report, ResidualEstimate
from mifit.core.mesh import normalize
from mifit.core.process import one_blas_thread
from mifit.errors import InputError
from mifit.progress import Progress, silent
from mifit.sampling.observations import Surface
from mifit.stages.normals.refine_normals import texel_images

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


@checked
@one_blas_thread()
def find_residual(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    normals: NormalsEstimate | None,
    cameras: Sequence[str],
    config: ResidualConfig | None = None,
    progress: Progress = silent,
) -> ResidualEstimate:
    """What the images of each timestep hold beyond reflectance and light.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        Its timesteps are those that are looked at.
    reflectance : ReflectanceEstimate
        Stage 2.
    normals : NormalsEstimate or None
        Stage 3; without it the mesh's normals are shaded.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : ResidualConfig, optional
    progress : Progress

    Returns
    -------
    ResidualEstimate
        Its report has the root mean square of the images' deviation from the model over the face's texels,
        before and after (``residual``, ``left``), linear.

    Raises
    ------
    InputError
        No camera or timestep, or normals of another size than the maps.
    """
    started, config = time.perf_counter(), config or ResidualConfig()
    size = len(reflectance.diffuse)
    if normals is not None and normals.normal_object.shape[1] != size:
        raise InputError(
            f"residual: found normals of {normals.normal_object.shape[1]} texels a side, expected {size} as the maps"
        )
    texels = None
    radiance = np.zeros((len(geometry.timesteps), size, size, 3), dtype=np.float32)
    before = after = count = 0.0
    progress("find residual", 0, len(geometry.timesteps))
    for i, timestep in enumerate(geometry.timesteps):
        surface = Surface(capture, model, geometry.at([timestep]), cameras, size, whole=True, texels=texels)
        texels = surface.texels
        refined = None
        if normals is not None and timestep in normals.timesteps:
            refined = texels.from_map(normals.normal_object[normals.timesteps.index(timestep)])
        rows, difference, weight = _difference(surface, reflectance, refined, geometry.rotation[i])
        found = (weight[..., None] * difference).sum(1) / (config.prior + weight.sum(1))[:, None]
        values = np.zeros((len(texels.index), 3), dtype=np.float32)
        values[rows] = found
        radiance[i] = texels.to_map(values)
        face = weight * surface.facial[rows, None]
        before += float((face * (difference**2).mean(-1)).sum())
        after += float((face * ((difference - found[:, None]) ** 2).mean(-1)).sum())
        count += float(face.sum())
        progress("find residual", i + 1, len(geometry.timesteps))
    details = {"residual": float(np.sqrt(before / max(count, 1.0))), "left": float(np.sqrt(after / max(count, 1.0)))}
    # A closed form: there is nothing that could fail to converge.
    report = Report("converged", {}, time.perf_counter() - started, (), details)
    return ResidualEstimate(geometry.timesteps, radiance, report)


def _difference(
    surface: Surface, reflectance: ReflectanceEstimate, refined: NDArray | None, rotation: NDArray
) -> tuple[NDArray, NDArray[np.float32], NDArray[np.float32]]:
    """Texels (n,) that images of one timestep measure, what each shows beyond the model (n, J, 3), and its weight.

    The weight is the probability that the image shows the point: 1 for a view that does for sure, however it sees it.
    """
    rows, seen, images = texel_images(surface, reflectance)
    normal = seen.normal[:, 0] @ rotation
    if refined is not None:
        known = np.any(refined[rows] != 0, axis=1)
        normal = np.where(known[:, None], normalize(refined[rows]), normal)
    difference = np.zeros_like(seen.colour)
    for j, (at, image) in enumerate(images):
        difference[at, j] = seen.colour[at, j] - image(normal[at])[0]
    return rows, difference, np.where(seen.measured > 0, seen.inlier, np.float32(0.0)).astype(np.float32)
