"""The chart of normal corrections: unit, smooth, without poles."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mifit.core.uv import TexelMap, bend, tangent_plane, texel_neighbours, transport, unbend


def directions(n=500, seed=0):
    v = np.random.default_rng(seed).normal(size=(n, 3))
    v[:6] = np.concatenate([np.eye(3), -np.eye(3)])  # the poles of any chart
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def test_tangents_are_an_orthonormal_right_handed_frame_at_poles_too():
    n = directions()
    t = tangent_plane(n)
    frame = np.stack([t[:, 0], t[:, 1], n], axis=1)
    assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (len(n), 1, 1)), atol=1e-12)
    assert_allclose(np.linalg.det(frame), 1.0)


@pytest.mark.parametrize("size", [0.0, 0.1, 1.0, 3.0])
def test_bent_normals_are_unit_and_come_back(size):
    n = directions()
    t = tangent_plane(n)
    x = size * np.random.default_rng(1).normal(size=(len(n), 2))
    bent = bend(n, t, x)
    assert_allclose(np.linalg.norm(bent, axis=1), 1.0, atol=1e-12)
    assert_allclose(unbend(n, t, bent), x, atol=1e-9)


def test_the_derivative_at_zero_is_the_tangent_plane():
    n = directions()
    t = tangent_plane(n)
    for i, step in enumerate(1e-6 * np.eye(2)):
        slope = (bend(n, t, np.tile(step, (len(n), 1))) - bend(n, t, np.tile(-step, (len(n), 1)))) / 2e-6
        assert_allclose(slope, t[:, i], atol=1e-9)


def test_transported_tangents_fit_their_new_normal():
    n, m = directions(seed=2), directions(seed=3)
    keep = (n * m).sum(1) > -0.9
    n, m = n[keep], m[keep]
    t = transport(n, tangent_plane(n), m)
    frame = np.stack([t[:, 0], t[:, 1], m], axis=1)
    assert_allclose(np.linalg.det(frame), 1.0, atol=1e-9)
    assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (len(n), 1, 1)), atol=1e-9)
    assert_allclose(transport(n, tangent_plane(n), n), tangent_plane(n), atol=1e-12)


def test_neighbours_inside_a_map_with_holes():
    texels = TexelMap(3, np.array([0, 1, 4, 8]), np.zeros(4, np.int32), np.zeros((4, 3), np.float32))
    near = texel_neighbours(texels)  # up, down, left, right; itself at the border
    assert near.tolist() == [[0, 0, 0, 1], [1, 2, 0, 1], [1, 2, 2, 2], [3, 3, 3, 3]]
