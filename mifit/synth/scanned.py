"""A scanned head with its maps, moved rigidly and path traced, as a capture with truth.

Nothing of the head comes from a morphable model, and nothing of its skin from this project's shading: what a fit makes
of such a capture is evidence where its own kind of heads is a test.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.capture.transforms import Shot, View, write_transforms
from mifit.core.arrays import write_ply
from mifit.core.camera import Camera
from mifit.core.files import replacing, write_json
from mifit.core.image import linear_to_srgb, read_image, reduced, write_image
from mifit.core.mesh import vertex_normals
from mifit.errors import InputError
from mifit.progress import Progress, silent
from mifit.render.pathtrace import Material, PathTracer, Surface
from mifit.synth.compose import expose, exposure_of

MAPS = ("albedo", "specular", "roughness", "displacement")


@dataclass(frozen=True)
class ScannedHead:
    """A head in centimetres, y up, nose along +z, turned about the origin.

    It has one texture coordinate per vertex, ``uv`` (V, 2); row 0 of a map is at v = 1. ``maps`` (S, S, ...) are
    ``albedo`` (linear, 0..1), ``specular`` and ``roughness`` (0..1), ``displacement`` (centimetres).
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    uv: NDArray[np.float32]
    maps: dict[str, NDArray[np.float32]]

    @classmethod
    def load(
        cls, path: str | Path, maps: Mapping[str, str | Path], unit_mm: float = 10.0, flip_v: bool = False
    ) -> ScannedHead:
        """Read a mesh with texture coordinates (glTF, OBJ, PLY), of ``unit_mm`` millimetres per unit, and its maps.

        Among the maps must be ``albedo``; see `MAPS`. Images with an 8-bit transfer curve are decoded for the albedo
        only. ``flip_v`` turns them upside down: glTF counts v from the top, most other formats from the bottom, and
        some files keep the other one's habit. InputError for no mesh, no texture coordinates, or an unknown or
        unreadable map.
        """
        try:
            mesh = trimesh.load_mesh(path, process=False)
        except Exception as error:  # trimesh raises whatever its readers do
            raise InputError(f"{path}: not a readable mesh ({error})") from None
        uv = getattr(mesh.visual, "uv", None)
        if not len(getattr(mesh, "faces", ())) or uv is None or len(uv) != len(mesh.vertices):
            raise InputError(f"{path}: found no triangles with texture coordinates, expected a textured head")
        unknown = sorted(set(maps) - set(MAPS))
        if unknown or "albedo" not in maps:
            raise InputError(
                f"maps: found {', '.join(sorted(maps)) or 'none'}; expected albedo, and of {', '.join(MAPS[1:])}"
            )
        vertices = np.asarray(mesh.vertices, dtype=np.float64) * unit_mm / 10.0
        middle = 0.5 * (vertices[:, 0].min() + vertices[:, 0].max())
        near = np.abs(vertices[:, 0] - middle) < 0.2 * np.ptp(vertices[:, 0])
        sizes = np.ptp(vertices, axis=0)
        if not near.any() or not sizes.min() > 0.05 * sizes.max():
            found = " x ".join(f"{size:.3g}" for size in sizes)
            raise InputError(f"{path}: found a mesh of {found} cm, flat or without a middle, expected a head")
        nose = vertices[near][np.argmax(vertices[near, 2])]
        height = sizes[1]
        if not 10 < height < 100:
            raise InputError(
                f"{path}: the head is {height:.3g} cm high at {unit_mm:g} mm per unit, expected 10 to 100; set the unit"
            )
        vertices -= (middle, nose[1], nose[2] - 9.0)  # the point that the head turns about lies so far behind
        uv = np.asarray(uv, np.float32)
        if flip_v:
            uv = uv * np.array((1, -1), np.float32) + np.array((0, 1), np.float32)
        return cls(vertices, np.asarray(mesh.faces), uv, _read_maps(maps))

    def posed(self, pose: tuple[NDArray, NDArray]) -> NDArray[np.float64]:
        """World-space vertices under a rotation (3, 3) and translation (3,)."""
        return self.vertices @ pose[0].T + pose[1]


def maps_of(texts: Sequence[str]) -> dict[str, Path]:
    """``NAME=FILE`` texts as a dictionary; InputError for any other text."""
    maps = {}
    for text in texts:
        name, separator, file = text.partition("=")
        if not (separator and file):
            raise InputError(f"--maps {text}: expected NAME=FILE, such as albedo=colour.jpg")
        maps[name] = Path(file)
    return maps


def _read_maps(files: Mapping[str, str | Path]) -> dict[str, NDArray[np.float32]]:
    maps = {}
    for name, path in files.items():
        image = read_image(path)
        if name != "albedo":  # no colours: the codes themselves are the values
            linear = Path(path).suffix.lower() in (".exr", ".hdr")
            image = (image if linear else linear_to_srgb(np.clip(image, 0.0, 1.0))).mean(axis=-1)
        size = min(1024, min(image.shape[:2]))
        maps[name] = _resized(image, size)
    size = len(maps["albedo"])
    maps = {name: _resized(image, size) for name, image in maps.items()}
    gloss = maps.get("specular", np.full((size, size), 0.4, np.float32))
    # from black to white: roughness where no map of it is given, weight of the glossy lobe
    maps.setdefault("roughness", 0.48 - 0.18 * gloss)
    maps["specular"] = 0.15 + 0.7 * gloss
    relief = maps.get("displacement", np.zeros((size, size), np.float32))
    maps["displacement"] = np.float32(0.05) * relief  # centimetres from black to white
    maps["albedo"] = np.clip(maps["albedo"], 0.005, 0.95)
    return {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in maps.items()}


def _resized(image: NDArray, size: int) -> NDArray[np.float32]:
    if image.shape[:2] != (size, size):
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.float32)


def rigid_motion(timesteps: int, seed: int) -> list[tuple[NDArray, NDArray]]:
    """Rotation and translation per timestep, smooth in time; the first looks almost straight ahead."""
    rng = np.random.default_rng([seed, 31])
    speed, phase = rng.uniform(0.6, 1.2, 6), rng.uniform(-0.15, 0.15, 6)
    found = []
    for t in range(timesteps):
        # degrees, centimetres
        yaw, pitch, roll, *shift = np.array([12.0, 6.0, 3.0, 0.8, 0.5, 0.5]) * np.sin(phase + speed * t)
        rotation = Rotation.from_euler("yxz", [yaw, pitch, roll], degrees=True).as_matrix()
        found.append((rotation, np.array(shift)))
    return found


def synthesize_scan(
    out: str | Path,
    head: ScannedHead,
    cameras: Sequence[Camera],
    environments: Mapping[str, NDArray],
    timesteps: int = 4,
    seed: int = 0,
    spp: int = 64,
    progress: Progress = silent,
) -> Path:
    """Render a capture of a scanned head, with truth beside it.

    ``truth/NNNN.ply`` is the mesh in world space (centimetres), ``truth/maps.npz`` albedo, specular and roughness,
    ``truth/full_CAMERA.exr`` and ``truth/diffuse_CAMERA.exr`` the last camera's view of the first timestep with and
    without specular reflection, ``truth/relit_NAME.exr`` the same view under another environment, and
    ``truth/environment_NAME.exr`` that environment; all linear. ``truth/meta.json`` has the factor of each to the
    sensor's range. There are no landmarks: `mifit landmarks` finds them. ``transforms.json`` is written last.

    The last camera is the held-out view by custom. ``environments`` are lat-long radiance (H, W, 3) by name: the first
    lights the images, the others the relit truths.
    """
    out, (environment, *_) = Path(out), environments.values()
    relit = list(environments.items())[1:]
    total = timesteps + len(relit)
    maps = head.maps
    material = Material(maps["albedo"], maps["specular"], maps["roughness"], maps["displacement"])
    tracer = PathTracer({"head": material}, environment)
    poses = rigid_motion(timesteps, seed)

    def surface(pose: tuple[NDArray, NDArray]) -> Surface:
        world = head.posed(pose)
        return Surface(world, vertex_normals(world, head.faces), head.uv, head.faces, "head")

    exposure, relit_exposure = 0.0, {}
    shots = []
    progress("Rendering", 0, total)
    for t, pose in enumerate(poses):
        placed = surface(pose)
        images = tracer.render([placed], cameras, spp, seed=seed * 100_003 + t)
        if not t:
            exposure = exposure_of(images[0])
        for c, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            shot = Shot(camera.name, t, out / "images" / camera.name / f"{t:04d}.png")
            write_image(shot.image, expose(image[..., :3] * exposure, np.random.default_rng([seed, t, c, 22])))
            shots.append(shot)
        if not t:
            last = cameras[-1]
            bare = PathTracer({"head": material}, environment, specular=False)
            write_image(out / "truth" / f"full_{last.name}.exr", images[-1][..., :3])
            # The same seeds as the whole view's: their difference, the specular part, has less noise.
            first = bare.render([placed], cameras, spp, seed=seed * 100_003)[-1]
            write_image(out / "truth" / f"diffuse_{last.name}.exr", first[..., :3])
        grey = np.full_like(placed.vertices, 0.5)
        write_ply(out / "truth" / f"{t:04d}.ply", placed.vertices, head.faces, placed.normals, head.uv, grey)
        progress("Rendering", t + 1, total)
    with replacing(out / "truth" / "maps.npz") as temporary:
        halves = {name: value.astype(np.float16) for name, value in maps.items()}
        np.savez_compressed(temporary, **halves)  # type: ignore[arg-type]
    for i, (name, light) in enumerate(relit):
        light = reduced(light)
        image = PathTracer({"head": material}, light).render([surface(poses[0])], cameras[-1:], spp, seed=seed + i)[0]
        relit_exposure[name] = exposure_of(image)
        write_image(out / "truth" / f"relit_{name}.exr", image[..., :3])
        write_image(out / "truth" / f"environment_{name}.exr", light)
        progress("Rendering", timesteps + i + 1, total)
    note = {"exposure": exposure, "relit_exposure": relit_exposure, "seed": seed, "spp": spp}
    write_json(out / "truth" / "meta.json", note)
    write_transforms(out / "transforms.json", [View.of(camera) for camera in cameras], shots, "cm")
    return out
