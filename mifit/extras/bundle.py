"""Bundle adjustment of tracks on a head that moves before fixed cameras and changes its expression.

Unknown are focal lengths, relative poses of the cameras, a head pose per timestep, points in the head's frame,
free of any face model, and how each timestep's expression differs from the first one's, in the model's modes with a
Gaussian prior. Levenberg-Marquardt on Cauchy's loss; points are eliminated by the Schur complement (Triggs et al.,
Bundle adjustment, 2000).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

STEPS = 100
"""Steps that are taken at most."""
SETTLED = 1e-5
"""Relative fall of the energy in a step below which it counts as settled."""
NEGLIGIBLE = 0.05
"""Energy of a match below which falling further means nothing: a third of its deviation."""
CAUCHY = 1.5
"""Deviations of a match where the robust loss turns."""
EXPRESSION_DEVIATION = 0.3
"""Prior deviation of expression coefficients' changes between timesteps."""


@dataclass(frozen=True)
class Sightings:
    """Where N points are seen in images, pixels; ordered by point."""

    pixels: NDArray[np.float64]  # (M, 2), minus the principal point, pixels made square
    point: NDArray[np.int64]  # (M,) ascending, every one of 0..N-1
    camera: NDArray[np.int64]  # (M,)
    timestep: NDArray[np.int64]  # (M,) position among the timesteps
    deviation: float  # of a match along an axis, pixels


@dataclass(frozen=True)
class Freedom:
    """How C cameras may move: by ``design @ z``, with a Gaussian prior on z (R,).

    Attributes
    ----------
    design : (P, R)
        P are the C logarithms of focal lengths, then turn and shift of each camera but the first, camera axes.
    mean, precision : (R,)
        Of the prior; precision 0 where nothing is known.
    focals : int
        How many of z, the first ones, are logarithms of unknown focal lengths.
    """

    design: NDArray[np.float64]
    mean: NDArray[np.float64]
    precision: NDArray[np.float64]
    focals: int = 0

    @classmethod
    def of(cls, ways: NDArray) -> Freedom:
        """Ways (P, R) of moving, each by one deviation of the prior."""
        return cls(ways, np.zeros(ways.shape[1]), np.ones(ways.shape[1]))

    @classmethod
    def of_focals(cls, group: NDArray, focal: NDArray, expected: NDArray, deviation: float) -> Freedom:
        """Free poses, and focal lengths (C,) that cameras of one ``group`` share; -1 where a camera's is known.

        ``expected`` (G,) are the groups' focal lengths beforehand, with this deviation of their logarithms.
        """
        cameras, count, poses = len(group), len(expected), 6 * (len(group) - 1)
        design, mean, precision = np.zeros((cameras + poses, count + poses)), *np.zeros((2, count + poses))
        for g in range(count):
            design[:cameras, g] = group == g
            mean[g] = np.log(expected[g] / focal[group == g][0])
        design[cameras:, count:] = np.eye(poses)
        precision[:count] = deviation**-2.0
        return cls(design, mean, precision, count)


@dataclass(frozen=True)
class Bundle:
    """Cameras and a moving head; OpenCV axes. Camera 0 and the pose at timestep 0 stay as they are: they fix the gauge.

    Attributes
    ----------
    focal : (C,)
        Pixels.
    cameras : (C, 4, 4)
        From a common frame, such as the first camera's, to each camera's.
    heads : (T, 4, 4)
        From the head's frame to the common one.
    points : (N, 3)
        Head's frame, at timestep 0.
    expression : (T, K)
        Coefficients relative to timestep 0.
    moved : (R,)
        How far cameras have moved, `Freedom`'s z.
    """

    focal: NDArray[np.float64]
    cameras: NDArray[np.float64]
    heads: NDArray[np.float64]
    points: NDArray[np.float64]
    expression: NDArray[np.float64]
    moved: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class AdjustedBundle:
    """A bundle at the optimum, or where `STEPS` ended.

    Attributes
    ----------
    bundle : Bundle
    deviation : float
        Largest standard deviation of the logarithm of an unknown focal length, from the normal equations with all else
        eliminated, scaled by the residuals. Errors that matches share aren't in it. 0 where a calibration holds them.
    residual : float
        Median distance of a point from its match, pixels.
    settled : bool
    """

    bundle: Bundle
    deviation: float
    residual: float
    settled: bool


@dataclass(frozen=True)
class _Projected:
    turned: NDArray[np.float64]  # (M, 3) points turned as the head is
    swung: NDArray[np.float64]  # (M, 3) and as the camera is
    seen: NDArray[np.float64]  # (M, 3) in the camera's frame
    residual: NDArray[np.float64]  # (M, 2) pixels


def adjust_bundle(start: Bundle, seen: Sightings, freedom: Freedom, modes: NDArray) -> AdjustedBundle:
    """Bring projections onto matches.

    Parameters
    ----------
    start : Bundle
    seen : Sightings
    freedom : Freedom
    modes : (N, 3, K)
        How expressions move the points; K may be 0.

    Returns
    -------
    AdjustedBundle
    """
    damping, settled = 1e-4, False
    bundle = replace(start, moved=np.zeros(freedom.design.shape[1]))
    projected = _project(bundle, seen, modes)
    energy = _energy(bundle, projected, seen, freedom)
    for _ in range(STEPS):
        system = _System.of(bundle, projected, seen, freedom, modes)
        while damping < 1e6:
            trial = _moved(bundle, *system.step(damping), freedom)
            shown = _project(trial, seen, modes)
            value = _energy(trial, shown, seen, freedom)
            if value < energy:
                break
            damping *= 4.0
        else:
            settled = True  # no step falls further
            break
        settled = energy - value < SETTLED * max(energy, NEGLIGIBLE * len(seen.point))
        bundle, projected, energy, damping = trial, shown, value, max(damping / 5.0, 1e-9)
        if settled:
            break
    system = _System.of(bundle, projected, seen, freedom, modes)
    lengths = np.linalg.norm(projected.residual, axis=1)
    return AdjustedBundle(bundle, system.deviation(projected.residual), float(np.median(lengths)), settled)


def camera_information(bundle: Bundle, seen: Sightings) -> NDArray[np.float64]:
    """(P, P) mean square by which movements of the cameras change what a still head's matches show, pixels.

    Points have followed the movement where they can. P as in `Freedom`.
    """
    modes, movements = np.zeros((len(bundle.points), 3, 0)), 7 * len(bundle.cameras) - 6
    projected = _project(bundle, seen, modes)
    # before a large movement all look like outliers
    small = replace(projected, residual=np.zeros_like(projected.residual))
    every = Freedom(np.eye(movements), np.zeros(movements), np.zeros(movements))
    system = _System.of(replace(bundle, moved=np.zeros(movements)), small, seen, every, modes)
    reduced, _ = system._reduced(system._inverse(0.0), 0.0)
    return np.asarray(reduced * seen.deviation**2 / len(seen.point))


def _project(bundle: Bundle, seen: Sightings, modes: NDArray) -> _Projected:
    points = bundle.points[seen.point]
    if modes.shape[2]:
        points = points + np.einsum("mck,mk->mc", modes[seen.point], bundle.expression[seen.timestep])
    head, camera = bundle.heads[seen.timestep], bundle.cameras[seen.camera]
    turned = np.einsum("mij,mj->mi", head[:, :3, :3], points)
    swung = np.einsum("mij,mj->mi", camera[:, :3, :3], turned + head[:, :3, 3])
    at = swung + camera[:, :3, 3]
    depth = np.where(at[:, 2:] > 0, at[:, 2:], np.nan)
    return _Projected(turned, swung, at, bundle.focal[seen.camera, None] * at[:, :2] / depth - seen.pixels)


def _weights(residual: NDArray, seen: Sightings) -> tuple[NDArray, NDArray]:
    """Cauchy's loss and the weight (M,) of each match."""
    squared = np.sum(residual**2, axis=1) / (CAUCHY * seen.deviation) ** 2
    return 0.5 * CAUCHY**2 * np.log1p(squared), 1.0 / (seen.deviation**2 * (1.0 + squared))


def _energy(bundle: Bundle, projected: _Projected, seen: Sightings, freedom: Freedom) -> float:
    """Infinite where a point comes to lie behind a camera."""
    loss = float(_weights(projected.residual, seen)[0].sum())
    prior = float(freedom.precision @ (bundle.moved - freedom.mean) ** 2)
    prior += float(np.sum((bundle.expression / EXPRESSION_DEVIATION) ** 2))
    return loss + 0.5 * prior if np.isfinite(loss) else np.inf


def _cross(v: NDArray) -> NDArray[np.float64]:
    """(M, 3, 3) derivative of turning points v (M, 3) by small rotation vectors."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [np.stack(row, axis=1) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))]
    return np.stack(rows, axis=1)


@dataclass(frozen=True)
class _System:
    """Normal equations: P variables of cameras, heads and expressions; points apart."""

    block: NDArray[np.float64]  # (P, P)
    right: NDArray[np.float64]  # (P,)
    mixed: NDArray[np.float64]  # (N, P, 3)
    points: NDArray[np.float64]  # (N, 3, 3)
    points_right: NDArray[np.float64]  # (N, 3)
    weight: NDArray[np.float64]  # (M,)
    focals: int

    @classmethod
    def of(cls, bundle: Bundle, projected: _Projected, seen: Sightings, freedom: Freedom, modes: NDArray) -> _System:
        cameras, steps, k = len(bundle.cameras), len(bundle.heads), modes.shape[2]
        head_at = 7 * cameras - 6
        face_at = head_at + 6 * (steps - 1)
        jacobian = np.zeros((len(seen.point), 2, face_at + k * (steps - 1)))
        at, residual = projected.seen, projected.residual
        focal = bundle.focal[seen.camera]
        slope = np.zeros((len(at), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = focal / at[:, 2]
        slope[:, :, 2] = -focal[:, None] * at[:, :2] / at[:, 2:] ** 2
        turned = slope @ bundle.cameras[seen.camera, :3, :3]
        by_point = turned @ bundle.heads[seen.timestep, :3, :3]
        for c in range(cameras):
            of, first = seen.camera == c, cameras + 6 * (c - 1)
            jacobian[of, :, c] = focal[of, None] * at[of, :2] / at[of, 2:]
            if c == 0:
                continue
            jacobian[of, :, first : first + 3] = slope[of] @ _cross(projected.swung[of])
            jacobian[of, :, first + 3 : first + 6] = slope[of]
        for t in range(1, steps):
            of, first = seen.timestep == t, head_at + 6 * (t - 1)
            jacobian[of, :, first : first + 3] = turned[of] @ _cross(projected.turned[of])
            jacobian[of, :, first + 3 : first + 6] = turned[of]
            first = face_at + k * (t - 1)
            jacobian[of, :, first : first + k] = by_point[of] @ modes[seen.point[of]]
        jacobian = np.concatenate([jacobian[..., :head_at] @ freedom.design, jacobian[..., head_at:]], axis=2)
        weight = _weights(residual, seen)[1]
        weighted = jacobian * weight[:, None, None]
        columns = jacobian.shape[2]
        block = weighted.reshape(2 * len(at), columns).T @ jacobian.reshape(2 * len(at), columns)
        right = weighted.reshape(2 * len(at), columns).T @ residual.ravel()
        rest = np.zeros(6 * (steps - 1))
        stiff = np.concatenate([freedom.precision, rest, np.full(k * (steps - 1), EXPRESSION_DEVIATION**-2.0)])
        right += stiff * np.concatenate([bundle.moved - freedom.mean, rest, bundle.expression[1:].ravel()])
        starts = np.flatnonzero(np.diff(seen.point, prepend=-1))
        by_weight = by_point * weight[:, None, None]
        return cls(
            block + np.diag(stiff),
            right,
            np.add.reduceat(weighted.transpose(0, 2, 1) @ by_point, starts),
            np.add.reduceat(by_weight.transpose(0, 2, 1) @ by_point, starts),
            np.add.reduceat(np.einsum("mkp,mk->mp", by_weight, residual), starts),
            weight,
            freedom.focals,
        )

    def _inverse(self, damping: float) -> NDArray[np.float64]:
        trace = np.einsum("nii->n", self.points) / 3.0
        return np.linalg.inv(self.points + ((damping + 1e-9) * trace + 1e-12)[:, None, None] * np.eye(3))

    def _reduced(self, inverse: NDArray, damping: float) -> tuple[NDArray, NDArray]:
        """The Schur complement of the points (P, P), and the mixed block times their inverse (N, P, 3)."""
        product, size = self.mixed @ inverse, len(self.block)
        flat = [np.ascontiguousarray(m.transpose(1, 0, 2)).reshape(size, 3 * len(m)) for m in (product, self.mixed)]
        return self.block + damping * np.diag(np.diag(self.block)) - flat[0] @ flat[1].T, product

    def step(self, damping: float) -> tuple[NDArray, NDArray]:
        """Changes of the P variables and of the points (N, 3)."""
        inverse = self._inverse(damping)
        reduced, product = self._reduced(inverse, damping)
        change = -np.linalg.solve(reduced, self.right - np.einsum("npq,nq->p", product, self.points_right))
        back = self.points_right + np.einsum("npq,p->nq", self.mixed, change)
        return change, -np.einsum("nij,nj->ni", inverse, back)

    def deviation(self, residual: NDArray) -> float:
        """As in `AdjustedBundle`; infinite where nothing determines a focal length."""
        if not self.focals:
            return 0.0
        reduced, _ = self._reduced(self._inverse(0.0), 0.0)
        variance = np.diag(np.linalg.pinv(reduced, hermitian=True))[: self.focals]
        freedom = 2 * len(residual) - 3 * len(self.points) - len(self.block)
        scale = float(self.weight @ np.sum(residual**2, axis=1)) / max(freedom, 1)
        return float(np.sqrt(variance.max() * scale)) if freedom > 0 and variance.min() > 0 else np.inf


def _moved(bundle: Bundle, change: NDArray, points: NDArray, freedom: Freedom) -> Bundle:
    cameras, steps, opened = len(bundle.cameras), len(bundle.heads), len(bundle.moved)
    movement, rest = freedom.design @ change[:opened], change[opened:]
    face_at = 6 * (steps - 1)
    expression = bundle.expression.copy()
    expression[1:] += rest[face_at:].reshape(expression[1:].shape)
    return replace(
        bundle,
        focal=bundle.focal * np.exp(np.clip(movement[:cameras], -0.5, 0.5)),
        cameras=_turned(bundle.cameras, movement[cameras:]),
        heads=_turned(bundle.heads, rest[:face_at]),
        points=bundle.points + points,
        expression=expression,
        moved=bundle.moved + change[:opened],
    )


def _turned(poses: NDArray, change: NDArray) -> NDArray[np.float64]:
    """Poses of which all but the first are turned and shifted by ``change`` (6 numbers each)."""
    out = poses.copy()
    change = change.reshape(-1, 6)
    if len(change):
        out[1:, :3, :3] = Rotation.from_rotvec(change[:, :3]).as_matrix() @ poses[1:, :3, :3]
        out[1:, :3, 3] += change[:, 3:]
    return out
