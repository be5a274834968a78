"""The built-in head: mesh, symmetry, modes, cache."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import tracemalloc

import numpy as np
import pytest
from intersections import intersections

from mifit.core.mesh import edges, face_cross
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel, assemble
from mifit.morphable.builtin import head, sculpt
from mifit.morphable.builtin.head import make_head
from mifit.morphable.builtin.template import make_template
from mifit.morphable.model import VERSION
from mifit.morphable.openings import eyeballs
from mifit.morphable.topology import IBUG_MIRROR, closed_borders


@pytest.fixture(scope="module")
def coarse() -> MorphableModel:
    return MorphableModel.load("builtin:coarse")


@pytest.fixture(scope="module")
def template():
    return make_template(1.0, 2)


def test_sizes(coarse):
    assert 8500 < coarse.n_vertices < 10_000
    assert (coarse.n_identity, coarse.n_expression, coarse.n_albedo) == (160, 77, 100)
    full = make_template(head.DENSITY)
    assert 12_500 < len(full.vertices) < 14_500
    assert 25_000 < len(full.faces) < 29_000
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
    s, skin = coarse.symmetry, np.arange(coarse.n_vertices) < eyeballs(coarse)[0].min()
    assert (s[s] == np.arange(coarse.n_vertices)).all()
    np.testing.assert_array_equal((coarse.mean[s] * np.float32([-1, 1, 1]))[skin], coarse.mean[skin])
    np.testing.assert_allclose(coarse.mean[s] * [-1, 1, 1], coarse.mean, atol=1e-3)
    np.testing.assert_array_equal(coarse.landmarks[IBUG_MIRROR], s[coarse.landmarks])
    skin = coarse.faces[coarse.face_mask]
    faces = {tuple(np.roll(f, -f.argmin())) for f in skin}
    mirrored = {tuple(np.roll(f, -f.argmin())) for f in s[skin][:, ::-1]}
    assert faces == mirrored


def test_mesh_is_a_clean_surface(template, coarse):
    skin = template.faces
    _, count = edges(skin)
    assert count.max() == 2
    loops = sorted(closed_borders(skin), key=len, reverse=True)
    assert len(loops) == 4  # the neck, two eyes, the mouth
    assert len(eyeballs(coarse)) == 2
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
    j = coarse.identity_jacobian[: 3 * eyeballs(coarse)[0].min()]  # of the skin, which the eyes go along with
    gram = j.T @ j
    d = np.sqrt(np.diag(gram))
    correlation = gram / np.outer(d, d) - np.eye(len(d))
    assert np.abs(correlation).max() < 0.01
    spread = 10 * np.sqrt((coarse.identity**2).sum((1, 2)))[np.unique(coarse.faces[coarse.face_mask])]
    assert 4 < spread.mean() < 9  # mm


def summary(model: MorphableModel) -> list[float]:
    """Root mean squares of what a model holds, and sums of its indices."""
    arrays = model.mean, model.identity, model.expression, model.mean_albedo, model.albedo_modes, model.uv
    sizes = [float(np.sqrt((np.asarray(a, float) ** 2).mean())) for a in arrays]
    return [*sizes, model.n_vertices, int(model.landmarks.sum()), int(model.face_mask.sum())]


COMPUTED = {
    "coarse": [6.1108528, 0.03046862, 0.04135586, 0.3468852, 0.00945451, 0.5430817, 9441, 281336, 9152],
    "full": [6.1173436, 0.03059462, 0.04191954, 0.3398031, 0.00983755, 0.5608336, 15367, 496712, 16162],
    "completed": [6.1108528, 0.03046862, 0.04135586, 0.3279984, 0.01346702, 0.5698451, 9441, 281336, 9268],
}
"""What each model holds in version 1. Where it changes, raise `VERSION`, here too."""


@pytest.mark.parametrize("made", COMPUTED)
def test_a_model_that_is_computed_otherwise_has_another_version(coarse, made):
    if made == "completed":
        given = coarse.mean, coarse.faces, coarse.identity, coarse.expression
        model = assemble.ModelData("head", *given, coarse.unit_mm).complete()
    else:
        model = make_head(coarse=made == "coarse")
    assert (VERSION, summary(model)) == (1, pytest.approx(COMPUTED[made], rel=1e-5))


def test_results_are_read_after_code_changes_that_change_no_head(tmp_path, monkeypatch, coarse):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(head, "make_head", lambda c: coarse)
    now = head.builtin_model.__wrapped__(True).digest
    monkeypatch.setattr(head, "_DIGEST", "0" * 16)  # of other sources
    assert head.builtin_model.__wrapped__(True).digest == now
    monkeypatch.setattr(head, "VERSION", VERSION + 1)
    assert head.builtin_model.__wrapped__(True).digest != now


def test_made_again_is_the_same_model(coarse):
    """To float32's rounding, which differs with the alignment of memory; the cached file is the same for good."""
    again = make_head(coarse=True)
    for key in ("mean", "faces", "uv", "faces_uv", "landmarks", "face_mask", "symmetry", "expression_names"):
        np.testing.assert_array_equal(getattr(again, key), getattr(coarse, key), err_msg=key)
    for key in ("identity", "expression", "albedo_modes"):
        a, b = getattr(again, key), getattr(coarse, key)
        assert np.abs(a - b).max() < 1e-4 * np.abs(b).max(), key


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
    monkeypatch.setattr(head, "make_head", lambda c: made.append(c) or coarse)
    fresh = head.builtin_model.__wrapped__
    first = fresh(True)
    (file,) = (tmp_path / "mifit").iterdir()
    assert fresh(True).digest == first.digest and made == [True]
    file.write_bytes(file.read_bytes()[:5000])
    assert fresh(True).digest == first.digest and made == [True, True]
    assert fresh(True).digest == first.digest and made == [True, True]


def test_models_of_other_versions_stay_while_they_are_used(tmp_path, monkeypatch, coarse):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(head, "make_head", lambda c: coarse)
    (tmp_path / "mifit").mkdir()
    recent, old = (tmp_path / "mifit" / f"builtin-coarse-{n}.npz" for n in ("1" * 16, "2" * 16))
    for file in (recent, old):
        file.touch()
    os.utime(old, (0, time.time() - 30 * 86400 - 60))
    head.builtin_model.__wrapped__(True)
    assert recent.exists() and not old.exists()


def test_cache_folder_that_cannot_be_written_is_no_trouble(tmp_path, monkeypatch, coarse):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    monkeypatch.setattr(head, "make_head", lambda c: coarse)
    assert head.builtin_model.__wrapped__(True).digest == coarse.digest


def test_blink_closes_the_eye(coarse, template):
    coefficients = np.zeros(coarse.n_expression)
    coefficients[[coarse.expression_names.index(n) for n in ("blink_L", "blink_R")]] = 2.0
    v = 10 * coarse.shape(None, coefficients)
    gap = v[template.upper_lids, 1] - v[template.lower_lids, 1]
    open_gap = 10 * (coarse.mean[template.upper_lids, 1] - coarse.mean[template.lower_lids, 1])
    assert open_gap.max() > 7 and np.abs(gap).max() < 1.0
    for side, lids in zip((-1, 1), template.upper_lids, strict=True):
        ball = np.array([0, 34, 10]) + sculpt.EYE * (side, 1, 1)
        middle = lids[8:-8] if len(lids) > 20 else lids[4:-4]
        assert (np.linalg.norm(v[middle] - ball, axis=1) > sculpt.LID_RADIUS - 4.4).all()


RISKY = [
    *("jawOpen", "pucker", "funnel", "rollLower", "rollUpper", "lipPress", "smile_L", "frown_R", "blink_L", "squint_R"),
    *("jawSideways", "shrugLower", "upperLipUp_L", "lowerLipDown_R", "local_up_mid_y", "local_corner_x"),
]


def self_intersections(model: MorphableModel, skin: np.ndarray, name: str, sigma: float) -> int:
    """Edges that pierce triangles of the skin, insides of lids and lips included, where a mode moves it."""
    coefficients = np.zeros(model.n_expression)
    coefficients[model.expression_names.index(name)] = sigma
    neutral, v = 10.0 * model.mean.astype(float), 10.0 * model.shape(None, coefficients).astype(float)
    moved = np.linalg.norm(v - neutral, axis=1) > 0.1
    assert moved.any()
    box = ((v > v[moved].min(0) - 4) & (v < v[moved].max(0) + 4)).all(1)
    return len(intersections(v, skin[box[skin].all(1)]))


def modes_within_bounds(model: MorphableModel, names) -> list[tuple[str, float]]:
    bounds = dict(zip(model.expression_names, np.clip(model.expression_bounds, -2, 2), strict=True))
    return [(n, float(s)) for n in names for s in bounds[n] if s != 0]


def test_intersections_are_found():
    v = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [1, 1, -1], [1, 1, 1], [3, 3, 1.0]])
    f = np.array([[0, 1, 2], [3, 4, 5]])
    assert len(intersections(v, f)) > 0
    assert len(intersections(v + np.repeat([[0.0], [5.0]], 3, axis=0), f)) == 0


def test_risky_expressions_do_not_self_intersect(coarse, template):
    skin = template.faces
    for name, sigma in modes_within_bounds(coarse, RISKY):
        assert self_intersections(coarse, skin, name, sigma) == 0, (name, sigma)


@pytest.mark.slow
def test_no_expression_self_intersects_within_two_sigma(coarse, template):
    skin = template.faces
    others = [n for n in coarse.expression_names if n not in RISKY]
    for name, sigma in modes_within_bounds(coarse, others):
        assert self_intersections(coarse, skin, name, sigma) == 0, (name, sigma)


def test_random_subjects_are_different_people_with_intact_faces(coarse):
    face = coarse.faces[coarse.face_mask]
    on_face = np.unique(face)
    shapes = [10.0 * coarse.shape(coarse.sample(s)[0]).astype(float) for s in range(5)]
    for k, v in enumerate(shapes):
        assert len(intersections(v, face)) == 0
        for w in shapes[:k]:
            assert np.linalg.norm(v - w, axis=1)[on_face].mean() > 3.0


def test_jaw_opens_the_mouth_and_smile_widens_it(coarse):
    def landmarks(**coefficients: float) -> np.ndarray:
        c = np.zeros(coarse.n_expression)
        for name, value in coefficients.items():
            c[coarse.expression_names.index(name)] = value
        return 10.0 * coarse.shape(None, c)[coarse.landmarks]

    rest, opened, smile = landmarks(), landmarks(jawOpen=2), landmarks(smile_L=2, smile_R=2)
    assert opened[62, 1] - opened[66, 1] > rest[62, 1] - rest[66, 1] + 20
    assert np.linalg.norm(opened[27:36] - rest[27:36], axis=1).max() < 1.5  # the nose stays
    assert smile[54, 0] - smile[48, 0] > rest[54, 0] - rest[48, 0] + 10
    assert smile[48, 1] > rest[48, 1] + 5


_TIMING = """
import time
import numpy as np
from mifit.morphable import MorphableModel
m = MorphableModel.load("builtin:coarse")
identity, expression, albedo = m.sample(0)
plain = [(np.ones((3 * m.n_vertices, len(c)), np.float32), c) for c in (identity, expression, albedo)]
def evaluate():
    m.shape(identity, expression)
    m.albedo(albedo)
def multiply():
    for basis, coefficients in plain:
        basis @ coefficients
times = {evaluate: [], multiply: []}
for _ in range(30):
    for work in times:
        start = time.process_time()
        work()
        times[work].append(time.process_time() - start)
print(min(times[evaluate]) / min(times[multiply]))
"""


def test_evaluation_costs_three_plain_products(coarse):
    """In one thread, beside products of the same size, so that the machine's speed matters little."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    out = subprocess.run([sys.executable, "-c", _TIMING], env=environment, capture_output=True, text=True, check=True)
    assert float(out.stdout) < 2


def test_jacobian_products_copy_no_basis(coarse):
    residual = np.ones(3 * coarse.n_vertices, dtype=np.float32)
    tracemalloc.start()
    coarse.identity_jacobian.T @ residual
    coarse.identity_jacobian @ coarse.sample(0)[0]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 0.1 * coarse.identity.nbytes


def test_lengths_of_faces_deviate_as_people_do(coarse):
    """Standard deviations in mm of one sex: Zhuang and Bradtmiller (2005), men."""
    drawn = np.random.default_rng(0).standard_normal((2000, coarse.n_identity))
    points = coarse.mean[coarse.landmarks] + np.einsum("vak,nk->nva", coarse.identity[coarse.landmarks], drawn)
    points *= coarse.unit_mm
    for a, b, deviation in ((0, 16, 6.9), (27, 8, 7.0), (27, 33, 4.1), (48, 54, 4.2)):
        found = np.linalg.norm(points[:, a] - points[:, b], axis=1).std()
        assert found == pytest.approx(deviation, rel=0.15), (a, b)
    assert (points[:, 30, 2] - points[:, 33, 2]).std() == pytest.approx(2.7, rel=0.15)
