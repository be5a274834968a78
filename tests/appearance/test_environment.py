"""A face under a whole environment: closed forms on a ball, and what the cut keeps."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mifit.appearance.environment import EnvironmentLight, cut
from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import get
from mifit.appearance.occlusion import MeshPoints
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


def test_an_even_sky_lights_a_ball_evenly(ball) -> None:
    scene, points, view = ball
    light = EnvironmentLight(np.full((32, 64, 3), 0.7, np.float32), np.eye(3))
    diffuse, specular = light.shade(scene, points, points.normal, view, LOBE, np.zeros((len(scene.vertices), 3)))
    np.testing.assert_allclose(diffuse, 0.7, rtol=0.03)
    head_on = points.normal[:, 2] > 0.98
    smooth = Appearance(get("prefiltered"), Illumination(np.array([[0.7 * np.sqrt(4 * np.pi)] * 3])), LOBE)
    expected = smooth.shade(points.normal[head_on], view[head_on])[1]
    np.testing.assert_allclose(specular[head_on], expected, rtol=0.05)


def test_smooth_light_agrees_with_spherical_harmonics(ball) -> None:
    scene, points, view = ball
    coefficients = np.zeros((9, 3))
    coefficients[0], coefficients[2], coefficients[3], coefficients[6] = 3.0, 0.8, -0.5, 0.3
    image = sh.SHLighting(coefficients).to_latlong(64, 128).astype(np.float32)
    turn = sh_rotation(0.7)
    light = EnvironmentLight(image, turn)
    diffuse, specular = light.shade(scene, points, points.normal, view, LOBE, np.zeros((len(scene.vertices), 3)))
    smooth = Appearance(get("prefiltered"), Illumination(coefficients).rotated(turn), LOBE)
    d, s = smooth.shade(points.normal, view)
    assert np.abs(diffuse / d - 1.0).max() < 0.04
    facing = points.normal[:, 2] > 0.8  # further round the lobe dips below the horizon, where nothing comes from
    assert np.abs(specular / s - 1.0)[facing].max() < 0.08


def test_a_lamp_is_as_sharp_as_it_is_and_nothing_is_negative(ball) -> None:
    scene, points, view = ball
    image, toward = lamp()
    light = EnvironmentLight(image.astype(np.float32), np.eye(3))
    diffuse, specular = light.shade(scene, points, points.normal, view, LOBE, np.zeros((len(scene.vertices), 3)))
    assert diffuse.min() >= 0.0 and specular.min() >= 0.0
    expected = 3.0 / np.pi * np.maximum(points.normal @ toward, 0.0)
    assert np.abs(diffuse[:, 0] - expected).max() < 0.03
    half = toward + np.array([0.0, 0.0, 1.0])
    brightest = points.normal[specular[:, 0].argmax()]
    assert np.degrees(np.arccos(brightest @ half / np.linalg.norm(half))) < 8.0


def sh_rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def test_inside_a_ball_the_mesh_is_all_that_is_seen(variant) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=3)
    scene = SurfaceScene(mesh.vertices, np.asarray(mesh.faces)[:, ::-1])  # seen from within
    found = reception(scene)
    count = len(scene.vertices)
    one_ray = 1.1 / 64  # of a vertex, may slip through between facets
    np.testing.assert_allclose(found.from_mesh(np.full((count, 3), 0.5)), 0.5 * np.pi, rtol=one_ray)
    assert not found.from_sky(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3))).any()


def test_a_mesh_is_traced_once_for_all_rotations(ball) -> None:
    scene = ball[0]
    image = np.tile(np.linspace(0.0, 1.0, 64, dtype=np.float32)[:, None], (32, 1, 3))  # darker on one side
    albedo = np.zeros((len(scene.vertices), 3))
    kept = reception(scene)
    lit = [EnvironmentLight(image, sh_rotation(a)).at_vertices(scene, albedo)[1] for a in (0.0, 0.5)]
    assert reception(scene) is kept
    vertices = np.asarray(scene.vertices, dtype=np.float64)
    turned = SurfaceScene(vertices @ sh_rotation(0.5).T, scene.faces)
    again = EnvironmentLight(image, sh_rotation(0.5)).at_vertices(turned, albedo)[1]
    assert reception(turned) is not kept
    assert np.abs(lit[1] - lit[0]).max() > 0.1
    np.testing.assert_allclose(again, lit[0], rtol=0.05)  # light and mesh turned alike


def test_a_mesh_that_moves_is_traced_again(variant) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    scene = SurfaceScene(mesh.vertices, np.asarray(mesh.faces))
    before = reception(scene)
    scene.update(np.asarray(mesh.vertices) * [1.0, 1.0, 0.3])
    after = reception(scene)
    assert after is not before
    assert np.abs(after.normals - before.normals).max() > 0.1


def test_neither_a_turn_of_the_light_nor_another_mesh_is_another_kernel(ball) -> None:
    import drjit as dr

    ours, points, view = ball
    albedo = np.full((len(ours.vertices), 3), 0.4)

    def kernels(angle: float, size: float) -> set[str]:
        scene = SurfaceScene(size * np.asarray(ours.vertices), ours.faces)
        dr.kernel_history_clear()
        EnvironmentLight(lamp()[0] + np.float32(0.1), sh_rotation(angle)).shade(
            scene, points, points.normal, view, Lobe(30.0, 1.0), albedo
        )
        return {k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT}

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        first = kernels(0.3, 1.0)
        assert first and kernels(0.9, 1.3) == first
