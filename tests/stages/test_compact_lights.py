"""Compact lights: disc, shadows and lobe, and how stage 2 finds them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, TurningDome, turning_dome

from mifit.appearance.formation import OPEN
from mifit.appearance.illumination import DistantLight, disc
from mifit.appearance.occlusion import trace_transfer
from mifit.config import ReflectanceConfig
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.render.gbuffer import SurfaceScene
from mifit.sampling.observations import Surface
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.reflectance.als import EXPONENT as SKIN_EXPONENT
from mifit.stages.reflectance.forward import Forward
from tests.reference import specular_brdf
from tests.shaded import appearance, light_columns, shade_points

CONFIG = ReflectanceConfig(texture_size=SIZE, bands=4, exponent=EXPONENT, specular_albedo=1.0, smoothness_weight=1e-5)
KEY = DistantLight(normalize(np.array([0.75, 0.2, 0.6])), 0.02, np.array([4.0, 3.6, 3.0]))
FILL = DistantLight(normalize(np.array([-0.7, 0.35, 0.5])), 0.02, np.array([2.0, 2.4, 3.0]))
CAMERAS = ("left", "right")


def test_disc_is_even_and_centred():
    centre = normalize(np.array([0.3, -0.8, 0.5]))
    d = disc(centre, 0.3, 4096)
    cosine = d @ centre
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-12)
    assert cosine.min() >= np.cos(0.3) - 1e-12
    np.testing.assert_allclose(normalize(d.mean(0)), centre, atol=1e-3)
    assert np.median(cosine) == pytest.approx(0.5 * (1 + np.cos(0.3)), abs=1e-4)  # even in solid angle
    np.testing.assert_allclose(disc(centre, 0.0), np.tile(centre, (16, 1)), atol=1e-12)


def test_a_roof_hides_what_is_behind_it(variant):
    # A floor at z = 0, and a roof over x < 0 at z = 1.
    floor = [[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]
    roof = [[-9, -9, 1], [0, -9, 1], [0, 9, 1], [-9, 9, 1]]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    scene = SurfaceScene(np.array(floor + roof, np.float64), faces)
    x = np.linspace(-2, 2, 41) + 0.05
    points = np.stack([x, np.zeros(41), np.zeros(41)], axis=1)
    directions = normalize(np.array([[0.0, 0, 1], [1, 0, 1], [-1, 0, 1], [0, 0, -1]]))
    bits = scene.open_towards(points, np.tile([0.0, 0, 1], (41, 1)), directions)
    for number, edge in enumerate((0.0, -1.0, 1.0)):
        np.testing.assert_array_equal((bits >> number) & 1, x > edge)
    assert not ((bits >> 3) & 1).any()  # below the horizon
    with pytest.raises(InputError, match="found 33"):
        scene.open_towards(points, points, np.zeros((33, 3)))


def test_columns_are_cosine_and_lobe_at_the_lights_directions(variant):
    rng = np.random.default_rng(0)
    n = normalize(rng.normal(size=(200, 3)))
    v = normalize(n + 0.6 * rng.normal(size=(200, 3)))
    v = np.where((n * v).sum(1, keepdims=True) > 0, v, -v)
    light = replace(KEY, radius=0.1)
    directions = light.samples()
    seen = rng.integers(0, 1 << 16, 200).astype(np.uint32)
    matt, glossy = light_columns(n, v, seen, light, EXPONENT)
    open_sky = (seen[:, None] >> np.arange(16)) & 1
    cosine = np.maximum(n @ directions.T, 0.0)
    brdf = np.stack([specular_brdf(np.broadcast_to(d, n.shape), v, n, EXPONENT) for d in directions], axis=1)
    np.testing.assert_allclose(matt, (open_sky * cosine).mean(1) / np.pi, atol=1e-6)
    np.testing.assert_allclose(glossy, (open_sky * cosine * brdf).mean(1), atol=2e-4 * brdf.max())


@pytest.mark.parametrize("fresnel", [None, 8.0])
def test_the_lobe_agrees_with_the_prefiltered_one(variant, fresnel):
    """A wide dim disc is the same light as its spherical harmonics, seen through a lobe that is as smooth."""
    light = DistantLight(KEY.direction, 0.6, np.ones(3))
    rng = np.random.default_rng(1)
    n = normalize(light.direction + 0.4 * rng.normal(size=(300, 3)))
    v = normalize(n + 0.3 * rng.normal(size=(300, 3)))
    ones = np.ones((300, 3))
    _, smooth = shade_points(n, v, ones, ones[:, 0], light.coefficients(10), 0.0, 12.0, "prefiltered", fresnel=fresnel)
    _, sharp = light_columns(n, v, np.full(300, 0xFFFF, np.uint32), light, 12.0, fresnel)
    assert np.abs(sharp - smooth[:, 0]).max() < 0.06 * sharp.max()


def walled_dome() -> TurningDome:
    """The turning dome with a low wall across it that belongs to no map, under smooth light and a compact one."""
    dome = turning_dome(steps=3)
    count = len(dome.model.mean)
    wall = np.array([[-0.05, -0.5, 0.6], [-0.05, 0.5, 0.6], [-0.05, 0.5, 1.15], [-0.05, -0.5, 1.15]])
    faces = np.concatenate([dome.model.faces, count + np.array([[0, 1, 2], [0, 2, 3]])]).astype(np.int32)
    grow = {
        name: np.pad(getattr(dome.model, name), [(0, 4)] + [(0, 0)] * (getattr(dome.model, name).ndim - 1))
        for name in ("identity", "expression", "mean_albedo", "albedo_modes")
    }
    model = replace(
        dome.model,
        mean=np.concatenate([dome.model.mean, wall]).astype(np.float32),
        faces=faces,
        faces_uv=np.concatenate([dome.model.faces_uv, np.zeros((2, 3), np.int32)]),
        face_mask=np.arange(len(faces)) < len(faces) - 2,
        **grow,
    )
    centre = np.array([0.0, 0.0, 0.6])
    walls = np.stack([(wall - centre) @ r.T + centre for r in dome.geometry.rotation])
    vertices = np.concatenate([dome.geometry.vertices, walls.astype(np.float32)], axis=1)
    albedo = np.pad(dome.geometry.vertex_albedo, ((0, 4), (0, 0)), mode="edge")
    dome = replace(dome, model=model, geometry=replace(dome.geometry, vertices=vertices, vertex_albedo=albedo))
    for (name, t), frame in dome.frames.items():
        view, v = dome.camera(name), vertices[t]
        scene = SurfaceScene(v, faces)
        buffer = scene.gbuffer(view)
        hit = (buffer.face >= 0) & (buffer.face < len(faces) - 2) & frame.valid
        face, weights = buffer.face[hit], buffer.weights[hit]
        point = interpolate(v, faces, face, weights)
        normal = normalize(interpolate(vertex_normals(v, faces), faces, face, weights))
        toward = normalize(view.position - point)
        open_sky = scene.open_towards(point, normal, KEY.samples())
        matt, glossy = light_columns(normal, toward, open_sky, KEY, EXPONENT, dome.fresnel)
        uv = interpolate(model.uv, model.faces_uv, face, weights)
        x, y = sample_map(dome.diffuse, uv), sample_map(dome.specular, uv)
        traced = interpolate(trace_transfer(scene, v, vertex_normals(v, faces), 4), faces, face, weights)
        body, glint = shade_points(
            normal, toward, x, y, dome.radiance, 0.0, EXPONENT, "shadowed", traced, fresnel=dome.fresnel
        )
        image = np.full_like(frame.image, 0.1)
        sharp = (x * matt[:, None] + y[:, None] * glossy[:, None]) * KEY.colour.astype(np.float32)
        image[hit] = body + glint + sharp
        dome.frames[name, t] = replace(frame, image=image)
    return dome


@pytest.fixture(scope="module")
def walled(variant):
    return walled_dome()


@pytest.fixture(scope="module")
def found(walled):
    return infer_reflectance(walled, walled.model, walled.geometry, ("left", "right"), CONFIG)


def dome_under(*lights: DistantLight, steps: int = 3) -> TurningDome:
    """The turning dome with compact lights beside the smooth one."""
    dome = turning_dome(steps=steps)
    look = appearance(np.zeros((16, 3)), EXPONENT, "prefiltered", True, dome.fresnel, lights=lights)
    for (name, t), frame in dome.frames.items():
        view, v, faces = dome.camera(name), dome.geometry.vertices[t], dome.model.faces
        scene = SurfaceScene(v, faces)
        buffer = scene.gbuffer(view)
        face, weights = buffer.face[buffer.mask], buffer.weights[buffer.mask]
        point = interpolate(v, faces, face, weights)
        normal = normalize(interpolate(vertex_normals(v, faces), faces, face, weights))
        shadows = replace(OPEN, visible=tuple(scene.open_towards(point, normal, light.samples()) for light in lights))
        diffuse, specular = look.shade(normal, normalize(view.position - point), shadows)
        uv = interpolate(dome.model.uv, dome.model.faces_uv, face, weights)
        image = frame.image.copy()
        image[buffer.mask] += sample_map(dome.diffuse, uv) * diffuse + sample_map(dome.specular, uv)[:, None] * specular
        dome.frames[name, t] = replace(frame, image=image)
    return dome


def degrees_off(found, *lights: DistantLight) -> float:
    """Largest angle from a true light to the nearest that was found."""
    towards = np.array([light.direction for light in found.illumination.lights])
    return max(float(np.degrees(np.arccos((towards @ light.direction).max()))) for light in lights)


def test_a_light_that_throws_a_shadow_is_found(walled, found):
    assert found.shading_model == "shadowed" and len(found.illumination.lights) == 1
    assert degrees_off(found, KEY) < 1.0
    (key,) = found.illumination.lights
    good = found.confidence > 0.9
    gauge = walled.diffuse[good].mean() / found.diffuse[good].mean()
    np.testing.assert_allclose(key.colour / gauge, KEY.colour, rtol=0.1)


def test_a_light_without_a_shadow_is_found_by_cosine_and_highlight(variant):
    dome = dome_under(KEY)
    found = infer_reflectance(dome, dome.model, dome.geometry, CAMERAS, replace(CONFIG, texture_size=24))
    assert len(found.illumination.lights) == 1 and degrees_off(found, KEY) < 3.0


def test_without_a_given_exponent_the_lobe_is_that_of_skin_and_the_light_is_found(walled):
    config = replace(CONFIG, texture_size=24, exponent=None)
    found = infer_reflectance(walled, walled.model, walled.geometry, CAMERAS, config)
    assert found.lobe.exponent == SKIN_EXPONENT
    assert len(found.illumination.lights) == 1 and degrees_off(found, KEY) < 3.0


def test_two_lights_are_found_together(variant):
    dome = dome_under(KEY, FILL)
    found = infer_reflectance(dome, dome.model, dome.geometry, CAMERAS, replace(CONFIG, texture_size=24))
    assert len(found.illumination.lights) == 2 and degrees_off(found, KEY, FILL) < 4.0


def test_without_a_compact_light_none_is_made_up(variant):
    dome = turning_dome(steps=2)
    estimate = infer_reflectance(dome, dome.model, dome.geometry, CAMERAS, replace(CONFIG, texture_size=24))
    assert estimate.illumination.lights == ()


def test_single_directions_are_columns_of_point_lights(walled):
    """What the estimate is made of: cosine, lobe and shadow of each direction, as a light there has them."""
    surface = Surface(walled, walled.model, walled.geometry, CAMERAS, 32)
    seen = surface.observe(surface.sample(200, np.random.default_rng(0)))
    look = appearance(np.zeros((16, 3)), EXPONENT, "shadowed", True, walled.fresnel)
    forward = Forward(look, surface.meshes)
    towards = normalize(KEY.direction + 0.4 * np.random.default_rng(1).normal(size=(40, 3)))
    lights = tuple(DistantLight(d, 0.0, np.zeros(3)) for d in towards)
    expected = forward.with_lights(lights).transfers(seen, np.zeros((16 + len(lights), 3)))
    for found, known in zip(forward.columns(seen, towards), expected, strict=True):
        np.testing.assert_allclose(found, known[..., 16:], atol=1e-5)
