"""Scene files: what a user renders from them is what mifit renders."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import mifit
from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.core.camera import Camera
from mifit.core.estimate import NormalsEstimate
from mifit.core.image import read_image, to_8_bit, write_image
from mifit.core.metrics import psnr
from mifit.core.sh import LUMINANCE
from mifit.errors import InputError
from mifit.output.export import export
from mifit.output.relight import write_relit
from mifit.output.scene import write_scene
from mifit.output.surface import surface_maps
from mifit.render.scene import make_sensor, render_scene
from tests.output.conftest import ball_camera
from tests.output.test_views import smooth_environment


@pytest.fixture(scope="module")
def flat(ball):
    """The ball without ambient term, which path tracing doesn't have."""
    return replace(ball, reflectance=replace(ball.reflectance, illumination=replace(ball.illumination, ambient=0.0)))


@pytest.fixture(scope="module")
def scene(flat, variant, tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball.xml"
    export(flat, "mitsuba", path, timestep=0)
    return path


def test_scene_file_renders_as_mifit_renders(flat, scene):
    ours = flat.render(flat.cameras[1], 0, integrator="path", samples=64, seed=3)
    theirs = render_scene(scene, {}, spp=64, seed=3, sensor=1)
    inside = (ours[..., 3] == 1) & (theirs[..., 3] == 1)
    np.testing.assert_allclose(ours[inside][:, :3], theirs[inside][:, :3], atol=1e-6)
    other = render_scene(scene, {}, spp=64, seed=4, sensor=1)
    assert psnr(to_8_bit(other[..., :3]), to_8_bit(ours[..., :3]), inside) > 30


def test_path_tracing_a_convex_diffuse_ball_is_local_shading(flat):
    """No shadows, no interreflection: both integrators answer the same, bent normals included.

    Light from the side makes irradiance change most with the normal. The bend is small: a path loses the light below
    the mesh's horizon that a bent normal would see, by about its square.
    """
    camera = ball_camera(angle=10)
    tilt = Rotation.from_euler("y", -10, degrees=True).as_matrix().astype(np.float32)
    radiance = np.zeros((9, 3))
    radiance[0], radiance[3] = 3.0, -1.7  # Y_1,1 = -k x
    flat = replace(flat, reflectance=replace(flat.reflectance, illumination=Illumination(radiance)), normals=None)
    base = np.stack([surface_maps(flat, t).normal for t in flat.timesteps])
    tilted = replace(flat, normals=NormalsEstimate(flat.timesteps, base @ tilt, flat.geometry.report))
    local = tilted.render(camera, 0, method="diffuse")
    path = tilted.render(camera, 0, method="diffuse", integrator="path", samples=512)
    smooth = flat.render(camera, 0, method="diffuse")
    inside = (local[..., 3] == 1) & (path[..., 3] == 1)
    inside[:20], inside[-20:], inside[:, :20], inside[:, -20:] = False, False, False, False
    error = np.abs(path - local)[inside][:, :3].mean()
    bend = np.abs(smooth - local)[inside][:, :3].mean()
    assert bend > 0.02 and error < 0.25 * bend
    unbent = flat.render(camera, 0, method="diffuse", integrator="path", samples=256)
    assert unbent[inside][:, :3].mean() == pytest.approx(smooth[inside][:, :3].mean(), rel=0.005)


@pytest.mark.parametrize(("exponent", "fresnel"), [(12.0, None), (150.0, 8.0)])
def test_specular_light_of_both_integrators_is_alike(flat, exponent, fresnel):
    flat = replace(flat, reflectance=replace(flat.reflectance, lobe=Lobe(exponent, fresnel)))
    camera = ball_camera(angle=10)
    glint = {}
    for integrator, samples in (("local", 2), ("path", 512)):
        full, diffuse = (
            flat.render(camera, 0, method=m, integrator=integrator, samples=samples) for m in ("full", "diffuse")
        )
        glint[integrator] = (full - diffuse)[24:40, 24:40, :3].mean()
    assert glint["path"] == pytest.approx(glint["local"], rel=0.1)


def test_stage_1_path_traces_as_pca(stage_1_ball, variant):
    camera = ball_camera(angle=0)
    path = stage_1_ball.render(camera, 0, method="pca", integrator="path", samples=256)
    local = stage_1_ball.render(camera, 0, method="pca")
    middle = (slice(24, 40), slice(24, 40), slice(0, 3))
    assert path[middle].mean() == pytest.approx(local[middle].mean() - stage_1_ball.geometry.ambient, rel=0.03)


def test_relit_scene_is_lit_by_the_environment(flat, variant, tmp_path):
    lit = flat.relight(smooth_environment(), rotate=40)
    path = lit.render(flat.cameras[0], 0, method="diffuse", integrator="path", samples=256)
    local = lit.render(flat.cameras[0], 0, method="diffuse")
    inside = local[..., 3] == 1
    inside[:20], inside[-20:], inside[:, :20], inside[:, -20:] = False, False, False, False
    assert path[inside][:, :3].mean() == pytest.approx(local[inside][:, :3].mean(), rel=0.05)
    correlation = np.corrcoef(path[inside][:, 0], local[inside][:, 0])[0, 1]
    assert correlation > 0.95
    write_scene(lit, tmp_path / "lit.xml", 0)
    assert 'type="envmap"' in (tmp_path / "lit.xml").read_text()


def test_relit_views_are_fast_and_can_be_checked_by_path_tracing(flat, variant, tmp_path):
    write_image(tmp_path / "studio.hdr", smooth_environment())
    out = tmp_path / "out"
    found = write_relit(flat, tmp_path / "studio.hdr", out, rotations=[20.0], exposure="auto", check=True)
    assert {p.name for p in out.iterdir()} == {"left.png", "right.png", "relight.png", "relight.json"}
    assert json.loads((out / "relight.json").read_text()) == found
    assert 25 < found["check"]["psnr"] < 60
    assert found["exposure"] == pytest.approx(found["capture_exposure"])
    assert found["mean_radiance"] == pytest.approx(flat.lighting.coefficients[0] @ LUMINANCE / np.sqrt(4 * np.pi))
    path = flat.relight(smooth_environment(), 20.0).render(flat.cameras[0], 0, integrator="path", samples=144)
    found = write_relit(flat, tmp_path / "studio.hdr", out, flat.cameras[:1], [20.0], integrator="path")
    assert found["exposure"] == 1.0 and "check" not in found
    covered = path[..., 3] == 1
    shown = read_image(out / "left.png")[..., :3][covered]
    assert np.abs(to_8_bit(shown).astype(float) - to_8_bit(path[..., :3])[covered]).mean() < 2.0


def test_a_turning_light_is_a_view_after_another(flat, variant, tmp_path):
    write_image(tmp_path / "studio.hdr", smooth_environment())
    env, camera = tmp_path / "studio.hdr", flat.cameras[0].resized(0.5)
    write_relit(flat, env, tmp_path / "out", [camera], [0.0, 120.0, 240.0])
    names = {f"left_{k:03d}.png" for k in range(3)}
    assert {p.name for p in (tmp_path / "out").iterdir()} == names | {"relight.json"}
    single = to_8_bit(flat.relight(env, 240.0).render(camera, 0)[..., :3]).astype(float)
    turned = to_8_bit(read_image(tmp_path / "out" / "left_002.png")[..., :3]).astype(float)
    np.testing.assert_allclose(turned, single, atol=1.0)
    found = write_relit(flat, env, tmp_path / "video", [camera], [0.0, 120.0], video=tmp_path / "light.webp")
    assert {p.name for p in (tmp_path / "video").iterdir()} == {"relight.json"}
    assert found["files"] == [str(tmp_path / "light.webp")]
    with Image.open(tmp_path / "light.webp") as animation:
        assert animation.n_frames == 2 and animation.size == (32, 32)


def test_saved_result_has_a_scene_that_load_scene_renders(ball, variant, tmp_path):
    ball.save(tmp_path)
    scene = mifit.load_scene(tmp_path / "scene.xml", spp=4)
    assert len(scene.sensors()) == 2 and len(scene.shapes()) == 2


def off_centre(angle: float = 10.0) -> Camera:
    """A calibrated camera as real ones are, only more so: the centre 30 % off both ways, fx / fy = 1.01."""
    camera = ball_camera("real", angle, size=96)
    shift = 0.3 * 96
    return replace(camera, fy=camera.fx / 1.01, cx=camera.cx - shift, cy=camera.cy + shift)


def edges(alpha: np.ndarray) -> np.ndarray:
    """Left, right, upper and lower edge of a convex shape in the lines through its middle, in pixels."""
    found = []
    for image in (alpha, alpha.T):
        weight = image.astype(np.float64)
        places = np.arange(image.shape[1]) + 0.5
        width = weight.sum(1)
        rows = width > 0.7 * width.max()
        centre = (weight * places).sum(1)[rows] / width[rows]
        found += [(centre - 0.5 * width[rows]).mean(), (centre + 0.5 * width[rows]).mean()]
    return np.array(found)


def test_every_way_to_render_a_real_camera_shows_the_same(flat, variant, tmp_path):
    """Path tracing, the scene file, the export and path-traced relighting against local rendering."""
    lit = replace(flat, normals=None)
    camera = off_centre()
    relit = lit.relight(smooth_environment(), rotate=40)
    write_scene(lit, tmp_path / "scene.xml", 0, [camera], "diffuse")
    write_scene(relit, tmp_path / "relit.xml", 0, [camera], "diffuse")
    seen = replace(lit, cameras=(camera,), reflectance=replace(lit.reflectance, specular=0 * lit.reflectance.specular))
    export(seen, "mitsuba", tmp_path / "export.xml", timestep=0)
    for result, names in ((lit, ("scene", "export")), (relit, ("relit",))):
        local = result.render(camera, 0, method="diffuse", samples=8)
        images = [render_scene(tmp_path / f"{name}.xml", {}, spp=256, seed=1) for name in names]
        path = result.render(camera, 0, method="diffuse", integrator="path", samples=256)
        inside = (local[..., 3] == 1) & np.all([image[..., 3] == 1 for image in images], axis=0)
        assert inside.sum() > 300
        for image in [*images, path]:
            # Half of the ball is outside the image: the edges that are inside it count.
            np.testing.assert_allclose(edges(image[..., 3]), edges(local[..., 3]), atol=0.1)
            mean = image[inside][:, :3].mean(0)
            np.testing.assert_allclose(mean, local[inside][:, :3].mean(0), rtol=0.01)


def test_the_file_holds_the_sensor_that_is_rendered(flat, variant, tmp_path):
    import mitsuba as mi

    cameras = [flat.cameras[0], off_centre()]
    write_scene(flat, tmp_path / "scene.xml", 0, cameras)
    for loaded, camera in zip(mifit.load_scene(tmp_path / "scene.xml", spp=16).sensors(), cameras, strict=True):
        rendered = mi.traverse(make_sensor(camera))
        stored = mi.traverse(loaded)
        names = list(rendered.keys())
        assert [name.split(".")[-1] for name in names] == [name.split(".")[-1] for name in stored.keys()]
        for ours, theirs in zip(names, stored.keys(), strict=True):
            a, b = rendered[ours], stored[theirs]
            if ours == "to_world":
                np.testing.assert_allclose(np.array(a.matrix), np.array(b.matrix), rtol=1e-6, atol=1e-6)
            else:
                assert str(a) == str(b), ours
        assert loaded.sampler().sample_count() == 16


@pytest.mark.parametrize("name", ["face", "skin", "rest", "light", "$x", "a.b", "<", "", "ä b"])
def test_names_of_cameras_are_not_ids(flat, variant, tmp_path, name):
    cameras = [replace(c, name=name) for c in flat.cameras]
    write_scene(flat, tmp_path / "scene.xml", 0, cameras)
    scene = mifit.load_scene(tmp_path / "scene.xml", spp=1)
    ids = [sensor.id() for sensor in scene.sensors()]
    assert len(set(ids)) == 2 and all(i.startswith("camera_") for i in ids) and len(scene.shapes()) == 2


def test_a_lens_is_refused_before_anything_is_written(flat, tmp_path):
    camera = replace(flat.cameras[0], distortion=(0.1, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="found lens distortion"):
        write_scene(flat, tmp_path / "x.xml", 0, [camera])
    assert not list(tmp_path.iterdir())
