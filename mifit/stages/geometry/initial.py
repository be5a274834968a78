"""A first pose from landmarks: perspective-n-point per view and triangulation across views; the best one wins."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera


def triangulate(cameras: Sequence[Camera], pixels: Sequence[NDArray]) -> NDArray[np.float64]:
    """World points seen at given pixels: linear triangulation (Hartley and Zisserman, 12.2).

    Parameters
    ----------
    cameras : sequence of K cameras
    pixels : sequence of K arrays (n, 2)
        NaN where a camera doesn't see the point.

    Returns
    -------
    (n, 3)
        NaN where fewer than two cameras see the point.
    """
    rows = []
    for camera, pixel in zip(cameras, pixels, strict=True):
        ideal = (pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        p = camera.world_to_camera[:3]
        rows.append(ideal[:, :1] * p[2] - p[0])
        rows.append(ideal[:, 1:] * p[2] - p[1])
    stack = np.stack(rows, axis=1)  # (n, 2K, 4)
    seen = np.isfinite(stack[..., 0])
    enough = seen.sum(1) >= 4
    stack = np.where(seen[..., None], stack, 0.0)
    out = np.full((len(stack), 3), np.nan)
    if enough.any():
        homogeneous = np.linalg.svd(stack[enough])[2][:, -1]
        with np.errstate(divide="ignore", invalid="ignore"):
            out[enough] = homogeneous[:, :3] / homogeneous[:, 3:]
    return out


def align(source: NDArray, target: NDArray, scale: float) -> tuple[NDArray, NDArray]:
    """Rotation and translation with ``target = scale * R @ source + t`` in the least-squares sense (Umeyama 1991)."""
    a, b = source.mean(0), target.mean(0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation, b - scale * rotation @ a


def pose_candidates(
    cameras: Sequence[Camera], points: NDArray, pixels: Sequence[NDArray], scale: float
) -> list[tuple[NDArray, NDArray]]:
    """Poses that explain some of the landmarks.

    Parameters
    ----------
    points : (n, 3)
        Landmarks of the mean model, object space.
    pixels : sequence of (n, 2)
        Per camera, NaN where not seen.

    Returns
    -------
    list of (rotation (3, 3), translation (3,))
    """
    out = []
    world = triangulate(cameras, pixels)
    known = np.isfinite(world).all(1)
    if known.sum() >= 4:
        rotation, translation = align(points[known], world[known], scale)
        error = np.linalg.norm(world - scale * points @ rotation.T - translation, axis=1)
        good = known & (error <= 2.5 * np.median(error[known]))  # once more without gross outliers
        out.append(align(points[good], world[good], scale) if good.sum() >= 4 else (rotation, translation))
    for camera, pixel in zip(cameras, pixels, strict=True):
        seen = np.isfinite(pixel).all(1)
        if seen.sum() < 6:
            continue
        # a robust reprojection count first, so that outliers don't decide; the exact solution follows by LM
        try:
            ok, vector, shift, _ = cv2.solvePnPRansac(
                scale * points[seen],
                pixel[seen],
                camera.matrix,
                None,
                reprojectionError=0.03 * max(camera.width, camera.height),
                flags=cv2.SOLVEPNP_SQPNP,
            )
        except cv2.error:  # points that coincide
            continue
        if not ok or not np.isfinite(vector).all():
            continue
        head_to_camera = cv2.Rodrigues(vector)[0]
        rotation = camera.rotation.T @ head_to_camera
        out.append((rotation, camera.rotation.T @ (shift[:, 0] - camera.translation)))
    return out


def best_pose(
    cameras: Sequence[Camera],
    points: NDArray,
    pixels: Sequence[NDArray],
    scale: float,
    distance: float,
    more: Sequence[tuple[NDArray, NDArray]] = (),
) -> tuple[NDArray, NDArray]:
    """The pose of least median pixel distance over all views; parameters and result as for `pose_candidates`.

    One of its candidates, or of ``more``. Landmarks too thinly spread for any closed form: facing the first camera, at
    a ``distance``, world length.
    """

    def apart(pose: tuple[NDArray, NDArray]) -> float:
        world = scale * points @ pose[0].T + pose[1]
        each = [np.linalg.norm(c.project(world) - p, axis=1) for c, p in zip(cameras, pixels, strict=True)]
        shown = np.concatenate(each)[np.isfinite(np.concatenate(pixels)[:, 0])]
        return float(np.median(np.where(np.isfinite(shown), shown, np.inf))) if len(shown) else np.inf

    first = cameras[0]
    facing = first.rotation.T @ np.diag([1.0, -1.0, -1.0]), first.position + distance * first.rotation[2]
    return min([*(pose_candidates(cameras, points, pixels, scale) or [facing]), *more], key=apart)
