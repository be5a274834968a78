"""Frames absorbed into sums per texel: what the sums hold; order and kills change nothing; frames that disagree."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mifit.core.estimate import NormalsEstimate, Report
from mifit.errors import InputError
from mifit.extras.absorb.information import Information

CAMERAS = ("left", "right")
FRAMES = 6


def angles(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


@pytest.fixture(scope="module")
def scene(variant):
    """Six timesteps of one bumpy dome; the first two are fitted."""
    from tests.stages.normal_scene import build

    scene = build(timesteps=FRAMES, noise=0.02)
    scene.timesteps = tuple(range(FRAMES))
    return scene


@pytest.fixture
def result(scene, monkeypatch):
    """A fit of two timesteps whose normals are still the mesh's; stage 1 answers the truth for the others."""
    from mifit.reconstruction import Reconstruction
    from mifit.stages import track

    monkeypatch.setattr(
        track, "fit_pose_expression", lambda c, m, g, names, timestep, *_, **__: scene.geometry.at((timestep,))
    )
    monkeypatch.setattr(track, "texture_reference", lambda *arguments: "texture")
    return Reconstruction(
        model=scene.model,
        geometry=scene.geometry.at((0, 1)),
        reflectance=scene.reflectance,
        config={"seed": 0},
        cameras=tuple(scene.cameras[c] for c in CAMERAS),
    )


def normal_error(scene, result):
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    return angles(result.normals.normal_object[0], scene.normal_map)[mask].mean()


def image(rng, n=5):
    """One image of n texels: rows, target, weight, diffuse, specular, slope, cosine."""
    shapes = ((n, 3), (n, 3), (n, 3), (n, 3), (n, 3, 2), (n,))
    return [np.arange(n), *(rng.uniform(0.1, 1.0, shape) for shape in shapes)]


def test_sums_give_the_residual_at_any_state():
    rng = np.random.default_rng(0)
    images = [image(rng) for _ in range(4)]
    sums = Information.nothing(5)
    for one in images:
        sums.add(*one)
    albedo, specular, offsets = rng.uniform(0, 1, (5, 3)), rng.uniform(0, 1, 5), rng.normal(size=(5, 2))
    expected = np.zeros(5)
    for _, target, weight, diffuse, gloss, slope, _ in images:
        shown = albedo * diffuse + specular[:, None] * gloss + np.einsum("nci,ni->nc", slope, offsets)
        expected += (weight * (target - shown) ** 2).sum(1)
    assert_allclose(sums.residual(albedo, specular, offsets), expected, rtol=1e-10)


def test_the_order_of_images_is_rounding():
    rng = np.random.default_rng(1)
    images = [image(rng) for _ in range(20)]
    sums = [Information.nothing(5), Information.nothing(5)]
    for one in images:
        sums[0].add(*one)
    for k in rng.permutation(20):
        sums[1].add(*images[k])
    for f in fields(Information):
        assert_allclose(getattr(sums[0], f.name), getattr(sums[1], f.name), rtol=1e-12)


def test_slopes_are_those_of_differences(scene):
    from mifit.appearance.formation import Appearance
    from mifit.core.bend import bend, tangent_plane
    from mifit.extras.absorb.linear import linear_shading

    rng = np.random.default_rng(2)
    normals = rng.normal(size=(50, 3)) * 0.2 + [0.0, 0.0, 1.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tangents, offsets = tangent_plane(normals), 0.05 * rng.normal(size=(50, 2))
    view = np.tile([0.0, 0.0, 1.0], (50, 1))
    appearance = Appearance.of(scene.reflectance)
    found = linear_shading(appearance.shader(normals, view), normals, tangents, offsets, view)
    step = 2e-3
    for i in range(2):
        ahead, behind = (
            appearance.shade_bent(bend(normals, tangents, offsets + sign * step * np.eye(2)[i]), normals, view)
            for sign in (1, -1)
        )
        for k in range(2):
            assert_allclose(found[2 + k][..., i], (ahead[k] - behind[k]) / (2 * step), atol=0.02)
    for k, shown in enumerate(appearance.shade_bent(bend(normals, tangents, offsets), normals, view)):
        assert_allclose(found[k], shown, atol=1e-4)


def test_normals_sharpen_with_every_frame(scene, result):
    from mifit.extras.refine import refine

    scene.requested.clear()
    few, many = refine(result, scene, (0, 1)), refine(result, scene)
    assert scene.requested == set(CAMERAS)
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    base = np.where(mask[..., None], 0, 0) + np.array([0.0, 0.0, 1.0])
    assert normal_error(scene, many) < normal_error(scene, few) < angles(base, scene.normal_map)[mask].mean()
    assert many.timesteps == result.timesteps
    assert many.normals.report.details["refined"]["timesteps"] == list(range(FRAMES))
    seen = many.reflectance.frames[mask]
    assert np.median(seen) == FRAMES and np.median(few.reflectance.frames[mask]) == 2


def test_maps_come_back_from_wrong_ones(scene, result):
    from mifit.extras.refine import refine

    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    truth = NormalsEstimate((0, 1), np.stack([scene.normal_map] * 2), Report("converged"))
    wrong = result.with_albedo(np.clip(1.15 * scene.reflectance.diffuse, 0, 1))
    found = refine(replace(wrong, normals=truth), scene)
    error = np.abs(found.reflectance.diffuse - scene.reflectance.diffuse)[mask].mean()
    assert error < 0.25 * np.abs(wrong.reflectance.diffuse - scene.reflectance.diffuse)[mask].mean()


def test_eyes_keep_what_the_fit_found_beneath_their_film(scene, result):
    from mifit.extras.refine import refine

    beneath = scene.reflectance.diffuse.copy()
    lit = np.zeros_like(beneath)
    beneath[20:24, 20:24], lit[20:24, 20:24] = 0.05, 0.9
    eye = lit.any(axis=-1)
    reflectance = replace(scene.reflectance, diffuse=beneath, lit_eyes=lit)
    found = refine(replace(result, reflectance=reflectance), scene, (0, 1)).reflectance
    assert_array_equal(found.diffuse[eye], beneath[eye])
    assert_array_equal(found.lit_eyes.any(axis=-1), eye)
    # In its own light they are what the frames show.
    assert np.abs(found.lit_diffuse - scene.reflectance.diffuse)[eye].max() < 0.1


def test_shuffled_frames_give_the_same(scene, result):
    from mifit.extras.refine import refine

    one, other = refine(result, scene), refine(result, scene, (5, 2, 4, 3))
    assert_allclose(one.reflectance.diffuse, other.reflectance.diffuse, atol=1e-3)
    assert_allclose(one.normals.normal_object, other.normals.normal_object, atol=1e-3)


def test_a_killed_run_goes_on_to_the_same(scene, result, tmp_path, monkeypatch):
    from mifit.extras import refine as refinement

    monkeypatch.setattr(refinement, "EVERY", 2)
    expected = refinement.refine(result, scene)
    absorb, count = refinement.Absorber.absorb, [0]

    class Killed(BaseException):
        pass

    def die(*arguments):
        if count[0] == 5:
            raise Killed
        count[0] += 1
        return absorb(*arguments)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(refinement.Absorber, "absorb", die)
        refinement.refine(result, scene, checkpoints=tmp_path)
    count[0] = 0

    def counted(*arguments):
        count[0] += 1
        return absorb(*arguments)

    monkeypatch.setattr(refinement.Absorber, "absorb", counted)
    found = refinement.refine(result, scene, checkpoints=tmp_path)
    assert count[0] == FRAMES - 4  # the four frames of the last checkpoint are not read again
    assert_allclose(found.reflectance.diffuse, expected.reflectance.diffuse, atol=1e-3)
    assert_allclose(found.normals.normal_object, expected.normals.normal_object, atol=1e-3)
    assert_array_equal(found.reflectance.frames, expected.reflectance.frames)


def test_a_frame_in_other_light_is_left_out_and_named(scene, result):
    from mifit.extras.refine import refine

    frames = dict(scene.frames)
    for name in CAMERAS:
        frames[name, 4] = replace(frames[name, 4], image=frames[name, 4].image[:, ::-1] * 0.6)
    changed = replace(scene, frames=frames)
    found = refine(result, changed)
    details = found.normals.report.details["refined"]
    assert details["timesteps"] == [0, 1, 2, 3, 5] and list(details["left_out"]) == ["4"]
    assert "timestep 4: left out of the refinement" in found.normals.report.warnings[-1]
    without = refine(result, scene, (0, 1, 2, 3, 5))
    assert_array_equal(found.reflectance.diffuse, without.reflectance.diffuse)


def test_memory_does_not_grow_with_frames(scene, result):
    from mifit.extras.refine import refine

    refine(result, scene, (2,))  # kernels and caches
    peaks = []
    for steps in ((2, 3), range(FRAMES)):
        tracemalloc.start()
        refine(result, scene, steps)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.05 * peaks[0]


def test_what_cannot_be_refined_is_refused(scene, result):
    from mifit.extras.refine import refine

    with pytest.raises(InputError, match="without reflectance"):
        refine(replace(result, reflectance=None), scene)
    with pytest.raises(InputError, match="timestep 9: not in the capture"):
        refine(result, scene, (9,))


def test_frames_per_texel_are_in_the_folder(scene, result, tmp_path):
    from mifit.extras.refine import refine
    from mifit.reconstruction import Reconstruction

    scene.model.save(tmp_path / "dome.npz")
    found = refine(replace(result, model_source=str(tmp_path / "dome.npz")), scene)
    found.save(tmp_path / "out")
    again = Reconstruction.load(tmp_path / "out")
    assert_array_equal(again.reflectance.frames, found.reflectance.frames)
    assert again.normals.report.details["refined"] == found.normals.report.details["refined"]


def test_what_makes_a_frame_disagree():
    from mifit.extras.absorb.frame import FrameFit
    from mifit.extras.refine import _disagreement

    fitted = [FrameFit(0.01, 0.06, 0.9, 0.8), FrameFit(0.012, 0.05, 0.9, 0.9)]
    usual = FrameFit(0.015, 0.08, 0.9, 0.8)
    assert _disagreement(usual, fitted) == "" == _disagreement(usual, [])
    for change, word in (({"residual": 0.04}, "light"), ({"outliers": 0.2}, "before it"), ({"detail": 0.4}, "blurred")):
        assert word in _disagreement(replace(usual, **change), fitted)


def test_detail_falls_with_blur(scene):
    from scipy.ndimage import gaussian_filter

    from mifit.extras.absorb.frame import Absorber
    from mifit.stages.observations import Surface

    texture = np.random.default_rng(3).uniform(0.2, 0.6, scene.reflectance.diffuse.shape).astype(np.float32)
    surface = Surface(scene, scene.model, scene.geometry.at((0,)), CAMERAS, len(texture), whole=True)
    count = len(surface)
    absorber = Absorber(scene, scene.model, scene.reflectance, np.zeros((count, 2)), CAMERAS, surface)
    sharp, blurred = (surface.texels.from_map(t) for t in (texture, gaussian_filter(texture, (1, 1, 0))))
    rows, shown = np.arange(count), np.ones(count, bool)
    assert absorber._detail(rows, blurred, shown) < 0.5 * absorber._detail(rows, sharp, shown)
    assert absorber._detail(rows, sharp, np.zeros(count, bool)) == 0.0
