"""The ICT-FaceKit head: both of its forms."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.morphable import MorphableModel


@pytest.fixture(scope="module")
def ict(ict_path) -> MorphableModel:
    return MorphableModel.load(ict_path)


def test_head_npz_is_read_as_written(ict, ict_path):
    data = np.load(ict_path)
    np.testing.assert_array_equal(ict.mean, data["mean"])
    np.testing.assert_array_equal(ict.faces, data["faces"])
    np.testing.assert_array_equal(ict.identity[:, :, 7], data["identity"][7])
    np.testing.assert_allclose(ict.expression[:, :, 3] / 0.3, data["expression"][3], rtol=1e-6, atol=1e-7)
    assert ict.expression_names[26] == "jawOpen"
    np.testing.assert_allclose(ict.expression_bounds[26], [0, 1 / 0.3], rtol=1e-6)


def test_face_area_is_in_the_first_uv_tile_and_leaves_out_lids_and_inner_mouth(ict, ict_path):
    area = int(np.load(ict_path)["face_area_faces"])
    assert not ict.face_mask[area:].any()
    assert 0.9 * area < ict.face_mask.sum() < area
    assert ict.uv[ict.faces_uv[ict.face_mask]].max() <= 1
    inside = ict.mean[ict.faces[:area][~ict.face_mask[:area]]].mean(1)
    inner_lip_z = ict.mean[ict.landmarks[62], 2]
    mouth = np.abs(inside[:, 1] - ict.mean[ict.landmarks[62], 1]) < 2
    assert mouth.sum() > 100 and inside[mouth, 2].max() < inner_lip_z + 0.3


def test_borrowed_albedo_is_skin(ict):
    assert ict.n_albedo >= 20
    albedo = ict.albedo()
    assert 0.02 < albedo.min() and albedo.max() < 0.8
    lips, cheek = ict.landmarks[57], ict.landmarks[2]
    assert albedo[lips, 1] / albedo[lips, 0] < 0.9 * albedo[cheek, 1] / albedo[cheek, 0]
    brow = ict.landmarks[19]
    assert albedo[brow].mean() < 0.8 * albedo[cheek].mean()


def test_symmetry_is_an_involution(ict):
    assert (ict.symmetry[ict.symmetry] == np.arange(ict.n_vertices)).all()
    np.testing.assert_allclose(ict.mean[ict.symmetry] * (-1, 1, 1), ict.mean, atol=0.01)
