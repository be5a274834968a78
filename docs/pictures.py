"""The pictures of the pages, made from fits of heads whose licences allow it.

    python docs/pictures.py [--size 512] [--only hero gallery light sides]

Fits the shared captures of the Perry-Smith scan (CC-BY 3.0) and of Digital Emily (MIT) into ``out/pictures`` where
there is no result yet, and writes ``docs/images``. People's photographs stay out.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import mifit
from mifit.core.camera import Camera
from mifit.core.image import to_8_bit
from mifit.output.deferred import surface_material, visible_surface
from mifit.render.visible import trace_mesh

ROOT = Path(__file__).resolve().parents[1]
SHARED, IMAGES, WORK = ROOT.parent / "shared", ROOT / "docs" / "images", ROOT / "out" / "pictures"
ICT = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
HEADS = {
    "scan_city": ("left", "right", "third", (0, 1)), "scan_studio": ("left", "right", "third", (0, 1)),
    "scan_sun": ("left", "right", "third", (0, 1)), "emily": ("c3", "c4", "c2", (0,)),
}  # fmt: skip
"""Two fitted cameras, a third one that isn't, and the timesteps."""
TILE = 240
"""Height of a picture in a row, pixels."""


class Head:
    """A capture and its fit."""

    def __init__(self, name: str, size: int) -> None:
        left, right, self.third, self.timesteps = HEADS[name]
        self.name, self.cameras = name, (left, right)
        self.capture = mifit.Capture.load(SHARED / "captures" / name)
        folder = WORK / f"{name}_{size}"
        if not (folder / "result.json").exists():
            model = mifit.MorphableModel.load(str(ICT))
            config = mifit.FitConfig(reflectance=mifit.ReflectanceConfig(texture_size=size))
            mifit.fit(self.capture, model, self.cameras, self.timesteps, config).save(folder)
        self.result = mifit.Reconstruction.load(folder)

    @property
    def box(self) -> tuple[slice, slice]:
        """Rows and columns around the head in the third view."""
        view = self.capture.camera(self.third)
        rows, columns = np.nonzero(self.result.render(view, 0, "pca", samples=1)[..., 3] > 0)
        return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)

    def photograph(self, camera: str) -> NDArray[np.uint8]:
        """One photograph of the first timestep, cropped as the third view."""
        return to_8_bit(self.capture.frame(camera, 0).image)[self.box]

    def shown(self, values: Callable[[object], NDArray]) -> NDArray[np.uint8]:
        """Something of the surface's material (N, 3) in the third view."""
        view = self.capture.camera(self.third)
        surface = visible_surface(self.result, view, 0)
        return on_white(surface.image(values(surface_material(self.result, surface, 0))))[self.box]

    def lit(
        self, environment: str | None = None, rotate: float = 0.0, camera: Camera | None = None
    ) -> NDArray[np.uint8]:
        """The third view, or another, in the capture's light or under an environment."""
        result = self.result
        if environment is not None:
            result = result.relight(SHARED / "hdri" / f"{environment}.hdr", rotate, exposure="auto")
        picture = on_white(result.render(camera or self.capture.camera(self.third), 0))
        return picture[self.box] if camera is None else picture

    def scan(self) -> NDArray[np.uint8]:
        """The true mesh in the third view, shaded by its normals."""
        import trimesh

        truth = self.capture.path / "truth"
        path = truth / "0000.ply"
        mesh = trimesh.load(path if path.exists() else truth / "head.ply", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
        surface = trace_mesh(vertices, faces, self.capture.camera(self.third), 2)
        return clay(surface, np.asarray(mesh.vertex_normals), faces)[self.box]

    def mesh(self) -> NDArray[np.uint8]:
        """The fitted mesh in the third view, shaded by its normals."""
        vertices, faces = self.result.geometry.vertices[0], self.result.model.faces
        from mifit.core.mesh import vertex_normals

        surface = trace_mesh(vertices, faces, self.capture.camera(self.third), 2)
        return clay(surface, vertex_normals(vertices, faces), faces)[self.box]


def on_white(image: NDArray) -> NDArray[np.uint8]:
    """Linear colour with coverage over white, 8-bit sRGB."""
    return to_8_bit(image[..., :3] * image[..., 3:] + (1.0 - image[..., 3:]))


def clay(surface: object, normals: NDArray, faces: NDArray) -> NDArray[np.uint8]:
    """Grey shading of a traced mesh by a light beside the camera."""
    normal = (normals[faces[surface.face]] * surface.weights[..., None]).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = surface.view + np.float32([0.3, 0.5, 0.0])
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    shade = 0.08 + 0.6 * np.clip((normal * light).sum(axis=1), 0.0, 1.0)
    return on_white(surface.image(np.repeat(shade[:, None], 3, axis=1)))


def tile(image: NDArray, label: str = "", height: int = TILE) -> NDArray[np.uint8]:
    """An image at one height, with a label at its foot."""
    width = round(image.shape[1] * height / image.shape[0])
    out = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    foot = np.full((22, width, 3), 255, np.uint8)
    cv2.putText(foot, label, (4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (60, 60, 60), 1, cv2.LINE_AA)
    return np.concatenate([out, foot])


def row(tiles: list[NDArray]) -> NDArray[np.uint8]:
    """Tiles beside one another."""
    gap = np.full((tiles[0].shape[0], 6, 3), 255, np.uint8)
    return np.concatenate([part for t in tiles for part in (t, gap)][:-1], axis=1)


def page(rows: list[NDArray], path: Path) -> None:
    """Rows below one another, centred on white."""
    width = max(r.shape[1] for r in rows)
    padded = []
    for r in rows:
        left = (width - r.shape[1]) // 2
        padded.append(np.pad(r, ((0, 6), (left, width - r.shape[1] - left), (0, 0)), constant_values=255))
    Image.fromarray(np.concatenate(padded)).save(path, quality=88)
    print(f"wrote {path.relative_to(ROOT)}")


def strip(head: Head) -> NDArray[np.uint8]:
    """Two photographs in; albedo, specular reflection, normals, mesh and scan, relit."""
    rotation = head.capture.camera(head.third).world_to_camera[:3, :3]
    pictures = {
        "in": head.photograph(head.cameras[0]),
        "in ": head.photograph(head.cameras[1]),
        "diffuse albedo": head.shown(lambda m: m.diffuse),
        "specular albedo": head.shown(lambda m: np.repeat(8.0 * m.specular[:, None], 3, axis=1)),
        "normals": head.shown(lambda m: (0.5 + 0.5 * (m.normal @ rotation.T) * [1, -1, -1]) ** 2.2),
        "mesh": head.mesh(),
        "scan": head.scan(),
        "relit": head.lit("sunset"),
    }
    return row([tile(image, label.strip()) for label, image in pictures.items()])


def hero(size: int) -> None:
    """The first picture of the README."""
    page([strip(Head("scan_city", size))], IMAGES / "hero.jpg")


def gallery(size: int) -> None:
    """Every head: the held-out photograph, our view of it, and three lights."""
    rows = []
    for name in HEADS:
        head = Head(name, size)
        own = {"held-out photograph": head.photograph(head.third), "full": head.lit()}
        relit = {light: head.lit(light) for light in ("city", "studio", "sunset", "apartment")}
        rows.append(row([tile(image, f"{label}") for label, image in (own | relit).items()]))
    page(rows, IMAGES / "gallery.jpg")


def light(size: int, frames: int = 24, height: int = 260) -> None:
    """A light that turns about a head, as a small moving picture."""
    head = Head("scan_city", size)
    view, box = head.capture.camera(head.third), head.box
    turns = [360.0 * k / frames for k in range(frames)]
    turned = head.result.relight(SHARED / "hdri" / "sunset.hdr", rotations=turns, exposure="auto")
    images = []
    for lit in turned:
        picture = on_white(lit.render(view, 0, samples=1))[box]
        width = round(picture.shape[1] * height / picture.shape[0])
        images.append(Image.fromarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)))
    path = IMAGES / "light.webp"
    images[0].save(path, save_all=True, append_images=images[1:], duration=90, loop=0, quality=70)
    print(f"wrote {path.relative_to(ROOT)}")


def sides(size: int) -> None:
    """The scan from five sides under the studio's light."""
    result = Head("scan_city", size).result
    lit = result.relight(SHARED / "hdri" / "studio.hdr", exposure="auto")
    views = [result.orbit(yaw=yaw) for yaw in (-60, -30, 0, 30, 60)]
    page([row([tile(on_white(lit.render(view, 0))) for view in views])], IMAGES / "five_sides.jpg")


PICTURES = {"hero": hero, "gallery": gallery, "light": light, "sides": sides}


def main() -> None:
    """Make the pictures that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="texels along the side of the maps")
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    given = parser.parse_args()
    mifit.set_variant("auto")
    IMAGES.mkdir(exist_ok=True)
    for name in given.only:
        PICTURES[name](given.size)


if __name__ == "__main__":
    main()
