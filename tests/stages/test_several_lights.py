"""How stage 2 finds several compact lights: one beside another, two that hide one another, no more than there are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import TurningDome
from stages.test_near_light_search import CAMERAS, CONFIG, LAMP, MIDDLE, dome_under

from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import DistantLight, NearLight
from mifit.appearance.models import get
from mifit.appearance.occlusion import MeshPoints, OccludingMesh
from mifit.core.estimate import ReflectanceEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.observations import Surface
from mifit.stages.reflectance import choice
from mifit.stages.reflectance.choice import plain_forward
from mifit.stages.reflectance.key import APART, Candidates, WideLights, starts
from mifit.stages.reflectance.trials import fit_lighting, lighting_problem

KEY = DistantLight(normalize(np.array([0.75, 0.2, 0.6])), 0.02, np.array([4.0, 3.6, 3.0]))
FILL = DistantLight(normalize(np.array([-0.7, 0.35, 0.5])), 0.02, np.array([2.0, 2.4, 3.0]))


@pytest.fixture(scope="module")
def between(variant):
    return dome_under(KEY, FILL)


def fitted(dome: TurningDome, size: int, **settings) -> ReflectanceEstimate:
    return infer_reflectance(dome, dome.model, dome.geometry, CAMERAS, replace(CONFIG, texture_size=size, **settings))


def off_by(found: ReflectanceEstimate, directions) -> list[float]:
    """Degrees from each true direction to the nearest light found."""
    towards = np.array([light.direction for light in found.illumination.lights])
    return [float(np.degrees(np.arccos((towards @ d).max()))) for d in directions]


def unseen_view_error(dome: TurningDome, found: ReflectanceEstimate) -> float:
    """Root mean squared error of the third camera's images, which are not fitted."""
    look, errors = Appearance(get(found.shading_model), found.illumination, found.lobe), []
    for t in dome.geometry.timesteps:
        view, v, faces = dome.camera("third"), dome.geometry.vertices[t], dome.model.faces
        scene = SurfaceScene(v, faces)
        buffer = scene.gbuffer(view)
        face, weights = buffer.face[buffer.mask], buffer.weights[buffer.mask]
        point = interpolate(v, faces, face, weights)
        normal = normalize(interpolate(vertex_normals(v, faces), faces, face, weights))
        shadows = look.trace(OccludingMesh(scene), MeshPoints(point, normal, face, weights))
        matt, glossy = look.shade(normal, normalize(view.position - point), shadows, point)
        uv = interpolate(dome.model.uv, dome.model.faces_uv, face, weights)
        shown = sample_map(found.diffuse, uv) * matt + sample_map(found.specular, uv)[:, None] * glossy
        known = sample_map(found.confidence, uv) > 0.5
        errors.append((shown - dome.frames["third", t].image[buffer.mask])[known])
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))


def test_a_second_light_is_found_beside_the_first(between, monkeypatch):
    both = fitted(between, 24)
    assert both.report.details["shading"]["chosen"] == "keyed"
    assert len(both.illumination.lights) == 2
    assert max(off_by(both, [KEY.direction, FILL.direction])) < 3.0
    error = {trial["lights"]: trial["error"] for trial in both.report.details["shading"]["predicted"]}
    assert error[2] < 0.7 * error[1]
    monkeypatch.setattr(choice, "MARGIN", 0.9)  # the first one is asked for, a second one has to predict better
    one = fitted(between, 24, shading="keyed")
    assert len(one.illumination.lights) == 1
    assert unseen_view_error(between, both) < 0.6 * unseen_view_error(between, one)


def test_two_lights_that_hide_one_another_are_found_together(between, monkeypatch):
    monkeypatch.setattr(choice, "LIGHTS", 1)
    assert fitted(between, 48).illumination.lights == ()  # a search for one alone widens to make up for the other
    monkeypatch.undo()
    both = fitted(between, 48)
    assert len(both.illumination.lights) == 2
    assert max(off_by(both, [KEY.direction, FILL.direction])) < 3.0


def test_one_of_two_may_be_near(variant):
    found = fitted(dome_under(LAMP, FILL), 32)
    assert found.report.details["shading"]["chosen"] == "near"
    kinds = {type(light) for light in found.illumination.lights}
    assert kinds == {NearLight, DistantLight} and len(found.illumination.lights) == 2
    (near,) = (light for light in found.illumination.lights if isinstance(light, NearLight))
    assert np.linalg.norm(near.position - LAMP.position) < 0.25 * np.linalg.norm(LAMP.position - MIDDLE)
    (far,) = (light for light in found.illumination.lights if isinstance(light, DistantLight))
    assert far.direction @ FILL.direction > np.cos(np.radians(4.0))


def test_beside_a_light_that_is_kept_another_one_is_judged(between):
    surface = Surface(between, between.model, between.geometry, CAMERAS, 32)
    seen = surface.observe(surface.sample(400, np.random.default_rng(0)))
    albedo = np.full((len(seen.texel), 3), 0.4, np.float32)
    plain = plain_forward(get("shadowed"), CONFIG.exponent, CONFIG, surface)
    forward = plain.with_lights((KEY.with_colour(np.zeros(3)),))
    found = fit_lighting(seen, forward, albedo, CONFIG, 8)
    problem = lighting_problem(seen, forward, found.light, albedo, True)
    beside = Candidates.about(seen, forward, problem, found, kept=forward.lights)
    alone = Candidates.about(seen, forward, problem, found)
    dark = [light.with_colour(np.zeros(3)) for light in (KEY, FILL)]
    key, fill = beside.explained(dark)
    assert fill > 0.2 * float((beside.weight * beside.residual**2).sum())
    assert key < 0.05 * fill  # what is there already explains nothing more
    assert alone.explained(dark[:1])[0] > 10.0 * key  # but it does where it is to be replaced
    found_starts = starts(beside, WideLights.of(seen, plain))
    assert found_starts and all(d @ KEY.direction < np.cos(APART) for d in found_starts)
    assert found_starts[0] @ FILL.direction > np.cos(np.radians(10.0))
