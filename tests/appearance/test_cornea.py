"""The film of tears on an eye: Fresnel's equations, and what it mirrors."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from mifit.appearance.cornea import CORNEA, INDEX, REFLECTANCE, reflects, shade_eyes
from mifit.appearance.environment import EnvironmentLight
from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import get
from mifit.appearance.occlusion import MeshPoints, Occlusion
from mifit.core import sh
from mifit.render.gbuffer import SurfaceScene

SKIN = Lobe(20.0, 8.0)


def fresnel(cosine: np.ndarray) -> np.ndarray:
    """Fresnel's equations for unpolarised light that enters a dielectric."""
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / INDEX**2)
    across = (cosine - INDEX * inside) / (cosine + INDEX * inside)
    along = (INDEX * cosine - inside) / (INDEX * cosine + inside)
    return 0.5 * (across**2 + along**2)


def schlick(cosine: np.ndarray) -> np.ndarray:
    return REFLECTANCE + (1.0 - REFLECTANCE) * (1.0 - cosine) ** 5


@pytest.fixture(scope="module")
def ball(variant) -> tuple[SurfaceScene, MeshPoints, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    n = np.asarray(mesh.vertices, dtype=np.float32)[np.asarray(mesh.faces)[:, 0]]
    keep = n[:, 2] > 0.3
    corner = np.tile(np.float32([1.0, 0.0, 0.0]), (int(keep.sum()), 1))
    points = MeshPoints(n[keep], n[keep], np.flatnonzero(keep), corner)
    return SurfaceScene(mesh.vertices, np.asarray(mesh.faces)), points, np.tile(np.float32([0, 0, 1]), (len(corner), 1))


def test_the_film_reflects_as_glass_of_its_index_does() -> None:
    cosine = np.linspace(0.3, 1.0, 50)
    assert np.abs(schlick(cosine) - fresnel(cosine)).max() < 0.025
    assert REFLECTANCE == pytest.approx(float(fresnel(np.ones(1))[0]))
    assert REFLECTANCE * CORNEA.grazing == pytest.approx(1.0)
    assert reflects(SKIN) and not reflects(Lobe(5.0, None, False))  # the paper's lobe has units of its own


def test_an_even_sky_is_mirrored_by_the_fresnel_term_on_eyes_alone(ball) -> None:
    scene, points, view = ball
    eye = points.normal[:, 0] > 0
    light = EnvironmentLight(np.full((32, 64, 3), 0.7, np.float32), np.eye(3))
    given = scene, points, points.normal, view, SKIN, np.zeros((len(scene.vertices), 3))
    (diffuse, specular), (plain_diffuse, plain) = light.shade(*given, eye), light.shade(*given)
    np.testing.assert_array_equal(specular[~eye], plain[~eye])
    np.testing.assert_array_equal(diffuse, plain_diffuse)
    facing = eye & (points.normal[:, 2] > 0.6)
    expected = 0.7 * schlick(points.normal[facing, 2])
    np.testing.assert_allclose(REFLECTANCE * specular[facing].mean(1), expected, rtol=0.03)


def test_a_window_is_mirrored_where_it_is_and_as_large_as_it_is(ball) -> None:
    scene, points, view = ball
    toward = np.array([0.5, 0.4, 0.77]) / np.linalg.norm([0.5, 0.4, 0.77])
    image = np.zeros((64, 128, 3), np.float32)
    radius = 0.25
    image[sh.latlong_directions(64, 128) @ toward > np.cos(radius)] = 50.0
    light = EnvironmentLight(image, np.eye(3))
    given = scene, points, points.normal, view, SKIN, np.zeros((len(scene.vertices), 3))
    _, mirrored = light.shade(*given, np.ones(len(view), bool))
    mirror = 2.0 * points.normal[:, 2:] * points.normal - view
    off = np.arccos(np.clip(mirror @ toward, -1, 1))
    rise = schlick(points.normal[:, 2]) / REFLECTANCE
    np.testing.assert_allclose((mirrored[:, 0] / rise)[off < 0.5 * radius], 50.0, rtol=0.1)
    assert mirrored[off > 2.0 * radius].max() < 0.5
    assert light.shade(*given)[1][off > 2.0 * radius].max() > 2.0  # skin's own lobe smears it


def test_a_lamp_beside_smooth_light_shows_as_a_point(variant) -> None:
    n = np.float32([[np.sin(a), 0.0, np.cos(a)] for a in np.linspace(-0.6, 0.6, 121)])
    view = np.tile(np.float32([0, 0, 1]), (len(n), 1))
    lamp = DistantLight(np.array([np.sin(0.6), 0.0, np.cos(0.6)]), 0.0, np.ones(3))
    appearance = Appearance(get("prefiltered"), Illumination(np.zeros((1, 3)), (lamp,)), SKIN)
    open_sky = Occlusion(visible=(np.full(len(n), 0xFFFFFFFF, np.uint32),))
    eye = np.arange(len(n)) % 2 == 0
    diffuse, specular = shade_eyes(appearance, eye, n, n, view, open_sky, n)
    plain = appearance.shade_bent(n, n, view, open_sky, n)
    np.testing.assert_array_equal(diffuse, plain[0])
    np.testing.assert_array_equal(specular[~eye], plain[1][~eye])
    film = specular[eye, 0]
    peak = n[eye][film.argmax()]
    assert np.degrees(np.arctan2(peak[0], peak[2])) == pytest.approx(np.degrees(0.3), abs=1.2)
    assert (film > 0.5 * film.max()).sum() <= 7  # 4 degrees of the ball
    assert film.max() > 20 * plain[1].max()
