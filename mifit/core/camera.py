"""Pinhole cameras with OpenCV distortion.

Conventions
-----------
Pixel coordinates put the centre of the top-left pixel at (0.5, 0.5), as COLMAP and nerfstudio do; OpenCV's
integer-centred principal point is 0.5 smaller. Camera axes are OpenCV's: x right, y down, z forward.
nerfstudio's ``transform_matrix`` has OpenGL axes (y up, z backward) and is converted where it is read.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from mifit.core.arrays import same
from mifit.core.calls import finite, whole
from mifit.core.limits import MAX_PIXELS
from mifit.errors import InputError

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Parameters
    ----------
    width, height : int
        Image size in pixels.
    fx, fy, cx, cy : float
        Focal lengths and principal point in pixels (first pixel's centre at 0.5).
    world_to_camera : (4, 4) float64
        Rigid transform from world to camera, OpenCV axes, in the capture's units.
    distortion : tuple of float
        ``(k1, k2, p1, p2)`` or OpenCV's longer forms; empty for an undistorted camera.

    Raises
    ------
    InputError
        A size, focal length or pose that no camera has.

    Examples
    --------
    >>> camera = Camera.look_at(eye=(0, 0, 70), width=680, height=480)
    >>> camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0]])).round(1)
    array([[340. , 240. ],
           [340. , -35.5]])
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64] = field(repr=False)
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        name = f"camera {self.name!r}"
        for size in (self.width, self.height):
            whole(size, 1, f"{name}: width and height")
        if not (0 < self.fx < math.inf and 0 < self.fy < math.inf):
            raise InputError(f"{name}: found focal lengths {self.fx:g}, {self.fy:g}, expected positive numbers")
        finite((self.cx, self.cy, *self.distortion), (-1,), f"{name}: principal point and distortion")
        pose = finite(self.world_to_camera, (4, 4), f"{name}: world_to_camera")
        if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-2):
            raise InputError(f"{name}: world_to_camera: found no rotation in its first three columns, expected one")
        object.__setattr__(self, "world_to_camera", pose)

    def __eq__(self, other: object) -> bool:
        return same(self, other) if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.name, self.width, self.height, self.fx, self.fy, self.cx, self.cy))

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike = (0.0, 0.0, 0.0),
        up: ArrayLike = (0.0, 1.0, 0.0),
        width: int = 680,
        height: int = 480,
        fov: float = 20.0,
        name: str = "view",
    ) -> Camera:
        """A camera at ``eye`` that looks at ``target`` (3,), with square pixels and the principal point in the middle.

        ``up`` is the world direction that is up in the image; ``fov`` the horizontal field of view in degrees, above 0
        and below 180. InputError for a field of view out of range, or no view: eye at the target, or ``up`` along the
        view.
        """
        if not 0.0 < fov < 180.0:
            raise InputError(f"fov: found {fov}, expected degrees above 0 and below 180")
        start = finite(eye, (3,), "eye")
        forward = finite(target, (3,), "target") - start
        right = np.cross(forward, finite(up, (3,), "up"))
        lengths = np.linalg.norm(forward), np.linalg.norm(right)
        if not min(lengths) > 1e-9 * max(1.0, *np.abs(start)):
            raise InputError(f"look_at: found eye {eye!r}, target {target!r}, up {up!r}, expected a view")
        forward, right = forward / lengths[0], right / lengths[1]
        turn = np.stack([right, np.cross(forward, right), forward])
        focal = 0.5 * width / math.tan(math.radians(0.5 * fov))
        return cls(name, width, height, focal, focal, 0.5 * width, 0.5 * height, rigid(turn, -turn @ start))

    def orbit(
        self,
        yaw: float = 0.0,
        pitch: float = 0.0,
        target: ArrayLike = (0.0, 0.0, 0.0),
        up: ArrayLike = (0.0, 1.0, 0.0),
        distance: float | None = None,
        name: str | None = None,
    ) -> Camera:
        """This camera moved about the world point ``target`` (3,), which stays where it is in the image.

        ``yaw`` is in degrees about ``up``, positive ones move the camera to its right; ``pitch`` in degrees upwards,
        after the yaw; ``distance`` from the target, the capture's units, by default as it is. The name is by default
        this camera's with the angles. InputError for a distance that isn't positive, angles or vectors that aren't
        finite, or an ``up`` of no length.
        """
        if distance is not None and not 0 < distance < math.inf:
            raise InputError(f"distance: found {distance}, expected a number above 0")
        finite((yaw, pitch), (2,), "yaw, pitch")
        centre, axis = finite(target, (3,), "target"), finite(up, (3,), "up")
        if not axis.any() or (distance is not None and np.array_equal(centre, self.position)):
            raise InputError(f"orbit: found up {up!r}, target {target!r}, expected an axis and a place off the camera")
        turn = _about(axis, yaw)
        turn = _about(turn @ self.rotation[0], -pitch) @ turn
        away = turn @ (self.position - centre)
        if distance is not None:
            away *= distance / np.linalg.norm(away)
        rotation = self.rotation @ turn.T
        pose = rigid(rotation, -rotation @ (centre + away))
        return replace(self, name=name or f"{self.name}{yaw:+g}{pitch:+g}", world_to_camera=pose)

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) rotation, world to camera."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> NDArray[np.float64]:
        """(3,) translation, world to camera."""
        return self.world_to_camera[:3, 3]

    @property
    def position(self) -> NDArray[np.float64]:
        """(3,) optical centre in world space."""
        return -self.rotation.T @ self.translation

    @property
    def camera_to_world_opengl(self) -> NDArray[np.float64]:
        """(4, 4) camera-to-world matrix with OpenGL axes: nerfstudio's ``transform_matrix``."""
        return inverse(self.world_to_camera) @ OPENGL_FROM_OPENCV

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) intrinsic matrix for this module's pixel convention."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, factor: float) -> Camera:
        """This camera with an image of another size: ``factor`` pixels per pixel, to the nearest whole number.

        InputError for a factor that leaves no image, or too large a one.
        """
        if not 0 < factor * max(self.width, self.height) <= MAX_PIXELS:
            raise InputError(f"resized: found factor {factor}, expected one above 0 that leaves an image")
        width, height = (max(round(n * factor), 1) for n in (self.width, self.height))
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, cx=self.cx * x, fy=self.fy * y, cy=self.cy * y)

    def to_camera(self, points: NDArray) -> NDArray:
        """Camera points (..., 3) of world points (..., 3)."""
        return np.asarray(points) @ self.rotation.T + self.translation

    def project(self, points: NDArray) -> NDArray:
        """Ideal (undistorted) pixel coordinates (..., 2) of world points (..., 3).

        A point on or behind the camera plane gives NaN.
        """
        p = self.to_camera(np.asarray(points, dtype=np.float64))
        z = np.where(p[..., 2] > 1e-12, p[..., 2], np.nan)
        return np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], axis=-1)

    def pixel_rays(self, pixels: NDArray) -> NDArray:
        """Unit world-space directions (..., 3) away from the camera through ``pixels`` (..., 2).

        InputError for another shape.
        """
        pixels = np.asarray(pixels)
        if pixels.shape[-1:] != (2,):
            raise InputError(f"pixels: found shape {pixels.shape}, expected (..., 2)")
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        length = np.sqrt(x * x + y * y + 1.0)
        return np.stack([x / length, y / length, 1.0 / length], axis=-1) @ self.rotation

    def pixel_centres(self) -> NDArray[np.float64]:
        """(H, W, 2) coordinates of all pixel centres."""
        y, x = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack([x + 0.5, y + 0.5], axis=-1)


def rigid(rotation: ArrayLike, shift: ArrayLike = 0.0) -> NDArray[np.float64]:
    """(..., 4, 4) transforms that turn by rotations (..., 3, 3) and then move by shifts (..., 3)."""
    turn = np.asarray(rotation, dtype=np.float64)
    out = np.zeros((*turn.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = turn, shift, 1.0
    return out


def inverse(pose: NDArray) -> NDArray[np.float64]:
    """(4, 4) the inverse of a rigid transform (4, 4)."""
    turn = pose[:3, :3].T
    return rigid(turn, -turn @ pose[:3, 3])


def _about(axis: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    """(3, 3) rotation about an axis by the right-hand rule."""
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
