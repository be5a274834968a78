"""A face under a whole environment: closed forms on a ball, and what the cut keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from mifit.appearance.environment import cut, diffuse_light, illumination_of
from mifit.appearance.formation import Appearance
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import get
from mifit.appearance.occlusion import MeshPoints, OccludingMesh
from mifit.appearance.reception import reception
from mifit.core import sh
from mifit.render.gbuffer import SurfaceScene

LOBE = Lobe(40.0, 8.0)


@pytest.fixture(scope="module")
def ball(variant) -> tuple[SurfaceScene, MeshPoints, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    n = np.asarray(mesh.vertices, dtype=np.float32)
    vertex = np.asarray(mesh.faces)[:, 0]
    n = n[vertex]
    corner = np.tile(np.float32([1.0, 0.0, 0.0]), (len(n), 1))
    keep = n[:, 2] > 0.3
    points = MeshPoints(n[keep], n[keep], np.flatnonzero(keep), corner[keep])
    view = np.tile(np.float32([0.0, 0.0, 1.0]), (int(keep.sum()), 1))
    return SurfaceScene(mesh.vertices, np.asarray(mesh.faces)), points, view


def lamp(height=64, direction=(0.5, 0.4, 0.77), radius=0.12, power=3.0):
    """A black sky with one round lamp of a given irradiance."""
    d = sh.latlong_directions(height, 2 * height)
    toward = np.array(direction) / np.linalg.norm(direction)
    inside = d @ toward > np.cos(radius)
    angles = np.broadcast_to(sh.latlong_solid_angles(height, 2 * height)[:, None], inside.shape)
    return (inside * power / (inside * angles).sum())[..., None] * np.ones(3, np.float32), toward


def test_the_cut_keeps_power_and_mean_direction() -> None:
    image = np.random.default_rng(0).random((32, 64, 3)).astype(np.float32) ** 4
    directions, power = cut(image, 200)
    angles = np.broadcast_to(sh.latlong_solid_angles(32, 64)[:, None, None], image.shape)
    assert len(directions) == 200
    np.testing.assert_allclose(power.sum(0), (image * angles).sum((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-9)
    assert power.sum(1).max() < 4.0 * power.sum(1).mean()


def shaded(ball, image, turn=None) -> tuple[np.ndarray, np.ndarray]:
    """Diffuse and specular radiance of a black ball under an environment."""
    scene, points, view = ball
    turn = np.eye(3) if turn is None else turn
    found = illumination_of(image.astype(np.float32), 10).rotated(turn)
    look = Appearance(get("shadowed"), found, LOBE)
    given = points.normal, view, look.trace(OccludingMesh(scene), points)
    bare = replace(look, illumination=replace(found, radiance=np.zeros_like(found.radiance)))
    black = np.zeros((len(scene.vertices), 3))
    smooth = diffuse_light(image.astype(np.float32), turn, found.lights, scene, points, points.normal, black)
    return bare.shade(*given)[0] + smooth, look.shade(*given)[1]


def test_an_even_sky_lights_a_ball_evenly(ball) -> None:
    diffuse, _ = shaded(ball, np.full((32, 64, 3), 0.7))
    np.testing.assert_allclose(diffuse, 0.7, rtol=0.03)


def test_smooth_light_agrees_with_spherical_harmonics(ball) -> None:
    coefficients = np.zeros((9, 3))
    coefficients[0], coefficients[2], coefficients[3], coefficients[6] = 3.0, 0.8, -0.5, 0.3
    image, turn = sh.SHLighting(coefficients).to_latlong(64, 128).astype(np.float32), sh_rotation(0.7)
    found = illumination_of(image, 3)
    assert found.lights == ()
    np.testing.assert_allclose(found.radiance, coefficients, atol=5e-3)
    expected = sh.SHLighting(coefficients).rotate(turn).irradiance(ball[1].normal) / np.pi
    assert np.abs(shaded(ball, image, turn)[0] / expected - 1.0).max() < 0.04


def test_a_lamp_is_as_sharp_as_it_is(ball) -> None:
    image, toward = lamp()
    diffuse, specular = shaded(ball, image)
    points = ball[1]
    assert diffuse.min() >= 0.0
    expected = 3.0 / np.pi * np.maximum(points.normal @ toward, 0.0)
    assert np.abs(diffuse[:, 0] - expected).max() < 0.03
    half = toward + np.array([0.0, 0.0, 1.0])
    brightest = points.normal[specular[:, 0].argmax()]
    assert np.degrees(np.arccos(brightest @ half / np.linalg.norm(half))) < 8.0


def test_nothing_of_the_power_is_lost() -> None:
    image = lamp()[0].astype(np.float32) + np.float32(0.1)
    whole = sh.SHLighting.from_envmap(image, 3).coefficients
    np.testing.assert_allclose(illumination_of(image, 3).smooth().coefficients, whole, rtol=0.02, atol=0.02)


def sh_rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def test_inside_a_ball_the_mesh_is_all_that_is_seen(variant) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    scene = SurfaceScene(mesh.vertices, np.asarray(mesh.faces)[:, ::-1])  # seen from within
    found = reception(scene)
    count = len(scene.vertices)
    one_ray = 1.1 / 64  # of a vertex, may slip through between facets
    np.testing.assert_allclose(found.exchange @ np.full((count, 3), 0.5), 0.5 * np.pi, rtol=one_ray)
    assert not found.from_sky(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3))).any()


def test_a_mesh_is_traced_once_for_all_rotations(ball) -> None:
    kept = reception(ball[0])
    image = np.tile(np.linspace(0.0, 1.0, 64)[:, None], (32, 1, 3))  # darker on one side
    lit = [shaded(ball, image, sh_rotation(angle))[0] for angle in (0.0, 0.5)]
    assert reception(ball[0]) is kept
    assert np.abs(lit[1] - lit[0]).max() > 0.03


def test_a_mesh_that_moves_is_traced_again(variant) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    scene = SurfaceScene(mesh.vertices, np.asarray(mesh.faces))
    before = reception(scene)
    scene.update(np.asarray(mesh.vertices) * [1.0, 1.0, 0.3])
    after = reception(scene)
    assert after is not before
    assert np.abs(after.normals - before.normals).max() > 0.1
