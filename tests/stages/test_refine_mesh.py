"""Refined normals become shape: known bumps appear, the rest of the mesh stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mifit.config import MeshConfig
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, Report
from mifit.core.mesh import face_cross, interpolate, normalize, vertex_normals
from mifit.core.mesh_solve import interior_vertices
from mifit.core.uv import rasterize_uv
from mifit.stages.normals.refine_mesh import refine_mesh

SIZE = 192
DONE = Report("converged")


def turn(angle):
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def bumps(vertices):
    """Height of the true surface over the dome; zero at its border."""
    x, y = vertices[:, 0], vertices[:, 1]
    return 0.02 * np.sin(9 * x) * np.sin(8 * y) * (1 - x**2) * (1 - y**2)


@pytest.fixture(scope="module")
def problem():
    from normal_scene import dome_model

    model = dome_model(41)
    true = model.mean.astype(np.float64)
    true = true + bumps(true)[:, None] * vertex_normals(true, model.faces)
    texels = rasterize_uv(model.uv, model.faces_uv, SIZE, model.face_mask)
    wanted = normalize(interpolate(vertex_normals(true, model.faces), model.faces, texels.face, texels.weights))
    rotation, translation, scale = turn(0.4), np.array([1.0, -2.0, 3.0]), 0.5
    vertices = scale * model.mean @ rotation.T + translation
    geometry = GeometryEstimate(
        (3,), np.zeros(1), np.zeros(1), np.zeros((1, 1)), rotation[None], translation[None], scale,
        vertices[None].astype(np.float32), model.mean_albedo, np.zeros((9, 3)), 0.0, DONE,
    )  # fmt: skip
    normals = NormalsEstimate((3,), texels.to_map(wanted.astype(np.float32))[None], DONE)
    return model, geometry, normals, scale * true @ rotation.T + translation


def test_bumps_appear_in_positions(problem):
    model, geometry, normals, true = problem
    refined = refine_mesh(model, geometry, normals, MeshConfig(detail=20.0))
    before = np.linalg.norm(geometry.vertices[0] - true, axis=1)
    after = np.linalg.norm(refined.vertices[0] - true, axis=1)
    assert after.mean() < 0.35 * before.mean()


@pytest.mark.parametrize("times, low, high", [(0.25, 0.0, 0.2), (1.0, 0.3, 0.7), (4.0, 0.8, 1.1)])
def test_waves_as_long_as_the_detail_are_half_from_the_normals(problem, times, low, high):
    model, geometry, normals, true = problem
    # The bumps' waves: 2 pi / 9 by 2 pi / 8 of object space, whose unit is 10 mm like the setting's, cross each other.
    wave = 2 * np.pi / np.hypot(9, 8) * model.unit_mm / 10.0
    refined = refine_mesh(model, geometry, normals, MeshConfig(detail=times * wave))
    moved, wanted = refined.vertices[0] - geometry.vertices[0], true - geometry.vertices[0]
    share = float((moved * wanted).sum() / (wanted * wanted).sum())
    assert low < share < high


def test_positions_hold_against_the_normals_of_large_shapes(problem):
    model, geometry, normals, _ = problem
    free = refine_mesh(model, geometry, normals, MeshConfig(detail=20.0))
    held = refine_mesh(model, geometry, normals, MeshConfig(detail=0.01))
    move = [np.abs(r.vertices[0] - geometry.vertices[0]).max() for r in (free, held)]
    assert move[1] < 0.05 * move[0]


def test_border_stays_and_nothing_flips(problem):
    model, geometry, normals, _ = problem
    refined = refine_mesh(model, geometry, normals)
    inside = interior_vertices(model.faces, model.face_mask, len(model.mean))
    assert_allclose(refined.vertices[0][~inside], geometry.vertices[0][~inside], atol=1e-6)
    cosine = face_cross(refined.vertices[0], model.faces) * face_cross(geometry.vertices[0], model.faces)
    assert cosine.sum(1).min() > 0


def test_the_normals_of_the_mesh_itself_change_nothing(problem):
    model, geometry, normals, _ = problem
    empty = replace(normals, normal_object=np.zeros_like(normals.normal_object))
    refined = refine_mesh(model, geometry, empty)
    assert_allclose(refined.vertices, geometry.vertices, atol=1e-6)


def test_the_outcome_tells_whether_the_vertices_stand(problem, monkeypatch):
    model, geometry, normals, _ = problem
    assert refine_mesh(model, geometry, normals).report.outcome == "converged"
    monkeypatch.setattr("mifit.stages.normals.refine_mesh.MAX_ITERATIONS", 1)
    assert refine_mesh(model, geometry, normals).report.outcome == "max_iterations"
