"""Registration, models of any template, landmarks found on strange meshes, previews."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.cli.setup import model_info, notices
from mifit.morphable import MorphableModel
from mifit.morphable.assemble import unwrap
from mifit.morphable.register import register, rigid_between
from mifit.morphable.topology import EYES_AND_MOUTH, IBUG_MIRROR
from mifit.output.truth import nearest_points


@pytest.fixture(scope="module")
def coarse() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


@pytest.fixture(scope="module")
def ict(ict_path) -> MorphableModel:
    return MorphableModel.load(ict_path)


def test_the_distance_to_a_surface_is_exact():
    vertices = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    points = np.array([[1.0, 1, 3], [-2, 0, 0], [4, 4, 0], [2, -1, 1]])
    expected = [3.0, 2.0, 4 / np.sqrt(2), np.sqrt(2)]
    np.testing.assert_allclose(nearest_points(points, vertices, np.array([[0, 1, 2]]))[0], expected)


def test_rigid_between():
    rng = np.random.default_rng(0)
    p = rng.standard_normal((9, 3))
    r, t = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix(), np.array([1.0, 2, 3])
    rotation, translation = rigid_between(p, p @ r.T + t)
    np.testing.assert_allclose(rotation, r, atol=1e-12)
    np.testing.assert_allclose(translation, t, atol=1e-12)


def test_model_registers_to_a_subject_of_its_own(coarse):
    subject = 10.0 * coarse.shape(coarse.sample(1, 0.7)[0]).astype(float)
    r = Rotation.from_rotvec(np.array([0.1, 0.2, 0.0])).as_matrix()
    fit = register(coarse, subject @ r.T + 5.0, coarse.faces, coarse.landmarks, iterations=12)
    on_face = np.unique(coarse.faces[coarse.face_mask])
    assert np.linalg.norm(fit.vertices - subject @ r.T - 5.0, axis=1)[on_face].mean() < 1.0


def test_builtin_spans_ict_heads(coarse, ict):
    on_face = np.unique(coarse.faces[coarse.face_mask])
    for seed in (100, 101):
        head = 10.0 * ict.shape(ict.sample(seed)[0]).astype(float)
        fit = register(coarse, head, ict.faces, ict.landmarks)
        assert nearest_points(fit.vertices[on_face], head, ict.faces)[0].mean() < 2.0


def test_landmarks_are_found_on_a_mesh_without_any(ict):
    from mifit.morphable.assemble import transfer_landmarks

    found = transfer_landmarks(10.0 * ict.mean.astype(float), ict.faces)
    error = 10.0 * np.linalg.norm(ict.mean[found] - ict.mean[ict.landmarks], axis=1)
    assert np.median(error) < 6.0
    for ring in EYES_AND_MOUTH:
        assert error[list(ring)].mean() < 8.0


def test_unwrapping_is_one_to_one(coarse):
    uv, corners = unwrap(coarse.mean.astype(float), coarse.faces, coarse.face_mask)
    t = uv[corners[coarse.face_mask]].astype(float)
    a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert (area > -1e-9).all()
    assert area.sum() == pytest.approx(0.98**2, rel=0.02)  # fills the square but for the holes, once


def test_unwrapping_of_what_is_no_disc():
    two = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0], [4, 0, 0], [3, 1, 0]])
    uv, corners = unwrap(two, np.array([[0, 1, 2], [3, 4, 5]]), np.array([True, True]))
    assert corners.shape == (2, 3) and 0 <= uv.min() and uv.max() <= 1
    assert len(np.unique(uv[corners].reshape(-1, 2), axis=0)) == 6


def test_landmark_maps():
    np.testing.assert_array_equal(IBUG_MIRROR[IBUG_MIRROR], np.arange(68))


def test_info_names_what_is_odd(coarse):
    text = model_info(coarse)
    assert "identity          160 modes" in text and "77 bounded" in text and coarse.digest in text
    assert "notice" not in text
    odd = dataclasses.replace(coarse, faces=np.r_[coarse.faces[:-1], [[5, 5, 6]]])
    assert notices(odd)[0].startswith("1 faces of the mean have no area")
