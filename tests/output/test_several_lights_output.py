"""Several compact lights in saved results, renders, scene files, reports, glTF and relighting."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import DistantLight
from mifit.core.mesh import normalize
from mifit.output.export import export
from mifit.output.report import _lighting
from mifit.output.scene import write_scene
from mifit.result import Reconstruction

FAR = DistantLight(normalize(np.array([-0.6, 0.5, 0.6])), 0.01, np.array([1.0, 1.5, 2.0]))
OTHER = DistantLight(normalize(np.array([0.4, 0.35, 0.85])), 0.02, np.array([2.0, 1.5, 1.0]))


def under(result, *lights):
    illumination = replace(result.illumination, lights=lights)
    reflectance = replace(result.reflectance, shading_model="prefiltered", illumination=illumination)
    return replace(result, reflectance=reflectance, normals=None, mesh=None)


@pytest.fixture(scope="module")
def lit(ball, variant):
    return under(ball, FAR, OTHER)


def test_they_survive_saving_in_their_order(lit, tmp_path):
    lit.save(tmp_path)
    far, near = Reconstruction.load(tmp_path, lit.model).illumination.lights
    np.testing.assert_array_equal(far.direction, FAR.direction)
    np.testing.assert_array_equal(far.colour, FAR.colour)
    np.testing.assert_array_equal(near.direction, OTHER.direction)
    np.testing.assert_allclose(near.colour, OTHER.colour)


@pytest.mark.parametrize(("integrator", "samples"), [("local", 2), ("path", 128)])
def test_each_adds_to_a_render_what_it_adds_alone(lit, integrator, samples):
    results = [lit, under(lit, FAR), under(lit, OTHER), under(lit)]
    images = [r.render(lit.cameras[0], 0, "diffuse", integrator, samples, seed=1) for r in results]
    both, far, near, dark = (image[images[0][..., 3] == 1][:, :3] for image in images)
    alone = [(part - dark).mean(0) for part in (far, near)]
    assert min(part.min() for part in alone) > 0.005
    np.testing.assert_allclose((both - dark).mean(0), sum(alone), rtol=1e-3 if integrator == "local" else 0.03)


def test_scene_files_hold_an_emitter_each(lit, tmp_path):
    write_scene(lit, tmp_path / "scene.xml", 0)
    text = (tmp_path / "scene.xml").read_text()
    assert text.index('id="light_1"') < text.index('id="light_2"')
    assert text.count('type="directional"') == 2


def test_the_report_says_where_each_is(lit):
    text = _lighting(lit)
    assert all(light.describe() in text for light in (FAR, OTHER))


def test_glb_files_name_each(lit, tmp_path):
    export(lit, "glb", tmp_path / "ball.glb")
    data = (tmp_path / "ball.glb").read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])

    def lists(value):
        if isinstance(value, dict):
            return [value["lights"]] if "lights" in value else [x for v in value.values() for x in lists(v)]
        return [x for v in value for x in lists(v)] if isinstance(value, list) else []

    (found,) = (each for each in lists(document) if each and "radius" in each[0])
    assert found == json.loads(json.dumps([FAR.document(), OTHER.document()]))


def test_relighting_turns_all_of_them(lit):
    far, near = lit.relight(lit.illumination, rotate=90.0).illumination.lights
    for light, turned in ((FAR, far), (OTHER, near)):
        x, y, z = light.direction
        np.testing.assert_allclose(turned.direction, [z, y, -x], atol=1e-6)
