"""Every format: written in its documented layout and read back."""

from __future__ import annotations

import layouts
import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.formats.bfm_mat import load_bfm2009
from mifit.morphable.openings import SCLERA_ALBEDO, STRIP, eyeballs, lacks_eyes
from mifit.morphable.recognise import recognise
from mifit.morphable.topology import adjacency


@pytest.fixture(scope="module")
def source() -> MorphableModel:
    """The built-in head with few modes: real landmarks and a real face area."""
    full = MorphableModel.load("builtin:coarse")
    return full.subset(identity=6, expression=slice(4, 6), albedo=3)


def same_shape(m: MorphableModel, source: MorphableModel, expressions: float = 1.0) -> None:
    """Shapes agree in mm to the accuracy of float32, for random coefficients."""
    identity, expression = np.linspace(-2, 2, source.n_identity), np.array([1.0, -0.5])
    expected = source.unit_mm * source.shape(identity, expression)
    found = m.unit_mm * m.shape(identity, expression * expressions)
    np.testing.assert_allclose(found, expected, atol=2e-4)
    np.testing.assert_array_equal(m.faces, source.faces)
    np.testing.assert_array_equal(m.landmarks, source.landmarks)
    assert m.face_mask.sum() > 3000 and not m.face_mask.all()
    uv = m.uv[m.faces_uv[m.face_mask]]
    assert uv.min() >= 0 and uv.max() <= 1


def test_bfm2009(tmp_path, source):
    path = tmp_path / "01_MorphableModel.mat"
    layouts.write_bfm2009(path, source)
    assert recognise(path) == "bfm2009"
    m = MorphableModel.load(path)
    assert m.n_expression == 0
    np.testing.assert_array_equal(m.mean, (10.0 * source.mean.astype(np.float64)).astype(np.float32))  # bit-exact
    np.testing.assert_allclose(m.mean_albedo, source.mean_albedo, atol=1e-6)
    np.testing.assert_array_equal(m.faces, source.faces)  # stored inward, turned


@pytest.mark.parametrize("compress", [False, True])
def test_bfm2009_with_facewarehouse_expressions(tmp_path, source, compress):
    layouts.write_bfm2009(tmp_path / "m.mat", source, compress)
    offset = np.full((source.n_vertices, 3), 7.0)
    trim = layouts.write_facewarehouse(tmp_path, source, offset)
    m = MorphableModel.load(tmp_path / "m.mat")
    assert m.n_expression == 2
    e = 10.0 * source.expression[trim]
    np.testing.assert_allclose(m.expression[trim], e, atol=1e-5)
    assert not m.expression[len(trim) :].any()
    moved = load_bfm2009(tmp_path / "m.mat", add_expression_mean=True)
    np.testing.assert_allclose(moved.mean[trim] - m.mean[trim], 0.007, atol=1e-4)


def test_3ddfa(tmp_path, source):
    path = layouts.write_3ddfa(tmp_path, source)
    assert recognise(path) == "3ddfa"
    same_shape(MorphableModel.load(path), source)


def test_deep3d(tmp_path, source):
    path = tmp_path / "BFM_model_front.mat"
    layouts.write_deep3d(path, source)
    assert recognise(path) == "deep3d"
    m = MorphableModel.load(path)
    same_shape(m, source)
    np.testing.assert_array_equal(m.identity, (source.unit_mm / 100.0 * source.identity_jacobian).reshape(-1, 3, 6))
    np.testing.assert_allclose(m.mean_albedo, source.mean_albedo, atol=1e-6)


@pytest.mark.parametrize("version", [(0, 9), (0, 8), (1, 0)])
def test_bfm_h5(tmp_path, source, version):
    path = tmp_path / "model2017.h5"
    layouts.write_bfm_h5(path, source, version)
    assert recognise(path) == "bfm-h5"
    m = MorphableModel.load(path)
    same_shape(m, source)
    np.testing.assert_allclose(m.mean_albedo, source.mean_albedo, atol=1e-6)


def test_albedomm_beside_bfm(tmp_path, source):
    layouts.write_bfm_h5(tmp_path / "model2017.h5", source)
    layouts.write_albedomm(tmp_path / "albedoModel2020.h5", source)
    m = MorphableModel.load(tmp_path / "model2017.h5")
    np.testing.assert_allclose(m.mean_albedo, source.mean_albedo, atol=1e-6)
    np.testing.assert_allclose(m.albedo_modes, source.albedo_modes, atol=1e-6)  # linear: no decoding


def test_flame_pickle(tmp_path, source):
    path = tmp_path / "generic_model.pkl"
    layouts.write_flame_pickle(path, source)
    assert recognise(path) == "flame-pickle"
    m = MorphableModel.load(path)
    same_shape(m, source)


def test_flame_npz_with_texture(tmp_path, source):
    path = tmp_path / "flame.npz"
    layouts.write_flame_npz(path, source)
    layouts.write_flame_texture(tmp_path / "FLAME_albedo_from_BFM.npz", source)
    assert recognise(path) == "flame-npz"
    m = MorphableModel.load(path)
    same_shape(m, source)
    assert m.n_albedo == 4
    np.testing.assert_array_equal(m.uv, source.uv)
    assert 0.02 < m.mean_albedo.min() < m.mean_albedo.max() < 0.7  # 0.2..0.8 decoded from sRGB


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_eos(tmp_path, source, version):
    path = tmp_path / "sfm.bin"
    layouts.write_eos(path, source, version)
    if version == 1:
        layouts.write_eos_blendshapes(tmp_path / "expression_blendshapes_6.bin", source)
    assert recognise(path) == "eos"
    m = MorphableModel.load(path)
    same_shape(m, source, expressions=1 / 0.3)  # weights are scaled to plausible deviations
    assert m.expression_names == source.expression_names
    np.testing.assert_allclose(m.expression_bounds, [[0, 1 / 0.3]] * 2, rtol=1e-6)
    if version == 4:
        np.testing.assert_allclose(m.uv, source.uv, atol=1e-6)


def test_own_format_is_bit_exact(tmp_path, source):
    source.save(tmp_path / "m.npz")
    assert recognise(tmp_path / "m.npz") == "mifit"
    assert MorphableModel.load(tmp_path / "m.npz").digest == source.digest


def test_ict_folder_agrees_with_the_head_npz(shared, ict_path):
    whole = MorphableModel.load(ict_path)
    folder = MorphableModel.load(shared / "models" / "ict_facekit" / "FaceXModel_sample")
    for key in ("mean", "faces", "uv", "faces_uv", "landmarks", "face_mask"):
        np.testing.assert_array_equal(getattr(folder, key), getattr(whole, key), err_msg=key)
    np.testing.assert_allclose(folder.mean_albedo, whole.mean_albedo, atol=1e-5)
    np.testing.assert_allclose(folder.identity, whole.identity[:, :, :3], atol=5e-6)
    for k, name in enumerate(folder.expression_names):
        j = whole.expression_names.index(name)
        np.testing.assert_allclose(folder.expression[:, :, k], whole.expression[:, :, j], atol=5e-6)
    assert folder.expression_names == ("browInnerUp_L", "jawOpen", "mouthSmile_L", "mouthSmile_R")


@pytest.fixture(scope="module")
def gnm(source, tmp_path_factory):
    """A head in the layout of GNM, loaded, with its landmarks beside it."""
    path = tmp_path_factory.mktemp("gnm") / "gnm_head.npz"
    layouts.write_gnm(path, source)
    layouts.landmarks_beside(path, source)
    assert recognise(path) == "gnm"
    return MorphableModel.load(path)


def test_gnm_has_skin_and_eyes_and_no_clear_corneas(gnm, source):
    same_shape(gnm, source)
    assert gnm.n_vertices == source.n_vertices  # modes of teeth that aren't there and corneas are gone
    eyes = eyeballs(gnm)
    assert len(eyes) == 2 and not lacks_eyes(gnm)
    np.testing.assert_allclose(gnm.mean_albedo[eyes[0]], np.tile(SCLERA_ALBEDO, (len(eyes[0]), 1)), atol=1e-6)
    assert not gnm.albedo_modes[np.concatenate(eyes)].any() and gnm.albedo_modes.any()


def test_every_piece_of_gnm_has_a_place_of_its_own_in_the_maps(gnm):
    piece = connected_components(adjacency(gnm.faces, gnm.n_vertices), directed=False)[1][gnm.faces[:, 0]]
    skin = piece == np.bincount(piece).argmax()
    above, below = (gnm.uv[gnm.faces_uv[rows]].reshape(-1, 2) for rows in (skin, ~skin))
    assert above[:, 1].min() >= STRIP - 1e-6 > below[:, 1].max() and 0 <= below.min() and above.max() <= 1 + 1e-6
    left, right = (gnm.uv[gnm.faces_uv[np.isin(gnm.faces[:, 0], ball)]].reshape(-1, 2)[:, 0] for ball in eyeballs(gnm))
    assert left.max() < right.min() or right.max() < left.min()


def test_gnm_finds_its_landmarks_on_the_skin(source, tmp_path):
    path = tmp_path / "head.npz"
    layouts.write_gnm(path, source)
    found = MorphableModel.load(path)
    away = np.linalg.norm(found.mean[found.landmarks] * 100 - source.mean[source.landmarks], axis=1)  # cm
    assert np.median(away) < 0.5 and not np.isin(found.landmarks, np.concatenate(eyeballs(found))).any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"triangle_uvs": np.zeros((3, 3, 2))}, "triangle_uvs has shape"),
        ({"triangles": np.full((4, 3), 10**6)}, "with indices in 0"),
        ({"vertex_groups": np.zeros((2, 2))}, "vertex_groups has shape"),
        ({"expression_basis": np.zeros((2, 7, 3))}, "expression_basis has shape"),
        ({"template_vertex_positions": np.zeros((9, 2))}, "must be"),
    ],
)
def test_bad_gnm_files(source, tmp_path, changes, message):
    layouts.write_gnm(tmp_path / "head.npz", source, changes)
    with pytest.raises(InputError, match=message):
        MorphableModel.load(tmp_path / "head.npz")
