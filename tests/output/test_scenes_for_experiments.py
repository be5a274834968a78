"""`Reconstruction.scene`: one set of ids, rendered and differentiated by every integrator, whatever the fit was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mifit
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.config import SHADINGS
from mifit.errors import InputError
from tests.output.conftest import ball_camera, ball_result
from tests.output.test_result_scene import off_centre
from tests.output.test_views import smooth_environment

OURS_AND_THEIRS = ("shdirect", "path", "direct", "prb", "prb_basic", "direct_projective", "prb_projective")
QUICK = ("shdirect", "prb")
KEYS = (
    "skin.diffuse_reflectance.data", "skin.specular_reflectance.data", "skin.normal_correction.data",
    "light.coefficients",
)  # fmt: skip


def face(model="prefiltered", order=3, lights=(), fresnel=None):
    """The ball under light of some bands that is negative in places, with compact lights or without."""
    ball = ball_result(size=16)
    radiance = np.zeros((order * order, 3))
    radiance[:9] = ball.illumination.radiance
    radiance[9:] = 0.3 * np.random.default_rng(0).standard_normal((order * order - 9, 3))
    lobe = replace(ball.lobe, fresnel=fresnel, normalized=model != "paper")
    reflectance = replace(
        ball.reflectance, illumination=Illumination(radiance, lights, 0.02), lobe=lobe, shading_model=model
    )
    return replace(ball, reflectance=reflectance)


SUN = DistantLight(np.array([0.6, 0.0, 0.8]), 0.05, np.array([1.0, 0.9, 0.8]))
LIGHTINGS = {"3 bands": (3, (), None), "5 bands and a compact light": (5, (SUN,), 5.0)}
MOST = pytest.param("shdirect", "prefiltered", "10 bands and a compact light", marks=pytest.mark.slow)
"""All bands that there are, once: their kernels take a quarter of a minute to compile, those with shadows minutes."""


def combinations():
    """Ours with every model and lighting; every other integrator with the paper's model, and with one that stands for
    the rest, which differ in `shdirect` alone, under either lighting in turn.

    All at once would take twice as long: each compiles kernels of its own.
    """
    plain, rich = LIGHTINGS
    ours = [(model, light) for model in SHADINGS[1:] for light in LIGHTINGS if model != "paper" or light == plain]
    found = [("shdirect", *each) for each in ours]
    for i, integrator in enumerate(OURS_AND_THEIRS[1:]):
        found += [(integrator, "paper", plain), (integrator, "prefiltered", (plain, rich)[i % 2])]
    quick = {(integrator, model, plain) for integrator in QUICK for model in SHADINGS[1:]}
    return [pytest.param(*each, marks=[] if each in quick else pytest.mark.slow) for each in found] + [MOST]


@pytest.mark.parametrize(("integrator", "model", "lighting"), combinations())
def test_every_integrator_renders_and_differentiates_every_scene(variant, integrator, model, lighting):
    import drjit as dr
    import mitsuba as mi

    light = (10, (SUN,), 5.0) if lighting == MOST.values[2] else LIGHTINGS[lighting]
    scene = face(model, *light).scene(integrator, cameras=[ball_camera(size=24)], samples=4)
    parameters = mi.traverse(scene)
    optimizer = mi.ad.Adam(lr=0.1)
    for key in KEYS:
        optimizer[key] = parameters[key]
    parameters.update(optimizer)
    image = mi.render(scene, parameters, spp=4, seed=1)
    pixels = np.array(image)
    assert pixels.shape == (24, 24, 4) and np.isfinite(pixels).all() and pixels[12, 12, :3].min() > 0.02
    dr.backward(dr.mean(dr.square(image[..., :3] - 0.3), axis=None))
    for key in KEYS:
        gradient = np.array(dr.grad(optimizer[key]))
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0, key


@pytest.mark.parametrize("model", SHADINGS[1:])
def test_shdirect_shows_what_local_rendering_shows(variant, model):
    import mitsuba as mi

    # Without refined normals, shadows of the ball on itself and edges there is nothing that the two do differently.
    result = replace(face(model, fresnel=None), normals=None, mesh=None)
    camera = ball_camera(angle=5)
    image = np.array(mi.render(result.scene("shdirect", cameras=[camera]), spp=4))
    local = result.render(camera, 0)
    inside = (local[..., 3] == 1) & (image[..., 3] == 1)
    inside[:20], inside[-20:], inside[:, :20], inside[:, -20:] = False, False, False, False
    assert inside.sum() > 300
    difference = np.abs(image - local)[inside][:, :3]
    assert difference.mean() < 0.01 * local[inside][:, :3].mean()


def test_shdirect_shades_a_compact_light_as_path_tracing_does(variant):
    import mitsuba as mi

    lit = face(lights=(SUN,))
    dark = replace(lit, reflectance=replace(lit.reflectance, illumination=Illumination(np.zeros((9, 3)), (SUN,))))
    camera = ball_camera(size=48)
    scenes = {name: dark.scene(name, cameras=[camera]) for name in ("shdirect", "direct")}
    images = {name: np.array(mi.render(scene, spp=64, seed=0))[..., :3] for name, scene in scenes.items()}
    assert images["direct"].max() > 0.2
    np.testing.assert_allclose(images["shdirect"].mean(), images["direct"].mean(), rtol=0.01)


def test_ids_are_the_same_in_every_scene(variant):
    import mitsuba as mi

    result = face(lights=(SUN,))
    names = [set(mi.traverse(result.scene(name)).keys()) for name in ("path", "prb")]
    assert names[0] == names[1] >= {*KEYS, "skin.exponent.value", "camera_left.to_world", "rest.vertex_color"}
    scene = result.scene({"type": "path", "max_depth": 2}, timestep=3, cameras=[off_centre()])
    assert [sensor.id() for sensor in scene.sensors()] == ["camera_real"]
    assert {shape.id() for shape in scene.shapes()} == {"face", "rest"}
    assert {emitter.id() for emitter in scene.emitters()} == {"light", "light_1"}


def test_a_relit_face_keeps_its_ids(variant):
    import mitsuba as mi

    lit = face().relight(smooth_environment(), rotate=30)
    assert "light.data" in mi.traverse(lit.scene("path"))
    assert "light.coefficients" in mi.traverse(lit.scene("shdirect"))  # which knows harmonics alone


def test_stage_1_has_a_scene_too(variant, stage_1_ball):
    import mitsuba as mi

    image = np.array(mi.render(stage_1_ball.scene("shdirect", method="pca"), spp=1))
    local = stage_1_ball.render(stage_1_ball.cameras[0], 0, method="pca")
    middle = (slice(24, 40), slice(24, 40), slice(0, 3))
    assert image[middle].mean() == pytest.approx(local[middle].mean(), rel=0.01)


def test_what_is_refused(variant):
    result = face()
    with pytest.raises(InputError, match="timestep 1 is not in this result"):
        result.scene(timestep=1)
    with pytest.raises(InputError, match="method: found 'best'"):
        result.scene(method="best")
    with pytest.raises(InputError, match="nonsense"):
        result.scene("nonsense")
    with pytest.raises(InputError, match="found lens distortion"):
        result.scene(cameras=[replace(ball_camera(), distortion=(0.1, 0, 0, 0))])


def test_scenes_of_the_result_folder_render_with_shdirect(variant, tmp_path):
    import mitsuba as mi

    face(order=10).save(tmp_path)
    scene = mifit.load_scene(tmp_path / "scene.xml", spp=1)
    image = mi.render(scene, integrator=mi.load_dict({"type": "shdirect", "model": "shadowed"}), spp=1)
    assert np.isfinite(np.array(image)).all()
