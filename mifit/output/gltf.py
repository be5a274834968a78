"""Binary glTF 2.0 of a reconstruction: maps, expressions as morph targets, cameras."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mifit
from mifit.core.camera import Camera, rigid
from mifit.core.estimate import GeometryEstimate
from mifit.core.files import Document, replacing
from mifit.core.image import encode_png, to_8_bit
from mifit.core.mesh import SplitMesh, tangents
from mifit.output.surface import Shape, shape_of, surface_maps, vertex_materials
from mifit.result import Reconstruction

_KINDS = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123}
STEP = 1.0 / 32767
"""Metres of a step of a morph target: 16 bits hold up to a metre either way (KHR_mesh_quantization)."""
ARKIT = {
    "blink": "eyeBlink", "squint": "eyeSquint", "sneer": "noseSneer", "smile": "mouthSmile", "frown": "mouthFrown",
    "dimple": "mouthDimple", "stretch": "mouthStretch", "upperLipUp": "mouthUpperUp", "lowerLipDown": "mouthLowerDown",
    "pucker": "mouthPucker", "funnel": "mouthFunnel", "rollUpper": "mouthRollUpper", "rollLower": "mouthRollLower",
    "shrugLower": "mouthShrugLower",
}  # fmt: skip
"""ARKit's names of the built-in model's expressions, where they differ."""


class _Buffer:
    """The binary chunk, and the views and accessors that describe it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[Document] = []
        self.accessors: list[Document] = []

    def view(self, data: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.data += data
        self.views.append(view)
        return len(self.views) - 1

    def accessor(self, values: NDArray, kind: str, target: int | None = 34962, bounds: bool = False) -> int:
        """Append an array (N,) or (N, C); returns the accessor's index."""
        array = np.ascontiguousarray(values, dtype=kind)
        entry: Document = {
            "bufferView": self.view(array.tobytes(), target),
            "componentType": _KINDS[array.dtype],
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
        }
        if bounds:
            entry |= {name: np.atleast_1d(f(array, axis=0)).tolist() for name, f in (("min", np.min), ("max", np.max))}
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def sparse(self, values: NDArray) -> int:
        """Append codes (N, 3) of `STEP` each, of which only the rows that aren't 0 are stored; the accessor's index."""
        array = np.ascontiguousarray(values, dtype="<i2")
        rows = np.flatnonzero(array.any(axis=1))
        rows = rows if len(rows) else np.zeros(1, dtype=int)
        kind = np.dtype("<u2" if len(array) <= 2**16 else "<u4")
        bounds = {name: f(array, axis=0).tolist() for name, f in (("min", np.min), ("max", np.max))}
        stored = {
            "count": len(rows),
            "indices": {"bufferView": self.view(rows.astype(kind).tobytes()), "componentType": _KINDS[kind]},
            "values": {"bufferView": self.view(array[rows].tobytes())},
        }
        entry = {"componentType": 5122, "normalized": True, "count": len(array), "type": "VEC3", "sparse": stored}
        self.accessors.append(entry | bounds)
        return len(self.accessors) - 1


def shape_name(name: str) -> str:
    """The name that ARKit has for a blend shape: ``mouthSmile_L`` is ``mouthSmileLeft``."""
    stem, side = re.fullmatch("(.*?)(_[LR])?", name).groups()  # type: ignore[union-attr]
    return ARKIT.get(stem, stem) + {"_L": "Left", "_R": "Right", None: ""}[side]


def write_glb(
    result: Reconstruction,
    path: str | Path,
    timestep: int | None = None,
    animate: Sequence[int] | None = None,
    fps: float = 12.0,
) -> None:
    """Write one timestep as a ``.glb`` file, whole or not at all.

    The head is in metres, in object space, under a node that holds its pose; node and mesh are called as the file, and
    the fitted cameras stand beside it. Faces with a place in the atlas have the maps: base colour, tangent-space
    normals, and the specular albedo through KHR_materials_specular. glTF has GGX lobes, so the Blinn-Phong
    exponent m becomes alpha = sqrt(2 / (m + 2)), and roughness = sqrt(alpha). The other faces have vertex colours.
    Expressions are morph targets in steps of 0.03 mm. They hold only the vertices that move by a tenth of a millimetre
    or more. The timestep's coefficients are the weights; a coefficient from 0 to a bound is a weight from 0 to 1.
    Targets have ARKit's names where the model has its shapes.
    Recovered lighting is in the scene's ``extras``: glTF has no spherical harmonics.

    ``timestep`` is by default the first that is animated, or else that was fitted; ``animate`` names timesteps to play
    as an animation of the pose and of the expressions' weights, ``fps`` a second.
    """
    model, geometry = result.model, result.geometry
    timestep = (animate or result.timesteps)[0] if timestep is None else timestep
    i = result.index(timestep)
    metre = result.unit_mm / 1000.0
    rotation, scale = geometry.rotation[i], float(geometry.scale)
    shape = shape_of(result, timestep, world=False)
    posed = shape.vertices * metre
    low, high = np.asarray(model.expression_bounds, dtype=np.float64).T
    full = np.where((low == 0) & np.isfinite(high) & (high > 0), high, 1.0)  # coefficient of a weight of 1
    weights = np.asarray(geometry.expression[i], dtype=np.float64) / full
    targets = (model.expression * (scale * metre * full)).astype(np.float32)
    # Targets leave out vertices that move by less than a tenth of a millimetre at full weight.
    targets *= (np.linalg.norm(targets, axis=1, keepdims=True) > 1e-4).astype(np.float32)
    codes = np.clip(np.round(targets / STEP), -32767, 32767)
    # Base plus weighted targets is the fitted shape, to rounding.
    base = posed - STEP * (codes @ weights) if len(weights) else posed

    out = _Buffer()
    albedo = vertex_materials(result, skin=True)[:, :3]
    rest = {"name": "rest", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
    primitives = [
        _primitive(out, part, base, shape.normals, codes, None if name == "face" else albedo)
        for name, part in shape.parts().items()
    ]
    images, textures, skin = _skin(out, result, timestep, shape)
    subject = Path(path).stem
    head: Document = {"name": subject, "mesh": 0}
    place = geometry.translation[i] * metre
    animations = []
    if animate:  # a node that is animated may have no matrix
        head |= {"rotation": _quaternions(rotation[None])[0].tolist(), "translation": place.tolist()}
        rows = [result.index(t) for t in animate]
        animations.append(_animation(out, geometry, rows, np.subtract(animate, animate[0]) / fps, metre, full))
    else:
        head["matrix"] = rigid(rotation, place).T.ravel().tolist()
    nodes = [head]
    for k, camera in enumerate(result.cameras):
        pose = camera.camera_to_world_opengl.copy()
        pose[:3, 3] *= metre
        nodes.append({"name": camera.name, "camera": k, "matrix": pose.T.ravel().tolist()})
    document: Document = {
        "asset": {"version": "2.0", "generator": f"mifit {mifit.__version__}"},
        "extensionsUsed": list(skin["extensions"]),
        "scene": 0,
        "scenes": [
            {
                "nodes": list(range(len(nodes))),
                "extras": {
                    "sh_radiance": result.lighting.coefficients.tolist(),
                    "sh_convention": "real, Condon-Shortley phase, index l*l+l+m, world axes",
                    "lights": [light.document() for light in result.illumination.lights],
                    "timestep": timestep,
                },
            }
        ],
        "nodes": nodes,
        "meshes": [{"name": subject, "primitives": primitives}],
        "materials": [skin, rest],
        "textures": textures,
        "images": images,
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "accessors": out.accessors,
        "bufferViews": out.views,
    }
    if len(weights):
        names = [shape_name(name) for name in model.expression_names]
        document |= {"extensionsRequired": ["KHR_mesh_quantization"]}
        document["extensionsUsed"].append("KHR_mesh_quantization")
        document["meshes"][0] |= {"weights": weights.tolist(), "extras": {"targetNames": names}}
    if result.cameras:
        document["cameras"] = [_camera(camera) for camera in result.cameras]
    if animations:
        document["animations"] = animations
    document["buffers"] = [{"byteLength": len(out.data)}]
    _write(Path(path), document, bytes(out.data))


def _primitive(
    out: _Buffer, part: SplitMesh, base: NDArray, normals: NDArray, codes: NDArray, albedo: NDArray | None
) -> Document:
    """One primitive: with texture coordinates and tangents, or vertex albedo (V, 3); morph targets (V, 3, K)."""
    n = normals[part.origin]
    attributes = {"POSITION": out.accessor(base[part.origin], "<f4", bounds=True), "NORMAL": out.accessor(n, "<f4")}
    if albedo is None:
        tangent, sign = tangents(base[part.origin], n, part.uv, part.faces)
        attributes["TANGENT"] = out.accessor(np.column_stack([tangent, sign]), "<f4")
        attributes["TEXCOORD_0"] = out.accessor(part.uv * (1, -1) + (0, 1), "<f4")
    else:
        attributes["COLOR_0"] = out.accessor(albedo[part.origin], "<f4")
    primitive: Document = {
        "attributes": attributes,
        "indices": out.accessor(part.faces.ravel(), "<u2" if len(part.origin) <= 2**16 else "<u4", target=34963),
        "material": 0 if albedo is None else 1,
    }
    if codes.shape[2]:
        primitive["targets"] = [{"POSITION": out.sparse(codes[part.origin, :, k])} for k in range(codes.shape[2])]
    return primitive


def _skin(
    out: _Buffer, result: Reconstruction, timestep: int, shape: Shape
) -> tuple[list[Document], list[Document], Document]:
    """Images, textures and material of the face area."""
    maps = surface_maps(result, timestep, skin=True)
    bent = shape.tangent_map(maps.normal)
    peak = max(float(maps.specular.max()), 1e-6)
    lobe = result.lobe
    # Plain Blinn-Phong reflects alike at all angles; a fitted Fresnel factor has Schlick's form, as glTF's has.
    grazing = lobe.grazing
    strength = np.dstack([np.full((*maps.specular.shape, 3), 255), 255 * maps.specular / peak])
    planes = {
        "baseColor": to_8_bit(maps.diffuse),
        "normal": np.round(127.5 * (bent + 1)).astype(np.uint8),
        "specular": strength.round().astype(np.uint8),  # KHR_materials_specular reads the alpha channel
    }
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": out.view(encode_png(codes))}
        for name, codes in planes.items()
    ]
    textures = [{"sampler": 0, "source": k} for k in range(3)]
    skin = {
        "name": "skin",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "roughnessFactor": math.sqrt(lobe.roughness),
        },
        "normalTexture": {"index": 1},
        "extensions": {
            "KHR_materials_specular": {
                # Reflectance is specularFactor at grazing angles, and that times 0.04 colours along the normal.
                "specularFactor": min(lobe.factor() * peak * grazing, 1.0),
                "specularTexture": {"index": 2},
                "specularColorFactor": [1.0 / (0.04 * grazing)] * 3,
            }
        },
    }
    return images, textures, skin


def _animation(
    out: _Buffer, geometry: GeometryEstimate, rows: Sequence[int], seconds: NDArray, metre: float, full: NDArray
) -> Document:
    """Pose and expression of node 0 over time, linear between timesteps."""
    times = out.accessor(seconds, "<f4", target=None, bounds=True)
    values = {"translation": geometry.translation[rows] * metre, "rotation": _quaternions(geometry.rotation[rows])}
    if geometry.expression.shape[1]:
        values["weights"] = (geometry.expression[rows] / full).ravel()
    return {
        "name": "sequence",
        "samplers": [
            {"input": times, "interpolation": "LINEAR", "output": out.accessor(v, "<f4", target=None)}
            for v in values.values()
        ],
        "channels": [{"sampler": k, "target": {"node": 0, "path": path}} for k, path in enumerate(values)],
    }


def _quaternions(rotations: NDArray) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) -> unit quaternions x y z w, each in the half-space of the one before."""
    q = Rotation.from_matrix(rotations).as_quat()
    turn = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(turn)])[:, None]


def _camera(camera: Camera) -> Document:
    return {
        "name": camera.name,
        "type": "perspective",
        "perspective": {
            "yfov": 2.0 * math.atan(0.5 * camera.height / camera.fy),
            "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
            "znear": 0.01,
        },
    }


def _write(path: Path, document: Document, binary: bytes) -> None:
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary)))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)
