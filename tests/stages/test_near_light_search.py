"""How stage 2 finds out that a lamp is near, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, TurningDome, turning_dome

from mifit.appearance.formation import OPEN
from mifit.appearance.illumination import DistantLight, NearLight
from mifit.config import ReflectanceConfig
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.errors import InputError
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.observations import Surface
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.near import Judge, find_near, without_edges
from mifit.stages.reflectance.trials import fit_lighting, lighting_problem
from tests.shaded import appearance

CONFIG = ReflectanceConfig(texture_size=SIZE, shading="auto", bands=4, exponent=EXPONENT, smoothness_weight=1e-5)
MIDDLE = np.array([0.0, 0.0, 0.6])
LAMP = NearLight(MIDDLE + 3.0 * normalize(np.array([0.6, 0.35, 0.75])), 0.03, np.array([4.0, 3.6, 3.0]), MIDDLE)
CAMERAS = ("left", "right")


def dome_under(*lights: DistantLight | NearLight, steps: int = 3) -> TurningDome:
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
        shadows = replace(OPEN, visible=tuple(light.visible(scene, point, normal) for light in lights))
        matt, glossy = look.shade(normal, normalize(view.position - point), shadows, point)
        uv = interpolate(dome.model.uv, dome.model.faces_uv, face, weights)
        image = frame.image.copy()
        image[buffer.mask] += sample_map(dome.diffuse, uv) * matt + sample_map(dome.specular, uv)[:, None] * glossy
        dome.frames[name, t] = replace(frame, image=image)
    return dome


@pytest.fixture(scope="module")
def lamplit(variant):
    return dome_under(LAMP)


def test_a_lamp_three_lengths_away_is_found_where_it_is(lamplit):
    found = infer_reflectance(lamplit, lamplit.model, lamplit.geometry, CAMERAS, CONFIG)
    shading = found.report.details["shading"]
    assert shading["chosen"] == "near" and found.shading_model == "shadowed"
    (light,) = found.illumination.lights
    assert isinstance(light, NearLight)
    assert np.linalg.norm(light.position - LAMP.position) < 0.1 * LAMP.distance
    error = {x["shading"]: x["error"] for x in shading["predicted"]}
    assert error["near"] < 0.8 * error["keyed"]


def test_a_distant_light_stays_distant(variant):
    dome = dome_under(DistantLight(LAMP.direction, 0.02, LAMP.colour))
    found = infer_reflectance(dome, dome.model, dome.geometry, CAMERAS, CONFIG)
    assert found.report.details["shading"]["chosen"] == "keyed"
    (light,) = found.illumination.lights
    assert isinstance(light, DistantLight) and light.direction @ LAMP.direction > np.cos(np.radians(2.0))


def judge_about(dome, light):
    """What judges places about a fit with a light, and the points."""
    surface = Surface(dome, dome.model, dome.geometry, CAMERAS, SIZE)
    seen = surface.observe(surface.sample(400, np.random.default_rng(0)))
    plain = appearance(np.zeros((16, 3)), EXPONENT, "prefiltered", True, dome.fresnel)
    forward = Forward(plain, surface.meshes).with_lights((light,))
    certain = without_edges(seen, forward)
    albedo = np.full((400, 3), 0.4, np.float32)
    found = fit_lighting(certain, forward, albedo, CONFIG, 20)
    problem = lighting_problem(certain, forward, found.light, albedo, True)
    return Judge.about(certain, forward, problem, found), certain


def test_places_are_judged_by_what_they_leave(lamplit):
    judge, _ = judge_about(lamplit, LAMP.with_colour(np.zeros(3)))
    lights = [replace(LAMP, position=MIDDLE + f * (LAMP.position - MIDDLE)) for f in (0.6, 1.0, 2.0)]
    distant = DistantLight(LAMP.direction, 0.01, np.zeros(3))
    left = judge.unexplained([*lights, distant])
    assert left.argmin() == 1 and left[1] < left[2] < left[3]
    np.testing.assert_allclose(judge.unexplained([distant, lights[2]]), left[[3, 2]], rtol=1e-4)  # whatever the order


def test_a_first_search_goes_from_far_away_to_about_there(lamplit):
    distant = DistantLight(LAMP.direction, 0.02, np.zeros(3))
    judge, seen = judge_about(lamplit, distant)
    light = find_near(judge, distant, seen.point)
    assert isinstance(light, NearLight) and 0.5 < light.distance / LAMP.distance < 2.0


def test_edges_of_shadows_dont_judge(variant):
    dome = turning_dome(steps=1)
    light = DistantLight(normalize(np.array([1.0, 0.0, 0.55])), 0.0, np.zeros(3))
    surface = Surface(dome, dome.model, dome.geometry, CAMERAS, SIZE)
    seen = surface.observe(surface.sample(2000, np.random.default_rng(0)))
    forward = Forward(appearance(np.zeros((16, 3)), EXPONENT, "prefiltered"), surface.meshes).with_lights((light,))
    left_out = (seen.weight > 0) & (without_edges(seen, forward).weight == 0)
    angle = np.degrees(np.arcsin(seen.normal[:, 0] @ light.direction))  # above the horizon of the light
    assert left_out[np.abs(angle) < 5.0].any() and not left_out[angle > 12.0].any()


def test_adam_refuses_it():
    with pytest.raises(InputError, match="found 'near' with solver 'adam'"):
        replace(CONFIG, shading="near", solver="adam")
