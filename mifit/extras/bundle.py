"""Bundle adjustment of tracks on a head that moves before fixed cameras and changes its expression.

Unknown are focal lengths, poses of the cameras, a head pose per timestep, points in the head's frame, free of any face
model, and how each timestep's expression differs from the first one's, in the model's modes with a Gaussian prior.
Levenberg-Marquardt on Cauchy's loss; points are eliminated by the Schur complement (Triggs et al., Bundle adjustment,
2000).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.optim import Outcome, minimize
from mifit.stages.checks.landmark_model import EXPRESSION_DEVIATION
from mifit.stages.geometry.parameters import cross_matrix, left_jacobian

CAUCHY = 1.5
"""Deviations of a match where the robust loss turns."""


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
    """How C cameras may move: by ``design`` (7 C, R) times z, with a Gaussian prior on z.

    It gives the C logarithms of focal lengths, then turn and shift of each camera, camera axes. ``mean`` (R,) and
    ``precision`` (R, R) are the prior's; a precision of 0: nothing is known.
    """

    design: NDArray[np.float64]
    mean: NDArray[np.float64]
    precision: NDArray[np.float64]

    @classmethod
    def of_focals(cls, group: NDArray, focal: NDArray, expected: NDArray, deviation: float) -> Freedom:
        """Free poses but the first, and focal lengths (C,) that cameras of a ``group`` share; -1: a known one.

        ``expected`` (G,) are the groups' focal lengths beforehand, with this deviation of their logarithms.
        """
        cameras, count = len(group), len(expected)
        design = np.zeros((7 * cameras, count + 6 * (cameras - 1)))
        design[:cameras, :count] = group[:, None] == np.arange(count)
        design[cameras + 6 :, count:] = np.eye(6 * (cameras - 1))
        mean, precision = np.zeros((2, design.shape[1]))
        mean[:count] = [np.log(expected[g] / focal[group == g][0]) for g in range(count)]
        precision[:count] = deviation**-2.0
        return cls(design, mean, np.diag(precision))


@dataclass(frozen=True)
class Bundle:
    """Cameras and a moving head; OpenCV axes. The pose at timestep 0 stays as it is: it fixes the gauge.

    ``focal`` (C,) is in pixels; ``cameras`` (C, 4, 4) go from a common frame, such as the first camera's, to each
    camera's, ``heads`` (T, 4, 4) from the head's frame to the common one. ``points`` (N, 3) are in the head's frame at
    timestep 0, and coefficients ``expression`` (T, K) relative to it.
    """

    focal: NDArray[np.float64]
    cameras: NDArray[np.float64]
    heads: NDArray[np.float64]
    points: NDArray[np.float64]
    expression: NDArray[np.float64]


@dataclass(frozen=True)
class AdjustedBundle:
    """A bundle at the optimum, or where the iterations ended, which ``settled`` says.

    ``movement`` (R,) is what cameras were moved by, in the order of the freedom's design, and ``deviations`` (R,) its
    standard deviations from the normal equations with all else eliminated, scaled by the residuals. Errors that matches
    share aren't in them. ``energy`` is that of matches and priors, ``residual`` the median distance of a point from its
    match, pixels.
    """

    bundle: Bundle
    movement: NDArray[np.float64]
    deviations: NDArray[np.float64]
    energy: float
    residual: float
    settled: bool


def adjust_bundle(start: Bundle, seen: Sightings, freedom: Freedom, modes: NDArray | None = None) -> AdjustedBundle:
    """Bring projections onto matches; ``modes`` (N, 3, K) are how expressions move the points, none by default."""
    modes = np.zeros((len(start.points), 3, 0)) if modes is None else modes
    problem = _Problem(start, seen, freedom, modes)
    solution = minimize(problem, problem.start(), energy_tolerance=1e-5)
    residual, opened = problem.project(solution.value).residual, freedom.design.shape[1]
    variance = np.diag(problem.linearize(solution.value).inverse(np.eye(len(solution.value), opened))[:opened])
    scale = problem.weights(residual)[1] @ np.sum(residual**2, axis=1) / max(residual.size - opened, 1)
    energies = problem.energies(solution.value)
    return AdjustedBundle(
        problem.bundle(solution.value),
        solution.value[:opened],
        np.sqrt(np.where(variance > 0, variance, np.inf) * scale),
        energies["matches"] + energies["prior"],
        float(np.median(np.linalg.norm(residual, axis=1))),
        solution.outcome in (Outcome.CONVERGED, Outcome.STALLED),
    )


@dataclass(frozen=True)
class _Projected:
    turned: NDArray[np.float64]  # (M, 3) points turned as the head is
    swung: NDArray[np.float64]  # (M, 3) and as the camera is
    seen: NDArray[np.float64]  # (M, 3) in the camera's frame
    residual: NDArray[np.float64]  # (M, 2) pixels


@dataclass(frozen=True)
class _Problem:
    """Unknowns, in this order: z, movements of all heads but the first, their expressions, points."""

    origin: Bundle
    seen: Sightings
    freedom: Freedom
    modes: NDArray[np.float64]

    def start(self) -> NDArray[np.float64]:
        moved = np.zeros(self.freedom.design.shape[1] + 6 * len(self.origin.heads) - 6)
        return np.concatenate([moved, self.origin.expression[1:].ravel(), self.origin.points.ravel()])

    def split(self, x: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
        """Z, focal movements (C,), camera movements (C, 6), head movements (T - 1, 6), expressions (T - 1, K)."""
        opened, cameras, steps = self.freedom.design.shape[1], len(self.origin.cameras), len(self.origin.heads) - 1
        movement = self.freedom.design @ x[:opened]
        heads, rest = np.split(x[opened : len(x) - self.origin.points.size], [6 * steps])
        expressions = rest.reshape(steps, self.modes.shape[2])
        return x[:opened], movement[:cameras], movement[cameras:].reshape(-1, 6), heads.reshape(-1, 6), expressions

    def bundle(self, x: NDArray) -> Bundle:
        _, focals, cameras, heads, expressions = self.split(x)
        return Bundle(
            self.origin.focal * np.exp(focals),
            _moved(self.origin.cameras, cameras),
            np.concatenate([self.origin.heads[:1], _moved(self.origin.heads[1:], heads)]),
            x[len(x) - self.origin.points.size :].reshape(-1, 3),
            np.concatenate([self.origin.expression[:1], expressions]),
        )

    def project(self, x: NDArray) -> _Projected:
        bundle, seen = self.bundle(x), self.seen
        points = bundle.points[seen.point]
        if self.modes.shape[2]:
            points = points + np.einsum("mck,mk->mc", self.modes[seen.point], bundle.expression[seen.timestep])
        head, camera = bundle.heads[seen.timestep], bundle.cameras[seen.camera]
        turned = np.einsum("mij,mj->mi", head[:, :3, :3], points)
        swung = np.einsum("mij,mj->mi", camera[:, :3, :3], turned + head[:, :3, 3])
        at = swung + camera[:, :3, 3]
        depth = np.where(at[:, 2:] > 0, at[:, 2:], np.nan)  # an energy of NaN is refused
        return _Projected(turned, swung, at, bundle.focal[seen.camera, None] * at[:, :2] / depth - seen.pixels)

    def weights(self, residual: NDArray) -> tuple[NDArray, NDArray]:
        """Cauchy's loss and the weight (M,) of each match."""
        squared = np.sum(residual**2, axis=1) / (CAUCHY * self.seen.deviation) ** 2
        return CAUCHY**2 * np.log1p(squared), 1.0 / (self.seen.deviation**2 * (1.0 + squared))

    def energies(self, x: NDArray) -> dict[str, float]:
        z, *_, expressions = self.split(x)
        off = z - self.freedom.mean
        prior = float(off @ self.freedom.precision @ off + np.sum((expressions / EXPRESSION_DEVIATION) ** 2))
        matches = float(self.weights(self.project(x).residual)[0].sum())
        # the last is constant: without noise an energy falls for ever
        return {"matches": matches, "prior": prior, "noise": 0.1 * len(self.seen.point)}

    def linearize(self, x: NDArray) -> _System:
        z, _, camera_moves, head_moves, expressions = self.split(x)
        bundle, projected, seen = self.bundle(x), self.project(x), self.seen
        cameras, k = len(bundle.cameras), self.modes.shape[2]
        head_at = 7 * cameras
        face_at = head_at + head_moves.size
        shared = np.zeros((len(seen.point), 2, face_at + expressions.size))
        at, focal = projected.seen, bundle.focal[seen.camera]
        slope = np.zeros((len(at), 2, 3))
        slope[:, 0, 0] = slope[:, 1, 1] = focal / at[:, 2]
        slope[:, :, 2] = -focal[:, None] * at[:, :2] / at[:, 2:] ** 2
        turned = slope @ bundle.cameras[seen.camera, :3, :3]
        by_point = turned @ bundle.heads[seen.timestep, :3, :3]
        for c, move in enumerate(camera_moves):
            of, first = seen.camera == c, cameras + 6 * c
            shared[of, :, c] = focal[of, None] * at[of, :2] / at[of, 2:]
            shared[of, :, first : first + 6] = _by_pose(slope[of], projected.swung[of], move)
        for t, move in enumerate(head_moves):
            of, first, face = seen.timestep == t + 1, head_at + 6 * t, face_at + k * t
            shared[of, :, first : first + 6] = _by_pose(turned[of], projected.turned[of], move)
            shared[of, :, face : face + k] = by_point[of] @ self.modes[seen.point[of]]
        shared = np.concatenate([shared[..., :head_at] @ self.freedom.design, shared[..., head_at:]], axis=2)
        rows, own = np.arange(at[:, :2].size).reshape(-1, 2, 1), 3 * seen.point[:, None, None] + np.arange(3)
        places = np.broadcast_to(rows, by_point.shape).ravel(), np.broadcast_to(own, by_point.shape).ravel()
        points = sp.csr_matrix((by_point.ravel(), places), (rows.size, bundle.points.size))
        jacobian = sp.hstack([sp.csr_matrix(shared.reshape(rows.size, -1)), points]).tocsr()
        weighted = sp.diags(np.repeat(self.weights(projected.residual)[1], 2)) @ jacobian
        columns, opened = shared.shape[2], len(z)
        stiff = np.repeat([0.0, EXPRESSION_DEVIATION**-2.0], [head_moves.size, expressions.size])
        prior = sp.block_diag([self.freedom.precision, np.diag(stiff), sp.csr_matrix((x.size - columns,) * 2)])
        gradient = weighted.T @ projected.residual.ravel()
        gradient[:opened] += self.freedom.precision @ (z - self.freedom.mean)
        gradient[opened:columns] += stiff * x[opened:columns]
        return _System((jacobian.T @ weighted + prior).tocsr(), gradient, columns)


@dataclass
class _System:
    """Normal equations as `mifit.optim` wants them; no unknown is bounded, and points come last."""

    hessian: sp.csr_matrix
    gradient: NDArray[np.float64]
    shared: int

    def product(self, step: NDArray) -> NDArray[np.float64]:
        return np.asarray(self.hessian @ step)

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        return -self.inverse(self.gradient if gradient is None else gradient, damping)

    def inverse(self, right: NDArray, damping: float = 0.0) -> NDArray[np.float64]:
        """Of the damped matrix, times columns, by the Schur complement of the points' blocks.

        The scale, which nothing determines, is held by a billionth of the diagonal.
        """
        p, diagonal = self.shared, self.hessian.diagonal()
        damped = self.hessian + sp.diags((damping + 1e-9) * np.maximum(diagonal, 1e-9 * diagonal.max()))
        points = damped[p:, p:].tobsr((3, 3))
        inverse = sp.bsr_matrix((np.linalg.inv(points.data), points.indices, points.indptr))
        mixed = damped[:p, p:].toarray()
        product = mixed @ inverse
        schur = damped[:p, :p].toarray() - product @ mixed.T
        shared = np.linalg.solve(schur, right[:p] - product @ right[p:])
        return np.concatenate([shared, inverse @ (right[p:] - mixed.T @ shared)])


def _by_pose(slope: NDArray, turned: NDArray, move: NDArray) -> NDArray[np.float64]:
    """(M, 2, 6) derivative of pixels by a pose's turn and shift, from that by places (M, 2, 3)."""
    return np.concatenate([-slope @ cross_matrix(turned) @ left_jacobian(move[:3]), slope], axis=2)


def _moved(poses: NDArray, moves: NDArray) -> NDArray[np.float64]:
    """Poses (N, 4, 4) turned and shifted by 6 numbers each."""
    out = poses.copy()
    if len(moves):
        out[:, :3, :3] = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ poses[:, :3, :3]
        out[:, :3, 3] += moves[:, 3:]
    return out
