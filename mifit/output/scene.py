"""A reconstruction as a Mitsuba scene file.

The path integrator of ``mifit render`` reads the same file that a user gets, so the two can't differ.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mifit.core.arrays import write_ply
from mifit.core.calls import whole
from mifit.core.camera import Camera, rigid
from mifit.core.files import Document, write_text
from mifit.core.image import write_image
from mifit.core.limits import MAX_COUNT
from mifit.core.mesh import interpolate, normalize
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.output.deferred import render_local, visible_surface
from mifit.output.surface import Shape, mapped_faces, shape_of, surface_maps, vertex_materials
from mifit.render.scene import load_scene, render_scene, sensor_description, to_mitsuba, to_xml
from mifit.render.variant import check_active_variant
from mifit.result import METHODS, Method, Reconstruction

Skin = Callable[[Mapping[str, Document]], Mapping[str, object]]
"""Makes a BSDF's dictionary of those of the maps' textures."""


def write_scene(
    result: Reconstruction,
    path: str | Path,
    timestep: int,
    cameras: Sequence[Camera] | None = None,
    method: Method = "full",
) -> None:
    """Write ``NAME.xml``, which uses mifit's plugins, and its files in ``NAME_files``.

    Faces with a place in the atlas have the maps; others have vertex albedo that continues them. The skin is
    ``blinnphong`` with the refined normals as slopes, and the light is ``shenv``, or a lat-long ``envmap`` of a relit
    result. A compact light is a ``directional`` emitter. The ambient term stands for light that local shading leaves
    out, such as interreflection, so a path-traced scene doesn't have it. A camera whose pixels aren't square is
    mifit's ``pinhole``.

    ``cameras`` are the sensors in this order, the fitted ones by default; ``method`` is that of
    `Reconstruction.render`. InputError for a camera with lens distortion; nothing is written then.
    """
    path = Path(path)
    cameras = result.cameras if cameras is None else cameras
    files = path.with_name(re.sub(r"[^\w.-]", "_", path.stem) + "_files")
    scene = scene_description(result, cameras, method, files.name)
    _write_files(result, files, timestep, method)
    write_text(path, to_xml(scene, "Written by mifit. Needs mifit.register_plugins()."))


def render_view(
    result: Reconstruction,
    camera: Camera,
    timestep: int = 0,
    method: Method = "full",
    integrator: Literal["local", "path"] = "local",
    samples: int | None = None,
    seed: int = 0,
) -> NDArray[np.float32]:
    """(H, W, 4) one view of a result; see `Reconstruction.render`."""
    check_shown(result, timestep, method)
    check_active_variant()
    if samples is not None:
        whole(samples, 1, "samples", MAX_COUNT)
    if integrator == "local":
        return render_local(result, camera, timestep, method, samples or 2)
    if integrator == "path":
        return render_path(result, camera, timestep, method, samples or 64, seed)
    raise InputError(f"integrator: found {integrator!r}, expected 'local' or 'path'")


def check_shown(result: Reconstruction, timestep: int, method: Method) -> None:
    """InputError for a timestep or a method that a result can't show."""
    result.index(timestep)
    if method not in METHODS:
        raise InputError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
    if method not in result.methods:
        raise InputError(
            f"method {method!r} needs reflectance, but this fit ended after the geometry stage; "
            "use 'pca', or fit with --until reflectance"
        )


def render_path(
    result: Reconstruction, camera: Camera, timestep: int, method: Method, samples: int, seed: int
) -> NDArray[np.float32]:
    """Path trace one view through the scene file; see `Reconstruction.render`."""
    with tempfile.TemporaryDirectory(prefix="mifit-scene-") as folder:
        path = Path(folder) / "scene.xml"
        write_scene(result, path, timestep, [camera], method)
        image = render_scene(path, {}, spp=samples, seed=seed)
    # Mitsuba's film adds up light on black; colours here are those of the covered part. Its alpha also counts
    # the inside of the head, seen through the eye openings, so coverage is that of local rendering.
    hit = image[..., 3:]
    surface = visible_surface(result, camera, timestep)
    alpha = surface.image(np.zeros((len(surface.pixel), 3)))[..., 3:]
    colour = np.where(alpha > 0, image[..., :3] / np.maximum(hit, 1e-3), 0.0)
    return np.concatenate([colour, alpha], axis=-1).astype(np.float32)


def _write_files(result: Reconstruction, files: Path, timestep: int, method: Method) -> NDArray[np.float32]:
    """Write meshes, maps and environment; returns the normals as slopes (S, S, 3), see `_slopes`."""
    if method == "pca":
        result = replace(result, reflectance=None, normals=None)
    shape, albedo = shape_of(result, timestep), vertex_materials(result)[:, :3]
    files.mkdir(parents=True, exist_ok=True)
    for name, part in shape.parts().items():
        vertices, normals, colours = (values[part.origin] for values in (shape.vertices, shape.normals, albedo))
        write_ply(files / f"{name}.ply", vertices, part.faces, normals, part.uv, colours, viewer_colours=False)
    maps = surface_maps(result, timestep)
    specular = maps.specular if method == "full" else np.zeros_like(maps.specular)
    slopes = _slopes(result, timestep, maps.normal, shape)
    write_image(files / "diffuse.exr", np.clip(maps.diffuse, 0, 1))
    write_image(files / "specular.exr", np.clip(specular, 0, 1))
    write_image(files / "slopes.exr", slopes)
    if result.environment is not None:
        write_image(files / "environment.exr", result.environment)
    return slopes


def _slopes(result: Reconstruction, timestep: int, normal_object: NDArray, shape: Shape) -> NDArray[np.float32]:
    """(S, S, 3) refined normals as slopes along Mitsuba's shading frame, 0 in the third channel.

    That frame has s along dp/du, perpendicular to the interpolated normal n, and t = n x s.
    """
    model = result.model
    size = normal_object.shape[0]
    rotation = result.geometry.rotation[result.index(timestep)]
    texels = rasterize_uv(model.uv, model.faces_uv, size, shape.mapped)
    n = normalize(interpolate(shape.normals, model.faces, texels.face, texels.weights))
    p, t = shape.vertices[model.faces].astype(np.float64), model.uv[model.faces_uv].astype(np.float64)
    d1, d2 = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = d1[:, :1] * d2[:, 1:] - d1[:, 1:] * d2[:, :1]
    along_u = (d2[:, 1:] * (p[:, 1] - p[:, 0]) - d1[:, 1:] * (p[:, 2] - p[:, 0])) * np.sign(area)
    u = along_u[texels.face]
    s = normalize(u - np.sum(u * n, axis=1, keepdims=True) * n)
    bent = normalize(texels.from_map(normal_object) @ rotation.T)
    height = np.maximum(np.sum(bent * n, axis=1), 1e-3)
    pair = np.stack([np.sum(bent * s, axis=1), np.sum(bent * np.cross(n, s), axis=1)], axis=1) / height[:, None]
    pair *= np.minimum(1.0, 4.0 / np.maximum(np.linalg.norm(pair, axis=1, keepdims=True), 1e-9))  # 76 degrees
    flat = np.zeros((size, size, 3), dtype=np.float32)
    flat[..., :2] = texels.to_map(pair.astype(np.float32))
    return flat


def load_result_scene(
    result: Reconstruction,
    timestep: int,
    integrator: str | Mapping[str, object],
    cameras: Sequence[Camera],
    method: Method,
    samples: int,
    skin: Skin | None,
) -> Any:
    """A loaded ``mi.Scene`` of one timestep; see `Reconstruction.scene`."""
    check_active_variant()
    check_shown(result, timestep, method)
    whole(samples, 1, "samples", MAX_COUNT)
    if not all(isinstance(camera, Camera) for camera in cameras):
        raise TypeError("scene: cameras: found other objects, expected Camera")
    chosen: Document = {"type": integrator} if isinstance(integrator, str) else dict(integrator)
    if chosen.get("type") == "shdirect":
        if result.environment is not None:  # what it shades is smooth light
            smooth = replace(result.illumination, radiance=result.lighting.coefficients, lights=())
            result = result.with_illumination(smooth)
        fitted = None if method == "pca" else result.reflectance
        ambient = result.geometry.ambient if fitted is None else fitted.illumination.ambient
        model = "prefiltered" if fitted is None else fitted.shading_model
        chosen = {"model": model, "ambient": float(ambient)} | chosen
    chosen = {"hide_emitters": True} | chosen
    with tempfile.TemporaryDirectory(prefix="mifit-scene-") as folder:
        slopes = _write_files(result, Path(folder), timestep, method)
        scene = scene_description(result, cameras, method, folder, chosen, samples)
        if skin is not None:
            bent = normalize(np.concatenate([slopes[..., :2], np.ones_like(slopes[..., :1])], axis=-1))
            write_image(f"{folder}/normal.exr", 0.5 * bent + 0.5)
            names = {"diffuse": False, "specular": True, "slopes": True, "normal": True}
            scene["skin"] = dict(skin({name: _texture(f"{folder}/{name}.exr", raw) for name, raw in names.items()}))
        return load_scene(to_mitsuba(scene))


def scene_description(
    result: Reconstruction,
    cameras: Sequence[Camera],
    method: Method,
    files: str,
    integrator: Mapping[str, object] | None = None,
    samples: int = 64,
) -> Document:
    """The scene of `write_scene` as a description (`render.scene`), its files in the folder ``files``.

    Ids are ours, not the user's: ``skin`` and ``light`` (maps and lighting), ``light_1`` ... (compact lights),
    ``face`` and ``rest`` (shapes), and ``camera_NAME`` (see `sensor_ids`).
    """
    if method == "pca":
        result = replace(result, reflectance=None, normals=None)
    path = {"type": "path", "max_depth": 5, "hide_emitters": True}
    scene: Document = {"type": "scene", "integrator": path if integrator is None else dict(integrator)}
    for name, camera in zip(sensor_ids(cameras), cameras, strict=True):
        scene[name] = sensor_description(camera, samples)
    scene["skin"] = {
        "type": "blinnphong",
        "diffuse_reflectance": _texture(f"{files}/diffuse.exr", False),
        "specular_reflectance": _texture(f"{files}/specular.exr"),
        **result.lobe.parameters(),
        "normal_correction": _texture(f"{files}/slopes.exr"),
    }
    scene["face"] = _shape(f"{files}/face.ply", {"type": "ref", "id": "skin"})
    if not mapped_faces(result).all():
        albedo = {"type": "mesh_attribute", "name": "vertex_color"}
        # The skin's lobe, of no strength: `shdirect` shades both together.
        lobe = result.lobe.parameters()
        bare = {"type": "blinnphong", "diffuse_reflectance": albedo, "specular_reflectance": 0.0, **lobe}
        scene["rest"] = _shape(f"{files}/rest.ply", bare)
    if result.environment is not None:
        scene["light"] = {"type": "envmap", "filename": f"{files}/environment.exr"}
        if result.environment_rotation is not None:
            scene["light"]["to_world"] = rigid(result.environment_rotation)
    else:
        rows = result.illumination.radiance
        text = ",  ".join(" ".join(f"{x:.9g}" for x in row) for row in rows)
        scene["light"] = {"type": "shenv", "coefficients": text}
    lamps = result.illumination.lights if result.environment is None else ()  # it holds them
    for number, light in enumerate(lamps, 1):
        scene[f"light_{number}"] = light.emitter()
    return scene


def sensor_ids(cameras: Sequence[Camera]) -> list[str]:
    """``camera_NAME`` for each camera, of letters, digits, ``_`` and ``-`` alone; two of one id get a number."""
    ids: list[str] = []
    for camera in cameras:
        base = "camera_" + re.sub(r"[^A-Za-z0-9_-]", "_", camera.name)
        name, number = base, 2
        while name in ids:
            name, number = f"{base}_{number}", number + 1
        ids.append(name)
    return ids


def _texture(file: str, raw: bool = True) -> Document:
    return {"type": "bitmap", "filename": file, "raw": raw, "wrap_mode": "clamp"}


def _shape(file: str, bsdf: Document) -> Document:
    return {"type": "ply", "filename": file, "flip_tex_coords": True, "bsdf": bsdf}
