"""Visibility: what lies beside the fitted head is told from the head by the other views."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.sampling.visibility import OUTLIER, background, footprint, outlier_prior, outline_distance
from tests.output.conftest import ball_camera

SKIN = (0.5, 0.3, 0.25)


def test_doubt_rises_to_the_outline_and_with_the_angle() -> None:
    cosine, distance = np.linspace(1, 0, 9), np.linspace(60, 0, 9)
    assert (np.diff(outlier_prior(cosine, np.full(9, 1e3))) > 0).all()
    assert (np.diff(outlier_prior(np.ones(9), distance)) > 0).all()
    assert outlier_prior(np.array(1.0), np.array(1e3)) == pytest.approx(OUTLIER[0])


def test_outlines_are_steps_of_depth_not_slopes() -> None:
    depth = np.full((20, 30), np.inf, np.float32)
    depth[:, 5:] = 10.0 + 0.5 * np.arange(25)  # a steep plane beside nothing
    depth[:, 15:] -= 3.0  # and before itself
    distance = outline_distance(depth, 1.0)
    assert (distance[:, :6] == 0).all() and (distance[:, 14:16] == 0).all()
    assert distance[10, 10] == pytest.approx(4.0, abs=0.3) and distance[10, 25] > 8
    assert (outline_distance(np.full((4, 4), np.inf, np.float32), 1.0) == 0).all()
    assert (outline_distance(np.ones((4, 4), np.float32), 1.0) > 1e3).all()


def test_background_over_a_head_that_is_too_wide_is_found_and_the_face_is_not() -> None:
    image = np.full((60, 80, 3), 0.02)
    image[15:, 25:60] = SKIN
    hit = np.zeros((60, 80), bool)
    hit[5:, 20:65] = True  # the mesh is wider than the head
    face = np.zeros_like(hit)
    face[30:, 20:50] = True
    found = background(image, hit, face)
    truth = np.zeros_like(hit)
    truth[5:11, 20:65] = truth[5:, 62:65] = True  # three pixels off the head's edge
    assert not (found & face).any()
    inner = np.zeros_like(hit)
    inner[18:, 28:57] = True
    assert not (found & inner).any()
    assert found[truth].mean() > 0.8
    edge = np.zeros_like(hit)
    edge[13:15, 25:60] = True  # still background, but blurred into the head
    assert found[edge & hit].all()
    dark = image.copy()
    dark[25:35, 35:45] = 0.02  # as dark as the background, but joined to nothing of it
    assert not background(dark, hit, face)[27:33, 37:43].any()
    assert not background(image, np.ones_like(hit), face).any()


def test_the_back_of_a_face_covers_no_pixels() -> None:
    camera = ball_camera(angle=0.0)
    corners, front = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
    pixels = 0.5 * (camera.fx / 70.0) ** 2
    assert footprint(corners, front, camera, np.array([2.0]))[0] == pytest.approx(0.5 * pixels)
    assert footprint(corners, front[:, ::-1], camera, np.array([2.0]))[0] == 0.0
