"""The report's interactive 3D view: mesh, maps and lighting packed for `assets/viewer.js`."""

from __future__ import annotations

import base64
import json

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import Document
from mifit.core.image import to_8_bit
from mifit.core.sh import SHLighting, bands, cosine_coefficients
from mifit.output.figures import jpeg_uri, png_uri
from mifit.output.surface import shape_of, surface_maps, vertex_materials
from mifit.result import Reconstruction


def viewer_data(result: Reconstruction, timestep: int) -> str:
    """JSON for the 3D view of one timestep; quantised, for looking at only.

    Positions have 16 bits of the bounding sphere, normals 8, texture coordinates 16; the alpha of the vertex
    colour tells whether a face has maps (1) or none (0).
    """
    model, shape = result.model, shape_of(result, timestep, world=False)
    vertices, rotation = shape.vertices / result.geometry.scale, result.geometry.rotation[result.index(timestep)]
    named = shape.parts()
    parts = list(named.values())  # they share no vertex
    origin = np.concatenate([p.origin for p in parts])
    uv = np.concatenate([p.uv for p in parts])
    starts = np.cumsum([0, *(len(p.origin) for p in parts)])
    kind = np.repeat([255 if name == "face" else 0 for name in named], np.diff(starts))
    faces = np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)])
    position = vertices[origin]
    normals = shape.normals[origin]
    centre = (position.min(0) + position.max(0)) / 2
    radius = float(np.abs(position - centre).max())
    face_centre = vertices[np.unique(model.faces[model.face_mask])]
    colour = np.column_stack([to_8_bit(vertex_materials(result, skin=True)[origin, :3]), kind]).astype(np.uint8)
    wide = len(origin) > 65535
    maps = surface_maps(result, timestep, skin=True)
    peak = max(float(maps.specular.max()), 1e-3)
    data: Document = {
        "vertices": len(origin),
        "position": _base64(np.round((position - centre) / radius * 32767), "<i2"),
        "uv": _base64(np.round(np.clip(uv, 0, 1) * 65535), "<u2"),
        "normal": _base64(np.round(normals * 127), "i1"),
        "colour": _base64(colour, "u1"),
        "index": _base64(faces, "<u4" if wide else "<u2"),
        "index_bits": 32 if wide else 16,
        "centre": centre.tolist(),
        "radius": radius,
        "focus": ((face_centre.min(0) + face_centre.max(0)) / 2).tolist(),
        "rotation": rotation.ravel().tolist(),
        "specular_scale": peak,
        "maps": {
            "diffuse": jpeg_uri(to_8_bit(maps.diffuse), 90),
            "specular": jpeg_uri(np.round(255 * np.clip(maps.specular / peak, 0, 1)).astype(np.uint8), 90),
            "normal": png_uri(np.round(127.5 * (maps.normal + 1)).astype(np.uint8)),
        },
        **_lighting(result),
    }
    return json.dumps(data)


def _lighting(result: Reconstruction) -> Document:
    """Recovered lighting for the view's shader: of the lobe a lat-long picture, and polynomials in the cosine."""
    irradiance = result.lighting.truncate(3).coefficients * (cosine_coefficients(3)[bands(3)] / np.pi)[:, None]
    order = result.lighting.order
    cosines = np.linspace(0.05, 1.0, 40)
    albedo, tilt, factors = result.lobe.zonal(order, cosines)
    blurred = SHLighting(factors[bands(order), None] * result.lighting.coefficients).to_latlong(64, 128)
    peak = max(float(blurred.max()), 1e-6)
    return {
        "irradiance": irradiance.ravel().tolist(),
        "glossy": png_uri(np.round(255 * np.sqrt(np.clip(blurred / peak, 0, 1))).astype(np.uint8)),
        "glossy_scale": peak,
        "lobe_albedo": np.polynomial.polynomial.polyfit(cosines, albedo, 5).tolist(),
        "lobe_tilt": np.polynomial.polynomial.polyfit(cosines, tilt, 5).tolist(),
        "ambient": float(result.illumination.ambient),
        "exponent": result.lobe.exponent,
    }


def _base64(values: NDArray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()
