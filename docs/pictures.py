"""The pictures of the pages, made from fits of heads whose licences allow it.

    python docs/pictures.py [--size 512] [--only hero gallery light sides table methods builtin film] [--keep]

Fits the shared captures of the Perry-Smith scan (CC-BY 3.0) and of Digital Emily (MIT), and heads as in Table 1, into
``out/pictures``, and writes ``docs/images``. ``--keep`` takes the fits that are there. People's photographs stay out.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

import mifit
from mifit.core.image import to_8_bit
from mifit.core.mesh import vertex_normals
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
MADE = {"table_0": "apartment", "table_2": "softbox", "table_3": "apartment"}
"""Heads as `benchmarks.table1` makes them, by their number, and their light; the built-in model is fitted to them."""
EXPRESSIONS = (
    ("jawOpen",), ("smile_L", "smile_R", "cheekSquint_L", "cheekSquint_R"),
    ("frown_L", "frown_R", "browInnerUp_L", "browInnerUp_R"), ("pucker",),
    ("browDown_L", "browDown_R", "sneer_L", "sneer_R"), ("blink_L",), ("cheekPuff_L", "cheekPuff_R"),
)  # fmt: skip
TILE = 240
"""Height of a picture in a row, pixels."""
FAR_MM = 2.0
"""Distance to the scan that has full colour."""
LEVEL = 0.2
"""Median of skin in a relit picture, linear."""


class Head:
    """A capture and its fit, seen by a third camera at the pictures' scale."""

    def __init__(self, name: str, size: int) -> None:
        left, right, third, timesteps = HEADS.get(name, ("left", "right", "third", (0, 1)))
        self.name, self.cameras, folder = name, (left, right), WORK / f"{name}_{size}"
        self.capture = mifit.Capture.load(made(name) if name in MADE else SHARED / "captures" / name)
        if not (folder / "result.json").exists():
            model = mifit.MorphableModel.load("builtin" if name in MADE else str(ICT))
            config = mifit.FitConfig(reflectance=mifit.ReflectanceConfig(texture_size=size))
            mifit.fit(self.capture, model, self.cameras, timesteps, config).save(folder)
        self.result = mifit.Reconstruction.load(folder)
        self.third, view = third, self.capture.camera(third)
        rows = np.nonzero(self.result.render(view.resized(0.25), 0, "pca", samples=1)[..., 3].any(axis=1))[0]
        self.scale = min(1.0, 0.3 * TILE / np.ptp(rows))
        self.view = view.resized(self.scale)
        shown = self.result.render(self.view, 0, "pca", samples=1)[..., 3] > 0
        self.box = around(shown)
        self.relit = cache(self._relit)

    def _relit(self, environment: str) -> mifit.Reconstruction:
        return self.result.relight(SHARED / "hdri" / f"{environment}.hdr", exposure="auto")

    def photograph(self, camera: str) -> NDArray[np.uint8]:
        """One photograph of the first timestep, cropped as the third view."""
        image = to_8_bit(self.capture.frame(camera, 0).image)
        return cv2.resize(image, (self.view.width, self.view.height), interpolation=cv2.INTER_AREA)[self.box]

    def shown(self, values: Callable[[object], NDArray]) -> NDArray[np.uint8]:
        """Something of the skin's material (N, 3) in the third view."""
        skin = self.relit("sunset")  # without what is left in the capture's own light
        surface = visible_surface(skin, self.view, 0)
        return on_white(surface.image(values(surface_material(skin, surface, 0))))[self.box]

    def lit(self, environment: str | None = None) -> NDArray[np.uint8]:
        """The third view in the capture's light, or under an environment."""
        if environment is None:
            return on_white(self.result.render(self.view, 0))[self.box]
        return on_white(exposed(self.relit(environment).render(self.view, 0)))[self.box]

    def side(self, environment: str, yaw: float) -> NDArray[np.uint8]:
        """The head under an environment from so many degrees beside the front."""
        image = self.relit(environment).render(self.beside(yaw), 0)
        return on_white(exposed(image))[around(image[..., 3] > 0)]

    def beside(self, yaw: float) -> mifit.Camera:
        """A camera that sees the whole head from so many degrees beside the front."""
        view = self.result.orbit(yaw=yaw).resized(self.scale)
        return replace(view, fx=0.7 * view.fx, fy=0.7 * view.fy)

    def front(self) -> Head:
        """The same head, seen from the front."""
        other = copy(self)
        other.view = self.result.orbit().resized(self.scale)
        other.box = around(self.result.render(other.view, 0, "pca", samples=1)[..., 3] > 0)
        return other

    def scan(self) -> NDArray[np.uint8]:
        """The true mesh in the third view, shaded by its normals."""
        return self.clay(*self.truth())

    def mesh(self) -> NDArray[np.uint8]:
        """The fitted mesh in the third view, shaded by its normals."""
        return self.clay(self.result.geometry.vertices[0], self.result.model.faces)

    def start(self) -> NDArray[np.uint8]:
        """The mesh of the morphable model's fit alone."""
        fit = mifit.fit_geometry(self.capture, self.result.model, self.cameras, (0,), mifit.GeometryConfig())
        return self.clay(fit.vertices[0], self.result.model.faces)

    def truth(self) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Vertices and faces of the scan."""
        folder = self.capture.path / "truth"
        path = folder / "0000.ply"
        mesh = trimesh.load(path if path.exists() else folder / "head.ply", process=False)
        return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)

    def clay(self, vertices: NDArray, faces: NDArray) -> NDArray[np.uint8]:
        """A mesh in the third view, shaded by its normals."""
        return clay(vertices, faces, self.view)[self.box]

    def normals(self, refined: bool) -> NDArray[np.uint8]:
        """Normals as colours, the mesh's or the refined ones."""
        rotation = self.view.world_to_camera[:3, :3]
        geometry, faces = self.result.geometry.vertices[0], self.result.model.faces
        if refined:
            return self.shown(lambda m: coloured(m.normal @ rotation.T))
        surface = trace_mesh(geometry, faces, self.view, 2)
        normal = (vertex_normals(geometry, faces)[faces[surface.face]] * surface.weights[..., None]).sum(axis=1)
        return on_white(surface.image(coloured(normal @ rotation.T)))[self.box]

    def apart(self) -> NDArray[np.uint8]:
        """How far the mesh lies outside (red) or inside (blue) the scan; full colour at `FAR_MM`."""
        vertices, faces = self.truth()
        surface = trace_mesh(vertices, faces, self.view, 1)
        corners = vertices[faces[surface.face]]
        points = (corners * surface.weights[..., None]).sum(axis=1).astype(np.float64)
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        fitted = trimesh.Trimesh(self.result.geometry.vertices[0], self.result.model.faces, process=False)
        nearest = near(fitted, points)
        outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
        signed = ((nearest - points) * outwards).sum(axis=1) * self.capture.unit_mm / FAR_MM
        out, into = np.clip(signed, 0.0, 1.0), np.clip(-signed, 0.0, 1.0)
        colour = 1.0 - np.stack([into, np.maximum(out, into), out], axis=1)
        return on_white(surface.image(colour.astype(np.float32)))[self.box]

    def marked(self) -> NDArray[np.uint8]:
        """The first photograph with its landmarks."""
        name = self.cameras[0]
        frame, camera = self.capture.frame(name, 0), self.capture.camera(name)
        image = cv2.resize(to_8_bit(frame.image), (self.view.width, self.view.height), interpolation=cv2.INTER_AREA)
        for x, y in frame.landmarks * self.view.width / camera.width:
            cv2.circle(image, (round(float(x)), round(float(y))), 2, (40, 220, 40), -1, cv2.LINE_AA)
        return image[self.box]


def around(shown: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns of the true pixels."""
    rows, columns = np.nonzero(shown)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


def made(name: str) -> Path:
    """Folder of a head as in Table 1, path traced once."""
    folder, seed = WORK / "captures" / name, int(name.rpartition("_")[2])
    if not (folder / "transforms.json").exists():
        light = SHARED / "hdri" / f"{MADE[name]}.hdr"
        mifit.synthesize(folder, 1, 2, light, seed=100 + seed, tone=0.25 * seed, outside=0.5, landmark_bias=1.9)
    return folder


@cache
def head(name: str, size: int) -> Head:
    """A head, fitted once."""
    return Head(name, size)


def exposed(image: NDArray) -> NDArray[np.float32]:
    """An image whose covered pixels have a median of `LEVEL`."""
    level = np.median(image[image[..., 3] > 0.5, :3].mean(axis=1))
    return image * np.float32([LEVEL / level] * 3 + [1.0])


def on_white(image: NDArray) -> NDArray[np.uint8]:
    """Linear colour with coverage over white, 8-bit sRGB."""
    return to_8_bit(image[..., :3] * image[..., 3:] + (1.0 - image[..., 3:]))


def clay(vertices: NDArray, faces: NDArray, view: mifit.Camera, colours: NDArray | None = None) -> NDArray[np.uint8]:
    """A mesh of grey clay, or of colours (V, 3), lit from beside the camera."""
    surface = trace_mesh(vertices, faces, view, 2)
    normals = vertex_normals(vertices, faces)
    normal = (normals[faces[surface.face]] * surface.weights[..., None]).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    light = surface.view + np.float32([0.3, 0.5, 0.0])
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    shade = 0.08 + 0.6 * np.clip((normal * light).sum(axis=1), 0.0, 1.0)
    colour = np.ones((1, 3)) if colours is None else (colours[faces[surface.face]] * surface.weights[..., None]).sum(1)
    return on_white(surface.image((shade[:, None] * colour).astype(np.float32)))


def coloured(normal: NDArray) -> NDArray[np.float32]:
    """Normals (N, 3) in camera space as linear colours."""
    return ((0.5 + 0.5 * normal * [1, -1, -1]) ** 2.2).astype(np.float32)


def near(mesh: trimesh.Trimesh, points: NDArray, candidates: int = 12) -> NDArray[np.float64]:
    """The nearest points (N, 3) on a mesh, among the triangles with the nearest middles."""
    index = cKDTree(mesh.triangles_center).query(points, candidates)[1]
    given = mesh.triangles[index].reshape(-1, 3, 3), np.repeat(points, candidates, axis=0)
    found = trimesh.triangles.closest_point(*given).reshape(-1, candidates, 3)
    best = np.linalg.norm(found - points[:, None], axis=2).argmin(axis=1)
    return found[np.arange(len(points)), best]


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


def strip(shown: Head) -> NDArray[np.uint8]:
    """Two photographs in; albedo, specular reflection, normals, mesh and scan, relit."""
    pictures = {
        "in": shown.photograph(shown.cameras[0]),
        "in ": shown.photograph(shown.cameras[1]),
        "diffuse albedo": shown.shown(lambda m: m.diffuse),
        "specular albedo": shown.shown(lambda m: np.repeat(8.0 * m.specular[:, None], 3, axis=1)),
        "normals": shown.normals(refined=True),
        "mesh": shown.mesh(),
        "scan": shown.scan(),
        "relit": shown.lit("sunset"),
    }
    return row([tile(image, label.strip()) for label, image in pictures.items()])


def hero(size: int) -> None:
    """The first picture of the README."""
    page([strip(head("scan_city", size)), strip(head("emily", size).front())], IMAGES / "hero.jpg")


def gallery(size: int) -> None:
    """Every head: the held-out photograph, our view of it, and three lights."""
    rows = []
    for name in HEADS:
        one = head(name, size)
        own = {"held-out photograph": one.photograph(one.third), "full": one.lit()}
        relit = {light: one.lit(light) for light in ("city", "studio", "sunset", "apartment")}
        rows.append(row([tile(image, f"{label}") for label, image in (own | relit).items()]))
    page(rows, IMAGES / "gallery.jpg")


def light(size: int, frames: int = 24) -> None:
    """A light that turns about a head, from three sides, as a small moving picture."""
    one = head("scan_city", size)
    turns = [360.0 * k / frames for k in range(frames)]
    turned = one.result.relight(SHARED / "hdri" / "sunset.hdr", rotations=turns, exposure="auto")
    views = [one.beside(yaw) for yaw in (-30, 0, 30)]
    boxes = [around(one.result.render(view, 0, "pca", samples=1)[..., 3] > 0) for view in views]
    images = [
        Image.fromarray(row([tile(on_white(lit.render(v, 0))[box]) for v, box in zip(views, boxes, strict=True)]))
        for lit in turned
    ]
    path = IMAGES / "light.webp"
    images[0].save(path, save_all=True, append_images=images[1:], duration=90, loop=0, quality=70)
    print(f"wrote {path.relative_to(ROOT)}")


def sides(size: int) -> None:
    """Two heads from five sides, each under a light of its own."""
    views = list(zip((-70, -35, 0, 35, 70), ("city", "studio", "sunset", "apartment", "softbox"), strict=True))
    rows = [row([tile(head(n, size).side(e, y), e) for y, e in views]) for n in ("scan_city", "emily")]
    page(rows, IMAGES / "five_sides.jpg")


def methods(size: int) -> None:
    """A strip for each step, and one for all of them."""
    one = head("scan_city", size)
    specular = one.shown(lambda m: np.repeat(8.0 * m.specular[:, None], 3, axis=1))
    diffuse, start, mesh = one.shown(lambda m: m.diffuse), one.start(), one.mesh()
    refined, marked = one.normals(refined=True), one.marked()
    strips = {
        "geometry": {"photograph, landmarks": marked, "model's fit": start, "scan": one.scan()},
        "surface": {"model's fit": start, "surface": mesh, "scan": one.scan(), f"+-{FAR_MM:g} mm": one.apart()},
        "reflectance": {
            "held-out photograph": one.photograph(one.third), "full": one.lit(),
            "diffuse albedo": diffuse, "specular albedo x 8": specular,
        },
        "normals": {"normals of the mesh": one.normals(refined=False), "refined normals": refined},
        "pipeline": {
            "1 landmarks": marked, "2 model's fit": start, "3 surface": mesh, "4 diffuse albedo": diffuse,
            "5 specular albedo": specular, "6 normals": refined, "7 relit": one.lit("sunset"),
        },
    }  # fmt: skip
    for name, pictures in strips.items():
        page([row([tile(image, label) for label, image in pictures.items()])], IMAGES / f"{name}.jpg")


def table(size: int) -> None:
    """Heads as in Table 1: photographs, maps, the held-out view, another light."""
    rows = []
    for one in (head(name, size) for name in MADE):
        pictures = {
            "in": one.photograph(one.cameras[0]),
            "in ": one.photograph(one.cameras[1]),
            "diffuse albedo": one.shown(lambda m: m.diffuse),
            "specular albedo x 8": one.shown(lambda m: np.repeat(8.0 * m.specular[:, None], 3, axis=1)),
            "held-out photograph": one.photograph(one.third),
            "full": one.lit(),
            "sunset": one.lit("sunset"),
        }
        rows.append(row([tile(image, label.strip()) for label, image in pictures.items()]))
    page(rows, IMAGES / "table.jpg")


def builtin(size: int) -> None:
    """The built-in model: its mean from three sides, and expressions."""
    model = mifit.MorphableModel.load("builtin")
    colours = 1.8 * np.clip(model.albedo(), 0.0, 1.0)

    def drawn(expression: NDArray | None, yaw: float) -> NDArray[np.uint8]:
        vertices = model.shape(None, expression) * np.float32(model.unit_mm / 10.0)
        angle, middle = np.radians(yaw), (vertices.max(axis=0) + vertices.min(axis=0)) / 2.0
        eye = middle + 90.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        view = mifit.Camera.look_at(eye, middle, width=3 * TILE // 4, height=TILE, fov=15.0)
        return tile(clay(vertices, model.faces, view, colours))

    def unit(names: tuple[str, ...]) -> NDArray[np.float64]:
        return 2.0 * np.isin(model.expression_names, names)

    moved = [drawn(unit(names), 20.0) for names in EXPRESSIONS]
    tiles = [drawn(None, 0.0), drawn(None, 45.0), drawn(None, 90.0), *moved]
    page([row(tiles[:5]), row(tiles[5:])], IMAGES / "builtin.jpg")


def film(size: int) -> None:
    """How two phones stand before a face, from above."""
    image = np.full((420, 760, 3), 255, np.uint8)
    head, dark, grey, warm = (380, 110), (60, 60, 60), (170, 170, 170), (250, 190, 60)

    def text(words: str, x: int, y: int) -> None:
        width = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)[0][0]
        cv2.putText(image, words, (x - width // 2, y), cv2.FONT_HERSHEY_SIMPLEX, 0.55, dark, 1, cv2.LINE_AA)

    for side in (-1, 1):
        angle = np.radians(20.0 * side)
        away, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
        phone = head + 240.0 * away
        cv2.line(image, head, tuple(phone.astype(int)), grey, 1, cv2.LINE_AA)
        corners = [phone + 28 * i * across + (6 + 6 * j) * away for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        cv2.fillConvexPoly(image, np.round(corners).astype(np.int32), dark, cv2.LINE_AA)
        text("left" if side < 0 else "right", round(phone[0]), round(phone[1]) + 40)
        cv2.circle(image, (380 + 300 * side, 130), 26, warm, -1, cv2.LINE_AA)
        text("soft light", 380 + 300 * side, 180)
    cv2.ellipse(image, head, (150, 150), 90, -20, 20, grey, 1, cv2.LINE_AA)
    text("30 to 50 degrees", 380, 290)
    cv2.ellipse(image, head, (42, 54), 0, 0, 360, (225, 180, 150), -1, cv2.LINE_AA)
    cv2.fillConvexPoly(image, np.int32([[371, 160], [389, 160], [380, 180]]), (225, 180, 150), cv2.LINE_AA)
    Image.fromarray(image).save(IMAGES / "film.png", optimize=True)
    print("wrote docs/images/film.png")


PICTURES = {
    "hero": hero, "gallery": gallery, "light": light, "sides": sides, "table": table, "methods": methods,
    "builtin": builtin, "film": film,
}  # fmt: skip


def main() -> None:
    """Make the pictures that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512, help="texels along the side of the maps")
    parser.add_argument("--only", nargs="*", choices=PICTURES, default=list(PICTURES))
    parser.add_argument("--keep", action="store_true", help="take the fits in out/pictures")
    given = parser.parse_args()
    if not ICT.exists():
        raise SystemExit(f"{ICT}: not found; the pictures need the shared captures and models")
    if not given.keep:
        shutil.rmtree(WORK, ignore_errors=True)
    mifit.set_variant("auto")
    IMAGES.mkdir(exist_ok=True)
    for name in given.only:
        started = time.perf_counter()
        PICTURES[name](given.size)
        print(f"{name}: {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
