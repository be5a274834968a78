"""Eyes: in the capture's own light as its images show them, in any other under a film of tears."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.cornea import CORNEA, REFLECTANCE
from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.core.camera import Camera
from mifit.core.estimate import ReflectanceEstimate, Report
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeball_faces
from mifit.output.deferred import visible_surface
from mifit.output.export import export
from mifit.output.surface import surface_maps
from mifit.output.viewer import viewer_data
from mifit.reconstruction import Reconstruction
from tests.output.conftest import mean_geometry

SIZE, BENEATH, PAINTED = 256, 0.3, 0.8
EVEN = Illumination(np.full((1, 3), 2.0))


@pytest.fixture(scope="module")
def head(variant) -> Reconstruction:
    """The mean head with even maps, and eyes that are brighter in its own light."""
    model = MorphableModel.load("builtin:coarse")
    geometry = mean_geometry(model)
    texels = rasterize_uv(model.uv, model.faces_uv, SIZE, model.mapped)
    eye = texels.to_map(eyeball_faces(model)[texels.face])[..., None]
    shown = np.where(texels.mask[..., None], np.float32(BENEATH), np.float32(0)).repeat(3, axis=2)
    reflectance = ReflectanceEstimate(
        shown, 0.1 * shown[..., 0], texels.mask.astype(np.float32), EVEN, Lobe(20.0, 8.0), "prefiltered",
        Report("converged"), lit_eyes=np.where(eye, np.float32(PAINTED), np.float32(0)).repeat(3, axis=2),
    )  # fmt: skip
    return Reconstruction(
        model=model, geometry=geometry, reflectance=reflectance, config={}, cameras=(close(model),), capture_digest=""
    )


def close(model: MorphableModel, size: int = 64) -> Camera:
    """A camera close before one eye."""
    ball = model.mean[np.unique(model.faces[eyeball_faces(model) & (model.mean[model.faces[:, 0], 0] > 0)])]
    centre = ball.mean(axis=0).astype(np.float64)
    unit = 1.0 / model.unit_mm
    facing = Camera.look_at(centre + np.array([0.0, 0.0, 300.0 * unit]), centre, np.array([0.0, 1.0, 0.0]))
    fx = float(8.0 * size)
    return Camera("close", size, size, fx, fx, size / 2, size / 2, facing.world_to_camera)


def eyes_of(result: Reconstruction) -> np.ndarray:
    """(H, W) pixels that show nothing but an eye."""
    surface = visible_surface(result, result.cameras[0], 0)
    eye = eyeball_faces(result.model)[surface.face]
    found = surface.image(np.repeat(eye[:, None], 3, axis=1).astype(np.float32))
    return (found[..., 0] > 0.999) & (found[..., 3] == 1)


def test_its_own_light_shows_the_highlights_that_were_seen(head):
    eye = eyes_of(head)
    assert eye.sum() > 100
    level = 2.0 / np.sqrt(4 * np.pi)
    np.testing.assert_allclose(head.render(head.cameras[0], 0, "diffuse")[eye, :3], PAINTED * level, rtol=0.02)
    assert "eyes" not in {shape.id() for shape in head.scene("path").shapes()}


def test_another_light_shows_what_lies_beneath_and_mirrors_itself(head):
    eye, level = eyes_of(head), 0.6
    lit = head.relight(np.full((16, 32, 3), level, np.float32), exposure=1.0)
    assert lit.reflectance.lit_eyes is None
    matt, full = (lit.render(head.cameras[0], 0, method) for method in ("diffuse", "full"))
    assert matt[eye, :3].max() < 1.02 * BENEATH * level
    film = (full - matt)[eye, :3]
    open_sky = np.quantile(film, 0.9)  # lids are mirrored beside them
    assert open_sky == pytest.approx(REFLECTANCE * level, rel=0.1)
    maps = surface_maps(head, 0, skin=True)
    np.testing.assert_array_equal(maps.diffuse, surface_maps(lit, 0).diffuse)


def test_paths_show_the_same_film(head):
    window = np.full((32, 64, 3), 0.05, np.float32)
    window[9:14, 28:34] = 30.0  # before the face, the middle of the map
    lit, eye, camera = head.relight(window, exposure=1.0), eyes_of(head), head.cameras[0]
    assert "eyes" in {shape.id() for shape in lit.scene("path").shapes()}
    films = []
    for options in ({}, {"integrator": "path", "samples": 64}):
        full, matt = (lit.render(camera, 0, method, **options) for method in ("full", "diffuse"))
        films.append(np.where(eye[..., None], (full - matt)[..., :3], 0).mean(axis=-1))
    fast, path = films
    assert fast.max() > 10 * np.median(fast[eye])  # a window, not a haze
    assert path.sum() == pytest.approx(fast.sum(), rel=0.15)
    places = [np.array(np.unravel_index(film.argmax(), film.shape)) for film in films]
    bright = [film > 0.5 * REFLECTANCE * 30.0 for film in films]
    assert all(b.sum() > 3 for b in bright)
    assert np.linalg.norm(np.subtract(*(np.argwhere(b).mean(axis=0) for b in bright))) < 2, places


def test_the_paper_has_no_film(head):
    plain = replace(head.reflectance, lobe=Lobe(5.0, None, False), shading_model="paper", lit_eyes=None)
    assert "eyes" not in {shape.id() for shape in replace(head, reflectance=plain).scene("path").shapes()}


def test_edited_albedo_is_what_eyes_show(head):
    edited = head.with_albedo(0.5 * head.reflectance.diffuse)
    assert edited.reflectance.lit_eyes is None
    assert head.with_specular(0.2).reflectance.lit_eyes is not None


def test_they_are_kept_in_the_folder(head, tmp_path):
    head.save(tmp_path / "result")
    again = Reconstruction.load(tmp_path / "result", model=head.model)
    np.testing.assert_array_equal(again.reflectance.lit_eyes, head.reflectance.lit_eyes)
    np.testing.assert_array_equal(again.reflectance.lit_diffuse, head.reflectance.lit_diffuse)


def test_files_for_other_programs_tell_eyes_from_skin(head, tmp_path):
    data = json.loads(viewer_data(head, 0))
    alpha = np.frombuffer(base64.b64decode(data["colour"]), "u1").reshape(-1, 4)[:, 3]
    vertices = len(np.unique(head.model.faces_uv[eyeball_faces(head.model)]))
    assert (alpha == 128).sum() == vertices and data["film"][0] == REFLECTANCE
    export(head, "obj", tmp_path / "a.obj")
    groups = (tmp_path / "a.obj").read_text().split("\ng ")
    eyes = next(group for group in groups if group.startswith("eyes\n"))
    assert eyes.count("\nf ") == eyeball_faces(head.model).sum()
    assert f"Ns {CORNEA.typical:g}" in (tmp_path / "a.mtl").read_text()
