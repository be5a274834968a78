"""Path tracing with Mitsuba's own plugins: what synthetic captures are rendered with.

Nothing here shares a formula with the fitted shading model, so a fit to these images is no inverse crime.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import dr, mi
from mifit.core.camera import Camera
from mifit.core.files import Document
from mifit.render.gbuffer import make_mesh
from mifit.render.scene import make_sensor


@dataclass(frozen=True)
class Material:
    """Two microfacet lobes over a rough diffuse base, as maps with row 0 at v = 1.

    ``albedo`` (S, S, 3) is linear; ``gloss`` (S, S) the weight of the glossy lobe against the dry one, 0..1;
    ``roughness`` that of the dry lobe, of which the glossy one has 0.6; ``bump`` relief along the normal, in scene
    units.
    """

    albedo: NDArray[np.float32]
    gloss: NDArray[np.float32]
    roughness: NDArray[np.float32]
    bump: NDArray[np.float32]


@dataclass(frozen=True)
class Surface:
    """A mesh to render, split along UV seams, and the name of its material."""

    vertices: NDArray
    normals: NDArray
    uv: NDArray
    faces: NDArray
    material: str


class PathTracer:
    """Materials and environment, loaded once; surfaces are given per image.

    ``environment`` (H, W, 3) is lat-long radiance in Mitsuba's ``envmap`` layout: row 0 up, u = 0 along -z, u = 1/4
    along +x. Without ``specular`` the lobes don't reflect: the diffuse base alone is left.
    """

    def __init__(self, materials: dict[str, Material], environment: NDArray, specular: bool = True) -> None:
        gc.collect()  # a kernel has a branch for every mesh and material that is alive: garbage would make a new one
        self._bsdfs = {name: mi.load_dict(_bsdf(material, float(specular))) for name, material in materials.items()}
        bitmap = mi.Bitmap(np.ascontiguousarray(environment, dtype=np.float32))
        self._emitter = mi.load_dict({"type": "envmap", "bitmap": bitmap})
        self._integrator = mi.load_dict({"type": "path", "max_depth": 4, "hide_emitters": True})  # two bounces

    def render(
        self, surfaces: Sequence[Surface], cameras: Sequence[Camera], spp: int, seed: int
    ) -> list[NDArray[np.float32]]:
        """Views (H, W, 4) from each camera: linear radiance on black, and coverage.

        ``spp`` samples per pixel at the least, rounded up to the next k * k or k * (k + 1), which stratify well.
        """
        side = math.isqrt(spp - 1) + 1
        spp = side * (side - 1) if side * (side - 1) >= spp else side * side
        content: Document = {"type": "scene", "environment": self._emitter}
        for i, surface in enumerate(surfaces):
            content[f"surface{i}"] = make_mesh(
                surface.vertices,
                surface.faces,
                uv=surface.uv * (1.0, -1.0) + (0.0, 1.0),  # Mitsuba's textures have row 0 at v = 0
                normals=surface.normals,
                bsdf=self._bsdfs[surface.material],
            )
        scene = mi.load_dict(content)
        images = []
        for i, camera in enumerate(cameras):
            view = make_sensor(camera, spp)
            start = dr.opaque(mi.UInt32, (seed * 1000 + i) % 2**32)  # a literal would compile a kernel per seed
            image = mi.render(scene, sensor=view, integrator=self._integrator, spp=spp, seed=start)
            images.append(np.array(image, dtype=np.float32))
        return images


def _bsdf(material: Material, strength: float) -> Document:
    def lobe(specular: float, roughness: NDArray) -> Document:
        return {
            "type": "principled",
            "base_color": _texture(material.albedo),
            "roughness": _texture(roughness),
            "specular": specular,
        }

    return {
        "type": "bumpmap",
        "arbitrary": _texture(material.bump),
        "nested": {
            "type": "blendbsdf",
            "weight": _texture(material.gloss),
            "dry": lobe(0.3 * strength, material.roughness),
            "oily": lobe(0.7 * strength, 0.6 * material.roughness),
        },
    }


def _texture(values: NDArray) -> Document:
    data = np.ascontiguousarray(values, dtype=np.float32)
    bitmap = mi.Bitmap(data if data.ndim == 3 else data[..., None])
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat", "format": "variant"}
