"""The likelihood of landmarks under a calibration: a statistical face at one pose a timestep, seen by all cameras.

The face is the model's mean with the covariance that identities and expressions give its landmarks. What a hypothesis
leaves unexplained is

    E = 3/2 sum log(1 + r^2 / (2 s^2)) + 1/2 |a|^2 + 1/2 sum |b_t|^2,

a negative log-likelihood up to a constant: residuals r in pixels follow a Cauchy distribution, the coefficients a
of the face and b_t of a timestep's expression a normal one. It is minimised by damped Gauss-Newton steps with
weights (Lange, Little and Taylor 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.core.camera import Camera
from mifit.morphable import MorphableModel
from mifit.morphable.topology import INNER
from mifit.stages.geometry.initial import best_pose, triangulate
from mifit.stages.geometry.parameters import Pose
from mifit.stages.geometry.points import project

IDENTITY_MODES, EXPRESSION_MODES = 25, 8
"""Principal directions of the landmarks that are kept; what is left out is below a millimetre."""
EXPRESSION_DEVIATION = 0.3
"""Standard deviation of an expression weight, which is 0..1."""
NOISE_OF_SPREAD = 0.07
"""Deviation of a landmark, as part of the root-mean-square distance of the inner points from their middle: 3.5 % of the
distance of the outer corners of the eyes, of which detectors err by 3 to 4 % (300-W benchmark, Sagonas et al. 2016)."""
STEPS, SETTLED = 12, 1e-2
"""Gauss-Newton steps at the most, and the gain below which they end."""
BEHIND = 50.0
"""Cost of a landmark whose point lies behind the camera."""


@dataclass(frozen=True)
class Shot:
    """Landmarks of one image: (68, 2) pixels, NaN where not seen; ``step`` counts timesteps."""

    camera: Camera
    step: int
    pixels: NDArray[np.float64]


@dataclass(frozen=True)
class FaceStatistics:
    """Landmarks inside of faces, without the jaw, in world units.

    Attributes
    ----------
    mean : (51, 3)
    shared, local : (51, 3, K)
        One standard deviation of identity, and of a timestep's expression.
    unit_mm : float
        Millimetres of a world unit.
    """

    mean: NDArray[np.float64]
    shared: NDArray[np.float64]
    local: NDArray[np.float64]
    unit_mm: float

    @classmethod
    def of(cls, model: MorphableModel, unit_mm: float) -> FaceStatistics:
        """Of a model, for a capture whose unit of length is ``unit_mm`` millimetres."""
        scale = model.unit_mm / unit_mm

        def modes(basis: NDArray, count: int) -> NDArray[np.float64]:
            rows = scale * basis[model.landmarks].astype(np.float64).reshape(68 * 3, -1).T
            if not rows.size:
                return np.zeros((len(INNER), 3, 0))
            _, size, directions = np.linalg.svd(rows, full_matrices=False)
            found = (size[:, None] * directions)[:count].reshape(-1, 68, 3)
            return np.ascontiguousarray(np.moveaxis(found[:, INNER], 0, 2))

        return cls(
            scale * model.mean[model.landmarks[INNER]].astype(np.float64),
            modes(model.identity, IDENTITY_MODES),
            modes(EXPRESSION_DEVIATION * model.expression, EXPRESSION_MODES),
            unit_mm,
        )


@dataclass(frozen=True)
class Explanation:
    """How well a face explains some landmarks.

    Attributes
    ----------
    cost : float
        Negative log-likelihood for each landmark; about 0.9 where landmarks err as a detector's do.
    size : float
        Size of the face over the model's mean; 1 with a single camera, which doesn't show it.
    shift : (2,)
        Pixels by which the landmarks of the freed camera lie off.
    offsets : dict of camera name to float
        Median distance of its landmarks from the face's, in pixels.
    """

    cost: float
    size: float
    shift: NDArray[np.float64]
    offsets: dict[str, float]


def noise_of(shots: Sequence[Shot]) -> float:
    """Deviation of a landmark in pixels: `NOISE_OF_SPREAD` of the largest face; at least half a pixel."""
    spread = [shot.pixels[INNER][np.isfinite(shot.pixels[INNER]).all(1)] for shot in shots]
    sizes = [float(np.sqrt(((p - p.mean(0)) ** 2).sum(1).mean())) for p in spread if len(p)]
    return max(NOISE_OF_SPREAD * max(sizes, default=0.0), 0.5)


def explain(shots: Sequence[Shot], face: FaceStatistics, shifted: str | None = None) -> Explanation:
    """The most likely face, its size and poses, and how likely they make the landmarks.

    Parameters
    ----------
    shots : sequence of Shot
        Of one timestep or more.
    face : FaceStatistics
    shifted : str, optional
        A camera whose landmarks may all lie off by the same pixels, beside what the model's text says.
    """
    noise = noise_of(shots)
    steps = sorted({shot.step for shot in shots})
    shots = [replace(shot, step=steps.index(shot.step)) for shot in shots]
    sized = len({shot.camera.name for shot in shots}) > 1
    size = _size(shots, face) if sized else 1.0
    poses = [_pose([shot for shot in shots if shot.step == k], face, size) for k in range(len(steps))]
    shared, local = face.shared.shape[2], face.local.shape[2] + 6
    free = shared + 1 + 2 * (shifted is not None)
    x = np.zeros(free + local * len(steps))
    x[shared] = np.log(size)
    prior = np.zeros(len(x))
    prior[:shared] = 1.0
    prior[shared] = 0.0 if sized else 1e12
    for k in range(len(steps)):
        prior[free + k * local : free + (k + 1) * local - 6] = 1.0

    rows = [free + shot.step * local + np.arange(local) for shot in shots]
    places = [np.r_[np.arange(free), own] for own in rows]
    blocks = [np.ix_(at, at) for at in places]

    def look(x: NDArray, poses: list[tuple[NDArray, NDArray]]) -> tuple[float, NDArray, NDArray, list[NDArray]]:
        """Energy, gradient, curvature, and residuals (51, 2) of each shot."""
        energy, gradient, curvature = 0.5 * float((prior * x) @ x), prior * x, np.diag(prior)
        residuals = []
        for shot, own, at, block in zip(shots, rows, places, blocks, strict=True):
            residual, jacobian = _project(shot, face, x[:free], x[own], poses[shot.step], shifted)
            squared = (residual**2).sum(1) / (2 * noise**2)
            seen = np.isfinite(squared)
            behind = ~seen & np.isfinite(shot.pixels[INNER]).all(1)
            energy += 1.5 * float(np.log1p(squared[seen]).sum()) + BEHIND * float(behind.sum())
            weight = np.where(seen, 1.5 / (1 + np.where(seen, squared, 0)), 0.0) / noise**2
            flat = np.repeat(weight, 2)
            residual = np.where(seen[:, None], residual, 0.0)
            jacobian = np.where(seen[:, None, None], jacobian, 0.0).reshape(-1, len(at))
            gradient[at] += jacobian.T @ (flat * residual.ravel())
            curvature[block] += (jacobian.T * flat) @ jacobian
            residuals.append(np.where(seen[:, None], residual, np.nan))
        return energy, gradient, curvature, residuals

    now, damping = look(x, poses), 1e-3
    for _ in range(STEPS):
        diagonal = np.diag(now[2]).copy()
        step = np.linalg.solve(now[2] + np.diag(damping * diagonal + 1e-9 * diagonal[prior < 1e9].max()), -now[1])
        moved, turned = x + step, list(poses)
        for k in range(len(steps)):
            at = free + (k + 1) * local - 6
            rotation = Rotation.from_rotvec(moved[at : at + 3]).as_matrix() @ poses[k][0]
            turned[k] = (rotation, poses[k][1] + moved[at + 3 : at + 6])
            moved[at : at + 6] = 0.0
        other = look(moved, turned)
        if not np.isfinite(other[0]) or other[0] > now[0]:
            damping *= 10.0
            continue
        gained, damping = now[0] - other[0], 0.2 * damping
        x, poses, now = moved, turned, other
        if gained < SETTLED:
            break
    count = sum(int(np.isfinite(shot.pixels[INNER]).all(1).sum()) for shot in shots)
    lengths: dict[str, list[NDArray]] = {}
    for residual, shot in zip(now[3], shots, strict=True):
        length = np.linalg.norm(residual, axis=1)
        lengths.setdefault(shot.camera.name, []).append(length[np.isfinite(length)])
    middle = {name: np.concatenate(values) for name, values in lengths.items()}
    return Explanation(
        now[0] / max(count, 1),
        float(np.exp(np.clip(x[shared], -30, 30))),
        x[shared + 1 : free].copy(),
        {name: float(np.median(values)) if len(values) else np.inf for name, values in middle.items()},
    )


def _size(shots: Sequence[Shot], face: FaceStatistics) -> float:
    """Size of the triangulated face over the mean's, median over timesteps."""
    found = []
    for step in {shot.step for shot in shots}:
        mine = [shot for shot in shots if shot.step == step]
        points = triangulate([shot.camera for shot in mine], [shot.pixels for shot in mine])[INNER]
        known = np.isfinite(points).all(1)
        if known.sum() < 6:
            continue
        both = (points[known], face.mean[known])
        spread = [float(np.median(np.linalg.norm(p - np.median(p, axis=0), axis=1))) for p in both]
        found.append(spread[0] / spread[1])
    return float(np.clip(np.median(found), 1e-6, 1e6)) if found else 1.0


def _pose(shots: Sequence[Shot], face: FaceStatistics, scale: float) -> tuple[NDArray, NDArray]:
    """Pose of the mean face that reprojects best among closed forms."""
    cameras, pixels = [shot.camera for shot in shots], [shot.pixels[INNER] for shot in shots]
    return best_pose(cameras, face.mean, pixels, scale, 500.0 * scale / face.unit_mm)


def _project(
    shot: Shot, face: FaceStatistics, shared: NDArray, own: NDArray, pose: tuple[NDArray, NDArray], shifted: str | None
) -> tuple[NDArray, NDArray]:
    """Residuals (51, 2) in pixels and their derivatives (51, 2, n) by shared unknowns and the timestep's own."""
    count, camera = face.shared.shape[2], shot.camera
    size = float(np.exp(np.clip(shared[count], -30, 30)))
    shape = face.mean + face.shared @ shared[:count] + face.local @ own[:-6]
    found = project(camera, Pose(*pose, size, np.eye(3)), shape)
    pixels = np.where(found.depth[:, None] > 0, found.pixels, np.nan)
    columns = [found.by_object @ face.shared, found.by_log_scale[..., None]]
    if shifted is not None:
        mine = float(shifted == camera.name)
        pixels = pixels + mine * shared[count + 1 :]
        columns.append(np.broadcast_to(mine * np.eye(2), (len(INNER), 2, 2)))
    columns += [found.by_object @ face.local, found.by_pose]
    return pixels - shot.pixels[INNER], np.concatenate(columns, axis=2)
