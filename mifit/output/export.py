"""Geometry with its maps for other programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np

from mifit.capture.transforms import UNITS_MM
from mifit.core.arrays import write_ply
from mifit.core.calls import checked
from mifit.core.files import check_overwriting, write_bytes, write_text
from mifit.core.image import encode_png, to_8_bit, write_image
from mifit.errors import InputError
from mifit.output.gltf import write_glb
from mifit.output.scene import write_scene
from mifit.output.surface import shape_of, surface_maps, vertex_materials
from mifit.output.usd import write_usdz
from mifit.result import Reconstruction

Format = Literal["glb", "obj", "ply", "usd", "mitsuba"]
SUFFIXES = {"glb": ".glb", "obj": ".obj", "ply": ".ply", "usd": ".usdz", "mitsuba": ".xml"}


OBJ_SPECULAR = 0.08
"""Reflectance along the normal where an OBJ's specular map, sRGB as Blender reads it, is white."""
Mesh = Literal["fitted", "refined"]


@checked
def export(
    result: Reconstruction,
    format: Format,
    path: str | Path,
    timestep: int | None = None,
    mesh: Mesh = "fitted",
    animate: bool = False,
    fps: float = 12.0,
    units: str | None = None,
) -> None:
    """Write one timestep for another program.

    Parameters
    ----------
    format : {"glb", "obj", "ply", "usd", "mitsuba"}
        ``glb``: binary glTF (`write_glb`). ``obj``: mesh in world space, ``.mtl`` and maps beside it. ``ply``: mesh in
        world space with UVs, normals and vertex colours. ``usd``: a ``.usdz`` package (`write_usdz`). ``mitsuba``: a
        scene with mifit's plugins, its files in ``NAME_files``.
    path : path
        File to write; its suffix must be the format's.
    mesh : {"fitted", "refined"}
        ``refined`` has the refined normals as shape.
    animate : bool
        ``glb`` plays all timesteps, ``fps`` a second; maps, and a refined mesh's shape, stay those of ``timestep``.
    units : {"m", "cm", "mm"}, optional
        Of ``obj`` and ``ply``; default: the result's. ``glb`` and ``usd`` are in metres.

    Raises
    ------
    InputError
        Unknown format or mesh, an animation in another format than ``glb``, another suffix, a timestep that was not
        fitted, or no refined mesh.
    """
    path = Path(path)
    if format not in SUFFIXES:
        raise InputError(f"format: found {format!r}, expected one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() != SUFFIXES[format]:
        raise InputError(f"{path}: found suffix {path.suffix!r}, expected {SUFFIXES[format]!r} for format {format}")
    if mesh not in ("fitted", "refined"):
        raise InputError(f"mesh: found {mesh!r}, expected 'fitted' or 'refined'")
    timestep = result.timesteps[0] if timestep is None else timestep
    result.index(timestep)
    beside = ("_diffuse.png", "_specular.png", "_normal.png", "_normal.exr", ".mtl") if format == "obj" else ()
    for end in beside:
        check_overwriting(path.with_name(path.stem + end))
    if animate and format != "glb":
        raise InputError(f"animate: found format {format!r}, expected 'glb', the only one that holds an animation")
    if not 1e-3 <= fps <= 1e3:
        raise InputError(f"fps: found {fps}, expected 0.001 to 1000")
    if units is not None and (format not in ("obj", "ply") or units not in UNITS_MM):
        raise InputError(f"units: found {units!r} for {format}, expected m, dm, cm or mm for obj or ply")
    factor = 1.0 if units is None else result.unit_mm / UNITS_MM[units]
    if mesh == "refined":
        result = result.with_refined_mesh()
        result.index(timestep)
    if format == "glb":
        write_glb(result, path, timestep, sorted(result.timesteps) if animate else None, fps)
    elif format == "obj":
        _write_obj(result, path, timestep, factor, units or result.units)
    elif format == "ply":
        shape = shape_of(result, timestep)
        split, at = shape.mesh, shape.mesh.origin
        albedo = result.geometry.vertex_albedo[at]
        write_ply(path, factor * shape.vertices[at], split.faces, shape.normals[at], split.uv, albedo)
    elif format == "usd":
        write_usdz(result, path, timestep)
    else:
        write_scene(result, path, timestep)


def _write_obj(result: Reconstruction, path: Path, timestep: int, factor: float, units: str) -> None:
    """OBJ with ``vt`` and ``vn``; what has maps and the rest are groups with a material each."""
    model, shape, stem = result.model, shape_of(result, timestep), path.stem
    mapped, maps = shape.mapped, surface_maps(result, timestep, skin=True)
    bent = shape_of(result, timestep, world=False).tangent_map(maps.normal)
    write_image(path.with_name(f"{stem}_diffuse.png"), maps.diffuse)
    reflectance = np.clip(result.lobe.factor() * maps.specular / OBJ_SPECULAR, 0.0, 1.0)
    write_image(path.with_name(f"{stem}_specular.png"), reflectance)
    write_bytes(path.with_name(f"{stem}_normal.png"), encode_png(np.round(127.5 * (bent + 1)).astype(np.uint8)))
    write_image(path.with_name(f"{stem}_normal.exr"), 0.5 * (bent + 1))
    albedo = vertex_materials(result, skin=True)[:, :3]
    rest = shape.parts().get("rest")
    grey = albedo[rest.origin].mean(0) if rest else np.full(3, 0.5)
    colour = " ".join(f"{c:.5f}" for c in np.clip(grey, 0, 1))
    specular = " ".join([f"{OBJ_SPECULAR:g}"] * 3)
    write_text(
        path.with_suffix(".mtl"),
        # Pr, of physically based programs, is glTF's roughness. Blender reads a normal map from map_Bump, and takes its
        # values as they are in an .exr alone; other programs read norm.
        f"newmtl skin\nillum 2\nKd 1 1 1\nKs {specular}\nNs {result.lobe.exponent:.6g}\n"
        f"Pr {math.sqrt(result.lobe.roughness):.4f}\nmap_Kd {stem}_diffuse.png\nmap_Ks {stem}_specular.png\n"
        f"norm {stem}_normal.png\nmap_Bump -bm 1.0 {stem}_normal.exr\n\n"
        f"newmtl rest\nillum 1\nKd {colour}\nKs 0 0 0\n",
    )
    codes = to_8_bit(albedo) / 255.0
    lines = [f"# written by mifit; units {units}", f"mtllib {stem}.mtl"]
    lines += [
        f"v {x:.7g} {y:.7g} {z:.7g} {r:.4f} {g:.4f} {b:.4f}"
        for (x, y, z), (r, g, b) in zip((factor * shape.vertices).tolist(), codes.tolist(), strict=True)
    ]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in model.uv.tolist()]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in shape.normals.tolist()]
    for name, selected in (("skin", mapped), ("rest", ~mapped)):
        lines += [f"g {name}", f"usemtl {name}"]
        for f, t in zip((model.faces[selected] + 1).tolist(), (model.faces_uv[selected] + 1).tolist(), strict=True):
            lines.append("f " + " ".join(f"{a}/{b}/{a}" for a, b in zip(f, t, strict=True)))
    write_text(path, "\n".join(lines) + "\n")
