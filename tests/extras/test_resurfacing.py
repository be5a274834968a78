"""Which frames of a video are swept, what is done with the surface that they show, and a run that is stopped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from mifit.core.estimate import GeometryEstimate, Report
from mifit.errors import ConvergenceError
from mifit.extras import resurface as resurfacing
from mifit.extras.resurface import MOST, resurfaced
from mifit.extras.sweep_again import on_surface
from mifit.morphable import MorphableModel
from mifit.result.record import Result

FITTED = (0, 1, 2, 3)
STEPS = 60
LOST, HIDDEN = 17, 23
"""Timesteps in which the face isn't found, and in which a hand is before it."""


@pytest.fixture(scope="module")
def model():
    return MorphableModel.load("builtin:coarse").subset(identity=3, expression=3, albedo=3)


def posed(model, timesteps, displacement):
    count = len(timesteps)
    geometry = GeometryEstimate(
        timesteps=tuple(timesteps),
        identity=np.zeros(model.n_identity),
        albedo=np.zeros(model.n_albedo),
        expression=np.zeros((count, model.n_expression)),
        rotation=np.tile(np.eye(3), (count, 1, 1)),
        translation=np.array([[0.1 * t, 0.0, 0.0] for t in timesteps]),
        scale=1.0,
        vertices=np.zeros((count, model.n_vertices, 3), np.float32),
        vertex_albedo=model.mean_albedo,
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report("converged"),
        displacement=displacement,
    )
    return on_surface(model, geometry, displacement)


@pytest.fixture
def result(model):
    """A fit of four timesteps with a fifth that was tracked."""
    steps = (*FITTED, 9)
    geometry = posed(model, steps, np.full((model.n_vertices, 3), 0.01, np.float32))
    return Result(model, geometry, cameras=(SimpleNamespace(name="left"), SimpleNamespace(name="right")))


class Video:
    """As much of a capture as is looked at."""

    def landmarks(self, name, timestep):
        return True


@dataclass
class Calls:
    """What the parts were asked for."""

    count: int = 0
    followed: tuple = ()
    swept: tuple = ()
    judged: tuple = ()
    sweeps: int = 0


@pytest.fixture
def calls(model, monkeypatch):
    """Stand-ins for what reads images: a sweep that moves the surface by 0.05 and turns the swept timesteps."""
    calls = Calls()

    def choose(capture, cameras, count, timesteps, beside):
        calls.count = count
        assert tuple(beside) == FITTED and not set(timesteps) & set(FITTED)
        return SimpleNamespace(timesteps=tuple(sorted(timesteps)[:count]))

    class Follower:
        def __init__(self, capture, model, geometry, names, *rest):
            assert geometry.timesteps == FITTED
            self.home = geometry

        def next(self, timestep):
            if timestep == LOST:
                raise ConvergenceError("lost")
            calls.followed += (timestep,)
            return posed(model, (timestep,), self.home.displacement), False, []

    def sweep(capture, model, geometry, judged, cameras, config, progress):
        calls.sweeps += 1
        calls.judged = tuple(judged)
        calls.swept = tuple(t for t in geometry.timesteps if t not in judged)
        found = geometry.at(calls.swept)
        found = replace(found, translation=found.translation + 1.0)
        found = on_surface(model, found, found.displacement + np.float32(0.05))
        return found, {"name": "surface of further frames", "kept": calls.count != 3, "seconds": 1.0}

    monkeypatch.setattr(resurfacing, "choose_frames", choose)
    monkeypatch.setattr(resurfacing, "Follower", Follower)
    monkeypatch.setattr(resurfacing, "sweep_again", sweep)
    monkeypatch.setattr(
        resurfacing, "errors_between_views", lambda *given: [3.0 if HIDDEN in given[3] else 1.0 + 0.01 * given[3][0]]
    )
    return calls


def test_no_more_than_so_many_timesteps_are_swept_however_long_the_video(result, calls):
    resurfaced(result, Video(), FITTED, range(STEPS))
    assert calls.count == 18  # a third of them judges
    chosen = set(range(4, 22)) - {LOST}
    assert set(calls.followed) == chosen - {9}  # which the result has
    assert set(calls.swept) | set(calls.judged) == chosen | set(FITTED)
    assert len(calls.swept) <= MOST and not set(calls.judged) & set(FITTED)
    assert len(calls.judged) == 6


def test_a_frame_whose_views_disagree_is_not_used(result, calls):
    resurfaced(result, Video(), FITTED, range(20, STEPS))
    assert HIDDEN in calls.followed and HIDDEN not in calls.swept + calls.judged


def test_all_timesteps_of_the_result_follow_the_surface(model, result, calls):
    found = resurfaced(result, Video(), FITTED, range(10, STEPS))
    assert found.timesteps == result.timesteps and 9 not in calls.swept
    moved = found.geometry.vertices - result.geometry.vertices
    np.testing.assert_allclose(moved[:4], 1.05 * np.array([1.0, 1.0, 1.0]) * np.ones_like(moved[:4]), atol=1e-5)
    np.testing.assert_allclose(moved[4], 0.05, atol=1e-5)
    np.testing.assert_allclose(found.geometry.displacement, 0.06, atol=1e-6)
    assert found.geometry.report.details["phases"][-1]["kept"] is True


def test_a_surface_that_is_not_kept_is_told_and_changes_nothing(result, calls, monkeypatch):
    monkeypatch.setattr(resurfacing, "MOST", 6)  # the stand-in keeps nothing where three are asked for
    monkeypatch.setattr(resurfacing, "FEWEST", 3)
    found = resurfaced(result, Video(), FITTED, range(STEPS))
    assert found.geometry.vertices is result.geometry.vertices
    assert found.geometry.report.details["phases"][-1]["kept"] is False


@pytest.mark.parametrize("timesteps", [FITTED, range(9)])
def test_few_further_frames_leave_the_surface(result, calls, timesteps):
    assert resurfaced(result, Video(), FITTED, timesteps) is result and calls.sweeps == 0


def test_a_surface_in_the_span_of_the_model_stays_there(result, calls):
    spanned = replace(result, geometry=replace(result.geometry, displacement=None))
    assert resurfaced(spanned, Video(), FITTED, range(STEPS)) is spanned
    off = replace(result, config={"surface": {"enabled": False}})
    assert resurfaced(off, Video(), FITTED, range(STEPS)) is off and calls.sweeps == 0


def test_a_stopped_run_does_not_sweep_again(result, calls, tmp_path):
    given = result, Video(), FITTED, range(STEPS)
    first, again = (resurfaced(*given, folder=tmp_path, key="one") for _ in range(2))
    assert calls.sweeps == 1
    np.testing.assert_array_equal(first.geometry.vertices, again.geometry.vertices)
    assert again.geometry.report.details == first.geometry.report.details
    resurfaced(*given, folder=tmp_path, key="other")
    assert calls.sweeps == 2
