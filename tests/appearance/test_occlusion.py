from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mifit.appearance.occlusion import MeshPoints, VertexTransfer, _visible, trace_transfer
from mifit.core import sh
from mifit.core.mesh import normalize
from mifit.errors import InputError
from mifit.render.gbuffer import SurfaceScene
from tests.shaded import diffuse_matrix


@pytest.fixture(scope="module")
def wall() -> tuple[np.ndarray, np.ndarray]:
    """A wall in the plane x = 0, so large that it fills half the sky over a floor in front of it."""
    vertices = np.array([[0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]]) * 1000.0
    return vertices, np.array([[0, 1, 2], [0, 2, 3]])


POINT = np.array([[10.0, 0.0, 0.0]])
UP = np.array([[0.0, 0.0, 1.0]])


def test_half_the_sky_is_the_integral_over_half_the_sky(variant: str, wall) -> None:
    traced = trace_transfer(SurfaceScene(*wall), POINT, UP, order=3, samples=4096)[0]
    d, w = sh.quadrature(200)
    visible = np.maximum(d[:, 2], 0) * (d[:, 0] > 0) / np.pi
    assert np.abs(traced - (w * visible) @ sh.basis(d, 3)).max() < 4e-3


def test_a_convex_body_casts_no_shadow_on_itself(variant: str) -> None:
    ball = trimesh.creation.icosphere(3)
    n = np.array(ball.vertices)
    assert np.array_equal(trace_transfer(SurfaceScene(n, ball.faces), n, n, 4), diffuse_matrix(n, 4))


def test_a_wall_sends_light_back(variant: str, wall) -> None:
    """Under constant radiance half of what a floor beside a wall sees is the wall, which sees half the sky."""
    vertices, faces = np.asarray(wall[0]), np.asarray(wall[1])
    floor = np.array([[0, -1, 0], [1, -1, 0], [1, 1, 0], [0, 1, 0]]) * 1000.0
    both = np.concatenate([vertices - np.array([1.0, 0.0, 0.0]), floor])
    indices = np.concatenate([faces, [[4, 5, 6], [4, 6, 7]]])
    white = np.sqrt(4 * np.pi)  # constant radiance 1
    dark = trace_transfer(SurfaceScene(both, indices), POINT, UP, 1, 4096)[0, 0] * white
    lit = trace_transfer(SurfaceScene(both, indices), POINT, UP, 1, 4096, bounce_albedo=0.5)[0, 0] * white
    assert dark == pytest.approx(0.5, abs=0.01)
    assert 0.5 * 0.5 * 0.4 < lit - dark < 0.5 * 0.5  # the wall's lower end sees less than the whole sky


def test_deep_folds_carry_little_noise(variant: str) -> None:
    """At the bottom of a shaft that shows 4 per cent of the sky, 64 rays tell no light from where none comes."""
    side, height = 1.0, 2.5
    box = trimesh.creation.box((side, side, height))
    roof = np.asarray(box.face_normals)[:, 2] > 0.5
    vertices, faces = np.array(box.vertices) + np.array([0.0, 0.0, 0.5 * height]), np.array(box.faces)[~roof]
    points, up = np.tile([[0.05, -0.1, 0.01]], (40, 1)), np.tile(UP, (40, 1))
    scene = SurfaceScene(vertices, faces)
    truth = trace_transfer(scene, points, up, order=8, samples=4096).mean(axis=0)
    assert truth[0] * np.sqrt(4 * np.pi) == pytest.approx(0.045, abs=0.02)
    found = trace_transfer(scene, points, up, order=8, samples=64)
    # The closed form less the blocked rays is off by 0.095.
    assert np.sqrt(((found - truth) ** 2).sum(axis=1).mean()) < 0.045
    sky = sh.quadrature(64)
    light = (sky[1] * np.exp(4 * (sky[0] @ [0.8, 0.0, 0.6] - 1))) @ sh.basis(sky[0], 8)  # positive, from aside
    assert (found @ light).min() > -0.01 * np.abs(light[0]) * np.sqrt(4 * np.pi)


def test_seeds(variant: str, wall) -> None:
    a, b, c = (trace_transfer(SurfaceScene(*wall), POINT, UP, 2, 16, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_bad_input_is_named(variant: str, wall) -> None:
    with pytest.raises(InputError, match="points and normals"):
        trace_transfer(SurfaceScene(*wall), POINT, UP[:0], 3)
    with pytest.raises(InputError, match="samples: found 0"):
        trace_transfer(SurfaceScene(*wall), POINT, UP, 3, samples=0)
    assert trace_transfer(SurfaceScene(*wall), POINT[:0], UP[:0], 3).shape == (0, 9)


def test_each_light_has_its_own_shadows(variant: str, wall) -> None:
    """One light behind the wall, of two samples, and one before it."""
    points = MeshPoints(POINT, UP, np.zeros(1, int), np.ones((1, 3)) / 3)
    behind, before = normalize(np.array([[-1.0, 0, 1], [-1, 0.1, 1]])), normalize(np.array([[1.0, 0, 1]]))
    found = _visible(SurfaceScene(*wall), points, [behind, before])
    assert [bits.tolist() for bits in found] == [[0], [1]]
    assert [bits.tolist() for bits in _visible(SurfaceScene(*wall), points, [before, behind])] == [[1], [0]]


def test_joined_shadows_are_those_of_each_timestep() -> None:
    rng = np.random.default_rng(0)
    parts = [VertexTransfer(rng.random((5, 4)), rng.integers(0, 5, (3, 3)), rng.random((3, 3))) for _ in range(2)]
    joined = VertexTransfer.joined(parts, np.array([1, 0, 1]))
    found = joined.values[joined.corners].reshape(3, 3, 3, 4)
    for image, step in enumerate((1, 0, 1)):
        np.testing.assert_array_equal(found[:, image], parts[step].values[parts[step].corners])
