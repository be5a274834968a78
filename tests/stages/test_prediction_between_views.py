"""Each fitted view predicted from the others: the truer surface predicts better, on the pixels that all share."""

from __future__ import annotations

import numpy as np
import pytest
from memory_capture import make_capture

from mifit.morphable import MorphableModel
from mifit.stages.surface.prediction_between_views import errors_between_views, every

CAMERAS = ("left", "right")


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=10, expression=5, albedo=10)


@pytest.fixture(scope="module")
def capture(model):
    return make_capture(model, [(0, 0, 0), (-6, 10, 3)], width=255, height=180)


def nearer(capture, millimetres):
    """The surface moved towards the middle between the cameras; a unit is a centimetre."""
    truth = np.stack(capture.vertices)
    towards = np.mean([capture.camera(name).position for name in CAMERAS], axis=0) - truth.mean(axis=(0, 1))
    return truth + 0.1 * millimetres * towards / np.linalg.norm(towards)


def errors(model, capture, surfaces):
    return errors_between_views(capture, model, CAMERAS, (0, 1), surfaces)


def test_the_true_surface_predicts_best_and_errors_grow_with_the_distance(model, capture):
    found = errors(model, capture, [nearer(capture, mm) for mm in (0.0, 1.0, 2.0, 4.0)])
    assert found == sorted(found) and found[3] > 2.0 * found[0]


def test_every_candidate_is_judged_on_the_same_pixels(model, capture):
    """What one surface doesn't cover counts for none."""
    truth = nearer(capture, 0.0)
    alone = errors(model, capture, [truth, truth])
    assert alone[0] == alone[1]
    beside = errors(model, capture, [truth, 0.6 * truth])
    assert beside[0] != alone[0] and beside[1] > beside[0]


def test_nothing_in_common_is_infinite(model, capture):
    truth = nearer(capture, 0.0)
    assert errors(model, capture, [truth, truth + 1e4]) == [np.inf, np.inf]


def test_a_coarser_view_shows_the_centres_of_the_pixels_that_it_keeps(capture):
    camera = capture.camera("left")
    coarse = every(camera, 4)
    points = np.array([[0.3, -0.2, 0.1], [2.0, 1.0, -1.0]])
    fine, kept = camera.project(points), coarse.project(points)
    assert kept == pytest.approx((fine - 0.5) / 4 + 0.5)  # pixel 4 i is pixel i: both have their centres there
