"""Binary PLY files of the result folder: positions, normals, texture coordinates and vertex colours."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import read_bytes, write_bytes
from mifit.core.image import to_8_bit
from mifit.core.limits import MAX_MODEL_BYTES
from mifit.errors import InputError

_GROUPS = {"vertices": "xyz", "normals": ("nx", "ny", "nz"), "uv": "uv", "albedo": "rgb"}


def write_ply(
    path: str | Path,
    vertices: NDArray,
    faces: NDArray,
    normals: NDArray,
    uv: NDArray,
    albedo: NDArray,
    viewer_colours: bool = True,
) -> None:
    """Write a triangle mesh, whole or not at all.

    Parameters
    ----------
    vertices, normals : (N, 3)
        Stored as float32.
    faces : (F, 3) int
    uv : (N, 2)
        Properties ``u v``, v = 0 at the last row of a map.
    albedo : (N, 3)
        Linear reflectance 0..1: properties ``r g b``, float32, what Mitsuba reads as ``vertex_color``.
    viewer_colours : bool
        Also writes ``red green blue``, 8-bit sRGB, what mesh viewers show and Mitsuba warns of.
    """
    from trimesh import Trimesh
    from trimesh.exchange.ply import export_ply

    columns = {**dict(zip("uv", uv.T, strict=True)), **dict(zip("rgb", albedo.T, strict=True))}
    mesh = Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=to_8_bit(albedo) if viewer_colours else None,
        vertex_attributes={name: np.asarray(column, dtype=np.float32) for name, column in columns.items()},
        process=False,
    )
    write_bytes(path, export_ply(mesh, vertex_normal=True))


def read_ply(path: str | Path) -> dict[str, NDArray]:
    """Read a PLY file that `write_ply` wrote.

    Returns
    -------
    dict
        ``vertices``, ``normals``, ``albedo`` (N, 3) float32, ``uv`` (N, 2) float32, ``faces`` (F, 3) int32.

    Raises
    ------
    InputError
        The file is missing, cut short or of another layout.
    """
    from trimesh.exchange.ply import load_ply

    data = read_bytes(path, MAX_MODEL_BYTES, "mesh")
    try:
        stored = load_ply(io.BytesIO(data), fix_texture=False)
        table = stored["metadata"]["_ply_raw"]["vertex"]["data"]  # as it is stored: nothing merged or normalised
        out = {key: np.stack([table[n] for n in names], 1).astype("<f4") for key, names in _GROUPS.items()}
        faces = np.asarray(stored["faces"], dtype=np.int32).reshape(-1, 3)
    except Exception as error:  # whatever a damaged file makes the reader raise
        raise InputError(f"{path}: not a mesh that mifit wrote ({error}); fit again, or restore the file") from None
    return {**out, "faces": faces}
