"""Eyeballs: what stands out of the skin goes behind it, and nothing else moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.normal_scene import dome_model

from mifit.core.estimate import GeometryEstimate, Report
from mifit.morphable import MorphableModel
from mifit.morphable.openings import with_eyes
from mifit.stages.eyes import behind_lids, eyeballs
from tests.test_pipeline import without_eyes


@pytest.fixture(scope="module")
def head() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


def posed(model: MorphableModel, vertices: np.ndarray) -> GeometryEstimate:
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    shift, scale = np.array([3.0, -2.0, 50.0]), 0.1  # world in decimetres
    world = (scale * vertices @ turn.T + shift).astype(np.float32)
    return GeometryEstimate(
        (0,),
        np.zeros(1),
        np.zeros(1),
        np.zeros((1, 1)),
        turn[None],
        shift[None],
        scale,
        world[None],
        model.mean_albedo,
        np.zeros((9, 3)),
        0.0,
        Report("converged"),
    )


def test_the_built_in_head_has_two_eyeballs_and_a_plain_face_none(head: MorphableModel) -> None:
    left, right = eyeballs(head)
    assert head.mean[left, 0].max() < 0 < head.mean[right, 0].min()
    assert eyeballs(dome_model()) == []


def test_an_eyeball_that_stands_out_goes_behind_the_lids(head: MorphableModel) -> None:
    eye = np.concatenate(eyeballs(head))
    pushed = head.mean.astype(np.float64).copy()
    pushed[eye, 2] += 0.25
    before = posed(head, pushed)
    after = behind_lids(head, before)
    moved = np.flatnonzero(np.abs(after.vertices[0] - before.vertices[0]).max(axis=1) > 0)
    assert len(moved) and np.isin(moved, eye).all()
    edges = head.faces[np.isin(head.faces[:, 0], eye)][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    longest = (np.linalg.norm(np.diff(v[edges], axis=1), axis=-1).max() for v in (after.vertices[0], pushed))
    assert next(longest) < 2.0 * next(longest) * before.scale
    again = behind_lids(head, after)
    left = np.abs(again.vertices[0] - after.vertices[0]).max(axis=1) > 0
    assert left.sum() < 0.1 * len(moved), (left.sum(), len(moved))
    still = behind_lids(head, replace(before, vertices=before.vertices[:0]))
    assert still.vertices.shape[0] == 0


def test_tissue_behind_the_lids_pushes_no_eyeball(head: MorphableModel) -> None:
    """It surrounds the balls that a model got: wherever it lies, only skin sends them back."""
    skin = without_eyes(head)
    whole = with_eyes(skin)
    added = np.arange(whole.n_vertices) >= skin.n_vertices
    tissue = added & ~np.isin(np.arange(whole.n_vertices), np.concatenate(eyeballs(whole)))
    moved = []
    for forwards in (0.0, 0.6):
        vertices = whole.mean.astype(np.float64)
        vertices[tissue, 2] += forwards
        before = posed(whole, vertices)
        moved.append(np.abs(behind_lids(whole, before).vertices[0] - before.vertices[0]).max(axis=1))
    np.testing.assert_array_equal(*moved)
