"""Normals, areas and interpolation on meshes with known answers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mifit.core import mesh


def tetrahedron():
    vertices = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return vertices, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def test_face_cross_is_outward_and_twice_the_area():
    vertices, faces = tetrahedron()
    cross = mesh.face_cross(vertices, faces)
    centre = vertices[faces].mean(1)
    assert np.all(np.sum(cross * centre, axis=1) > 0)
    assert_allclose(0.5 * np.linalg.norm(cross, axis=1), np.sqrt(3) / 4 * 8, rtol=1e-12)


def test_vertex_normals_of_a_sphere_point_outward():
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = mesh.vertex_normals(sphere.vertices, sphere.faces)
    assert np.degrees(np.arccos(np.sum(normals * sphere.vertices, axis=1).clip(-1, 1))).max() < 1.0


def test_vertex_normals_turn_with_the_mesh_and_ignore_its_size():
    vertices, faces = tetrahedron()
    angle = 0.7
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = mesh.vertex_normals(1e-3 * vertices @ turn.T, faces)
    assert_allclose(turned, mesh.vertex_normals(vertices, faces) @ turn.T, atol=1e-12)


def test_normals_of_nothing_are_defined():
    vertices = np.zeros((4, 3))
    normals = mesh.vertex_normals(vertices, np.array([[0, 1, 2]]))
    assert_allclose(normals, np.tile([0.0, 0.0, 1.0], (4, 1)))
    assert_allclose(mesh.normalize(np.array([[0.0, 0, 0], [0, 3, 4]])), [[0, 0, 1], [0, 0.6, 0.8]])


def test_normalize_leaves_its_argument_alone():
    v = np.zeros((2, 3))
    mesh.normalize(v)
    assert not v.any()


def test_interpolation_is_exact_for_linear_functions():
    vertices, faces = tetrahedron()
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(3), 50)
    face = rng.integers(0, 4, 50)
    points = mesh.interpolate(vertices, faces, face, weights)
    values = vertices @ np.array([[1.0], [-2.0], [0.5]]) + 3.0
    assert_allclose(mesh.interpolate(values, faces, face, weights)[:, 0], points @ [1.0, -2.0, 0.5] + 3.0)
