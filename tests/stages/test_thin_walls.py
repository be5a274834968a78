"""Thin walls, such as the wings of the nose, keep their sides apart; only what lies in a cavity moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import vertex_normals
from mifit.morphable import MorphableModel
from mifit.optim import Outcome
from mifit.stages.geometry.surfaces import moved_by, object_shapes
from mifit.stages.surface.thin_walls import KEPT, Walls, keep_walls
from tests.morphable.intersections import intersections

OUTSIDE, INSIDE = 0.9, 0.6
"""Radii of a cup, centimetres: a wall of 3 mm around a cavity of 12."""
RINGS, ROUND = 10, 32


@pytest.fixture(scope="module")
def cup():
    """A cup that opens downwards, as a nostril does: outside from the top to the rim, then inside up again."""
    down = np.linspace(0.08, 0.5 * np.pi, RINGS)
    profile = [(OUTSIDE * np.sin(a), OUTSIDE * np.cos(a)) for a in down]
    profile += [(INSIDE * np.sin(a), INSIDE * np.cos(a)) for a in down[::-1]]
    turn = 2.0 * np.pi * np.arange(ROUND) / ROUND
    mean = np.array([(r * np.sin(t), y, r * np.cos(t)) for r, y in profile for t in turn], np.float32)
    faces = []
    for ring in range(len(profile) - 1):
        for k in range(ROUND):
            a, b = ring * ROUND + k, ring * ROUND + (k + 1) % ROUND
            faces += [(a, a + ROUND, b), (b, a + ROUND, b + ROUND)]
    count = len(mean)
    uv = np.stack([np.tile(turn / 7.0, len(profile)), np.repeat(np.linspace(0, 1, len(profile)), ROUND)], axis=1)
    return MorphableModel(
        name="cup",
        mean=mean,
        faces=np.array(faces, np.int32),
        identity=np.full((count, 3, 1), 1e-3, np.float32),
        expression=np.full((count, 3, 1), 1e-3, np.float32),
        mean_albedo=np.full((count, 3), 0.5, np.float32),
        albedo_modes=np.full((count, 3, 1), 1e-3, np.float32),
        uv=uv.astype(np.float32),
        faces_uv=np.array(faces, np.int32),
        landmarks=np.arange(68, dtype=np.int32),
        face_mask=np.ones(len(faces), bool),
    )


@pytest.fixture(scope="module")
def walls(cup):
    return Walls.of(cup)


@pytest.fixture(scope="module")
def fit(cup):
    return GeometryEstimate(
        timesteps=(0,),
        identity=np.zeros(1),
        albedo=np.zeros(1),
        expression=np.zeros((1, 1)),
        rotation=np.eye(3)[None],
        translation=np.zeros((1, 3)),
        scale=1.0,
        vertices=cup.mean[None],
        vertex_albedo=np.full((cup.n_vertices, 3), 0.5, np.float32),
        shading=np.zeros((9, 3)),
        ambient=0.0,
        report=Report(Outcome.CONVERGED, 0, 0.0),
    )


@pytest.fixture(scope="module")
def pressed(cup, fit):
    """The outside pressed in by 4 mm on one side, deeper than the wall is thick, fading to both sides."""
    away = np.linalg.norm(cup.mean - [0.0, 0.45, 0.8], axis=1)
    outside = np.arange(cup.n_vertices) < RINGS * ROUND
    depth = np.where(outside, 0.4 * np.exp(-((away / 0.35) ** 2)), 0.0)
    return moved_by(cup, fit, -depth[:, None] * vertex_normals(cup.mean.astype(np.float64), cup.faces))


def thickness(model, walls, geometry):
    """Distance of both sides along the outer one's normal, over that of the mean."""
    shape = object_shapes(model, geometry)[0]
    normal = vertex_normals(shape, model.faces)[walls.outer]
    return ((shape[walls.outer] - shape[walls.inner]) * normal).sum(1) / walls.thickness


def test_the_inside_of_a_wall_is_what_lies_in_the_cavity(walls):
    assert len(walls.outer) > 0.4 * RINGS * ROUND
    assert (walls.outer < RINGS * ROUND).all() and (walls.inner >= RINGS * ROUND).all()
    np.testing.assert_allclose(walls.thickness, OUTSIDE - INSIDE, rtol=0.15)


def test_a_fit_with_its_walls_stays_as_it_is(cup, fit):
    found, count = keep_walls(cup, fit)
    assert found is fit and count == 0


def test_what_came_through_the_skin_goes_back(cup, walls, pressed):
    before = thickness(cup, walls, pressed)
    assert (before < 0).sum() > 3
    found, count = keep_walls(cup, pressed)
    assert count == (before < KEPT).sum()
    assert thickness(cup, walls, found).min() > 0.8 * KEPT
    moved = np.linalg.norm(found.vertices[0] - pressed.vertices[0], axis=1) > 1e-6
    assert moved.any() and not moved[: RINGS * ROUND].any()


def test_the_surface_no_longer_intersects_itself(cup, pressed):
    found, _ = keep_walls(cup, pressed)
    assert len(intersections(10.0 * pressed.vertices[0], cup.faces)) > 10
    assert len(intersections(10.0 * found.vertices[0], cup.faces)) == 0


def test_walls_are_kept_at_the_timestep_that_presses_them(cup, fit, pressed):
    """An expression presses the outside in; at the other timestep it is neutral."""
    inwards = (pressed.vertices[0] - fit.vertices[0])[..., None].astype(np.float32)
    model = replace(cup, expression=inwards, expression_bounds=None)
    both = replace(
        fit,
        timesteps=(0, 1),
        expression=np.array([[0.0], [1.0]]),
        rotation=np.stack([np.eye(3)] * 2),
        translation=np.zeros((2, 3)),
        vertices=np.concatenate([fit.vertices, pressed.vertices]),
    )
    found, count = keep_walls(model, both)
    assert count > 3
    assert (np.linalg.norm(found.vertices - both.vertices, axis=2).max(axis=1) > 1e-6).all()


def test_a_face_without_cavities_has_no_walls():
    assert len(Walls.of(MorphableModel.load("builtin:coarse").subset(identity=5, expression=5, albedo=5)).outer) == 0
