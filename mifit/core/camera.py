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
from numpy.typing import NDArray

from mifit.errors import InputError

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    Parameters
    ----------
    name : str
        Camera identifier, e.g. ``"left"``.
    width, height : int
        Image size in pixels.
    fx, fy, cx, cy : float
        Focal lengths and principal point in pixels (first pixel's centre at 0.5).
    world_to_camera : (4, 4) float64
        Rigid transform from world to camera, OpenCV axes, in the capture's units.
    distortion : tuple of float
        ``(k1, k2, p1, p2)`` or OpenCV's longer forms; empty for an undistorted camera.
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
        if min(self.width, self.height) < 1 or not (0 < self.fx < math.inf and 0 < self.fy < math.inf):
            raise InputError(
                f"camera {self.name!r}: found {self.width} x {self.height} pixels and focal lengths {self.fx:g}, "
                f"{self.fy:g}, expected positive numbers"
            )

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
        inverse = np.eye(4)
        inverse[:3, :3] = self.rotation.T
        inverse[:3, 3] = self.position
        return inverse @ OPENGL_FROM_OPENCV

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) intrinsic matrix for this module's pixel convention."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def with_square_pixels(self) -> Camera:
        """This view with rows as high as columns are wide, for programs that know square pixels only.

        Centre, axes and fx stay, fy becomes fx, and the number of rows grows or shrinks with it, rounded up: shrunk or
        stretched to the old height the image is this camera's, up to the last row's fraction.
        """
        if self.fx == self.fy:
            return self
        ratio = self.fx / self.fy
        rows = max(1, math.ceil(self.height * ratio - 1e-6))
        return replace(self, height=rows, fy=self.fx, cy=self.cy * ratio)

    def to_camera(self, points: NDArray) -> NDArray:
        """World points (..., 3) -> camera points (..., 3)."""
        return points @ self.rotation.T + self.translation

    def project(self, points: NDArray) -> NDArray:
        """World points (..., 3) -> ideal (undistorted) pixel coordinates (..., 2).

        A point on or behind the camera plane gives NaN.
        """
        p = self.to_camera(np.asarray(points, dtype=np.float64))
        z = np.where(p[..., 2] > 1e-12, p[..., 2], np.nan)
        return np.stack([self.fx * p[..., 0] / z + self.cx, self.fy * p[..., 1] / z + self.cy], axis=-1)

    def pixel_rays(self, pixels: NDArray) -> NDArray:
        """Pixel coordinates (..., 2) -> unit world-space directions (..., 3) away from the camera."""
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        d = np.stack([x, y, np.ones_like(x)], axis=-1)
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        return d @ self.rotation

    def pixel_centres(self) -> NDArray[np.float64]:
        """(H, W, 2) coordinates of all pixel centres."""
        y, x = np.mgrid[0 : self.height, 0 : self.width]
        return np.stack([x + 0.5, y + 0.5], axis=-1)
