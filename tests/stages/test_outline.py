"""Borders of the head in an image: found where the image has them, and nothing where nothing tells them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_capture import make_capture

from mifit.core.mesh import normalize, vertex_normals
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.surface.outline import _chain, find_borders, joined


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=10, expression=5, albedo=10)


@pytest.fixture(scope="module")
def capture(model):
    return make_capture(model, width=680, height=480)


def borders(model, capture, inwards=0.0, factor=1.0):
    """In the left view of the true surface, moved inwards by so many millimetres; a unit is a centimetre."""
    truth = capture.vertices[0]
    moved = truth - 0.1 * inwards * vertex_normals(truth, model.faces)
    return find_borders(capture, SurfaceScene(moved, model.faces), ("left",), 0, factor)


@pytest.mark.parametrize("factor", [1.0, 0.5])
@pytest.mark.parametrize("inwards", [-2.0, 0.0, 2.0])
def test_the_border_is_where_the_image_has_it(model, capture, inwards, factor):
    found = borders(model, capture, inwards, factor)
    camera = capture.camera("left")
    pixel_mm = 10.0 * np.linalg.norm(camera.position - capture.vertices[0].mean(0)) / camera.fx
    assert len(found.offset) > 30 * factor
    off = 10.0 * found.offset - inwards
    assert abs(np.median(off)) < 0.5 * pixel_mm / factor
    assert np.percentile(np.abs(off), 80) < 1.5 * pixel_mm / factor


def test_borders_move_the_surface_across_the_line_of_sight(model, capture):
    found = borders(model, capture)
    ray = normalize(found.position - capture.camera("left").position)
    assert np.abs((found.normal * ray).sum(1)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-6)


def test_the_precision_is_what_the_offsets_scatter_by_or_less(model, capture):
    """One of ten counts: a border's precision is at most a tenth of what its scatter alone would give."""
    found = borders(model, capture)
    scatter = 1.4826 * np.median(np.abs(found.offset - np.median(found.offset)))
    assert 0 < np.median(found.precision) < 1.0 / scatter**2


def test_a_background_of_skin_tells_nothing(model, capture):
    """Where both sides look alike no border is known, rather than one that is anywhere."""
    alike = capture.changed(lambda name, t, frame: replace(frame, image=np.full_like(frame.image, 0.3)))
    assert len(borders(model, alike).offset) < 0.1 * len(borders(model, capture).offset)


def test_what_is_masked_is_not_looked_at(model, capture):
    masked = capture.changed(lambda name, t, frame: replace(frame, valid=np.zeros_like(frame.valid)))
    assert len(borders(model, masked).offset) == 0


def test_where_the_mesh_ends_there_is_no_border(model, capture):
    """A face cut out of the head ends without turning away from the view."""
    inner = vertex_normals(capture.vertices[0], model.faces)
    towards = normalize(capture.camera("left").position - capture.vertices[0])
    kept = ((inner * towards).sum(1) > 0.7)[model.faces].all(1)
    scene = SurfaceScene(capture.vertices[0], model.faces[kept])
    assert len(find_borders(capture, scene, ("left",), 0, 1.0).offset) == 0


def test_neighbours_outvote_a_stray_one():
    score = np.zeros((9, 5))
    score[:, 1] = 4.0
    score[4] = (0.0, 0.0, 0.0, 0.0, 5.0)
    position = np.arange(5.0)
    belief = _chain(score, position)
    np.testing.assert_allclose(belief.sum(1), 1.0)
    assert belief[4] @ position < 2.0 and score[4].argmax() == 4


def test_the_chain_is_the_sum_over_all_paths():
    """Against brute force over every sequence of three positions."""
    rng = np.random.default_rng(0)
    score, position = rng.normal(size=(3, 4)), np.arange(4.0)
    move = np.exp(-0.5 * ((position[:, None] - position) / 0.5) ** 2)
    move /= move.sum(1, keepdims=True)
    paths = np.einsum("i,ij,j,jk,k->ijk", np.exp(score[0]), move, np.exp(score[1]), move, np.exp(score[2]))
    expected = np.stack([paths.sum((1, 2)), paths.sum((0, 2)), paths.sum((0, 1))]) / paths.sum()
    np.testing.assert_allclose(_chain(score, position), expected, atol=1e-12)


def test_nothing_joined_is_empty():
    assert joined([]).offset.shape == (0,) and joined([]).normal.shape == (0, 3)
