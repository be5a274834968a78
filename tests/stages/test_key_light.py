"""The compact light: its disc, shadows and lobe, and how stage 2 finds it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, TurningDome, turning_dome

from mifit.appearance.illumination import DistantLight, disc
from mifit.appearance.models import get
from mifit.appearance.occlusion import trace_transfer
from mifit.appearance.reference import specular_brdf
from mifit.config import ReflectanceConfig
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.observations import Surface
from mifit.stages.reflectance.choice import plain_forward
from mifit.stages.reflectance.key import Candidates
from mifit.stages.reflectance.trials import fit_lighting, lighting_problem
from tests.shaded import light_columns, shade_points

CONFIG = ReflectanceConfig(texture_size=SIZE, shading="keyed", bands=4, exponent=EXPONENT, smoothness_weight=1e-5)
KEY = DistantLight(normalize(np.array([0.75, 0.2, 0.6])), 0.02, np.array([4.0, 3.6, 3.0]))


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


def test_a_compact_light_is_found(walled, found):
    assert found.report.details["shading"]["chosen"] == "keyed" and found.shading_model == "shadowed"
    (key,) = found.illumination.lights
    assert np.degrees(np.arccos(key.direction @ KEY.direction)) < 1.0
    good = found.confidence > 0.9
    gauge = walled.diffuse[good].mean() / found.diffuse[good].mean()
    np.testing.assert_allclose(key.colour / gauge, KEY.colour, rtol=0.1)
    residuals = found.report.details["shading"]["residuals"]
    assert residuals["keyed"] < 0.3 * residuals["shadowed"]


def test_auto_takes_it_where_it_explains_the_images(walled):
    part = replace(CONFIG, texture_size=24, shading="auto")
    choice = infer_reflectance(walled, walled.model, walled.geometry, ("left", "right"), part).report.details["shading"]
    assert choice["chosen"] == "keyed"


def test_it_is_looked_for_beside_smoother_lighting_too(walled, monkeypatch):
    from mifit.stages.reflectance import choice
    from mifit.stages.reflectance.lighting_equations import PRIORS

    search, tried = choice._with_light, []

    def hidden_at_first(trials, chosen, priors, wide):
        tried.append(priors.roughness / PRIORS.roughness)
        return None if priors is PRIORS else search(trials, chosen, priors, wide)

    monkeypatch.setattr(choice, "_with_light", hidden_at_first)
    part = replace(CONFIG, texture_size=24, shading="auto")
    estimate = infer_reflectance(walled, walled.model, walled.geometry, ("left", "right"), part)
    assert tried == [1.0, 10.0, 10.0]  # a second light is looked for beside what showed the first
    assert estimate.report.details["shading"]["chosen"] == "keyed"
    (key,) = estimate.illumination.lights
    assert np.degrees(np.arccos(key.direction @ KEY.direction)) < 2.0


def test_without_a_compact_light_none_is_made_up(variant):
    dome = turning_dome(steps=2)
    estimate = infer_reflectance(dome, dome.model, dome.geometry, ("left", "right"), replace(CONFIG, texture_size=24))
    assert estimate.illumination.lights == ()
    assert estimate.report.details["shading"]["why"] == "no compact light explains enough"


def test_adam_refuses_it(walled):
    with pytest.raises(InputError, match="use solver 'als'"):
        replace(CONFIG, solver="adam")


def test_lights_judged_together_are_judged_as_each_alone(walled):
    surface = Surface(walled, walled.model, walled.geometry, ("left", "right"), 32)
    seen = surface.observe(surface.sample(300, np.random.default_rng(0)))
    albedo = np.full((len(seen.texel), 3), 0.4, np.float32)
    forward = plain_forward(get("shadowed"), 30.0, replace(CONFIG, bands=4), surface)
    found = fit_lighting(seen, forward, albedo, CONFIG, 4)
    problem = lighting_problem(seen, forward, found.light, albedo, True)
    candidates = Candidates.about(seen, forward, problem, found)
    towards = KEY.direction + 0.4 * np.random.default_rng(1).normal(size=(5, 3))
    lights = [DistantLight(d / np.linalg.norm(d), 0.05 * (i + 1), np.zeros(3)) for i, d in enumerate(towards)]
    together = candidates.explained(lights)
    assert np.ptp(together) > 0.1 * together.max() > 0.0
    # In double precision to the digit; what the equations leave of sums in single precision is a thousandth of them.
    names = ("weight", "diffuse_cross", "specular_cross")
    parts = {name: getattr(candidates, name).astype(np.float64) for name in names}
    fine = replace(candidates, rows=[rows.astype(np.float64) for rows in candidates.rows], **parts)
    exact = fine.explained(lights)
    np.testing.assert_allclose(exact, [fine.explained([light])[0] for light in lights], rtol=1e-9)
    np.testing.assert_allclose(together, exact, rtol=1e-3)
    bits = np.stack([np.stack([light.visible(m.scene, seen.point[:, t], seen.normal[:, t])
                               for t, m in enumerate(forward.meshes)], axis=1) for light in lights])  # fmt: skip
    np.testing.assert_allclose(candidates.explained(lights, bits), together, rtol=1e-6)
