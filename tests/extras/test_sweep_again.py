"""More timesteps of a video mend a surface; what they don't speak for stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import vertex_normals
from mifit.extras.sweep_again import on_surface, openings_closed, sweep_again
from mifit.morphable import MorphableModel
from mifit.stages.surface.displace import solve_displacement
from tests.stages.memory_capture import make_capture
from tests.stages.test_find_surface import bumps, seen_vertices

BOTH = ("left", "right")
ANGLES = [(0, 0, 0), (-6, 10, 3), (5, -12, 0), (-8, -8, 2), (8, 6, -3), (0, 16, 0)]
SEVERAL = tuple(range(len(ANGLES)))
JUDGED = (1, 4)


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=10, expression=5, albedo=10)


@pytest.fixture(scope="module")
def filmed(model):
    """A head with bumps of 2 mm, without expression, and its true poses."""
    beyond = replace(model, mean=model.mean + bumps(model))
    return make_capture(beyond, ANGLES, width=340, height=240, identity=0.0, frown=0.0, shift=0.0)


@pytest.fixture(scope="module")
def flat(model, filmed):
    """The true poses of a surface with dents of 1 mm in place of the bumps."""
    steps = len(ANGLES)
    geometry = GeometryEstimate(
        timesteps=SEVERAL,
        identity=np.zeros(model.n_identity),
        albedo=np.zeros(model.n_albedo),
        expression=np.zeros((steps, model.n_expression)),
        rotation=filmed.rotation,
        translation=np.zeros((steps, 3)),
        scale=1.0,
        vertices=np.zeros((steps, model.n_vertices, 3), np.float32),
        vertex_albedo=model.mean_albedo,
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report("converged"),
        displacement=-0.5 * bumps(model),
    )
    return on_surface(model, geometry, geometry.displacement)


def off_mm(model, filmed, found):
    """Mean distance along the true normals at the first timestep, at vertices that both cameras see, mm."""
    rows = seen_vertices(model, filmed)
    way = vertex_normals(filmed.vertices[0], model.faces)[rows]
    return 10.0 * np.abs(((found.vertices[0] - filmed.vertices[0])[rows] * way).sum(1)).mean()


def judged_as(monkeypatch, *errors):
    monkeypatch.setattr("mifit.extras.sweep_again.errors_between_views", lambda *_: list(errors))


def test_more_timesteps_mend_the_surface(model, filmed, flat):
    found, details = sweep_again(filmed, model, flat, JUDGED, BOTH)
    assert details["kept"] and details["between_views"][1] < details["between_views"][0]
    assert details["judged"] == list(JUDGED) and found.timesteps == (0, 2, 3, 5) == tuple(details["timesteps"])
    assert off_mm(model, filmed, found) < 0.6 * off_mm(model, filmed, flat)


def test_a_surface_through_which_other_views_agree_less_is_dropped(model, filmed, flat, monkeypatch):
    judged_as(monkeypatch, 1.0, 1.01)
    found, details = sweep_again(filmed, model, flat, JUDGED, BOTH)
    assert details["kept"] is False and details["between_views"] == [1.0, 1.01]
    np.testing.assert_array_equal(found.vertices, flat.at((0, 2, 3, 5)).vertices)
    np.testing.assert_array_equal(found.displacement, flat.displacement)


def test_what_judges_is_not_swept(model, filmed, flat, monkeypatch):
    judged_as(monkeypatch, 1.0, 0.9)
    one = filmed.changed(lambda name, t, frame: replace(frame, image=0 * frame.image) if t in JUDGED else frame)
    found = [sweep_again(capture, model, flat, JUDGED, BOTH)[0] for capture in (filmed, one)]
    np.testing.assert_array_equal(found[0].displacement, found[1].displacement)


def test_poses_stay_on_another_surface(model, flat):
    moved = on_surface(model, flat, flat.displacement + np.float32(0.1))
    shift = np.einsum("tij,j->ti", flat.rotation, np.full(3, 0.1))
    np.testing.assert_allclose(
        moved.vertices - flat.vertices, np.broadcast_to(shift[:, None], moved.vertices.shape), atol=1e-5
    )


def test_openings_of_timesteps_that_are_not_swept_are_left_out(flat):
    phases = [{"name": "surface", "openings": {"mouth": {"closed": [0, 2, 9], "opening_mm": {}}}}]
    given = replace(flat, report=Report("converged", details={"phases": phases}))
    assert openings_closed(given)["mouth"]["closed"] == [0, 2]
    assert openings_closed(flat) == {}


def test_more_timesteps_are_no_more_certain_than_a_few(model, filmed, flat, monkeypatch):
    """What misleads the matching of a patch does so in all timesteps: the prior holds against all of them together."""
    judged_as(monkeypatch, 1.0, 0.9)
    given = []

    def solve(plate, points, normals, offsets, precision, *rest):
        given.append(precision)
        return solve_displacement(plate, points, normals, offsets, precision, *rest)

    monkeypatch.setattr("mifit.stages.surface.coarse_to_fine.solve_displacement", solve)
    first = []
    for count in (2.0, 4.0, 40.0):  # of four: more than there are is each for itself
        monkeypatch.setattr("mifit.extras.sweep_again.COUNT_AS", count)
        given.clear()
        sweep_again(filmed, model, flat, JUDGED, BOTH)
        first.append(given[0])
    np.testing.assert_array_equal(first[1], first[2])
    ratio = first[0][first[1] > 0] / first[1][first[1] > 0]
    matched = int(np.isclose(ratio, 0.5).sum())
    assert matched > 1000
    np.testing.assert_allclose(ratio[:matched], 0.5)
    np.testing.assert_allclose(ratio[matched:], 1.0)  # of outlines, which lie elsewhere on the head in every image
