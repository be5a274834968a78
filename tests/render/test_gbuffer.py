from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mifit.core.camera import Camera
from mifit.core.mesh import interpolate
from mifit.errors import InputError
from mifit.render import gbuffer
from mifit.render.gbuffer import SurfaceScene


@pytest.fixture(scope="module")
def ball() -> tuple[np.ndarray, np.ndarray]:
    sphere = trimesh.creation.icosphere(4, 1.0)
    return np.array(sphere.vertices) * (10.0, 12.0, 9.0), np.array(sphere.faces)


@pytest.fixture(scope="module")
def camera() -> Camera:
    world_to_camera = np.eye(4)
    world_to_camera[:3, 3] = (1.0, -2.0, 60.0)
    return Camera("test", 120, 90, 260.0, 250.0, 61.3, 44.1, world_to_camera)


def test_hits_project_to_pixel_centres(variant: str, ball, camera: Camera) -> None:
    vertices, faces = ball
    g = SurfaceScene(vertices, faces).gbuffer(camera)
    assert 1000 < g.mask.sum() < g.mask.size
    assert g.weights[g.mask].min() > -1e-5 and np.allclose(g.weights[g.mask].sum(1), 1.0, atol=1e-5)
    assert (g.weights[~g.mask] == 0).all() and np.isinf(g.depth[~g.mask]).all()
    points = interpolate(vertices, faces, g.face[g.mask], g.weights[g.mask].astype(np.float64))
    assert np.abs(camera.project(points) - camera.pixel_centres()[g.mask]).max() < 1e-3
    assert np.abs(camera.to_camera(points)[:, 2] - g.depth[g.mask]).max() < 1e-3


def test_update_moves_the_mesh(variant: str, ball, camera: Camera) -> None:
    vertices, faces = ball
    scene = SurfaceScene(vertices, faces)
    before = scene.gbuffer(camera).mask.sum()
    scene.update(vertices * 0.5)
    after = scene.gbuffer(camera)
    assert 0.2 * before < after.mask.sum() < 0.3 * before
    assert np.array_equal(after.face, SurfaceScene(vertices * 0.5, faces).gbuffer(camera).face)


def test_rays_are_saved_where_no_vertex_projects(variant: str, ball, camera: Camera) -> None:
    """A mesh in a corner, behind the camera in part, and out of the image."""
    vertices, faces = ball
    scene = SurfaceScene(vertices, faces)
    whole = scene.gbuffer(camera)
    moved = replace(camera, cx=camera.cx - camera.width / 2)
    cut, columns = scene.gbuffer(moved), camera.width // 2
    np.testing.assert_array_equal(cut.mask[:, :columns], whole.mask[:, columns:])
    seen = cut.mask[:, :columns]
    np.testing.assert_allclose(cut.depth[:, :columns][seen], whole.depth[:, columns:][seen], rtol=1e-5)
    assert not scene.gbuffer(replace(camera, cx=camera.cx + 10 * camera.width)).mask.any()
    inside = replace(camera, world_to_camera=np.eye(4))
    around = SurfaceScene(vertices - vertices.mean(axis=0), faces).gbuffer(inside)
    assert around.mask.all()


def test_visibility_of_vertices(variant: str, ball, camera: Camera) -> None:
    vertices, faces = ball
    normals = vertices / np.array([10.0, 12.0, 9.0]) ** 2
    view = camera.position - vertices
    cosine = (view * normals).sum(1) / np.linalg.norm(view, axis=1) / np.linalg.norm(normals, axis=1)
    visible = SurfaceScene(vertices, faces).visible_from(vertices, camera.position)
    assert visible[cosine > 0.1].all() and not visible[cosine < -0.1].any()


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_visibility_does_not_depend_on_units(variant: str, ball, camera: Camera, size: float) -> None:
    vertices, faces = ball
    g = SurfaceScene(vertices, faces).gbuffer(camera)
    points = interpolate(vertices, faces, g.face[g.mask], g.weights[g.mask].astype(np.float64))
    visible = SurfaceScene(vertices * size, faces).visible_from(points * size, camera.position * size)
    assert visible.mean() > 0.999


def test_a_wall_hides(variant: str) -> None:
    wall = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0], [-9, -9, -5], [9, -9, -5], [0, 9, -5]], float)
    scene = SurfaceScene(wall, np.array([[0, 1, 2], [3, 4, 5]]))
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -5.0], [5.0, -5.0, -5.0]])
    assert scene.visible_from(points, np.array([0.0, 0.0, 50.0])).tolist() == [True, False, True]
    assert scene.visible_from(np.zeros((0, 3)), np.zeros(3)).shape == (0,)


def test_bad_meshes_are_refused(variant: str, ball, camera: Camera) -> None:
    vertices, faces = ball
    with pytest.raises(InputError, match=r"expected \(V, 3\)"):
        SurfaceScene(vertices[:, :2], faces)
    with pytest.raises(InputError, match="expected 0 to"):
        SurfaceScene(vertices[:10], faces)
    with pytest.raises(InputError, match="not finite"):
        SurfaceScene(np.where(vertices > 9, np.nan, vertices), faces)
    scene = SurfaceScene(vertices, faces)
    with pytest.raises(InputError, match="found shape"):
        scene.update(vertices[:5])
    bent = Camera("bent", 8, 8, 9, 9, 4, 4, np.eye(4), (0.1, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="distortion"):
        scene.gbuffer(bent)


def test_rays_of_a_box_are_those_of_its_pixels_centres(variant: str, camera: Camera) -> None:
    for rows, columns in ((slice(None), slice(None)), (slice(3, 40), slice(10, 11))):
        expected = camera.pixel_rays(camera.pixel_centres()[rows, columns]).reshape(-1, 3)
        directions, along = gbuffer._box_rays(camera, (rows, columns))
        np.testing.assert_allclose(np.array(directions).T, expected, rtol=0, atol=1e-7)
        np.testing.assert_allclose(np.array(along), expected @ camera.rotation[2], rtol=0, atol=1e-7)


def test_what_a_camera_saw_is_kept_until_the_mesh_moves(variant: str, ball, camera: Camera, monkeypatch) -> None:
    vertices, faces = ball
    scene = SurfaceScene(vertices, faces)
    first = scene.gbuffer(camera)
    first.face[:] = 7  # the caller's own
    monkeypatch.setattr(gbuffer, "_box_rays", lambda *_: pytest.fail("rays were sent again"))
    again = scene.gbuffer(camera)
    monkeypatch.undo()
    fresh = SurfaceScene(vertices, faces).gbuffer(camera)
    for name in ("face", "weights", "depth"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fresh, name))
    turned = scene.gbuffer(replace(camera, cx=70.0))
    assert not np.array_equal(turned.face, fresh.face)
    scene.update(vertices + np.array([0.0, 0.0, 5.0]))
    assert scene.gbuffer(camera).depth[45, 60] > fresh.depth[45, 60] + 4.0
