"""Universal Scene Description of a reconstruction: one ``.usdz`` with mesh, maps and cameras. It needs usd-core."""

from __future__ import annotations

import math
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.files import replacing, write_bytes
from mifit.core.image import encode_png, to_8_bit
from mifit.core.mesh import SplitMesh
from mifit.errors import InputError
from mifit.output.surface import shape_of, surface_maps, vertex_materials
from mifit.result import Reconstruction

APERTURE = 36.0
"""Width of a sensor in USD's unit of focal lengths."""


def write_usdz(result: Reconstruction, path: str | Path, timestep: int) -> None:
    """Write one timestep as a ``.usdz`` file, whole or not at all.

    The head is in metres, in world space with y up. The skin is a ``UsdPreviewSurface`` in its specular workflow:
    albedo in sRGB, reflectance along the normal and tangent-space normals as they are, GGX roughness as in
    `gltf.write_glb`. Faces without maps have vertex colours. The fitted cameras stand beside it. InputError without
    usd-core.
    """
    try:
        from pxr import Usd, UsdGeom, UsdUtils
    except ImportError:
        raise InputError('format usd needs usd-core; install it with: pip install "mifit[usd]"') from None
    metre, stem = result.unit_mm / 1000.0, re.sub(r"\W|^(?=\d)", "_", Path(path).stem)
    shape, maps = shape_of(result, timestep), surface_maps(result, timestep, skin=True)
    reflectance = result.lobe.factor() * maps.specular
    peak = max(float(reflectance.max()), 1e-6)
    images = {
        "albedo": to_8_bit(maps.diffuse),
        "reflectance": np.repeat(np.round(255 * reflectance / peak).astype(np.uint8)[..., None], 3, axis=2),
        "normal": np.round(127.5 * (shape.tangent_map(maps.normal) + 1)).astype(np.uint8),
    }
    colours = vertex_materials(result, skin=True)[:, :3]
    with tempfile.TemporaryDirectory() as folder:
        for name, codes in images.items():
            write_bytes(Path(folder) / f"{name}.png", encode_png(codes))
        stage = Usd.Stage.CreateNew(str(Path(folder) / "head.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, f"/{stem}")
        stage.SetDefaultPrim(root.GetPrim())
        for name, part in shape.parts().items():
            mesh = _mesh(stage, f"/{stem}/{name}", part, metre * shape.vertices, shape.normals, colours)
            _material(stage, f"/{stem}/{name}_material", mesh, name == "face", peak, math.sqrt(result.lobe.roughness))
        for camera in result.cameras:
            _camera(stage, f"/{stem}/camera_" + re.sub(r"\W", "_", camera.name), camera, metre)
        stage.GetRootLayer().Save()
        with replacing(path) as temporary:
            if not UsdUtils.CreateNewUsdzPackage(str(Path(folder) / "head.usdc"), str(temporary)):
                raise InputError(f"{path}: usd-core could not write the package")


def _mesh(stage: Any, path: str, part: SplitMesh, points: NDArray, normals: NDArray, colours: NDArray) -> Any:
    from pxr import Sdf, UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points[part.origin].astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(part.faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(part.faces.astype(np.int32).ravel()))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals[part.origin].astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    values = UsdGeom.PrimvarsAPI(mesh)
    uv = values.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    uv.Set(Vt.Vec2fArray.FromNumpy(part.uv.astype(np.float32)))
    mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(
        Vt.Vec3fArray.FromNumpy(colours[part.origin].astype(np.float32))
    )
    return mesh


def _material(stage: Any, path: str, mesh: Any, mapped: bool, peak: float, roughness: float) -> None:
    """The skin's material with its maps, or a plain one of vertex colours."""
    from pxr import Sdf, UsdShade

    kinds, material = Sdf.ValueTypeNames, UsdShade.Material.Define(stage, path)

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Any:
        made = UsdShade.Shader.Define(stage, f"{path}/{name}")
        made.CreateIdAttr(kind)
        for key, (of, value) in inputs.items():
            made.CreateInput(key, of).Set(value)
        return made.ConnectableAPI()

    surface = shader("surface", "UsdPreviewSurface", useSpecularWorkflow=(kinds.Int, 1))
    material.CreateSurfaceOutput().ConnectToSource(surface, "surface")
    surface.CreateInput("roughness", kinds.Float).Set(roughness if mapped else 1.0)
    name, of = ("st", kinds.Float2) if mapped else ("displayColor", kinds.Float3)
    reader = shader("reader", f"UsdPrimvarReader_float{2 if mapped else 3}", varname=(kinds.String, name))
    reader.CreateOutput("result", of)
    if not mapped:
        surface.CreateInput("specularColor", kinds.Color3f).Set((0.0, 0.0, 0.0))
        surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(reader, "result")
    for image, target, space, scale, bias in (
        ("albedo", "diffuseColor", "sRGB", 1.0, 0.0),
        ("reflectance", "specularColor", "raw", peak, 0.0),
        ("normal", "normal", "raw", 2.0, -1.0),
    ):
        if mapped:
            levels = {"scale": (kinds.Float4, (scale,) * 3 + (1.0,)), "bias": (kinds.Float4, (bias,) * 3 + (0.0,))}
            file = {"file": (kinds.Asset, Sdf.AssetPath(f"./{image}.png")), "sourceColorSpace": (kinds.Token, space)}
            texture = shader(image, "UsdUVTexture", **file, **levels)
            texture.CreateInput("st", kinds.Float2).ConnectToSource(reader, "result")
            texture.CreateOutput("rgb", kinds.Float3)
            kind = kinds.Normal3f if target == "normal" else kinds.Color3f
            surface.CreateInput(target, kind).ConnectToSource(texture, "rgb")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _camera(stage: Any, path: str, camera: Camera, metre: float) -> None:
    from pxr import Gf, UsdGeom

    pose = camera.camera_to_world_opengl.copy()
    pose[:3, 3] *= metre
    made, pixel = UsdGeom.Camera.Define(stage, path), APERTURE / camera.width
    made.AddTransformOp().Set(Gf.Matrix4d(pose.T.tolist()))
    made.CreateFocalLengthAttr(camera.fx * pixel)
    made.CreateHorizontalApertureAttr(APERTURE)
    made.CreateVerticalApertureAttr(camera.height * pixel * camera.fx / camera.fy)
    made.CreateHorizontalApertureOffsetAttr((0.5 * camera.width - camera.cx) * pixel)
    made.CreateVerticalApertureOffsetAttr((camera.cy - 0.5 * camera.height) * pixel * camera.fx / camera.fy)
