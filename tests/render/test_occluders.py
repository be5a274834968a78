"""Meshes that are kept between pictures: the same one for equal arrays, and no more than a few."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mifit.render import visible as occluders


@pytest.fixture(autouse=True)
def nothing_kept(variant: str) -> None:
    occluders._meshes.clear()


def test_equal_arrays_share_a_mesh_and_its_shadows() -> None:
    ball = trimesh.creation.icosphere(2)
    first = occluders.occluding_mesh(np.array(ball.vertices), np.array(ball.faces))
    traced = first.transfer(3)
    again = occluders.occluding_mesh(np.array(ball.vertices), np.array(ball.faces))
    assert again is first and again.transfer(3) is traced
    single = np.array(ball.vertices, np.float32)
    assert occluders.occluding_mesh(single, ball.faces) is occluders.occluding_mesh(single.astype(float), ball.faces)


def test_a_moved_mesh_is_another_one_and_the_callers_array_may_change() -> None:
    ball = trimesh.creation.icosphere(1)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    first = occluders.occluding_mesh(vertices, faces)
    vertices[0] *= 1.01
    second = occluders.occluding_mesh(vertices, faces)
    assert second is not first
    np.testing.assert_array_equal(first.scene.vertices, ball.vertices)


def test_only_the_last_are_kept() -> None:
    ball = trimesh.creation.icosphere(1)
    made = [occluders.occluding_mesh(np.array(ball.vertices) * (1 + k), np.array(ball.faces)) for k in range(10)]
    assert list(occluders._meshes._kept.values()) == made[-8:]
