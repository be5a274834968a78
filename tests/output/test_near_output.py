"""A near light in saved results, renders, scene files, reports and relighting."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import NearLight
from mifit.output.scene import write_scene
from mifit.reconstruction import Reconstruction

PLACE, POWER = np.array([12.0, 10.0, 24.0]), np.array([2.0, 1.5, 1.0])


@pytest.fixture(scope="module")
def lit(ball, variant):
    """The ball, nine units in radius, without refined normals and with a light fifteen units off its surface."""
    light = NearLight(PLACE, 0.1, POWER, np.zeros(3))
    illumination = replace(ball.reflectance.illumination, lights=(light,))
    reflectance = replace(ball.reflectance, shading_model="prefiltered", illumination=illumination)
    return replace(ball, reflectance=reflectance, normals=None, mesh=None)


def added(result, *arguments):
    """What the light adds to the pixels that show the ball."""
    dark = replace(result, reflectance=replace(result.reflectance, illumination=result.illumination.without_lights()))
    images = [r.render(result.cameras[0], 0, *arguments, seed=1) for r in (result, dark)]
    return (images[0] - images[1])[images[0][..., 3] == 1][:, :3]


def test_it_survives_saving(lit, tmp_path):
    lit.save(tmp_path)
    (light,) = Reconstruction.load(tmp_path, lit.model).illumination.lights
    assert isinstance(light, NearLight) and light.radius == 0.1
    np.testing.assert_allclose(light.position, PLACE)
    np.testing.assert_allclose(light.colour, POWER, rtol=1e-12)
    (document,) = json.loads((tmp_path / "result.json").read_text())["lighting"]["lights"]
    np.testing.assert_allclose(document["intensity"], POWER * (PLACE**2).sum())


def test_path_tracing_agrees_with_local_shading(lit):
    """On a convex ball a point emitter adds what local shading adds, place by place."""
    local, path = added(lit, "diffuse", "local", 2), added(lit, "diffuse", "path", 256)
    bright = local[:, 0] > 0.15
    assert bright.sum() > 500
    np.testing.assert_allclose(path[bright].mean(0), local[bright].mean(0), rtol=0.01)
    brightest = local[:, 0] > np.quantile(local[bright, 0], 0.9)
    np.testing.assert_allclose(path[brightest].mean(0), local[brightest].mean(0), rtol=0.02)


def test_a_scene_for_shdirect_has_it_too(lit):
    import mitsuba as mi

    dark = replace(lit, reflectance=replace(lit.reflectance, illumination=lit.illumination.without_lights()))
    scenes = [r.scene("shdirect", 0, method="diffuse") for r in (lit, dark)]
    images = [np.array(mi.render(scene, sensor=0, spp=16)) for scene in scenes]
    local = lit.render(lit.cameras[0], 0, "diffuse")[..., :3] - dark.render(lit.cameras[0], 0, "diffuse")[..., :3]
    bright = local[..., 0] > 0.15
    got = (images[0] - images[1])[..., :3]
    np.testing.assert_allclose(got[bright].mean(0), local[bright].mean(0), rtol=0.02)


def test_scene_files_hold_a_point_emitter(lit, tmp_path):
    write_scene(lit, tmp_path / "scene.xml", 0)
    for name in ("scene.xml", "scene_stock.xml"):
        text = (tmp_path / name).read_text()
        assert 'type="point"' in text and 'id="light_1"' in text


def test_the_report_says_where_it_is(lit):
    from mifit.output.report import _lighting

    assert f"({np.linalg.norm(PLACE) * lit.unit_mm:.0f} mm) from the head's middle" in _lighting(lit)


def test_relighting_takes_it_away_or_carries_it_around_the_head(lit):
    assert lit.relight(np.ones((16, 32, 3), np.float32)).illumination.lights == ()
    aside = np.array([3.0, 2.0, 100.0])  # a head that isn't at the origin of its world
    geometry = replace(lit.geometry, vertices=lit.geometry.vertices + aside.astype(np.float32))
    middle = geometry.vertices[0].mean(0)
    light = replace(lit.illumination.lights[0], position=PLACE + middle, centre=middle)
    moved = replace(lit, geometry=geometry)
    (turned,) = moved.relight(replace(lit.illumination, lights=(light,)), rotate=90.0).illumination.lights
    np.testing.assert_allclose(turned.position - middle, [PLACE[2], PLACE[1], -PLACE[0]], atol=1e-4)


def test_glb_files_name_it(lit, tmp_path):
    from mifit.output.export import export

    export(lit, "glb", tmp_path / "ball.glb")
    assert b'"intensity"' in (tmp_path / "ball.glb").read_bytes()


def test_an_edited_face_keeps_it(lit):
    dark = lit.with_albedo(0.5 * lit.reflectance.diffuse)
    np.testing.assert_allclose(added(dark, "diffuse", "local", 2), 0.5 * added(lit, "diffuse", "local", 2), atol=2e-3)
