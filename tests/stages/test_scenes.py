"""Scenes that are kept from one look to the next."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.stages.geometry.surfaces import Scenes

RIGHT = np.array([1.0, 0.0, 0.0])
FACES = np.array([[0, 1, 2]])
TRIANGLE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [9.0, 9.0, 9.0]])


def sees(scene, x):
    """Whether the triangle hides the point one below x on the plane from above."""
    return not scene.visible_from(np.array([[x, 0.2, -1.0]]), np.array([x, 0.2, 5.0]))[0]


@pytest.mark.usefixtures("variant")
def test_a_scene_follows_what_leaves_its_slack_and_nothing_else():
    scenes = Scenes(FACES, np.array([0, 1, 2]), slack=0.1)
    first = scenes.at(7, TRIANGLE)
    assert sees(first, 0.2) and not sees(first, 2.2)
    near, elsewhere = 0.09 * RIGHT + TRIANGLE, TRIANGLE.copy()
    elsewhere[3] += 5.0  # not watched
    for unmoved in (near, elsewhere):
        assert scenes.at(7, unmoved).vertices is TRIANGLE
    moved = scenes.at(7, 2.0 * RIGHT + TRIANGLE)
    assert sees(moved, 2.2) and not sees(moved, 0.2)
    assert scenes.at(8, TRIANGLE) is not moved and sees(moved, 2.2)


@pytest.mark.usefixtures("variant")
def test_without_slack_any_movement_counts():
    scenes = Scenes(FACES)
    first = scenes.at(0, TRIANGLE)
    assert scenes.at(0, TRIANGLE.copy()).vertices is TRIANGLE
    after = TRIANGLE + 1e-9
    assert scenes.at(0, after) is first and first.vertices is after
