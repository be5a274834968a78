"""Pictures of a calibration board through cameras with lens distortion, rendered from its texture."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.capture.lens import opencv_matrix
from mifit.core.camera import Camera
from mifit.extras.boards import Board

FINER = 2
"""Samples across a pixel."""


def pair() -> tuple[Camera, Camera]:
    """Two cameras half a metre apart that look at one place, in millimetres; nothing about them is round."""
    second = np.eye(4)
    second[:3, :3] = Rotation.from_euler("yxz", [24.0, -3.0, 2.0], degrees=True).as_matrix()
    second[:3, 3] = (-240.0, 12.0, 61.0)
    return (
        Camera("a", 640, 480, 811.3, 806.1, 327.4, 233.8, np.eye(4), (-0.21, 0.08, 0.0012, -0.0007)),
        Camera("b", 640, 480, 765.2, 768.9, 309.1, 246.3, second, (0.11, -0.19, -0.0009, 0.0015)),
    )


def poses(count: int, board: Board, distance: float, seed: int = 0) -> list[NDArray[np.float64]]:
    """Board-to-world transforms: the board wanders and tilts in front of the cameras."""
    rng = np.random.default_rng(seed)
    width, height = board.extent
    found = []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler(
            "yxz", [-12 + rng.uniform(-38, 38), rng.uniform(-38, 38), rng.uniform(-30, 30)], degrees=True
        ).as_matrix()
        centre = np.array([rng.uniform(-0.26, 0.26), rng.uniform(-0.2, 0.2), 1.0]) * distance * rng.uniform(0.85, 1.3)
        pose[:3, 3] = centre - pose[:3, :3] @ (width / 2, height / 2, 0.0)
        found.append(pose)
    return found


@functools.cache
def _rays(matrix: bytes, distortion: tuple[float, ...], width: int, height: int) -> NDArray[np.float64]:
    """Undistorted rays (N, 3) of all samples of a camera; a second's work, and there are two cameras."""
    n = FINER
    x, y = np.meshgrid((np.arange(width * n) + 0.5) / n - 0.5, (np.arange(height * n) + 0.5) / n - 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], 1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    flat = cv2.undistortPoints(pixels, np.frombuffer(matrix).reshape(3, 3), np.array(distortion), criteria=criteria)
    return np.concatenate([flat.reshape(-1, 2), np.ones((len(pixels), 1))], axis=1)


@dataclass
class Studio:
    """Renders a board for one camera."""

    board: Board
    camera: Camera
    noise: float = 1.5

    def __post_init__(self) -> None:
        camera = self.camera
        self._rays = _rays(opencv_matrix(camera).tobytes(), camera.distortion, camera.width, camera.height)
        self._scale = 4.0
        margin = round(12 * self._scale)
        self._margin = margin
        self._texture = cv2.GaussianBlur(
            np.pad(self.board.image(self._scale), margin, constant_values=255), (0, 0), 0.8
        )

    def render(self, board_to_world: NDArray[np.float64], seed: int = 0, blur: float = 0.0) -> NDArray[np.uint8]:
        """8-bit RGB image (H, W, 3) of the board in front of a grey wall; ``blur`` in pixels."""
        m = self.camera.world_to_camera @ board_to_world
        plane = np.linalg.inv(np.stack([m[:3, 0], m[:3, 1], m[:3, 3]], axis=1))
        found = self._rays @ plane.T
        place = found[:, :2] / found[:, 2:] * self._scale + self._margin - 0.5
        behind = found[:, 2] <= 0
        place[behind] = -1e4
        shape = (self.camera.height * FINER, self.camera.width * FINER)
        x, y = (place[:, i].reshape(shape).astype(np.float32) for i in (0, 1))
        image = cv2.remap(self._texture.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=90.0)
        image = 25 + 0.8 * image.reshape(self.camera.height, FINER, self.camera.width, FINER).mean((1, 3))
        if blur:
            image = cv2.GaussianBlur(image, (0, 0), blur)
        image = image + self.noise * np.random.default_rng(seed).standard_normal(image.shape)
        return np.repeat(np.clip(np.round(image), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
