"""The result folder: exact round trip, and damaged folders refused in words."""

from __future__ import annotations

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
import trimesh

from mifit.core.arrays import write_ply
from mifit.core.mesh import interpolate, split_at_seams, tangents, vertex_normals
from mifit.core.photometry import Photometry
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.morphable.topology import scalp_depth
from mifit.output.report import picture_maps
from mifit.output.surface import vertex_materials
from mifit.result import Reconstruction


@pytest.fixture(scope="module")
def saved(ball, tmp_path_factory):
    folder = tmp_path_factory.mktemp("result") / "ball"
    ball.model.save(folder.parent / "ball.npz")
    dataclasses.replace(ball, model_source=str(folder.parent / "ball.npz")).save(folder)
    return folder


def same(a, b):
    """Two records are equal, arrays to the last bit."""
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(x):
            same(x, y)
        elif isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        else:
            assert x == y, field.name


def test_round_trip_is_exact(ball, saved):
    again = Reconstruction.load(saved)
    for name in ("geometry", "reflectance", "normals", "mesh"):
        same(getattr(ball, name), getattr(again, name))
    assert again.model.digest == ball.model.digest
    for key in ("config", "capture_digest", "units", "unit_mm", "seconds", "peak_memory", "warnings"):
        assert getattr(again, key) == getattr(ball, key)
    for a, b in zip(again.cameras, ball.cameras, strict=True):
        same(a, b)


def test_what_images_are_divided_by_round_trips(ball, tmp_path):
    photometry = Photometry({"left": (1.0, 1.0, 1.0), "right": (1.25, 0.9, 1.1)}, {("right", 3): 0.5})
    dataclasses.replace(ball, geometry=dataclasses.replace(ball.geometry, photometry=photometry)).save(tmp_path)
    assert Reconstruction.load(tmp_path, ball.model).geometry.photometry == photometry


def test_confidence_of_the_specular_map_round_trips(ball, tmp_path):
    shares = np.random.default_rng(0).random(ball.reflectance.confidence.shape, np.float32)
    reflectance = dataclasses.replace(ball.reflectance, specular_confidence=shares)
    dataclasses.replace(ball, reflectance=reflectance).save(tmp_path)
    again = Reconstruction.load(tmp_path, ball.model).reflectance
    np.testing.assert_array_equal(again.specular_confidence, shares)
    assert "Confidence of the specular albedo" in picture_maps(dataclasses.replace(ball, reflectance=reflectance), 0)
    assert "Confidence of the specular albedo" not in picture_maps(ball, 0)


def test_folder_holds_the_files_of_the_contract(saved):
    names = {str(p.relative_to(saved)) for p in saved.rglob("*") if p.is_file()}
    assert names >= {
        "result.json",
        "geometry/0000.ply",
        "geometry/0003.ply",
        "maps/diffuse.exr",
        "maps/specular.exr",
        "maps/confidence.exr",
        "maps/normal_object_0000.exr",
        "maps/normal_object_0003.exr",
        "maps/normal_tangent_0003.png",
        "refined/0003.ply",
        "lighting.exr",
    }
    assert not [n for n in names if ".part" in n]


def test_mesh_opens_elsewhere_with_normals_and_texture_coordinates(ball, saved):
    mesh = trimesh.load(saved / "geometry" / "0003.ply", process=False)
    split = split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv)
    np.testing.assert_allclose(mesh.vertices, ball.geometry.vertices[1][split.origin], atol=1e-5)
    assert (mesh.faces == split.faces).all()
    np.testing.assert_array_equal(split.origin[split.faces], ball.model.faces)
    np.testing.assert_allclose(split.uv[split.faces], ball.model.uv[ball.model.faces_uv])
    expected = vertex_normals(ball.geometry.vertices[1], ball.model.faces)[split.origin]
    np.testing.assert_allclose(mesh.vertex_normals, expected, atol=1e-5)


def test_tangent_normals_decode_to_the_object_normals(ball, saved):
    """Decode as a glTF viewer does: interpolated tangent frame times the stored vector."""
    codes = cv2.imread(str(saved / "maps" / "normal_tangent_0000.png"))[..., ::-1]
    stored = codes.astype(np.float64) / 127.5 - 1
    split = split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv)
    i = 0
    vertices = (ball.geometry.vertices[i] @ ball.geometry.rotation[i])[split.origin]
    normals = vertex_normals(ball.geometry.vertices[i], ball.model.faces) @ ball.geometry.rotation[i]
    normals = normals[split.origin]
    tangent, sign = tangents(vertices, normals, split.uv, split.faces)
    np.testing.assert_allclose(np.sum(tangent * normals, 1), 0, atol=1e-5)
    texels = rasterize_uv(ball.model.uv, ball.model.faces_uv, 32, ball.model.face_mask)
    corners = split.faces[texels.face]
    n, t = (np.einsum("nk,nkc->nc", texels.weights, x[corners]) for x in (normals, tangent))
    local = texels.from_map(stored)
    b = sign[corners[:, 0], None] * np.cross(n, t)
    decoded = local[:, :1] * t + local[:, 1:2] * b + local[:, 2:] * n
    decoded /= np.linalg.norm(decoded, axis=1, keepdims=True)
    cosine = np.sum(decoded * texels.from_map(ball.normals.normal_object[0]), axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1.0
    # v grows upwards and the tangent follows u.
    for k in range(3):
        start, end = split.faces[:, k], split.faces[:, (k + 1) % 3]
        du = split.uv[end] - split.uv[start]
        along_u = (np.abs(du[:, 1]) < 1e-6) & ball.model.face_mask
        moving = np.sum((vertices[end] - vertices[start]) * tangent[start], axis=1) * du[:, 0]
        assert (moving[along_u] > 0).all()
        up = (np.abs(du[:, 0]) < 1e-6) & ball.model.face_mask
        bitangent = sign[:, None] * np.cross(normals, tangent)
        moving = np.sum((vertices[end] - vertices[start]) * bitangent[start], axis=1) * du[:, 1]
        assert (moving[up] > 0).all() and (along_u | up).any()


def test_results_from_before_meshes_were_refined_load(saved, tmp_path):
    folder = copy_of(saved, tmp_path)

    def older(document):
        document["stages"].pop("mesh")
        for step in document["timesteps"]:
            step.pop("refined_mesh")

    edit(folder, older)
    assert Reconstruction.load(folder).mesh is None


def test_a_refined_mesh_of_another_model_is_refused(saved, tmp_path):
    folder = copy_of(saved, tmp_path)
    three = np.eye(3, dtype=np.float32)
    write_ply(folder / "refined" / "0000.ply", three, np.array([[0, 1, 2]]), three, three[:, :2], three)
    with pytest.raises(InputError, match=r"refined/0000\.ply: found \d+ vertices, expected \d+"):
        Reconstruction.load(folder)


def test_stage_1_alone_round_trips(stage_1_ball, tmp_path):
    stage_1_ball.save(tmp_path)
    again = Reconstruction.load(tmp_path, stage_1_ball.model)
    assert again.reflectance is None and again.normals is None and again.mesh is None and again.methods == ("pca",)
    same(again.geometry, stage_1_ball.geometry)


def test_saving_again_leaves_nothing_stale(ball, stage_1_ball, tmp_path):
    ball.save(tmp_path)
    stage_1_ball.save(tmp_path)
    assert (
        not list(tmp_path.glob("maps/*"))
        and not list(tmp_path.glob("refined/*"))
        and not (tmp_path / "lighting.exr").exists()
    )


def copy_of(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "copy")


def edit(folder, change):
    path = folder / "result.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format_version=99), "found format_version 99, this mifit reads 1"),
        (lambda d: d.pop("lighting"), "key 'lighting' is missing"),
        (lambda d: d["timesteps"][0]["rotation"].pop(), "wrong kind"),
        (lambda d: d["model"]["identity"].append(1.0), "identity: found shape"),
        (lambda d: d["model"].update(digest="x"), "fit again, or bring the model back"),
        (lambda d: d["model"].update(source=""), "doesn't say which file holds its model"),
        (lambda d: d["lighting"]["radiance"][0].__setitem__(0, None), "radiance"),
    ],
)
def test_bad_document_is_named(saved, tmp_path, change, message):
    folder = copy_of(saved, tmp_path)
    edit(folder, change)
    with pytest.raises(InputError, match=message) as error:
        Reconstruction.load(folder)
    assert "result.json" in str(error.value)


@pytest.mark.parametrize("name", ["maps/diffuse.exr", "geometry/0003.ply", "maps/normal_object_0000.exr"])
@pytest.mark.parametrize("damage", ["missing", "truncated"])
def test_damaged_file_is_named(saved, tmp_path, name, damage):
    folder = copy_of(saved, tmp_path)
    if damage == "missing":
        (folder / name).unlink()
    else:
        (folder / name).write_bytes((folder / name).read_bytes()[:300])
    with pytest.raises(InputError, match=name.rsplit("/", 1)[1]):
        Reconstruction.load(folder)


def test_folders_that_are_no_results(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        Reconstruction.load(tmp_path / "nothing")
    with pytest.raises(InputError, match="no result or an unfinished one"):
        Reconstruction.load(tmp_path)
    (tmp_path / "result.json").write_text("{")
    with pytest.raises(InputError, match="not readable as JSON"):
        Reconstruction.load(tmp_path)


def test_hair_round_trips_and_goes_on_where_there_are_no_maps(ball, tmp_path):
    """Its colour covers the scalp beyond the face area; elsewhere the head stays as it is without."""
    model, wanted = ball.model, {17: (-0.4, 0.3, 0.9), 26: (0.4, 0.3, 0.9), 33: (0.0, -0.2, 1.0)}
    wanted |= {k: wanted[17] for k in range(18, 26)} | {0: (-1.0, 0.1, 0.2), 16: (1.0, 0.1, 0.2)}
    landmarks = model.landmarks.copy()
    unit = model.mean / np.linalg.norm(model.mean, axis=1, keepdims=True)
    landmarks[list(wanted)] = [np.argmax(unit @ direction) for direction in wanted.values()]
    marked = dataclasses.replace(model, landmarks=landmarks)
    size, hair = len(ball.reflectance.diffuse), (0.04, 0.03, 0.02)
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    depth = np.minimum(*scalp_depth(marked.mean, marked.landmarks))[:, None]
    scalp = interpolate(depth, model.faces, texels.face, texels.weights) > -0.3
    diffuse = texels.to_map(np.where(scalp, np.float32(hair), texels.from_map(ball.reflectance.diffuse)))
    reflectance = dataclasses.replace(ball.reflectance, diffuse=diffuse, hair=hair)
    haired = dataclasses.replace(ball, model=marked, reflectance=reflectance)
    haired.save(tmp_path / "result")
    again = Reconstruction.load(tmp_path / "result", marked)
    assert again.reflectance.hair == reflectance.hair
    bald = dataclasses.replace(haired, reflectance=dataclasses.replace(reflectance, hair=None))
    before, after = (vertex_materials(result)[:, :3] for result in (bald, again))
    back = unit @ (0.0, 0.7, -0.7) > 0.8
    assert before[back].mean() > 0.1 and np.abs(after[back] - hair).max() < 1e-6
    face = np.unique(model.faces[model.face_mask])
    np.testing.assert_allclose(after[face], before[face], atol=1e-6)
