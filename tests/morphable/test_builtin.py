"""The built-in head: mesh, symmetry, modes, cache."""

from __future__ import annotations

import numpy as np
import pytest

from mifit.core.mesh import face_cross
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.builtin import cache, sculpt
from mifit.morphable.builtin.head import make_head
from mifit.morphable.builtin.template import EYEBALL, SKIN, make_template
from mifit.morphable.landmarks import IBUG_MIRROR
from mifit.morphable.topology import boundary_loops, edges


@pytest.fixture(scope="module")
def coarse() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


@pytest.fixture(scope="module")
def template():
    return make_template(2)


def test_sizes(coarse):
    assert 6500 < coarse.n_vertices < 8500
    assert (coarse.n_identity, coarse.n_expression, coarse.n_albedo) == (100, 79, 100)
    full = make_template()
    assert 29_000 < len(full.vertices) < 33_000
    assert 57_000 < (full.face_part == SKIN).sum() < 62_000
    assert coarse.unit_mm == 10


def test_head_has_human_measures(coarse):
    p = 10 * coarse.mean[coarse.landmarks]
    assert 85 < np.linalg.norm(p[36] - p[45]) < 97  # outer eye corners
    assert 28 < np.linalg.norm(p[39] - p[42]) < 36  # inner eye corners
    assert 45 < np.linalg.norm(p[48] - p[54]) < 55  # mouth
    assert 105 < np.linalg.norm(p[27] - p[8]) < 122  # sellion to menton
    assert 15 < p[30, 2] - p[33, 2] < 25  # nose protrusion
    assert 125 < np.linalg.norm(p[0] - p[16]) < 150  # face width


def test_mean_is_its_own_mirror_image(coarse):
    s = coarse.symmetry
    assert (s[s] == np.arange(coarse.n_vertices)).all()
    np.testing.assert_array_equal(coarse.mean[s] * np.float32([-1, 1, 1]), coarse.mean)
    np.testing.assert_array_equal(coarse.landmarks[IBUG_MIRROR], s[coarse.landmarks])
    skin = coarse.faces[coarse.face_mask]
    faces = {tuple(np.roll(f, -f.argmin())) for f in skin}
    mirrored = {tuple(np.roll(f, -f.argmin())) for f in s[skin][:, ::-1]}
    assert faces == mirrored


def test_mesh_is_a_clean_surface(template, coarse):
    skin = template.faces[template.face_part != EYEBALL]
    _, count = edges(skin)
    assert count.max() == 2
    loops = boundary_loops(skin, len(template.vertices))
    assert len(loops) == 3  # the neck and two eyes; the pouch closes the mouth
    assert coarse.degenerate_faces.size == 0
    volume = (template.vertices[skin[:, 0]] * face_cross(template.vertices, skin)).sum() / 6e3
    assert 3000 < volume < 5000  # cubic centimetres, positive: faces look outwards
    directed = np.concatenate([skin[:, [0, 1]], skin[:, [1, 2]], skin[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)


def test_chart_is_one_to_one_and_filled_by_the_face(coarse):
    uv = coarse.uv[coarse.faces_uv]
    assert uv.min() >= 0 and uv.max() <= 1
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert (area[coarse.face_mask] > 0).all()
    texels = rasterize_uv(coarse.uv, coarse.faces_uv, 256, coarse.face_mask)
    assert area[coarse.face_mask].sum() == pytest.approx(len(texels.index) / 256**2, rel=0.02)  # nothing overlaps
    assert len(texels.index) / 256**2 > 0.5


def test_landmarks_are_distinct_and_on_the_face(coarse):
    assert len(np.unique(coarse.landmarks)) == 68
    on_face = np.unique(coarse.faces[coarse.face_mask])
    corners = [36, 39, 42, 45, 48, 54]  # ends of slits touch faces that are left out
    assert np.isin(np.delete(coarse.landmarks, corners), on_face).all()


def test_identity_modes_are_orthogonal_with_human_spread(coarse):
    j = coarse.identity_jacobian
    gram = j.T @ j
    d = np.sqrt(np.diag(gram))
    correlation = gram / np.outer(d, d) - np.eye(len(d))
    assert np.abs(correlation).max() < 0.05  # eyeballs, moved as wholes, disturb it a little
    spread = 10 * np.sqrt((coarse.identity**2).sum((1, 2)))[np.unique(coarse.faces[coarse.face_mask])]
    assert 4 < spread.mean() < 9  # mm


def test_made_twice_is_the_same_model(coarse):
    assert make_head(coarse=True).digest == coarse.digest


def test_albedo_is_a_reflectance(coarse):
    on_face = np.unique(coarse.faces[coarse.face_mask])
    assert coarse.mean_albedo.min() > 0 and coarse.mean_albedo.max() < 1
    for seed in range(5):
        albedo = coarse.albedo(coarse.sample(seed)[2])[on_face]
        assert (albedo > 0).mean() > 0.99 and albedo.max() < 1.0
        assert albedo[:, 0].mean() > albedo[:, 1].mean() > albedo[:, 2].mean()


def test_cache_is_used_and_a_damaged_one_replaced(tmp_path, monkeypatch, coarse):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = []
    monkeypatch.setattr(cache, "make_head", lambda c: made.append(c) or coarse)
    fresh = cache.builtin_model.__wrapped__
    first = fresh(True)
    (file,) = (tmp_path / "mifit").iterdir()
    assert fresh(True).digest == first.digest and made == [True]
    file.write_bytes(file.read_bytes()[:5000])
    assert fresh(True).digest == first.digest and made == [True, True]
    assert fresh(True).digest == first.digest and made == [True, True]


def test_cache_folder_that_cannot_be_written_is_no_trouble(tmp_path, monkeypatch, coarse):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(cache, "make_head", lambda c: coarse)
    assert cache.builtin_model.__wrapped__(True).digest == coarse.digest


def test_gaze_turns_the_eyes_only(coarse, template):
    e = coarse.expression[:, :, coarse.expression_names.index("gazeUp")]
    assert (np.abs(e).max(1) > 0)[template.part != EYEBALL].sum() == 0
    iris = (template.eye_angle > 0) & (template.eye_angle < 0.3)
    assert (e[iris, 1] > 0).all()


def test_blink_closes_the_eye(coarse, template):
    coefficients = np.zeros(79)
    coefficients[[coarse.expression_names.index(n) for n in ("blink_L", "blink_R")]] = 2.0
    v = 10 * coarse.shape(None, coefficients)
    gap = v[template.upper_lids, 1] - v[template.lower_lids, 1]
    open_gap = 10 * (coarse.mean[template.upper_lids, 1] - coarse.mean[template.lower_lids, 1])
    assert open_gap.max() > 7 and np.abs(gap).max() < 1.0
    for side, lids in zip((-1, 1), template.upper_lids, strict=True):
        ball = np.array([0, 34, 10]) + sculpt.EYE * (side, 1, 1)
        middle = lids[8:-8] if len(lids) > 20 else lids[4:-4]
        assert (np.linalg.norm(v[middle] - ball, axis=1) > sculpt.EYE_RADIUS - 2.5).all()
