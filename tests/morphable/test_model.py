"""The model itself: validation, evaluation, files."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys

import numpy as np
import pytest

from mifit.core.process import one_blas_thread
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeballs


def small_model(**changes) -> MorphableModel:
    """A lumpy sphere-like surface with random modes."""
    rng = np.random.default_rng(0)
    rows, columns = 9, 11
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    mean = np.stack([8 * (u - 0.5), 10 * (v - 0.5), 3 * np.cos(2 * (u - 0.5))], -1).reshape(-1, 3)
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel(), k[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    n = len(mean)
    values = {
        "name": "small",
        "mean": mean,
        "faces": faces,
        "identity": 0.2 * rng.standard_normal((n, 3, 5)),
        "expression": 0.2 * rng.standard_normal((n, 3, 4)),
        "mean_albedo": np.full((n, 3), 0.4),
        "albedo_modes": 0.02 * rng.standard_normal((n, 3, 3)),
        "uv": np.stack([u, v], -1).reshape(-1, 2),
        "faces_uv": faces,
        "landmarks": np.arange(68),
        "face_mask": np.ones(len(faces), dtype=bool),
        "expression_names": ("a", "b", "c", "d"),
    }
    return MorphableModel(**(values | changes))


def test_shape_and_albedo_are_the_linear_model():
    m = small_model()
    i, e, a = m.sample(3)
    expected = m.mean + np.einsum("vck,k->vc", m.identity, i) + np.einsum("vck,k->vc", m.expression, e)
    np.testing.assert_allclose(m.shape(i, e), expected, atol=1e-5)
    np.testing.assert_allclose(m.albedo(a), m.mean_albedo + np.einsum("vck,k->vc", m.albedo_modes, a), atol=1e-6)
    np.testing.assert_allclose(m.shape(i[:2]), m.mean + m.identity[:, :, :2] @ i[:2], atol=1e-5)


def test_jacobians_are_views():
    m = small_model()
    for jacobian, basis in ((m.identity_jacobian, m.identity), (m.albedo_jacobian, m.albedo_modes)):
        assert np.shares_memory(jacobian, basis)
        assert jacobian.shape == (3 * m.n_vertices, basis.shape[2])


def test_model_is_immutable_and_leaves_the_callers_arrays_writable():
    mine = np.zeros((99, 3, 2), dtype=np.float32)
    m = small_model(albedo_modes=mine)
    with pytest.raises(ValueError, match="read-only"):
        m.mean[0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        m.name = "other"
    m.shape()[0] = 1.0
    m.albedo()[0] = 1.0
    mine[0] = 1.0


def test_sample_is_deterministic():
    m = small_model()
    for a, b, c in zip(m.sample(1), m.sample(1), m.sample(2), strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)


def test_save_and_load_bit_for_bit(tmp_path):
    m = small_model()
    m.save(tmp_path / "m.npz")
    again = MorphableModel.load(tmp_path / "m.npz")
    for f in dataclasses.fields(m):
        np.testing.assert_array_equal(getattr(m, f.name), getattr(again, f.name), err_msg=f.name)
    assert again.digest == m.digest
    assert list(tmp_path.iterdir()) == [tmp_path / "m.npz"]


def test_subset():
    m = small_model()
    region = np.arange(len(m.faces)) < 10
    s = m.subset(identity=2, expression=slice(1, 3), albedo=1, region=region)
    assert (s.n_identity, s.n_expression, s.n_albedo) == (2, 2, 1)
    assert s.expression_names == ("b", "c")
    assert s.face_mask.sum() == 10
    np.testing.assert_array_equal(s.expression, m.expression[:, :, 1:3])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mean": np.full((99, 3), np.nan)}, r"mean\[0, 0\] is nan, expected finite"),
        ({"mean": np.zeros((99, 2))}, r"mean has shape \(99, 2\), expected \(99, 3\)"),
        ({"identity": np.zeros((99, 3))}, r"identity has shape \(99, 3\)"),
        ({"identity": np.zeros((98, 3, 2))}, r"identity has shape \(98, 3, 2\), expected \(99, 3, any\)"),
        ({"faces": np.full((160, 3), 99)}, r"faces holds indices 99..99, expected 0..98"),
        ({"faces": np.full((160, 3), -1)}, r"faces holds indices -1"),
        ({"faces_uv": np.full((160, 3), 1 << 20)}, "faces_uv holds indices"),
        ({"faces": np.full((160, 3), 1 << 40)}, "expected 32-bit indices"),
        ({"faces": np.zeros((160, 3))}, "faces has type float64, expected int32"),
        ({"landmarks": np.arange(51)}, r"landmarks has shape \(51,\), expected \(68,\)"),
        ({"face_mask": np.zeros(160, dtype=bool)}, "face_mask selects no face"),
        ({"expression_names": ("a",)}, "1 expression_names for 4 modes"),
        ({"expression_bounds": np.float32([[1, 0]] * 4)}, "lower bound above"),
        ({"unit_mm": 0.0}, "unit_mm is 0.0"),
    ],
)
def test_validation_names_what_is_wrong(changes, message):
    with pytest.raises(InputError, match=message):
        small_model(**changes)


def test_coefficients_of_the_wrong_shape_are_refused():
    m = small_model()
    with pytest.raises(InputError, match=r"identity coefficients have shape \(6,\), expected at most \(5,\)"):
        m.shape(np.zeros(6))


def test_degenerate_faces_are_reported():
    faces = small_model().faces.copy()
    faces[7] = (3, 3, 4)
    assert small_model(faces=faces).degenerate_faces.tolist() == [7]
    assert small_model().degenerate_faces.size == 0


def test_digest_of_a_computed_model_does_not_depend_on_threads(ict_path):
    """Results are refused for another model, so the digest must be the same in every process."""
    code = f"import mifit; print(mifit.MorphableModel.load({str(ict_path)!r}).digest)"
    other = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    with one_blas_thread():
        assert MorphableModel.load(ict_path).digest == other


def test_charts_with_a_place_of_their_own_are_mapped() -> None:
    head = MorphableModel.load("builtin:coarse")
    assert head.mapped.all()  # scalp, neck and eyes have their own part of the atlas
    eye = np.isin(head.faces[:, 0], eyeballs(head)[1])
    assert eye.sum() > 50
    uv = head.uv.copy()
    corners = np.unique(head.faces_uv[eye])
    uv[corners] += 0.5 - uv[corners].mean(axis=0)  # onto the middle of the face
    moved = dataclasses.replace(head, uv=uv, fingerprint="").mapped
    assert moved[~eye].mean() > 0.99 and not moved[eye].any()
    uv[corners] += 2.0
    assert not dataclasses.replace(head, uv=uv, fingerprint="").mapped[eye].any()
