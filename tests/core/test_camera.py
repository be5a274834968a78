"""Pinhole cameras: projection, rays and axes agree with each other."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.core.camera import Camera


def _camera() -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [10, -20, 5], degrees=True).as_matrix()
    pose[:3, 3] = (1.0, -2.0, 60.0)
    return Camera("c", 64, 48, 100.0, 101.0, 31.0, 25.0, pose)


def test_rays_go_through_the_points_that_project_to_their_pixels() -> None:
    camera = _camera()
    pixels = np.array([[0.5, 0.5], [63.5, 47.5], [31.0, 25.0], [10.0, 40.0]])
    points = camera.position + 57.0 * camera.pixel_rays(pixels)
    np.testing.assert_allclose(camera.project(points), pixels, atol=1e-9)


def test_points_behind_the_camera_have_no_projection() -> None:
    camera = _camera()
    behind = camera.position - 5.0 * camera.pixel_rays(np.array([[31.0, 25.0]]))
    assert np.isnan(camera.project(behind)).all()


def test_pixel_centres_lie_half_a_pixel_in() -> None:
    centres = _camera().pixel_centres()
    assert centres.shape == (48, 64, 2)
    assert centres[0, 0].tolist() == [0.5, 0.5]
    assert centres[2, 3].tolist() == [3.5, 2.5]


def test_opengl_matrix_looks_down_minus_z_with_y_up() -> None:
    camera = _camera()
    matrix = camera.camera_to_world_opengl
    np.testing.assert_allclose(matrix[:3, 3], camera.position, atol=1e-12)
    forward = camera.pixel_rays(np.array([[camera.cx, camera.cy]]))[0]
    np.testing.assert_allclose(-matrix[:3, 2], forward, atol=1e-12)
    up = camera.pixel_rays(np.array([[camera.cx, camera.cy - 10.0]]))[0] - forward
    assert up @ matrix[:3, 1] > 0
