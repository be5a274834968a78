"""Pose and expression of the timesteps by what their views show of one surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_capture import make_capture

from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.fit_geometry import fit_geometry
from mifit.stages.geometry.parameters import exponential
from mifit.stages.geometry.surfaces import moved_by
from mifit.stages.surface.align_timesteps import align_timesteps
from mifit.stages.surface.band import FeatureImage, feature_image
from mifit.stages.surface.kept_texture import KeptTexture
from mifit.stages.surface.sweep import BEST_APART, MOST_PAIRS, Posed, across_time
from mifit.stages.surface.views import pose_texels
from tests.output.conftest import ball_camera
from tests.stages.test_find_surface import QUICK

BOTH, STEPS = ("left", "right"), (0, 1, 2)
ANGLES = [(0, 0, 0), (-6, 10, 3), (4, -9, 0)]


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=30, expression=20, albedo=10)


@pytest.fixture(scope="module")
def capture(model):
    return make_capture(model, ANGLES, width=510, height=360)


@pytest.fixture(scope="module")
def right(model, capture):
    """The fit with the truth's poses and shapes."""
    fitted = fit_geometry(capture, model, BOTH, STEPS, QUICK)
    return replace(fitted, vertices=capture.vertices.astype(np.float32))


def posed(model, capture, geometry, size=300):
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    steps = []
    for timestep, vertices in zip(STEPS, geometry.vertices.astype(np.float64), strict=True):
        scene = SurfaceScene(vertices, model.faces)
        steps.append(pose_texels(capture, scene, vertices, model.faces, texels, BOTH, timestep, 1.0))
    return texels, steps


def disturbed(model, geometry, turn=0.25, shift=0.035, frown=0.15):
    """Moved timesteps and changed expressions, nothing in common to all: degrees, cm and coefficients."""
    rng = np.random.default_rng(4)
    turns, shifts = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    turns, shifts = turns - turns.mean(axis=0), shifts - shifts.mean(axis=0)
    changes = np.clip(geometry.expression + frown * rng.normal(size=geometry.expression.shape), 0.0, 1.0)
    changes = changes - geometry.expression
    changes -= changes.mean(axis=0)
    rotation = np.stack([r @ exponential(np.radians(turn * w)) for r, w in zip(geometry.rotation, turns, strict=True)])
    translation = geometry.translation + shift * np.einsum("tij,tj->ti", geometry.rotation, shifts)
    moved = replace(geometry, rotation=rotation, translation=translation, expression=geometry.expression + changes)
    return moved_by(model, replace(moved, displacement=None), np.zeros_like(model.mean))


def off_mm(model, one, other):
    """Root mean square of what parts two fits at the face's vertices along the skin and across, but for what is
    common to all timesteps."""
    seen = np.unique(model.faces[model.face_mask])
    way = (one.vertices - other.vertices)[:, seen] @ other.rotation
    return 10.0 * float(np.sqrt(((way - way.mean(axis=0)) ** 2).sum(axis=2).mean()))


def test_a_further_timestep_goes_to_where_the_kept_ones_agree(model, capture, right):
    start = moved_by(model, replace(right, displacement=None), np.zeros_like(model.mean))
    off = disturbed(model, start).at((2,))
    kept = KeptTexture(capture, model, right.at((0, 1)), BOTH)
    found = kept.aligned(off)
    seen, true = np.unique(model.faces[model.face_mask]), capture.vertices[2]
    before, after = (10.0 * np.linalg.norm(g.vertices[0] - true, axis=1)[seen].mean() for g in (off, found))
    assert before > 0.4
    assert after < 0.3 * before
    assert found.timesteps == (2,)
    assert kept.aligned(found).vertices == pytest.approx(found.vertices, abs=0.02)  # and stays there


def test_a_timestep_whose_face_is_hidden_stays(model, capture, right):
    rng, frames = np.random.default_rng(5), dict(capture.frames)
    for name in BOTH:
        frame = frames[name, 2]
        frames[name, 2] = replace(frame, image=rng.uniform(0.1, 0.5, frame.image.shape).astype(np.float32))
    hidden = replace(capture, frames=frames)
    off = disturbed(model, right).at((2,))
    found = KeptTexture(hidden, model, right.at((0, 1)), BOTH).aligned(off)
    shift = np.linalg.norm(found.translation - off.translation)
    assert shift < 0.05  # cm: noise agrees with nothing


def test_disturbed_timesteps_are_put_back(model, capture, right):
    start = moved_by(model, replace(right, displacement=None), np.zeros_like(model.mean))
    off = disturbed(model, start)
    found = align_timesteps(model, off, *posed(model, capture, off))
    assert off_mm(model, off, right) > 0.7
    assert off_mm(model, found, right) < 0.1 * off_mm(model, off, right)
    assert off_mm(model, found, right) < off_mm(model, start, right)  # what landmarks and stage 1's textures left
    again = moved_by(model, replace(found, displacement=None), np.zeros_like(model.mean))
    np.testing.assert_allclose(found.vertices, again.vertices, atol=1e-4)
    low, high = model.expression_bounds.T
    assert (found.expression >= np.minimum(low, off.expression) - 1e-9).all()
    assert (found.expression <= np.maximum(high, off.expression) + 1e-9).all()


def test_what_all_timesteps_would_do_alike_is_left_out(model, capture, right):
    """A head that is half a millimetre off at all of them is the surface's matter."""
    free = replace(model, expression_bounds=np.tile(np.float32([-np.inf, np.inf]), (model.n_expression, 1)))
    along = np.array([0.05, 0.0, 0.0])
    off = replace(right, translation=right.translation + right.rotation @ along)
    off = moved_by(free, replace(off, displacement=None), np.zeros_like(model.mean))
    found = align_timesteps(free, off, *posed(model, capture, off))
    shifts = np.einsum("tij,ti->tj", off.rotation, found.translation - off.translation)
    assert np.abs(shifts.mean(axis=0)).max() < 0.005
    assert np.abs((found.expression - off.expression).mean(axis=0)).max() < 1e-6


def test_expressions_stay_near_those_expected_where_images_say_little(model, capture, right):
    """However often timesteps are aligned: what was expected at first holds, not what was found the last time."""
    free = replace(model, expression_bounds=np.tile(np.float32([-np.inf, np.inf]), (model.n_expression, 1)))
    expected = right.expression + 0.2 * np.random.default_rng(6).normal(size=right.expression.shape)
    texels, steps = posed(model, capture, right)
    faint = [replace(step, seen=1e-9 * step.seen) for step in steps]
    found = align_timesteps(free, right, texels, faint, expected=expected)
    wanted = expected - expected.mean(axis=0) + right.expression.mean(axis=0)
    np.testing.assert_allclose(found.expression, wanted, atol=0.01)
    stays = align_timesteps(free, right, texels, faint)
    np.testing.assert_allclose(stays.expression, right.expression, atol=0.01)


def test_views_that_show_nothing_leave_the_timesteps(model, capture, right):
    texels, steps = posed(model, capture, right)
    blind = [replace(step, seen=np.zeros_like(step.seen)) for step in steps]
    found = align_timesteps(model, right, texels, blind)
    assert found is right


def test_pairs_across_time_are_views_fairly_apart_that_share_the_work(model, capture, right):
    _, steps = posed(model, capture, right)
    pairs = across_time(steps, right.rotation)
    assert 0 < len(pairs) <= MOST_PAIRS
    towards = {}
    for k, step in enumerate(steps):
        for i, image in enumerate(step.images):
            way = image.camera.position - step.position.mean(axis=0)
            towards[k, i] = way / np.linalg.norm(way) @ right.rotation[k]
    angles = [np.degrees(np.arccos(towards[a] @ towards[b])) for a, b in pairs]
    assert all(a[0] != b[0] for a, b in pairs) and 5.0 <= min(angles) and max(angles) <= 50.0
    assert abs(np.median(angles) - BEST_APART) < 15.0
    uses = np.bincount([2 * k + i for pair in pairs for k, i in pair], minlength=6)
    assert uses.max() - uses.min() <= 2


def test_a_head_that_stands_still_has_no_pairs_across_time(capture):
    camera = capture.camera("left")

    class Image:
        pass

    image = Image()
    image.camera = camera
    still = [Posed(np.zeros((4, 3)), np.zeros((4, 3)), (image,), np.ones((1, 4), np.float32))] * 2
    assert across_time(still, np.tile(np.eye(3), (2, 1, 1))) == []


def test_a_level_of_an_image_is_read_where_the_camera_sees_a_point():
    camera = ball_camera(size=64)
    x, y = np.meshgrid(np.arange(32) * 2.0 + 1.0, np.arange(32) * 2.0 + 1.0)  # centres in pixels of the full image
    image = FeatureImage(camera, 0.5, np.stack([x, np.ones_like(x), y], axis=-1).astype(np.float32))
    points = np.array([[1.0, 2, 3], [-2, 0.5, 1]])
    np.testing.assert_allclose(image.sample(points)[:, [0, 2]], camera.project(points), atol=1e-3)
    assert not image.sample(2.0 * camera.position[None] - points).any()  # behind the camera


def test_coarse_levels_leave_sheen_out_and_keep_what_is_painted():
    """A white highlight and a dark mark of the same contrast, on skin."""
    skin = np.tile(np.float32([0.4, 0.22, 0.15]), (64, 64, 1))
    glossy, marked = skin.copy(), skin.copy()
    glossy[28:36, 28:36] += 0.12
    marked[28:36, 28:36] *= 1.5
    valid, camera = np.ones((64, 64), bool), ball_camera(size=64)

    def contrast(image, factor):
        return float(np.ptp(feature_image(camera, image, valid, factor).values[..., 0]))

    assert contrast(glossy, 0.5) < 0.6 * contrast(marked, 0.5)
    assert contrast(glossy, 1.0) == pytest.approx(contrast(marked, 1.0), rel=0.15)
