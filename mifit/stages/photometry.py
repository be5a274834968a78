"""Gains of cameras and exposures of images, estimated together with smooth lighting from shared surface points.

The logarithm of what image j shows of point p in channel c is

    log I_pjc = log(a_pc phi(n_pj) . l_c + s psi(r_pj, v_pj) . l_c) + x_jc . theta

with the albedo ``a`` of the point, radiance ``l`` in a few harmonic bands, the specular level ``s`` of skin, harmonics
``phi`` of the normal (as Lambert's law filters them) and ``psi`` of the mirrored view (with a Fresnel rise), and the
unknown log factors ``theta`` that images share: three per camera (gain), one per timestep (all cameras change alike)
and one per image. Gauss-Newton with Geman and McClure's weights; albedos are eliminated, since each belongs to one
point. Every unknown has a Gaussian prior; so each group of factors has a posterior deviation, and counts only where it
is surely and visibly not 0. Light that turns with the head's pose is no exposure, and specular reflection towards one
camera no gain, because the model has both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.config import PhotometryConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate
from mifit.core.metrics import SURE, median_deviation
from mifit.core.photometry import Photometry
from mifit.core.sh import bands, basis, cosine_coefficients
from mifit.morphable.pigment import SPECULAR, SPREAD
from mifit.optim import geman_mcclure
from mifit.progress import Progress, silent
from mifit.sampling.observations import Observations, Surface
from mifit.sampling.visibility import DARKEST, GRAZING

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

MAP_SIZE, VALUES, FEWEST_POINTS = 256, 16_000, 50
"""Texels along the side of the map; observations (points times images) that are compared; fewest points that serve."""
FRONTAL = 3.0
"""Multiple of the grazing cosine below which a colour says nothing of the factor."""
BANDS = 4
"""Bands of the lighting."""
NEIGHBOURS = 0.03
"""Independent measurements per observation: neighbours share errors of the mesh."""
LEAST = {"gain": 0.1, "exposure": 0.05, "own": 0.05}
"""Least logarithm of a factor worth taking. Below, cameras of one kind differ by what specular reflection leaves."""
ITERATIONS = 12
"""Gauss-Newton steps."""


@dataclass(frozen=True)
class Factors:
    """Log factors of images: columns of a design and their groups.

    Attributes
    ----------
    design : (J, 3, U)
        How each factor acts on an image's channels.
    group : (U,) str
        ``"gain"``, ``"exposure"`` (common to all cameras of a timestep) or ``"own"`` (an image's own).
    """

    design: NDArray[np.float64]
    group: NDArray[np.str_]

    @classmethod
    def of(cls, camera: NDArray, step: NDArray) -> Factors:
        """All that images (J,) of cameras and timesteps may have; the first camera and timestep are the reference."""
        others, later = np.unique(camera)[1:], np.unique(step)[1:]
        columns = [("gain", camera == c, channel) for c in others for channel in np.eye(3)]
        columns += [("exposure", step == t, np.ones(3)) for t in later]
        columns += [("own", (camera == c) & (step == t), np.ones(3)) for c in others for t in later]
        design = np.stack([np.outer(images, channels) for _, images, channels in columns], axis=-1)
        return cls(design, np.array([name for name, _, _ in columns]))

    def only(self, groups: Sequence[str]) -> Factors:
        """The factors of some groups."""
        kept = np.isin(self.group, groups)
        return Factors(self.design[..., kept], self.group[kept])


@dataclass(frozen=True)
class Solution:
    """Log factors (U,) and their posterior standard deviations."""

    factors: Factors
    value: NDArray[np.float64]
    deviation: NDArray[np.float64]

    def sure(self) -> list[str]:
        """Groups of which a factor is surely and visibly not 1."""
        least = np.array([LEAST[name] for name in self.factors.group])
        clear = (np.abs(self.value) > least) & (np.abs(self.value) > SURE * self.deviation)
        return sorted(set(self.factors.group[clear].tolist()))

    def per_image(self) -> NDArray[np.float64]:
        """(J, 3) log factors."""
        return self.factors.design @ self.value


def find_photometry(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    config: PhotometryConfig | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Photometry:
    """Gains of cameras and exposures of images, where they surely differ.

    Parameters
    ----------
    capture, model, geometry
        Images and the fitted surface.
    cameras : sequence of str
        Cameras to read; the first one is the reference.
    config : PhotometryConfig, optional
    seed : int
        Chooses the points.
    progress : Progress

    Returns
    -------
    Photometry
        Empty for a single timestep, where specular reflection towards one camera looks like its gain, and where too
        few points are visible in several images.
    """
    config = config or PhotometryConfig()
    if not config.enabled or len(geometry.timesteps) < 2:
        return Photometry()
    progress("Photometry", 0, 1)
    surface = Surface(capture, model, geometry, cameras, MAP_SIZE)
    parts = [surface.observe(part) for part in surface.chunks()]
    seen = shared_points(parts, max(VALUES // surface.image_count, FEWEST_POINTS), np.random.default_rng(seed))
    found = Photometry()
    if len(seen.texel) >= FEWEST_POINTS and usable(seen).sum(axis=0).min() >= FEWEST_POINTS:
        albedo = interpolate(geometry.vertex_albedo, model.faces, seen.face, seen.barycentric)
        found = estimate_photometry(seen, albedo, cameras, geometry.timesteps)
    progress("Photometry", 1, 1)
    return found


def estimate_photometry(
    seen: Observations, albedo: NDArray, cameras: Sequence[str], timesteps: Sequence[int]
) -> Photometry:
    """Gains where a camera's surely differ, and exposures where an image's surely does, from N points in J images.

    ``albedo`` (N, 3) is what the model expects of the points, linear.
    """
    albedo = np.clip(np.nan_to_num(albedo, nan=0.3), 0.01, 1.0).astype(np.float64)
    found = solve_factors(seen, albedo, Factors.of(seen.camera, seen.step))
    groups = found.sure()
    while groups and groups != sorted(set(found.factors.group)):  # what is sure, estimated without what isn't
        found = solve_factors(seen, albedo, found.factors.only(groups))
        groups = found.sure()
    if not groups:
        return Photometry()
    factor = np.exp(found.per_image())
    first = {c: int(np.flatnonzero((seen.camera == c) & (seen.step == 0))[0]) for c in np.unique(seen.camera)}
    gain = {cameras[c]: (float(r), float(g), float(b)) for c, j in first.items() for r, g, b in [factor[j]]}
    relative = {j: float(np.mean(factor[j] / factor[first[seen.camera[j]]])) for j in range(len(factor))}
    exposure = {(cameras[seen.camera[j]], timesteps[seen.step[j]]): value for j, value in relative.items()}
    moving = bool({"exposure", "own"} & set(groups))
    return Photometry(gain if "gain" in groups else {}, exposure if moving else {})


def usable(seen: Observations) -> NDArray[np.bool_]:
    """(N, J) observations that are bright and frontal enough for a ratio."""
    frontal = np.einsum("njk,njk->nj", seen.image_normal, seen.view) > FRONTAL * GRAZING
    return (seen.measured > 0) & frontal & (seen.colour.min(axis=2) > DARKEST)


def shared_points(parts: Sequence[Observations], count: int, rng: np.random.Generator) -> Observations:
    """Points that two images or more measure, at most ``count``, chosen at random."""
    seen = Observations.join([part.take(np.flatnonzero(usable(part).sum(axis=1) >= 2)) for part in parts])
    total = len(seen.texel)
    return seen.take(np.sort(rng.choice(total, min(count, total), replace=False)))


def solve_factors(seen: Observations, albedo: NDArray, factors: Factors) -> Solution:
    """Factors, lighting, specular level and albedos (N, 3) by Gauss-Newton; see the module's equation."""
    measured = usable(seen)
    level = np.log(np.maximum(seen.colour, DARKEST)).astype(np.float64)
    weight = np.where(measured, seen.weight, 0.0)[..., None] / max(float(seen.weight[measured].mean()), 1e-12)
    phi, psi = _harmonics(seen)
    k, u = BANDS**2, len(factors.group)
    light_at = [slice(u + c * k, u + (c + 1) * k) for c in range(3)]
    # Unknowns: factors, light per channel, log of the specular level over skin's. The albedo starts at the model's.
    prior = np.concatenate([np.full(u, SPREAD**-2.0), np.zeros(3 * k), [SPREAD**-2.0]])
    rough = np.tile((bands(BANDS) * (bands(BANDS) + 1.0)) ** 2, 3)
    expected = np.log(albedo)
    log_albedo, x, sigma = expected.copy(), np.zeros(u + 3 * k + 1), SPREAD / 2.0
    for c in range(3):
        flat = float(np.exp(np.median((level - expected[:, None])[..., c][measured])))
        x[light_at[c]][0] = flat / basis(np.array([[0.0, 0.0, 1.0]]), 1)[0, 0]
    mean_light = float(np.mean([x[at][0] for at in light_at]))
    prior[u : u + 3 * k] = rough / mean_light**2
    for number in range(ITERATIONS):
        light = np.stack([x[at] for at in light_at], axis=1)
        a, s = np.exp(log_albedo)[:, None], SPECULAR * np.exp(x[-1])
        diffuse, specular = a * np.maximum(phi @ light, 1e-3), s * np.maximum(psi @ light, 0.0)
        fitted = diffuse + specular
        residual = level - np.log(fitted) - factors.design @ x[:u]
        w = weight * geman_mcclure(residual**2, 2.0 * sigma)[1] * (NEIGHBOURS / sigma**2)
        # Jacobian of the logarithm (N, J, 3, unknowns), and by the log albedo, which is eliminated.
        jacobian = np.zeros((*residual.shape, len(x)))
        jacobian[..., :u] = factors.design
        for c, at in enumerate(light_at):
            shining = np.where(specular[..., c] > 0, s, 0.0)[..., None] * psi
            jacobian[:, :, c, at] = (a[..., c, None] * phi + shining) / fitted[..., c, None]
        jacobian[..., -1] = specular / fitted
        by_albedo = w * (diffuse / fitted)
        diagonal = (by_albedo * (diffuse / fitted)).sum(axis=1) + SPREAD**-2.0
        right_albedo = (by_albedo * residual).sum(axis=1) - (log_albedo - expected) / SPREAD**2
        mixed = np.einsum("njc,njcu->ncu", by_albedo, jacobian)
        rows = jacobian.reshape(-1, len(x))
        weighted = (rows * w.reshape(-1, 1)).T
        eliminated = (mixed / diagonal[..., None]).reshape(-1, len(x))
        system = weighted @ rows - eliminated.T @ mixed.reshape(-1, len(x)) + np.diag(prior)
        right = weighted @ residual.ravel() - eliminated.T @ right_albedo.ravel() - prior * x
        floor = 1e-9 * np.trace(system) / len(x) * np.eye(len(x))
        step = np.linalg.solve(system + floor, right)
        albedo_step = (right_albedo - mixed @ step) / diagonal
        damped = min(1.0, 0.5 / max(float(np.abs(albedo_step).max()), 1e-12)) if number < 3 else 1.0
        x, log_albedo = x + damped * step, log_albedo + damped * albedo_step
        sigma = max(median_deviation(residual[measured]), 1e-3)
    return Solution(factors, x[:u], np.sqrt(np.diag(np.linalg.inv(system + floor)))[:u])


def _harmonics(seen: Observations) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, J, K) derivatives of Lambertian and of mirrored radiance by the lighting's coefficients."""
    normal, view = seen.image_normal.astype(np.float64), seen.view.astype(np.float64)
    cosine = (normal * view).sum(axis=-1, keepdims=True)
    mirrored = 2.0 * cosine * normal - view
    rise = 1.0 + (1.0 / SPECULAR - 1.0) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5  # Schlick, over normal incidence
    lambert = cosine_coefficients(BANDS)[bands(BANDS)] / np.pi
    shape = (*normal.shape[:2], BANDS**2)
    phi = basis(normal.reshape(-1, 3), BANDS).reshape(shape) * lambert
    return phi, rise * basis(mirrored.reshape(-1, 3), BANDS).reshape(shape)
