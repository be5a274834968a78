"""Binary PLY files of the result folder: positions, normals, texture coordinates and vertex colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import replacing
from mifit.core.image import to_8_bit
from mifit.errors import InputError

_FACE = np.dtype([("count", "u1"), ("index", "<i4", (3,))])


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
    layout = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v", "r", "g", "b")]
    if viewer_colours:
        layout += [(name, "u1") for name in ("red", "green", "blue")]
    table = np.empty(len(vertices), dtype=layout)
    columns = np.concatenate([vertices, normals, uv, albedo], axis=1)
    for i, (name, _) in enumerate(layout[:11]):
        table[name] = columns[:, i]
    colour = to_8_bit(albedo)
    for i, (name, _) in enumerate(layout[11:]):
        table[name] = colour[:, i]
    rows = np.empty(len(faces), dtype=_FACE)
    rows["count"], rows["index"] = 3, faces
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment written by mifit"]
    header += [f"element vertex {len(table)}", *(f"property {kinds[k]} {n}" for n, k in layout)]
    header += [f"element face {len(rows)}", "property list uchar int vertex_indices", "end_header", ""]
    with replacing(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + table.tobytes() + rows.tobytes())


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
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: not readable: {error.strerror}") from None
    end = data.find(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode("ascii", "replace").split("\n")
    kinds = {"float": "<f4", "uchar": "u1"}
    try:
        counts = {w[1]: int(w[2]) for w in map(str.split, lines) if w[:1] == ["element"]}
        layout = [(w[2], kinds[w[1]]) for w in map(str.split, lines) if w[:1] == ["property"] and len(w) == 3]
        table = np.frombuffer(data, layout, counts["vertex"], end)
        rows = np.frombuffer(data, _FACE, counts["face"], end + table.nbytes)
        groups = {"vertices": "xyz", "normals": ("nx", "ny", "nz"), "uv": "uv", "albedo": "rgb"}
        out = {key: np.stack([table[n] for n in names], 1) for key, names in groups.items()}
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: not a mesh that mifit wrote ({error}); fit again, or restore the file") from None
    return {**out, "faces": rows["index"].copy()}
