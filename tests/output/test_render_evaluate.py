"""Local rendering against plain NumPy, and evaluation against images whose error is known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from mifit.core import sh
from mifit.core.image import srgb_to_linear, write_image
from mifit.core.mesh import vertex_normals
from mifit.core.photometry import Photometry
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import with_eyes
from mifit.output.deferred import surface_material, visible_surface
from mifit.output.evaluate import compare, evaluate, face_area
from mifit.render.visible import trace_mesh
from tests.output.conftest import ball_camera, ball_result
from tests.test_pipeline import mean_geometry, without_eyes


@dataclass(frozen=True)
class FakeFrame:
    image: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True)
class FakeCapture:
    """Photographs made by a function of camera and timestep."""

    cameras: tuple
    images: object
    path: object = None
    timesteps: tuple = (0, 3)
    hidden: tuple = field(default=())
    calibrated: bool = True
    estimated: dict = field(default_factory=dict)

    def camera(self, name):
        return next(c for c in self.cameras if c.name == name)

    def with_fitted(self, cameras):
        return self

    def with_photometry(self, photometry):
        images = self.images
        return replace(self, images=lambda c, t: images(c, t) / photometry.factor(c.name, t))

    def frame(self, name, t):
        image = self.images(self.camera(name), t)
        valid = np.ones(image.shape[:2], bool)
        for rows, columns in self.hidden:
            valid[rows, columns] = False
        return FakeFrame(image, valid)


def test_samples_of_a_face_in_a_pixel_become_one_in_their_middle(ball, variant):
    vertices, faces, camera = ball.geometry.vertices[0], ball.model.faces, ball_camera().resized(4)
    every = trace_mesh(vertices, faces, camera, 2)
    some = trace_mesh(vertices, faces, camera, 2, joined=np.ones(len(faces), dtype=bool))
    assert len(some.face) < 0.5 * len(every.face)
    assert some.count.sum() == len(every.face)
    np.testing.assert_allclose(some.weights.sum(axis=1), 1.0, atol=1e-6)
    # What varies linearly over faces has the same mean in every pixel.
    np.testing.assert_allclose(some.image(some.points), every.image(every.points), atol=1e-5)


def test_pca_is_the_papers_equation(ball, variant):
    camera = ball_camera()
    surface = visible_surface(ball, camera, 3, 1)
    image = ball.render(camera, 3, method="pca", samples=1)
    # The paper's equation at one sample in the middle of the ball, from scratch.
    k = np.argmin(np.abs(surface.pixel - (32 * 64 + 32)))
    face = ball.model.faces[surface.face[k]]
    w = surface.weights[k]
    n = w @ vertex_normals(ball.geometry.vertices[1], ball.model.faces)[face]
    n /= np.linalg.norm(n)
    expected = 0.01 + (w @ ball.geometry.vertex_albedo[face]) * (sh.basis(n, 3) @ ball.geometry.shading)
    np.testing.assert_allclose(image.reshape(-1, 4)[surface.pixel[k], :3], expected, rtol=1e-4)


def test_diffuse_is_albedo_times_irradiance_with_refined_normals(ball, variant):
    camera = ball_camera()
    surface = visible_surface(ball, camera, 0, 1)
    material = surface_material(ball, surface, 0)
    inside = ball.model.face_mask[surface.face]
    irradiance = ball.lighting.irradiance(material.normal.astype(np.float64))
    expected = material.diffuse * irradiance / np.pi + 0.02
    image = ball.render(camera, 0, method="diffuse", samples=1).reshape(-1, 4)[surface.pixel, :3]
    np.testing.assert_allclose(image, expected, atol=2e-4)
    # Outside the face area: albedo and gloss that continue the maps, the mesh's normals.
    np.testing.assert_allclose(material.specular, 0.15, atol=1e-4)
    smooth = visible_surface(replace(ball, normals=None), camera, 0, 1)
    base = surface_material(replace(ball, normals=None), smooth, 0)
    np.testing.assert_allclose(material.normal[~inside], base.normal[~inside], atol=1e-6)
    assert np.abs(material.normal[inside] - base.normal[inside]).max() > 0.05


@pytest.mark.parametrize("model", ["paper", "prefiltered", "shadowed"])
def test_full_adds_specular_light(variant, model):
    result = ball_result(shading_model=model)
    camera = ball_camera()
    full, diffuse = (result.render(camera, 0, method=m) for m in ("full", "diffuse"))
    assert np.isfinite(full).all() and full.dtype == np.float32 and full.shape == (64, 64, 4)
    assert (full[..., :3] - diffuse[..., :3]).max() > 0.01
    np.testing.assert_array_equal(full[..., 3], diffuse[..., 3])


def test_alpha_is_coverage(ball, variant):
    camera = ball_camera(size=128)
    image = ball.render(camera, 0, samples=4)
    radius = ball.geometry.scale * (9.0 + 0.3 * 0.2)
    expected = np.pi * (radius * camera.fx / 70) ** 2
    assert image[..., 3].sum() == pytest.approx(expected, rel=0.05)
    assert set(np.unique(image[[0, -1], :, 3])) == {0.0} and image[64, 64, 3] == 1
    assert (image[image[..., 3] == 0] == 0).all()
    assert ((image[..., 3] > 0) & (image[..., 3] < 1)).any()


def test_back_faces_are_not_covered(variant):
    """A single triangle seen from behind."""
    vertices, faces = np.array([[-3, -3, 0], [3, -3, 0], [0, 3, 0.0]]), np.array([[0, 1, 2]])
    assert len(trace_mesh(vertices, faces, ball_camera(angle=0), 1).pixel) > 100
    assert len(trace_mesh(vertices, faces, ball_camera(angle=180), 1).pixel) == 0


def test_evaluation_of_a_perfect_photograph_and_of_a_known_error(ball, variant):
    camera = ball_camera("third", 5.0)
    capture = FakeCapture((camera,), lambda c, t: ball.render(c, t)[..., :3])
    found = evaluate(ball, capture, "third")
    assert list(found["methods"]) == ["pca", "diffuse", "full"]
    full = found["methods"]["full"]
    assert full["rmse"] == 0 and full["ssim"] == pytest.approx(1) and full["flip"] == 0
    assert found["methods"]["diffuse"]["rmse"] > 0 and found["timesteps"] == [0, 3]
    assert found["region_pixels"] == sum(x["region_pixels"] for x in found["per_timestep"])
    # A photograph that is 10 steps brighter in one timestep and 20 in the other: the pooled error is known.
    shift = {0: 10, 3: 20}
    pixels = {x["timestep"]: x["region_pixels"] for x in found["per_timestep"]}

    def brighter(c, t):
        codes = compare(ball, capture, "third", t).renders["full"][..., :3].astype(float) + shift[t]
        return srgb_to_linear(codes / 255)

    found = evaluate(ball, FakeCapture((camera,), brighter), "third")
    expected = np.sqrt(sum(pixels[t] * shift[t] ** 2 for t in shift) / sum(pixels.values()))
    assert found["methods"]["full"]["rmse"] == pytest.approx(expected, abs=0.2)
    assert found["per_timestep"][1]["methods"]["full"]["rmse"] == pytest.approx(20, abs=0.2)


def test_a_photograph_is_compared_at_its_cameras_gain(ball, variant):
    gain = np.float32((1.25, 0.9, 1.1))
    photometry = Photometry({"left": (1.0, 1.0, 1.0), "right": tuple(gain)})
    scaled = replace(ball, geometry=replace(ball.geometry, photometry=photometry))
    capture = FakeCapture(ball.cameras, lambda c, t: ball.render(c, t)[..., :3] * (gain if c.name == "right" else 1))
    for camera in ("left", "right"):
        assert evaluate(scaled, capture, camera)["methods"]["full"]["rmse"] < 0.6
    assert evaluate(ball, capture, "right")["methods"]["full"]["rmse"] > 5


def test_region_is_the_face_area_eroded_and_valid(ball, variant):
    camera = ball_camera("third", 5.0)
    area = face_area(ball.geometry.vertices[0], ball.model.faces, ball.model.face_mask, camera)
    surface = trace_mesh(ball.geometry.vertices[0], ball.model.faces, camera, 1)
    whole = np.zeros(64 * 64, bool)
    whole[surface.pixel] = ball.model.face_mask[surface.face]
    whole = whole.reshape(64, 64)
    rows, columns = np.nonzero(area)
    for dr in range(-2, 3):
        for dc in range(-2, 3):
            assert whole[rows + dr, columns + dc].all()
    assert whole.sum() > area.sum() > 0.5 * whole.sum()
    half = FakeCapture((camera,), lambda c, t: np.zeros((64, 64, 3)), hidden=((slice(0, 32), slice(None)),))
    assert not compare(ball, half, "third", 0).region[:32].any()


def test_skin_is_within_the_landmarks_without_eyes_and_mouth_where_a_fitted_view_sees_it(ball, variant, tmp_path):
    camera = ball_camera("third", 5.0)
    turn = np.linspace(0, 2 * np.pi, 17)
    marks = np.zeros((68, 2))
    marks[:17] = 32 + 18 * np.stack([np.cos(turn), np.sin(turn)], 1)
    marks[17:] = 32
    for first, last, middle in ((36, 42, (24, 26)), (42, 48, (40, 26)), (60, 68, (32, 42))):
        turn = np.linspace(0, 2 * np.pi, last - first, endpoint=False)
        marks[first:last] = middle + 3 * np.stack([np.cos(turn), np.sin(turn)], 1)

    class Marked(FakeCapture):
        def landmarks(self, name, t):
            return SimpleNamespace(points=marks)

    capture = Marked(
        (*ball.cameras, ball_camera("side", -60), camera), lambda c, t: ball.render(c, t)[..., :3], tmp_path
    )
    region = compare(ball, capture, "third", 0, region="skin").region
    rows, columns = np.nonzero(region)
    assert np.hypot(columns + 0.5 - 32, rows + 0.5 - 32).max() < 18 - 3
    assert not region[26, 24] and not region[26, 40] and not region[42, 32] and region[32, 32] and region.sum() > 200
    blind = replace(ball, cameras=(ball_camera("side", -60),))
    assert compare(blind, capture, "third", 0, region="skin").region.sum() < 0.8 * region.sum()


def test_truth_region_counts_uncovered_pixels_as_black(ball, variant, tmp_path):
    camera = ball_camera("third", 5.0)
    (tmp_path / "truth").mkdir()
    moved = ball.geometry.vertices[0] + np.float32([6, 0, 0])
    np.savez(tmp_path / "truth" / "0000.npz", vertices=moved)
    capture = FakeCapture((camera,), lambda c, t: np.full((64, 64, 3), 1.0), tmp_path)
    found = compare(ball, capture, "third", 0, region="truth")
    uncovered = found.region & (found.renders["full"][..., 3] == 0)
    assert uncovered.any() and (found.renders["full"][uncovered] == 0).all()


def test_truth_of_a_model_that_got_eyes_is_its_first_vertices(variant, tmp_path):
    model = MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2)
    skin = without_eyes(model)
    camera = ball_camera("third", 5.0, 128)
    (tmp_path / "truth").mkdir()
    np.savez(tmp_path / "truth" / "0000.npz", vertices=skin.mean)
    capture, regions = FakeCapture((camera,), lambda c, t: np.full((128, 128, 3), 0.3), tmp_path), []
    for fitted in (skin, with_eyes(skin)):
        result = replace(
            ball_result(), model=fitted, geometry=mean_geometry(fitted), reflectance=None, normals=None, mesh=None
        )
        regions.append(compare(result, capture, "third", 0, region="truth").region)
    assert regions[0].sum() > 1000
    np.testing.assert_array_equal(*regions)


def test_truth_of_another_mesh_needs_its_faces(ball, variant, tmp_path):
    camera = ball_camera("third", 5.0)
    (tmp_path / "truth").mkdir()
    capture = FakeCapture((camera,), lambda c, t: np.zeros((64, 64, 3)), tmp_path)
    with pytest.raises(InputError, match=r"no true mesh of timestep 0 .*--region truth needs"):
        compare(ball, capture, "third", 0, region="truth")
    corners = np.array([[-4, -4, 0], [4, -4, 0], [0, 4, 0.0]])
    np.savez(tmp_path / "truth" / "0000.npz", vertices=corners)
    with pytest.raises(InputError, match="found 3 vertices, but model 'ball' has 408"):
        compare(ball, capture, "third", 0, region="truth")
    np.savez(tmp_path / "truth" / "mesh.npz", faces=np.array([[0, 1, 2]]))
    assert compare(ball, capture, "third", 0, region="truth").region.any()


def test_bad_requests_are_named(ball, stage_1_ball, variant):
    camera = ball_camera()
    with pytest.raises(InputError, match="timestep 1 is not in this result; it has 0, 3"):
        ball.render(camera, 1)
    with pytest.raises(InputError, match="needs reflectance"):
        stage_1_ball.render(camera, 0, method="full")
    with pytest.raises(InputError, match="expected one of pca, diffuse, full"):
        ball.render(camera, 0, method="best")
    with pytest.raises(InputError, match="expected 'local' or 'path'"):
        ball.render(camera, 0, integrator="magic")
    pose = camera.world_to_camera.copy()
    pose[:3] = np.diag([-1.0, 1, -1]) @ pose[:3]
    behind = replace(camera, name="behind", world_to_camera=pose)
    with pytest.raises(InputError, match="face area is not visible"):
        evaluate(ball, FakeCapture((behind,), lambda c, t: np.zeros((64, 64, 3))), "behind")


class MarkedCapture(FakeCapture):
    """With 68 landmarks about the middle of the picture: a wide hull, small eyes, brows and mouth."""

    def landmarks(self, name, timestep):
        angle = np.linspace(0, 2 * np.pi, 68)
        points = 32 + 24 * np.stack([np.cos(angle), np.sin(angle)], 1)
        for part, middle in ((slice(17, 27), (32, 12)), (slice(36, 42), (26, 26)), (slice(42, 48), (38, 26))):
            points[part] = middle
        points[60:68] = (32, 44)
        return SimpleNamespace(points=points)


def test_passes_of_a_result_are_compared_with_the_truths(ball, variant, tmp_path):
    camera = ball_camera("third", 5.0)
    full, diffuse = (ball.render(camera, 0, method)[..., :3] for method in ("full", "diffuse"))
    capture = MarkedCapture((camera,), lambda c, t: full, tmp_path)
    with pytest.raises(InputError, match=r"--passes needs truth/diffuse_third.exr, which is missing"):
        evaluate(ball, capture, "third", (0,), passes=True)
    write_image(tmp_path / "truth" / "diffuse_third.exr", diffuse)
    write_image(tmp_path / "truth" / "full_third.exr", full)
    found = evaluate(ball, capture, "third", (0,), passes=True)["passes"]
    assert found["correlation"] > 0.999 and found["error"] < 0.01 and found["diffuse_psnr"] > 60
    assert found["share"] == pytest.approx(found["share_truth"], rel=0.01) and found["share"] > 0.02
    matt = replace(ball.reflectance, specular=np.zeros_like(ball.reflectance.specular))
    none = evaluate(replace(ball, reflectance=matt), capture, "third", (0,), passes=True)["passes"]
    assert none["share"] == 0 and none["correlation"] == 0 and none["error"] == pytest.approx(1.0)
    assert "passes" not in evaluate(ball, capture, "third", (0,))
