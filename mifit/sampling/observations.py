"""Images read at the texels of a map: colour, validity, weight, normal and view of every timestep and camera.

Photometric terms are sums over pixels. Here they are sums over texels, each weighted by the number of pixels that
it covers in a view, so that both sums agree whatever the size of the map, and a texel seen at an oblique angle or
from far away counts for less. Where the images are reliable only as far as the mesh is, an observation also weighs
no more than the probability that it shows the point (`sampling.visibility`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.occlusion import OccludingMesh
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate, hidden
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.process import BLOCK, on_all_cores
from mifit.core.uv import TexelMap, bilinear, rasterize_uv
from mifit.errors import InputError
from mifit.sampling.visibility import FacePixels, background, facing, footprint, outlier_prior, texel_area

if TYPE_CHECKING:
    from mifit.capture import Capture, Frame
    from mifit.morphable import MorphableModel
    from mifit.render.gbuffer import GBuffer

SHARED = ("step", "camera")
"""Fields of `Observations` that are the same for all texels."""


@dataclass(frozen=True)
class Observations:
    """Observations of N texels by J images; image j is timestep ``step[j]`` of the geometry seen by ``camera[j]``.

    Attributes
    ----------
    step, camera : (J,) int
        Index of the timestep in the geometry and of the camera in the list of cameras.
    texel : (N,) int64
        Position of each texel in the `TexelMap`.
    face : (N,) int32, barycentric : (N, 3) float32
        Where on the mesh each texel lies.
    colour : (N, J, 3) float32
        Linear image colour, bilinear; 0 where not observed.
    weight : (N, J) float32
        Pixels that the texel covers, less at grazing angles, times ``inlier``; 0 where occluded, outside or invalid.
    clipped : (N, J) bool
        The colour touches a clipped pixel: a lower bound, not a measurement.
    inlier : (N, J) float32
        Probability that the image shows the point, and not something beside or in front of it.
    point : (N, T, 3), normal : (N, T, 3) float32
        World position and unit normal per timestep.
    view : (N, J, 3) float32
        Unit vectors towards the camera.
    """

    step: NDArray[np.int64]
    camera: NDArray[np.int64]
    texel: NDArray[np.int64]
    face: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    inlier: NDArray[np.float32]
    point: NDArray[np.float32]
    normal: NDArray[np.float32]
    view: NDArray[np.float32]

    @property
    def measured(self) -> NDArray[np.float32]:
        """(N, J) weight of the observations that measure: clipped ones count nothing."""
        return np.where(self.clipped, np.float32(0.0), self.weight)

    @property
    def image_normal(self) -> NDArray[np.float32]:
        """(N, J, 3) unit normal per image."""
        return self.normal[:, self.step]

    def spread(self, values: NDArray) -> NDArray:
        """(N, J, ...) values (M, ...) of the observations of some weight, among zeros."""
        out = np.zeros((*self.weight.shape, *values.shape[1:]), values.dtype)
        out[self.weight > 0] = values
        return out

    @classmethod
    def join(cls, parts: Sequence[Observations]) -> Observations:
        """The observations of several sets of texels by the same images."""
        names = [f.name for f in fields(cls) if f.name not in SHARED]
        return replace(parts[0], **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def take(self, rows: NDArray | slice) -> Observations:
        """The observations of some of the texels."""
        names = [f.name for f in fields(self) if f.name not in SHARED]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True)
class Seen:
    """One image's camera, its timestep's mesh, and what each pixel shows of it (``face`` -1: nothing; ``weights``)."""

    camera: Camera
    timestep: int
    vertices: NDArray[np.float64]
    normals: NDArray
    face: NDArray[np.int32]
    weights: NDArray[np.float32]


@dataclass(frozen=True)
class SurfaceImage:
    """One image with what is needed to read it at surface points.

    Attributes
    ----------
    step, camera_index : int
    camera : Camera
    colour : (H, W, 3)
        0 where unusable.
    unusable, clipped : (H, W)
        1 where invalid, not the face area or at an occlusion edge; 1 where clipped.
    footprint : (F,)
        Pixels per texel, 0 for faces that face away.
    outline : (H, W)
        Pixels to the nearest outline times millimetres per unit of length.
    """

    step: int
    camera_index: int
    camera: Camera
    colour: NDArray[np.float32]
    unusable: NDArray[np.float32]
    clipped: NDArray[np.float32]
    footprint: NDArray[np.float32]
    outline: NDArray[np.float32]

    def read(self, x: NDArray, y: NDArray) -> NDArray[np.float32]:
        """(N, 3) colours of the usable pixels about integer-centred columns and rows (N,)."""
        lost = np.minimum(bilinear(self.unusable, x, y), np.float32(0.5))
        return np.asarray(bilinear(self.colour, x, y) / (1.0 - lost)[:, None], np.float32)


class Surface:
    """The images of a capture, read at the surface points of a map.

    Parameters
    ----------
    capture, model, geometry
        Images, topology and fitted vertices; the timesteps are the geometry's.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    size : int
        Side of the map in texels.
    robust : bool
        Weigh observations by how likely they show the point; without it by pixels alone, as the paper's sums do.
    whole : bool
        All texels that the model's maps hold, neck, scalp and eyes included, and not those of its face area alone.
    texels : TexelMap, optional
        These texels, where another surface of the same model has found them already.

    Raises
    ------
    InputError
        No camera, no timestep, or a face area that covers no texel.
    """

    def __init__(
        self,
        capture: Capture,
        model: MorphableModel,
        geometry: GeometryEstimate,
        cameras: Sequence[str],
        size: int,
        robust: bool = True,
        whole: bool = False,
        texels: TexelMap | None = None,
    ) -> None:
        if not cameras or not geometry.timesteps:
            raise InputError(
                f"found {len(cameras)} cameras and {len(geometry.timesteps)} timesteps, expected 1 or more of both"
            )
        from mifit.render.visible import occluding_mesh

        mapped = model.mapped if whole else model.face_mask
        self.texels: TexelMap = rasterize_uv(model.uv, model.faces_uv, size, mapped) if texels is None else texels
        self.facial: NDArray[np.bool_] = model.face_mask[self.texels.face]
        if not len(self.texels.index):
            raise InputError(f"model {model.name}: its face area covers no texel of a map of {size} texels a side")
        self.robust, self.geometry, self.faces = robust, geometry, model.faces
        self.vertices = [np.asarray(v, dtype=np.float64) for v in geometry.vertices]
        self.normals = [vertex_normals(v, model.faces) for v in self.vertices]
        self.meshes: tuple[OccludingMesh, ...] = tuple(occluding_mesh(v, model.faces) for v in self.vertices)
        area, millimetres = texel_area(model.uv, model.faces_uv, size), model.unit_mm / geometry.scale
        self._kept: Observations | None = None
        self._images: list[SurfaceImage] = []

        def prepare(i: int, k: int, camera: Camera, frame: Frame, buffer: GBuffer) -> SurfaceImage:
            pixels = FacePixels.of(buffer, self.vertices[i], model.faces, camera, (mapped, model.face_mask))
            unusable = pixels.edge | ~pixels.covered | ~frame.valid | ~np.isfinite(frame.image).all(-1)
            if whole:
                unusable |= background(frame.image, pixels.outline > 0, pixels.facial)
            return SurfaceImage(
                i,
                k,
                camera,
                np.where(unusable[..., None], 0, frame.image).astype(np.float32),
                unusable.astype(np.float32),
                frame.clipped.astype(np.float32),
                footprint(self.vertices[i], model.faces, camera, area),
                (pixels.outline * millimetres).astype(np.float32),
            )

        for i, timestep in enumerate(geometry.timesteps):
            views = [(k, capture.camera(name), capture.frame(name, timestep)) for k, name in enumerate(cameras)]
            found = [(i, *view, self.meshes[i].scene.gbuffer(view[1])) for view in views]
            self._images += on_all_cores(lambda one: prepare(*one), found)

    def __len__(self) -> int:
        return len(self.texels.index)

    def views(self) -> Iterator[Seen]:
        """Every image's camera and mesh, in the order of the images."""
        for image in self._images:
            i, buffer = image.step, self.meshes[image.step].scene.gbuffer(image.camera)
            timestep = self.geometry.timesteps[i]
            yield Seen(image.camera, timestep, self.vertices[i], self.normals[i], buffer.face, buffer.weights)

    def without(self, masks: Sequence[NDArray[np.bool_]]) -> Surface:
        """The same surface with pixels (H, W) of every image left out."""
        if not any(left_out.any() for left_out in masks):
            return self
        less = copy.copy(self)
        less._kept = None
        less._images = [
            replace(
                image,
                colour=np.where(left_out[..., None], np.float32(0), image.colour),
                unusable=np.maximum(image.unusable, left_out.astype(np.float32)),
            )
            for image, left_out in zip(self._images, masks, strict=True)
        ]
        return less

    def without_hidden(self, reflectance: ReflectanceEstimate) -> Surface:
        """The same surface without what stage 2 found in front of the face; as it is where images have no labels."""
        found = [reflectance.label(image.camera.name, self.geometry.timesteps[image.step]) for image in self._images]
        shapes = [image.unusable.shape for image in self._images]
        pairs = zip(found, shapes, strict=True)
        return self.without([np.zeros(shape, bool) if labels is None else hidden(labels) for labels, shape in pairs])

    @property
    def image_count(self) -> int:
        """Number of images J."""
        return len(self._images)

    @property
    def pairs(self) -> NDArray[np.int64]:
        """(P, 2) images of the same timestep: the first camera's with each other's."""
        first = {m.step: i for i, m in reversed(list(enumerate(self._images)))}
        pairs = [(first[m.step], i) for i, m in enumerate(self._images) if i != first[m.step]]
        return np.array(pairs, dtype=np.int64).reshape(-1, 2)

    def chunks(self, values: int = 8) -> list[NDArray[np.int64]]:
        """All texels in parts that bound the memory of so many values per observation."""
        step = max(256, 32 * BLOCK // (self.image_count * max(values, 8)))
        return [np.arange(i, min(i + step, len(self))) for i in range(0, len(self), step)]

    def sample(self, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Random texels of the face area among those that some image measures, ascending; at most ``count``.

        Raises
        ------
        InputError
            No image shows the face.
        """
        order = rng.permutation(np.flatnonzero(self.facial))
        found: list[NDArray] = []
        total = 0
        for start in range(0, len(order), 2 * count):
            part = order[start : start + 2 * count]
            part = part[self.observe(part).measured.sum(1) > 0]
            found.append(part)
            total += len(part)
            if total >= count:
                break
        if not total:
            raise InputError(
                "reflectance: no image shows the fitted face; found 0 visible texels. Check the cameras' calibration "
                "and the geometry, and whether all pixels of the face are clipped or invalid"
            )
        return np.sort(np.concatenate(found)[:count])

    def quality(self) -> NDArray[np.float32]:
        """(N,) how often, how well and how surely each texel was measured: 0 never, 1 by half of the images or more."""
        out = np.zeros(len(self), dtype=np.float32)
        for part in self.chunks():
            seen = self.observe(part)
            cosine = np.einsum("njk,njk->nj", seen.image_normal, seen.view)
            good = np.where(seen.measured > 0, np.clip(cosine, 0.0, 1.0) * seen.inlier, 0.0)
            out[part] = np.minimum(good.sum(1) / max(1.0, 0.35 * self.image_count), 1.0)
        return out

    def brightness(self) -> NDArray[np.float32]:
        """(N,) mean linear colour that images show of each texel, over channels too; 0 where none does."""
        out = np.zeros(len(self), dtype=np.float32)
        for part in self.chunks():
            seen = self.observe(part)
            total = (seen.measured * seen.colour.mean(-1)).sum(1)
            out[part] = total / np.maximum(seen.measured.sum(1), 1e-12)
        return out

    def colours(self, seen: Observations, vertices: Sequence[NDArray]) -> NDArray[np.float32]:
        """(N, J, 3) colours of observed texels whose timesteps' vertices (V, 3) have moved a little; 0 where unseen."""
        found = np.zeros_like(seen.colour)
        corners = self.faces, seen.face, seen.barycentric

        def read(k: int) -> None:
            image, rows = self._images[k], np.flatnonzero(seen.weight[:, k])
            points = interpolate(vertices[image.step], *corners)[rows]
            found[rows, k] = image.read(*(image.camera.project(points).T - 0.5))

        on_all_cores(read, range(len(self._images)))
        return found

    def observe(self, texel: NDArray[np.int64]) -> Observations:
        """Read all images at some of the texels (positions in the `TexelMap`).

        Where all texels fit into one of `chunks`, they are read once and kept.
        """
        if len(self.chunks()) > 1:
            return self._observe(texel)
        if self._kept is None:
            self._kept = self._observe(np.arange(len(self)))
        return self._kept.take(texel)

    def _observe(self, texel: NDArray[np.int64]) -> Observations:
        face, weights = self.texels.face[texel], self.texels.weights[texel]
        n, j, t = len(texel), len(self._images), len(self.vertices)
        colour, view = (np.zeros((n, j, 3), dtype=np.float32) for _ in range(2))
        weight, cosine = (np.zeros((n, j), dtype=np.float32) for _ in range(2))
        inlier = np.ones((n, j), dtype=np.float32)
        clipped = np.zeros((n, j), dtype=bool)
        point, normal = (np.zeros((n, t, 3), dtype=np.float32) for _ in range(2))
        for i in range(t):
            point[:, i] = interpolate(self.vertices[i], self.faces, face, weights)
            normal[:, i] = normalize(interpolate(self.normals[i], self.faces, face, weights))

        def place(k: int) -> tuple[NDArray, NDArray]:
            """Texels that face camera k before usable pixels, and where in the image."""
            image, camera = self._images[k], self._images[k].camera
            view[:, k] = normalize(camera.position.astype(np.float32) - point[:, image.step])
            cosine[:, k] = np.einsum("nk,nk->n", normal[:, image.step], view[:, k])
            weight[:, k] = image.footprint[face] * facing(cosine[:, k])
            rows = np.flatnonzero(weight[:, k])
            pixel = camera.project(point[rows, image.step]).T - 0.5
            far = np.array([[camera.width - 1], [camera.height - 1]])
            inside = np.logical_and(*((pixel >= 0) & (pixel <= far)))
            weight[rows[~inside], k] = 0.0
            rows, pixel = rows[inside], pixel[:, inside]
            usable = bilinear(image.unusable, *pixel) < 0.5
            weight[rows[~usable], k] = 0.0
            return rows[usable], pixel[:, usable]

        def read(k: int) -> None:
            image, camera, (rows, pixel) = self._images[k], self._images[k].camera, places[k]
            colour[rows, k] = image.read(*pixel)
            clipped[rows, k] = bilinear(image.clipped, *pixel) > 0.0
            if self.robust:
                depth = (point[rows, image.step] - camera.position) @ camera.rotation[2]
                millimetres = bilinear(image.outline, *pixel) * depth / camera.fx
                inlier[rows, k] = 1.0 - outlier_prior(cosine[rows, k], millimetres)

        places = on_all_cores(place, range(j))
        for k, (image, (rows, pixel)) in enumerate(zip(self._images, places, strict=True)):
            # Rays take all cores by themselves.
            visible = self.meshes[image.step].scene.visible_from(point[rows, image.step], image.camera.position)
            weight[rows[~visible], k] = 0.0
            places[k] = rows[visible], pixel[:, visible]
        on_all_cores(read, range(j))
        weight *= inlier
        step = np.array([image.step for image in self._images])
        camera = np.array([image.camera_index for image in self._images])
        return Observations(step, camera, texel, face, weights, colour, weight, clipped, inlier, point, normal, view)
