"""Positions from normals: known surfaces are returned, boundaries stay, nothing folds."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mifit.core.mesh import face_cross, normalize, vertex_normals
from mifit.core.mesh_solve import (
    MeshUpdater,
    interior_vertices,
    rotate_between,
    wanted_face_normals,
)
from mifit.core.uv import rasterize_uv


def grid(n=41):
    """A flat square of side 2, its UVs, and its faces."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], axis=1)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)])
    return vertices, 0.5 + 0.5 * vertices[:, :2], faces


def hill(vertices):
    """A height field that is zero at the square's boundary."""
    x, y = vertices[:, 0], vertices[:, 1]
    return 0.15 * np.cos(np.pi * x / 2) ** 2 * np.cos(np.pi * y / 2) ** 2 * (1 + 0.5 * np.sin(6 * x + 2 * y))


def face_normals(vertices, faces):
    return normalize(face_cross(vertices, faces))


def test_normals_of_a_hill_return_the_hill_to_a_percent_of_its_size():
    flat, _, faces = grid()
    true = flat.copy()
    true[:, 2] = hill(flat)
    free = interior_vertices(faces, np.ones(len(faces), bool), len(flat))
    moved = MeshUpdater(flat, faces, free, position_weight=1e-6).settle(flat, face_normals(true, faces), 40, 0.0)[0]
    error = np.linalg.norm(moved - true, axis=1)
    assert error.max() < 0.01 * 2.0
    assert np.sqrt((error**2).mean()) < 0.05 * np.ptp(true[:, 2])


def test_a_bumpy_sphere_is_integrated_to_a_percent_of_its_size():
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=4)
    base, faces = np.array(sphere.vertices), np.array(sphere.faces)
    height = 0.03 * np.sin(5 * base[:, 0]) * np.cos(4 * base[:, 1] + base[:, 2])
    true = base * (1 + height - height.mean())[:, None]
    # a closed surface needs the positions for its place and size only
    updater = MeshUpdater(base, faces, np.ones(len(base), bool), position_weight=1e-3)
    moved = updater.settle(base, face_normals(true, faces), 40, 0.0)[0]
    assert np.abs(np.linalg.norm(moved, axis=1) - np.linalg.norm(true, axis=1)).max() < 0.01 * 2
    before = np.sum(face_normals(base, faces) * face_normals(true, faces), axis=1)
    after = np.sum(face_normals(moved, faces) * face_normals(true, faces), axis=1)
    angles = np.degrees(np.arccos(np.clip([before, after], -1, 1))).mean(1)
    assert angles[1] < 0.1 * angles[0]


def test_own_normals_change_nothing():
    flat, _, faces = grid(15)
    surface = flat.copy()
    surface[:, 2] = hill(flat)
    updater = MeshUpdater(flat, faces, np.ones(len(flat), bool), position_weight=1.0)
    assert_allclose(updater.settle(surface, face_normals(surface, faces), 4, 0.0)[0], surface, atol=1e-9)
    assert_allclose(updater.settle(surface, np.zeros((len(faces), 3)), 4, 0.0)[0], surface, atol=1e-9)


def test_one_factorisation_serves_other_positions():
    flat, _, faces = grid(15)
    updater = MeshUpdater(flat, faces, interior_vertices(faces, np.ones(len(faces), bool), len(flat)), 1e-3)
    for amplitude in (0.5, 1.0):
        true = flat.copy()
        true[:, 2] = amplitude * hill(flat)
        moved = updater.settle(flat, face_normals(true, faces), 40, 0.0)[0]
        assert np.abs(moved - true).max() < 0.02


def test_fixed_vertices_stay_and_trusted_positions_hold():
    flat, _, faces = grid(21)
    mask = flat[faces].mean(1)[:, 0] > 0
    free = interior_vertices(faces, mask, len(flat))
    tilted = face_normals(np.column_stack([flat[:, :2], hill(flat)]), faces)
    loose = MeshUpdater(flat, faces, free, position_weight=1.0).settle(flat, tilted, 4, 0.0)[0]
    tight = MeshUpdater(flat, faces, free, position_weight=1e6).settle(flat, tilted, 4, 0.0)[0]
    assert_array_equal(loose[~free], flat[~free])
    assert np.abs(loose - flat).max() > 0.01
    assert np.abs(tight - flat).max() < 1e-4


def test_no_face_is_flipped_by_wild_normals():
    flat, _, faces = grid(21)
    rng = np.random.default_rng(0)
    wild = normalize(rng.normal(size=(len(faces), 3)))
    moved = MeshUpdater(flat, faces, np.ones(len(flat), bool), position_weight=1e-3).settle(flat, wild, 20, 0.0)[0]
    assert np.isfinite(moved).all()
    assert np.sum(face_cross(moved, faces) * face_cross(flat, faces), axis=1).min() > 0


def test_nothing_free_moves_nothing():
    flat, _, faces = grid(5)
    updater = MeshUpdater(flat, faces, np.zeros(len(flat), bool), 1.0)
    assert_array_equal(updater.settle(flat, np.tile([0.0, 1.0, 0.0], (len(faces), 1)), 4, 0.0)[0], flat)


def test_rotation_between_vectors():
    rng = np.random.default_rng(1)
    a, b, v = (normalize(rng.normal(size=(50, 3))) for _ in range(3))
    assert_allclose(rotate_between(a, b, a), b, atol=1e-12)
    assert_allclose(np.linalg.norm(rotate_between(a, b, v), axis=1), 1.0)
    assert_allclose(rotate_between(a, a, v), v)


def test_a_map_equal_to_its_base_asks_for_no_change():
    flat, uv, faces = grid(15)
    surface = flat.copy()
    surface[:, 2] = hill(flat)
    texels = rasterize_uv(uv, faces, 64)
    corner = vertex_normals(surface, faces)[faces[texels.face]]
    base = normalize(np.einsum("nk,nkc->nc", texels.weights, corner))
    wanted = wanted_face_normals(surface, faces, texels, base, base)
    assert_allclose(wanted, face_normals(surface, faces), atol=1e-9)


def test_interior_excludes_boundary_and_neighbours_of_other_faces():
    flat, _, faces = grid(5)
    assert interior_vertices(faces, np.ones(len(faces), bool), 25).sum() == 9
    mask = flat[faces].mean(1)[:, 0] > 0
    inside = interior_vertices(faces, mask, 25)
    assert set(flat[inside][:, 0]) == {0.5}
