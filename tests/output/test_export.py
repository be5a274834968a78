"""Files for other programs, read back by trimesh and by hand."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from mifit.core.image import read_image, srgb_to_linear
from mifit.core.mesh import part_of, split_at_seams, vertex_normals
from mifit.errors import InputError
from mifit.output.export import SUFFIXES, export


def read_glb(path):
    """JSON document and accessor reader of a binary glTF, after checks of its container."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert magic == b"glTF" and version == 2 and length == len(data)
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and binary_size % 4 == 0
    binary = data[28 + size :]
    assert len(binary) == binary_size >= document["buffers"][0]["byteLength"]

    def read(index):
        a = document["accessors"][index]
        if "sparse" in a:
            rows, values = a["sparse"]["indices"], a["sparse"]["values"]
            count, out = a["sparse"]["count"], np.zeros((a["count"], 3), np.float32)
            views = [document["bufferViews"][part["bufferView"]] for part in (rows, values)]
            kind = {5123: "<u2", 5125: "<u4"}[rows["componentType"]]
            index = np.frombuffer(binary, kind, count, views[0]["byteOffset"])
            assert (np.diff(index.astype(int)) > 0).all()
            assert a["componentType"] == 5122 and a["normalized"]
            out[index] = np.frombuffer(binary, "<i2", 3 * count, views[1]["byteOffset"]).reshape(-1, 3)
            assert out.min(0).tolist() == a["min"] and out.max(0).tolist() == a["max"]
            return out / 32767
        view = document["bufferViews"][a["bufferView"]]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[a["componentType"]]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[a["type"]]
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(binary, kind, a["count"] * width, view["byteOffset"]).reshape(-1, width)
        assert values.nbytes == view["byteLength"]
        if "min" in a:
            assert values.min(0).tolist() == a["min"] and values.max(0).tolist() == a["max"]
        return values

    return document, read, binary


@pytest.fixture(scope="module")
def glb(ball, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "ball.glb"
    export(ball, "glb", path, timestep=3)
    return path


def test_gltf_weights_and_targets_give_the_fitted_shape(ball, glb):
    document, read, _ = read_glb(glb)
    mesh = document["meshes"][0]
    assert mesh["extras"]["targetNames"] == ["jawOpen"] and mesh["weights"] == [0.7]
    pose = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    split = split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv)
    for primitive, selected in zip(mesh["primitives"], (ball.model.face_mask, ~ball.model.face_mask), strict=True):
        part = part_of(split, selected)
        base, target = read(primitive["attributes"]["POSITION"]), read(primitive["targets"][0]["POSITION"])
        assert np.abs(target).max() > 0
        world = (base + 0.7 * target) @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(world, ball.geometry.vertices[1][part.origin] / 100, atol=1e-6)
        np.testing.assert_array_equal(read(primitive["indices"]).reshape(-1, 3), part.faces)
        normal = read(primitive["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
        expected = vertex_normals(ball.geometry.vertices[1], ball.model.faces)[part.origin]
        np.testing.assert_allclose(normal @ pose[:3, :3].T, expected, atol=1e-5)


def test_gltf_material_holds_the_maps(ball, glb):
    document, read, binary = read_glb(glb)
    skin = document["materials"][0]
    alpha = math.sqrt(2 / (12.0 + 2))
    assert skin["pbrMetallicRoughness"]["roughnessFactor"] ** 2 == pytest.approx(alpha)
    specular = skin["extensions"]["KHR_materials_specular"]
    assert specular["specularFactor"] == pytest.approx(0.15, rel=1e-5)
    assert specular["specularColorFactor"] == pytest.approx([25] * 3)
    for image, texture in zip(document["images"], document["textures"], strict=True):
        view = document["bufferViews"][image["bufferView"]]
        data = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (32, 32, 4 if image["name"] == "specular" else 3)
        assert texture["sampler"] == 0
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    uv = read(attributes["TEXCOORD_0"])
    part = part_of(split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv), ball.model.face_mask)
    np.testing.assert_allclose(uv, part.uv * (1, -1) + (0, 1), atol=1e-6)
    tangent = read(attributes["TANGENT"])
    assert set(np.unique(tangent[:, 3])) <= {-1.0, 1.0}
    np.testing.assert_allclose(np.linalg.norm(tangent[:, :3], axis=1), 1, atol=1e-5)


def test_gltf_takes_the_fresnel_rise_over(ball, tmp_path):
    """Schlick's form in both: C_s along the normal, C_s (1 + fresnel) at grazing angles."""
    reflectance = replace(ball.reflectance, lobe=replace(ball.lobe, fresnel=4.0))
    export(replace(ball, reflectance=reflectance), "glb", tmp_path / "a.glb")
    specular = read_glb(tmp_path / "a.glb")[0]["materials"][0]["extensions"]["KHR_materials_specular"]
    assert specular["specularFactor"] == pytest.approx(0.15 * 5)
    assert specular["specularFactor"] * 0.04 * specular["specularColorFactor"][0] == pytest.approx(0.15)


def test_gltf_names_the_extensions_it_uses(glb):
    document = read_glb(glb)[0]
    assert document["extensionsUsed"] == ["KHR_materials_specular", "KHR_mesh_quantization"]
    assert document["extensionsRequired"] == ["KHR_mesh_quantization"]
    assert [material["name"] for material in document["materials"]] == ["skin", "rest"]


def test_gltf_holds_the_cameras_and_opens_in_trimesh(ball, glb):
    document, _, _ = read_glb(glb)
    assert [c["name"] for c in document["cameras"]] == ["left", "right"]
    node = next(n for n in document["nodes"] if n["name"] == "right")
    pose = np.array(node["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(pose[:3, 3] * 100, ball.camera("right").position, atol=1e-6)
    # The camera looks down -z at the head, which is at the origin.
    assert pose[:3, 2] @ pose[:3, 3] > 0.99 * np.linalg.norm(pose[:3, 3])
    scene = trimesh.load(glb)
    assert sum(len(g.faces) for g in scene.geometry.values()) == len(ball.model.faces)


def test_obj_opens_in_trimesh_with_its_maps(ball, tmp_path):
    export(ball, "obj", tmp_path / "ball.obj", timestep=0)
    assert {p.name for p in tmp_path.iterdir()} == {
        "ball.obj",
        "ball.mtl",
        "ball_diffuse.png",
        "ball_specular.png",
        "ball_normal.png",
        "ball_normal.exr",
    }
    scene = trimesh.load(tmp_path / "ball.obj", process=False)
    meshes = list(scene.geometry.values())
    assert sum(len(m.faces) for m in meshes) == len(ball.model.faces)
    skin = max(meshes, key=lambda m: m.triangles_center[:, 2].mean())
    assert len(skin.faces) == ball.model.face_mask.sum()
    found = np.sort(skin.triangles_center, axis=0)
    expected = ball.geometry.vertices[0][ball.model.faces[ball.model.face_mask]].mean(1)
    np.testing.assert_allclose(found, np.sort(expected, axis=0), atol=1e-4)


def test_ply_export(ball, tmp_path):
    export(ball, "ply", tmp_path / "new" / "ball.ply")
    assert len(trimesh.load(tmp_path / "new" / "ball.ply", process=False).faces) == len(ball.model.faces)


@pytest.mark.parametrize("format", ["glb", "obj", "ply", "mitsuba"])
def test_the_refined_mesh_exports(ball, tmp_path, format):
    path = tmp_path / f"fine{SUFFIXES[format]}"
    export(ball, format, path, timestep=3, mesh="refined")
    if format == "mitsuba":
        parts = [trimesh.load(tmp_path / "fine_files" / f"{name}.ply", process=False) for name in ("face", "rest")]
    else:
        loaded = trimesh.load(path, process=False)
        parts = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    assert sum(len(part.faces) for part in parts) == len(ball.model.faces)
    area = np.sort(np.concatenate([part.area_faces for part in parts]))
    expected = trimesh.Trimesh(ball.mesh.vertices[1], ball.model.faces, process=False).area_faces
    if format == "glb":  # metres, and the fitted expression is a weight: trimesh shows the base shape
        assert len(area) == len(expected)
    else:
        np.testing.assert_allclose(area, np.sort(expected), rtol=1e-3, atol=1e-5)


def test_the_refined_glb_has_the_refined_shape(ball, tmp_path):
    export(ball, "glb", tmp_path / "a.glb", timestep=3, mesh="refined")
    document, read, _ = read_glb(tmp_path / "a.glb")
    pose = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    primitive = document["meshes"][0]["primitives"][0]
    base, target = read(primitive["attributes"]["POSITION"]), read(primitive["targets"][0]["POSITION"])
    world = (base + 0.7 * target) @ pose[:3, :3].T + pose[:3, 3]
    part = part_of(split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv), ball.model.face_mask)
    np.testing.assert_allclose(world, ball.mesh.vertices[1][part.origin] / 100, atol=1e-6)


def test_a_result_without_a_refined_mesh_says_so(stage_1_ball, tmp_path):
    with pytest.raises(InputError, match="this result has no refined mesh; fit with --until normals"):
        export(stage_1_ball, "ply", tmp_path / "x.ply", mesh="refined")
    assert not list(tmp_path.iterdir())


def test_stage_1_exports_too(stage_1_ball, tmp_path):
    export(stage_1_ball, "glb", tmp_path / "a.glb")
    document, _, _ = read_glb(tmp_path / "a.glb")
    assert document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] == 0


def test_bad_requests_are_named(ball, tmp_path):
    with pytest.raises(InputError, match=r"expected '\.glb' for format glb"):
        export(ball, "glb", tmp_path / "x.obj")
    with pytest.raises(InputError, match="expected one of glb, obj, ply, usd, mitsuba"):
        export(ball, "fbx", tmp_path / "x.fbx")
    with pytest.raises(InputError, match="timestep 5 is not in this result"):
        export(ball, "ply", tmp_path / "x.ply", timestep=5)


def test_gltf_has_arkits_names_and_weights_and_leaves_out_what_stays_still(ball, tmp_path):
    moved = np.zeros((*ball.model.mean.shape, 2), np.float32)
    moved[:40, 1, 0] = np.linspace(0, 0.5, 40)  # centimetres at a third of the way
    model = replace(
        ball.model,
        expression=moved,
        expression_names=("smile_L", "browInnerUp_R"),
        expression_bounds=np.array([[0, 10 / 3], [0, 10 / 3]]),
    )
    geometry = replace(ball.geometry, expression=np.array([[1.0, 0.0], [10 / 3, 0.5]]))
    result = replace(ball, model=model, geometry=geometry, normals=None, mesh=None)
    export(result, "glb", tmp_path / "anna.glb", timestep=3)
    document, read, _ = read_glb(tmp_path / "anna.glb")
    mesh = document["meshes"][0]
    assert mesh["name"] == document["nodes"][0]["name"] == "anna"
    assert mesh["extras"]["targetNames"] == ["mouthSmileLeft", "browInnerUpRight"]
    np.testing.assert_allclose(mesh["weights"], [1.0, 0.15])
    split = split_at_seams(model.faces, model.faces_uv, model.uv)
    for primitive, selected in zip(mesh["primitives"], (model.face_mask, ~model.face_mask), strict=True):
        origin = part_of(split, selected).origin
        found = read(primitive["targets"][0]["POSITION"])
        expected = moved[origin, :, 0] * 1.02 / 100 * 10 / 3
        np.testing.assert_allclose(found, expected, atol=1e-4)
        stored = document["accessors"][primitive["targets"][0]["POSITION"]]["sparse"]["count"]
        assert stored == max((np.abs(expected[:, 1]) > 1e-4).sum(), 1)


@pytest.mark.parametrize("format", ["obj", "ply"])
def test_units_of_length_scale_the_mesh(ball, tmp_path, format):
    sizes = {}
    for units in (None, "m", "mm"):
        path = tmp_path / f"{units}{SUFFIXES[format]}"
        export(ball, format, path, units=units)
        sizes[units] = np.ptp(trimesh.load(path, process=False, force="mesh").vertices, axis=0)
    np.testing.assert_allclose(sizes["m"] * 100, sizes[None], rtol=1e-4)
    np.testing.assert_allclose(sizes["mm"] / 10, sizes[None], rtol=1e-4)
    with pytest.raises(InputError, match="units: found 'mm' for glb, expected m, dm, cm or mm for obj or ply"):
        export(ball, "glb", tmp_path / "a.glb", units="mm")


def test_obj_has_gltfs_roughness_and_links_its_normal_map(ball, glb, tmp_path):
    export(ball, "obj", tmp_path / "a.obj")
    skin = (tmp_path / "a.mtl").read_text().split("newmtl")[1]
    roughness = read_glb(glb)[0]["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"]
    assert float(skin.split("Pr ")[1].split()[0]) == pytest.approx(roughness, abs=1e-4)
    assert "Ks 0.08 0.08 0.08" in skin and "norm a_normal.png" in skin and "map_Bump -bm 1.0 a_normal.exr" in skin
    shown = srgb_to_linear(cv2.imread(str(tmp_path / "a_specular.png"), cv2.IMREAD_UNCHANGED).max() / 255) * 0.08
    assert shown == pytest.approx(min(ball.lobe.factor() * 0.15, 0.08), abs=1e-3)
    codes = read_image(tmp_path / "a_normal.exr")
    with_png = cv2.imread(str(tmp_path / "a_normal.png"))[..., ::-1] / 255.0
    np.testing.assert_allclose(codes, with_png, atol=0.003)


def test_usd_opens_again_with_the_fitted_shape_and_its_maps(ball, tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdShade

    path = tmp_path / "3 ball.usdz"
    export(ball, "usd", path, timestep=3)
    stage = usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == "Y"
    root = stage.GetDefaultPrim()
    assert root.GetName() == "_3_ball"
    split = split_at_seams(ball.model.faces, ball.model.faces_uv, ball.model.uv)
    for name, selected in (("face", ball.model.face_mask), ("rest", ~ball.model.face_mask)):
        part, mesh = part_of(split, selected), UsdGeom.Mesh(root.GetChild(name))
        points = np.asarray(mesh.GetPointsAttr().Get())
        np.testing.assert_allclose(points, ball.geometry.vertices[1][part.origin] / 100, atol=1e-6)
        np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), part.faces)
        material = UsdShade.MaterialBindingAPI(mesh.GetPrim()).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource()[0]
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        source = surface.GetInput("diffuseColor").GetConnectedSource()[0].GetPrim()
        if name == "face":
            image = UsdShade.Shader(source).GetInput("file").Get()
            assert image.path.endswith("albedo.png") and image.resolvedPath  # inside the package
            assert surface.GetInput("roughness").Get() ** 2 == pytest.approx(math.sqrt(2 / 14.0))
    camera, own = UsdGeom.Camera(root.GetChild(f"camera_{ball.cameras[0].name}")), ball.cameras[0]
    frustum = camera.GetCamera().frustum
    point = ball.geometry.vertices[1][:50]
    view = np.c_[point / 100, np.ones(len(point))] @ np.asarray(frustum.ComputeViewMatrix())
    seen = view @ np.asarray(frustum.ComputeProjectionMatrix())
    pixel = (seen[:, :2] / seen[:, 3:] * (1, -1) + 1) / 2 * (own.width, own.height)
    np.testing.assert_allclose(pixel, own.project(point)[..., :2], atol=0.01)
