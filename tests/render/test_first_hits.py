"""What `shdirect` keeps between images of a camera: nothing that has moved since, and no gradient but the true one."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest

import mifit
from mifit.appearance.arrays import aligned
from tests.render.test_shdirect import ball, bitmap, make_scene, positive_light

KEYS = (
    "mesh.bsdf.diffuse_reflectance.data",
    "mesh.bsdf.specular_reflectance.data",
    "mesh.bsdf.normal_correction.data",
    "light.coefficients",
)


@pytest.fixture(scope="module", autouse=True)
def plugins(variant: str) -> None:
    mifit.register_plugins()


def textured(hide: bool = False, **options):
    rng = np.random.default_rng(5)
    bsdf = {
        "type": "blinnphong",
        "diffuse_reflectance": bitmap(rng.uniform(0.2, 0.8, (16, 16, 3))),
        "specular_reflectance": bitmap(rng.uniform(0.1, 0.4, (16, 16, 1))),
        "normal_correction": bitmap(rng.uniform(-0.1, 0.1, (16, 16, 3))),
        "exponent": 20.0,
    }
    return make_scene(ball(), bsdf, positive_light(), hide_emitters=hide, **options)


def image_of(scene, integrator=None) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.render(scene, integrator=integrator or scene.integrator(), spp=1))


def change(scene, what: str) -> None:
    import mitsuba as mi

    params = mi.traverse(scene)
    if what == "sensor":
        turned = mi.ScalarTransform4f().look_at([1.0, 0.5, 4], [0, 0, 0], [0, 1, 0])
        params["sensor.to_world"] = mi.Transform4f(turned)
    elif what == "uv":
        params["mesh.vertex_texcoords"] = params["mesh.vertex_texcoords"] * 0.5
    elif what == "normals":
        params["mesh.vertex_normals"] = -params["mesh.vertex_normals"]
    elif what == "positions":
        params["mesh.vertex_positions"] = params["mesh.vertex_positions"] * 0.8
    elif what == "faces":
        faces = np.array(params["mesh.faces"]).reshape(-1, 3)
        faces[: len(faces) // 2] = faces[len(faces) // 2 :]
        params["mesh.faces"] = mi.UInt32(faces.ravel())
    elif what == "exponent":
        params["mesh.bsdf.exponent.value"] = 80.0
    elif what == "albedo":
        params["mesh.bsdf.diffuse_reflectance.data"] = params["mesh.bsdf.diffuse_reflectance.data"] * 0.5
    params.update()


@pytest.mark.parametrize("what", ["sensor", "uv", "normals", "positions", "faces", "albedo", "exponent"])
def test_what_moves_is_looked_at_again(what: str) -> None:
    import mitsuba as mi

    scene = textured()
    before = image_of(scene)
    change(scene, what)
    after = image_of(scene)
    fresh = image_of(scene, mi.load_dict({"type": "shdirect"}))
    np.testing.assert_array_equal(after, fresh)
    assert np.isfinite(after).all()
    assert np.abs(after - before).max() > 0.01


@pytest.mark.parametrize("what", ["to_world", "fx", "x_fov", "near_clip"])
def test_a_camera_that_changes_looks_again(what: str) -> None:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    pose = mi.ScalarTransform4f().look_at([0.3, 0, 4], [0, 0, 0], [0, 1, 0])
    kind = {"type": "pinhole", "fx": 40.0, "fy": 44.0, "cx": 16.0, "cy": 15.0}
    if what in ("x_fov", "near_clip"):
        kind = {"type": "perspective", "fov": 40}
    scene = textured()
    sensor = mi.load_dict({**kind, "to_world": pose, "film": film})

    def seen(integrator) -> np.ndarray:
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=1))

    before = seen(scene.integrator())
    if what == "to_world":
        sensor = mi.load_dict({**kind, "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0]) @ pose, "film": film})
    else:
        params = mi.traverse(sensor)
        params[what] = {"fx": 30.0, "x_fov": 55.0, "near_clip": 3.5}[what]
        params.update()
    after = seen(scene.integrator())
    np.testing.assert_array_equal(after, seen(mi.load_dict({"type": "shdirect"})))
    assert np.abs(after - before).max() > 0.01


@pytest.mark.parametrize(("pixels", "spp"), [("rgba", 1), ("rgba", 4), ("rgb", 4), ("luminance", 1)])
def test_pixels_written_at_once_are_those_that_mitsuba_adds_up(pixels: str, spp: int) -> None:
    import mitsuba as mi
    from mitsuba.python.ad.integrators.common import ADIntegrator

    scene = textured(hide=True)
    film = {"type": "hdrfilm", "width": 32, "height": 24, "pixel_format": pixels, "rfilter": {"type": "box"}}
    film |= {"crop_width": 20, "crop_height": 15, "crop_offset_x": 5, "crop_offset_y": 2}
    pose = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "fov": 40, "to_world": pose, "film": film})
    ours = np.array(scene.integrator().render(scene, sensor, 0, spp))
    theirs = np.array(ADIntegrator.render(scene.integrator(), scene, sensor, 0, spp))
    assert ours.shape == theirs.shape
    assert 0 < ours.max()
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)
    kept = sensor.film().bitmap(raw=False).convert(component_format=mi.Struct.Type.Float32)
    np.testing.assert_allclose(np.array(kept).reshape(theirs.shape), theirs, atol=1e-2)


def test_a_second_image_traces_no_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba as mi

    scene, traced = textured(), []
    find = mi.Scene.ray_intersect_preliminary
    monkeypatch.setattr(
        mi.Scene, "ray_intersect_preliminary", lambda *a, **k: traced.append(1) or find(*a, **k), raising=True
    )
    first, second = image_of(scene), image_of(scene)
    assert len(traced) == 1
    np.testing.assert_array_equal(first, second)


def test_views_share_an_integrator_and_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba as mi

    from mifit.render import first_hits

    monkeypatch.setattr(first_hits, "KEPT_RAYS", 3 * 32 * 32)
    scene = textured()
    integrator = scene.integrator()
    for k in range(6):
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": 40,
                "to_world": mi.ScalarTransform4f().look_at([k - 2.0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            }
        )
        seen = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=1))
        fresh = np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "shdirect"}), spp=1))
        np.testing.assert_array_equal(seen, fresh)
        assert len(integrator._hits.kept) <= 3


@pytest.mark.parametrize("hide", [False, True])
@pytest.mark.parametrize("spp", [1, 4])
def test_gradients_are_those_of_the_image_that_mitsuba_forms(hide: bool, spp: int) -> None:
    import drjit as dr
    import mitsuba as mi
    from mitsuba.python.ad.integrators.common import ADIntegrator

    scene = textured(hide)
    target = mi.TensorXf(aligned(np.random.default_rng(1).uniform(0, 1, (32, 32, 3))))

    def gradients(keys: tuple[str, ...], general: bool) -> list[np.ndarray]:
        params = mi.traverse(scene)
        for key in keys:
            dr.enable_grad(params[key])
            dr.set_grad(params[key], 0.0)
        params.update()
        integrator = mi.load_dict({"type": "shdirect", "hide_emitters": hide})
        if general:
            integrator.render_backward(scene, params, target, scene.sensors()[0], 0, spp)
        else:
            ADIntegrator.render_backward(integrator, scene, params, target, scene.sensors()[0], 0, spp)
        found = [np.array(dr.grad(params[key])) for key in keys]
        for key in keys:
            dr.disable_grad(params[key])
        return found

    for keys in (KEYS, ("mesh.vertex_positions",), ("light.coefficients",)):
        for ours, theirs in zip(gradients(keys, True), gradients(keys, False), strict=True):
            assert np.abs(theirs).max() > 0
            np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-5 * np.abs(theirs).max())


def test_a_view_past_everything_is_empty() -> None:
    import drjit as dr
    import mitsuba as mi

    scene = textured(hide=True)
    params = mi.traverse(scene)
    params["mesh.vertex_positions"] = params["mesh.vertex_positions"] + 100.0
    params.update()
    key = KEYS[0]
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, spp=1)
    dr.backward(dr.mean(image, axis=None))
    assert not np.array(image)[..., :3].any()
    assert not np.array(dr.grad(params[key])).any()


def test_a_scene_that_is_gone_leaves_nothing() -> None:
    """An integrator that held its scene, which holds it, would stay for ever, with all that it keeps."""
    scene = textured()
    image_of(scene)
    kept = weakref.ref(scene.integrator()._hits)
    assert kept() is not None
    del scene
    gc.collect()
    assert kept() is None
