"""A reconstruction as a Mitsuba scene file, for mifit's plugins and for plain Mitsuba.

The path integrator of ``mifit render`` reads the same file that a user gets, so the two can't differ.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.files import write_text
from mifit.core.image import write_image
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.output.deferred import visible_surface
from mifit.output.ply import write_ply
from mifit.output.surface import SplitMesh, part_of, split_at_seams, surface_maps

if TYPE_CHECKING:
    from mifit.output.reconstruction import Method, Reconstruction

STEEPEST = 4.0
"""Largest slope of a normal correction: 76 degrees."""

MITSUBA_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""OpenCV's camera axes (x right, y down) to Mitsuba's (x left, y up); both look along +z."""


def write_scene(
    reconstruction: Reconstruction,
    path: str | Path,
    timestep: int,
    cameras: Sequence[Camera] | None = None,
    method: Method = "full",
) -> None:
    """Write ``NAME.xml`` with mifit's plugins, ``NAME_stock.xml`` for plain Mitsuba, and their files.

    Both read meshes and maps from the folder ``NAME_files`` beside them. The face area has the maps; other faces
    have the fitted model's vertex albedo. In ``NAME.xml`` the skin is ``blinnphong`` with the fitted lobe's rise
    and the refined normals as slopes, and the light is ``shenv``. In ``NAME_stock.xml`` the skin blends ``diffuse``
    with a ``roughconductor`` of Beckmann roughness sqrt(2 / (m + 2)), which doesn't rise, under a ``normalmap``,
    and the light is a lat-long ``envmap``. A relit reconstruction has its environment as ``envmap`` in both. A
    compact light is a stock ``directional`` emitter in both. The ambient term stands for light that local shading
    leaves out, such as interreflection, so a path-traced scene doesn't have it.

    Parameters
    ----------
    reconstruction : Reconstruction
    path : path
        ``.xml`` file.
    timestep : int
    cameras : sequence of Camera, optional
        Sensors in this order; default: the fitted cameras.
    method : {"full", "diffuse", "pca"}
        What to leave out, see `Reconstruction.render`.
    """
    path = Path(path)
    cameras = reconstruction.cameras if cameras is None else cameras
    files = path.with_name(f"{path.stem}_files")
    _write_files(reconstruction, files, timestep, method)
    has_rest = not reconstruction.model.face_mask.all()
    for stock in (False, True):
        name = path if not stock else path.with_name(f"{path.stem}_stock.xml")
        text = _scene(reconstruction, files.name, cameras, method, has_rest, stock)
        write_text(name, text)


def render_path(
    reconstruction: Reconstruction, camera: Camera, timestep: int, method: Method, samples: int, seed: int
) -> NDArray[np.float32]:
    """Path trace one view through the scene file; see `Reconstruction.render`."""
    from mifit.render.scene_image import render_scene

    with tempfile.TemporaryDirectory(prefix="mifit-scene-") as folder:
        path = Path(folder) / "scene.xml"
        write_scene(reconstruction, path, timestep, [camera], method)
        image = render_scene(path, {}, spp=samples, seed=seed)
    # Mitsuba's film adds up light on black; colours here are those of the covered part. Its alpha also counts
    # the inside of the head, seen through the eye openings, so coverage is that of local rendering.
    hit = image[..., 3:]
    surface = visible_surface(reconstruction, camera, timestep)
    alpha = surface.image(np.zeros((len(surface.index), 3)))[..., 3:]
    colour = np.where(alpha > 0, image[..., :3] / np.maximum(hit, 1e-3), 0.0)
    return np.concatenate([colour, alpha], axis=-1).astype(np.float32)


def _write_files(reconstruction: Reconstruction, files: Path, timestep: int, method: Method) -> None:
    model, geometry = reconstruction.model, reconstruction.geometry
    if method == "pca":
        reconstruction = replace(reconstruction, reflectance=None, normals=None)
    vertices = geometry.vertices[reconstruction.index(timestep)]
    normals = vertex_normals(vertices, model.faces)
    mesh = split_at_seams(model)
    files.mkdir(parents=True, exist_ok=True)
    for name, selected in (("face", model.face_mask), ("rest", ~model.face_mask)):
        if selected.any():
            part = part_of(mesh, selected)
            write_ply(
                files / f"{name}.ply",
                vertices[part.origin],
                part.faces,
                normals[part.origin],
                part.uv,
                np.clip(geometry.vertex_albedo[part.origin], 0, 1),
                viewer_colours=False,
            )
    maps = surface_maps(reconstruction, timestep)
    specular = maps.specular if method == "full" else np.zeros_like(maps.specular)
    slopes = _slopes(reconstruction, timestep, maps.normal, vertices, normals, mesh)
    bent = normalize(np.concatenate([slopes[..., :2], np.ones_like(slopes[..., :1])], axis=-1))
    write_image(files / "diffuse.exr", np.clip(maps.diffuse, 0, 1))
    write_image(files / "specular.exr", np.clip(specular, 0, 1))
    write_image(files / "slopes.exr", slopes)
    write_image(files / "normal.exr", 0.5 * bent + 0.5)
    # A blend (1 - w) diffuse + w mirror with w = C_s wants its diffuse part to make up for the factor.
    base = maps.diffuse / np.maximum(1 - specular[..., None], 1e-3)
    write_image(files / "diffuse_stock.exr", np.clip(base, 0, 1))
    environment = reconstruction.environment
    if environment is None:
        environment = np.maximum(_without_key(reconstruction).lighting.to_latlong(128, 256), 0.0)
    write_image(files / "environment.exr", environment)


def _slopes(
    reconstruction: Reconstruction,
    timestep: int,
    normal_object: NDArray,
    vertices: NDArray,
    normals: NDArray,
    mesh: SplitMesh,
) -> NDArray[np.float32]:
    """(S, S, 3) refined normals as slopes along Mitsuba's shading frame; the third channel is 0.

    That frame has s along dp/du of the triangle, made perpendicular to the interpolated normal n, and t = n x s.
    """
    model = reconstruction.model
    size = normal_object.shape[0]
    rotation = reconstruction.geometry.rotation[reconstruction.index(timestep)]
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    n = normalize(interpolate(normals, model.faces, texels.face, texels.weights))
    p, t = vertices[model.faces].astype(np.float64), model.uv[model.faces_uv].astype(np.float64)
    d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = d1[:, :1] * d2[:, 1:] - d1[:, 1:] * d2[:, :1]
    along_u = (d2[:, 1:] * (p[:, 1] - p[:, 0]) - d1[:, 1:] * (p[:, 2] - p[:, 0])) * np.sign(area)
    u = along_u[texels.face]
    s = normalize(u - np.sum(u * n, axis=1, keepdims=True) * n)
    bent = normalize(texels.from_map(normal_object) @ rotation.T)
    height = np.maximum(np.sum(bent * n, axis=1), 1e-3)
    pair = np.stack([np.sum(bent * s, axis=1), np.sum(bent * np.cross(n, s), axis=1)], axis=1) / height[:, None]
    pair *= np.minimum(1.0, STEEPEST / np.maximum(np.linalg.norm(pair, axis=1, keepdims=True), 1e-9))
    flat = np.zeros((size, size, 3), dtype=np.float32)
    flat[..., :2] = texels.to_map(pair.astype(np.float32))
    return flat


def _scene(
    reconstruction: Reconstruction,
    files: str,
    cameras: Sequence[Camera],
    method: Method,
    has_rest: bool,
    stock: bool,
) -> str:
    needs = "Plain Mitsuba renders this." if stock else "Needs mifit.register_plugins()."
    parts = [
        '<scene version="3.0.0">',
        f"    <!-- Written by mifit. {needs} -->",
        '    <default name="spp" value="64"/>',
        '    <default name="max_depth" value="5"/>',
        '    <integrator type="path">',
        '        <integer name="max_depth" value="$max_depth"/>',
        '        <boolean name="hide_emitters" value="true"/>',
        "    </integrator>",
        *[_sensor(camera) for camera in cameras],
        _skin(reconstruction, files, stock),
        _shape("face", files, '<ref id="skin"/>'),
    ]
    if has_rest:
        rest = (
            '<bsdf type="diffuse"><texture name="reflectance" type="mesh_attribute">'
            '<string name="name" value="vertex_color"/></texture></bsdf>'
        )
        parts.append(_shape("rest", files, rest))
    parts.append(_light(reconstruction, files, method, stock))
    return "\n".join([*parts, "</scene>", ""])


def _sensor(camera: Camera) -> str:
    if any(camera.distortion) or abs(camera.fx / camera.fy - 1) > 1e-3:
        raise InputError(
            f"camera {camera.name}: found lens distortion or focal lengths {camera.fx:g} and {camera.fy:g}; "
            "a Mitsuba sensor wants an undistorted camera with square pixels"
        )
    matrix = np.linalg.inv(camera.world_to_camera) @ MITSUBA_AXES
    fov = math.degrees(2 * math.atan(0.5 * camera.width / camera.fx))
    return f"""    <sensor type="perspective" id={quoteattr(camera.name)}>
        <string name="fov_axis" value="x"/>
        <float name="fov" value="{fov:.9g}"/>
        <float name="principal_point_offset_x" value="{camera.cx / camera.width - 0.5:.9g}"/>
        <float name="principal_point_offset_y" value="{camera.cy / camera.height - 0.5:.9g}"/>
        <float name="near_clip" value="0.01"/>
        <float name="far_clip" value="10000"/>
        <transform name="to_world"><matrix value="{" ".join(f"{x:.9g}" for x in matrix.ravel())}"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="{camera.width}"/>
            <integer name="height" value="{camera.height}"/>
            <string name="pixel_format" value="rgba"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>"""


def _texture(name: str, file: str, raw: bool = True) -> str:
    return (
        f'<texture name="{name}" type="bitmap"><string name="filename" value={quoteattr(file)}/>'
        f'<boolean name="raw" value="{str(raw).lower()}"/><string name="wrap_mode" value="clamp"/></texture>'
    )


def _skin(reconstruction: Reconstruction, files: str, stock: bool) -> str:
    reflectance = reconstruction.reflectance
    exponent = reflectance.exponent if reflectance else 1.0
    if stock:
        alpha = math.sqrt(2.0 / (exponent + 2.0))
        return f"""    <bsdf type="normalmap" id="skin">
        {_texture("normalmap", f"{files}/normal.exr")}
        <bsdf type="blendbsdf">
            {_texture("weight", f"{files}/specular.exr")}
            <bsdf type="diffuse">{_texture("reflectance", f"{files}/diffuse_stock.exr", False)}</bsdf>
            <bsdf type="roughconductor">
                <string name="material" value="none"/>
                <string name="distribution" value="beckmann"/>
                <float name="alpha" value="{alpha:.9g}"/>
            </bsdf>
        </bsdf>
    </bsdf>"""
    normalized = reflectance is None or reflectance.shading_model != "paper"
    risen = reflectance is not None and reflectance.fresnel is not None
    rise = f'\n        <float name="fresnel" value="{reflectance.fresnel:.9g}"/>' if risen else ""
    return f"""    <bsdf type="blinnphong" id="skin">
        {_texture("diffuse_reflectance", f"{files}/diffuse.exr", False)}
        {_texture("specular_reflectance", f"{files}/specular.exr")}
        {_texture("normal_correction", f"{files}/slopes.exr")}
        <float name="exponent" value="{exponent:.9g}"/>{rise}
        <boolean name="normalized" value="{str(normalized).lower()}"/>
    </bsdf>"""


def _shape(name: str, files: str, bsdf: str) -> str:
    return f"""    <shape type="ply" id="{name}">
        <string name="filename" value={quoteattr(f"{files}/{name}.ply")}/>
        <boolean name="flip_tex_coords" value="true"/>
        {bsdf}
    </shape>"""


def _light(reconstruction: Reconstruction, files: str, method: Method, stock: bool) -> str:
    if stock or reconstruction.environment is not None:
        file = quoteattr(f"{files}/environment.exr")
        return f'    <emitter type="envmap"><string name="filename" value={file}/></emitter>' + _key(reconstruction)
    if method == "pca":
        reconstruction = replace(reconstruction, reflectance=None, normals=None)
    rows = ",  ".join(" ".join(f"{x:.9g}" for x in row) for row in _without_key(reconstruction).lighting.coefficients)
    return f'    <emitter type="shenv"><string name="coefficients" value="{rows}"/></emitter>' + _key(reconstruction)


def _key(reconstruction: Reconstruction) -> str:
    """The compact light as a stock emitter, where there is one; a point at infinity, whatever its radius."""
    key = None if reconstruction.reflectance is None else reconstruction.reflectance.key
    if key is None:
        return ""
    along, power = (", ".join(f"{x:.9g}" for x in values) for values in (-key.direction, key.irradiance))
    return (
        f'\n    <emitter type="directional"><vector name="direction" value="{along}"/>'
        f'<rgb name="irradiance" value="{power}"/></emitter>'
    )


def _without_key(reconstruction: Reconstruction) -> Reconstruction:
    if reconstruction.reflectance is None:
        return reconstruction
    return replace(reconstruction, reflectance=replace(reconstruction.reflectance, key_direction=None))
