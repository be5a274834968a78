"""What the images say about each texel: colour, validity, weight, normal and view of every timestep and camera.

Photometric terms are sums over pixels. Here they are sums over texels, each weighted by the number of pixels that
it covers in a view, so that both sums agree whatever the size of the map, and a texel seen at a grazing angle or
from far away counts for less. Where the images are to be trusted only as far as the mesh is, an observation also weighs
no more than the probability that it shows the point (`stages.trust`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.occlusion import OccludingMesh
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.process import on_all_cores
from mifit.core.uv import TexelMap, bilinear, rasterize_uv
from mifit.errors import InputError
from mifit.stages.shown import face_pixels, footprint, texel_area
from mifit.stages.surface_image import Placed, SurfaceImage
from mifit.stages.trust import agreement, background

if TYPE_CHECKING:
    from mifit.capture import Capture, Frame
    from mifit.morphable import MorphableModel
    from mifit.render.gbuffer import GBuffer

CHUNK_VALUES = 1 << 22
"""Texels x images that are held at a time."""
JUDGED = 1 << 14
"""Texels whose images are compared at a time: what they need stays in a core's cache."""


@dataclass(frozen=True)
class Observations:
    """Observations of N texels by J images; image j is timestep ``step[j]`` of the geometry seen by ``view[j]``.

    Attributes
    ----------
    texel : (N,) int64
        Position of each texel in the `TexelMap`.
    face : (N,) int32, barycentric : (N, 3) float32
        Where on the mesh each texel lies.
    step, camera : (J,) int
        Index of the timestep in the geometry and of the camera in the list of cameras.
    colour : (N, J, 3) float32
        Linear image colour, bilinear; 0 where not observed.
    weight : (N, J) float32
        Pixels that the texel covers, faded at grazing angles, times ``right``; 0 where occluded, outside or invalid.
    clipped : (N, J) bool
        The colour touches a clipped pixel: a lower bound, not a measurement.
    right : (N, J) float32
        Probability that the image shows the point, and not something beside or in front of it.
    point : (N, T, 3), normal : (N, T, 3) float32
        World position and unit normal per timestep.
    view : (N, J, 3) float32
        Unit vectors towards the camera.
    """

    texel: NDArray[np.int64]
    face: NDArray[np.int32]
    barycentric: NDArray[np.float32]
    step: NDArray[np.int64]
    camera: NDArray[np.int64]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    right: NDArray[np.float32]
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

    @classmethod
    def join(cls, parts: Sequence[Observations]) -> Observations:
        """The observations of several sets of texels by the same images."""
        shared: dict[str, Any] = {"step": parts[0].step, "camera": parts[0].camera}
        names = [f.name for f in fields(cls) if f.name not in shared]
        return cls(**shared, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def take(self, rows: NDArray | slice) -> Observations:
        """The observations of some of the texels."""
        return Observations(
            self.texel[rows],
            self.face[rows],
            self.barycentric[rows],
            self.step,
            self.camera,
            self.colour[rows],
            self.weight[rows],
            self.clipped[rows],
            self.right[rows],
            self.point[rows],
            self.normal[rows],
            self.view[rows],
        )


@dataclass(frozen=True)
class Seen:
    """One image's camera, its timestep's mesh, and what each pixel shows of it (``face`` -1: nothing; ``weights``)."""

    camera: Camera
    timestep: int
    vertices: NDArray[np.float64]
    normals: NDArray
    face: NDArray[np.int32]
    weights: NDArray[np.float32]


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
    trust : bool
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
        trust: bool = True,
        whole: bool = False,
        texels: TexelMap | None = None,
    ) -> None:
        if not cameras or not geometry.timesteps:
            raise InputError(
                f"found {len(cameras)} cameras and {len(geometry.timesteps)} timesteps, expected 1 or more of both"
            )
        from mifit.render.visible import occluding_mesh

        shown = model.mapped if whole else model.face_mask
        self.texels: TexelMap = rasterize_uv(model.uv, model.faces_uv, size, shown) if texels is None else texels
        self.facial: NDArray[np.bool_] = model.face_mask[self.texels.face]
        if not len(self.texels.index):
            raise InputError(f"model {model.name}: its face area covers no texel of a map of {size} texels a side")
        self.trust, self.geometry = trust, geometry
        self.faces = model.faces
        self.vertices = [np.asarray(v, dtype=np.float64) for v in geometry.vertices]
        self.normals = [vertex_normals(v, model.faces) for v in self.vertices]
        self.meshes: tuple[OccludingMesh, ...] = tuple(occluding_mesh(v, model.faces) for v in self.vertices)
        self.scenes = [mesh.scene for mesh in self.meshes]
        area = texel_area(model.uv, model.faces_uv, size)
        self._kept: Observations | None = None
        self._images: list[SurfaceImage] = []

        def look(i: int, k: int, camera: Camera, frame: Frame, buffer: GBuffer) -> SurfaceImage:
            covered, edge, outline, facial = face_pixels(
                buffer, self.vertices[i], model.faces, shown, camera, model.face_mask
            )
            unusable = edge | ~covered | ~frame.valid | ~np.isfinite(frame.image).all(-1)
            if whole:
                unusable |= background(frame.image, outline > 0, facial)
            return SurfaceImage(
                i,
                k,
                camera,
                np.where(unusable[..., None], 0, frame.image).astype(np.float32),
                unusable.astype(np.float32),
                frame.clipped.astype(np.float32),
                footprint(self.vertices[i], model.faces, camera, area),
                (outline * (model.unit_mm / geometry.scale)).astype(np.float32),
            )

        for i, timestep in enumerate(geometry.timesteps):
            views = [(k, capture.camera(name), capture.frame(name, timestep)) for k, name in enumerate(cameras)]
            found = [(i, *view, self.scenes[i].gbuffer(view[1])) for view in views]
            self._images += on_all_cores(lambda one: look(*one), found)

    def __len__(self) -> int:
        return len(self.texels.index)

    def views(self) -> Iterator[Seen]:
        """Every image's camera and mesh, in the order of the images."""
        for image in self._images:
            i, buffer = image.step, self.scenes[image.step].gbuffer(image.camera)
            timestep = self.geometry.timesteps[i]
            yield Seen(image.camera, timestep, self.vertices[i], self.normals[i], buffer.face, buffer.weights)

    def without(self, hidden: Sequence[NDArray[np.bool_]]) -> Surface:
        """The same surface with pixels (H, W) of every image left out."""
        less = copy.copy(self)
        less._kept = None
        less._images = [
            replace(
                image,
                colour=np.where(left_out[..., None], np.float32(0), image.colour),
                unusable=np.maximum(image.unusable, left_out.astype(np.float32)),
            )
            for image, left_out in zip(self._images, hidden, strict=True)
        ]
        if self._kept is not None:
            less._kept = self._reread(self._kept, less)
        return less

    def _reread(self, kept: Observations, less: Surface) -> Observations:
        """Observations of all texels with those read anew that are near pixels that another surface leaves out."""
        touched = np.zeros(len(kept.texel), dtype=bool)
        for k, (image, other) in enumerate(zip(self._images, less._images, strict=True)):
            rows = np.flatnonzero(kept.weight[:, k] > 0)
            pixel = image.camera.project(kept.point[rows, image.step].astype(np.float64)) - 0.5
            touched[rows] |= bilinear(other.unusable - image.unusable, pixel[:, 0], pixel[:, 1]) > 0
        rows = np.flatnonzero(touched)
        again = less._observe(rows)
        changed = {name: getattr(kept, name).copy() for name in ("colour", "weight", "clipped", "right")}
        for name, values in changed.items():
            values[rows] = getattr(again, name)
        return replace(kept, **changed)

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
        step = max(256, 8 * CHUNK_VALUES // (self.image_count * max(values, 8)))
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

    def quality(self, dark: float = 0.0) -> NDArray[np.float32]:
        """(N,) how often, how well and how surely each texel was measured: 0 never, 1 by half of the images or more.

        At linear colours of ``dark`` and below light isn't known well enough to measure an albedo.
        """
        out = np.zeros(len(self), dtype=np.float32)
        for part in self.chunks():
            seen = self.observe(part)
            cosine = np.einsum("njk,njk->nj", seen.image_normal, seen.view)
            good = np.where(seen.measured > 0, np.clip(cosine, 0.0, 1.0) * seen.right, 0.0)
            good *= np.maximum(1.0 - (dark / np.maximum(seen.colour.mean(-1), 1e-12)) ** 2, 0.0)
            out[part] = np.minimum(good.sum(1) / max(1.0, 0.35 * self.image_count), 1.0)
        return out

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
        colour = np.zeros((n, j, 3), dtype=np.float32)
        weight = np.zeros((n, j), dtype=np.float32)
        clipped = np.zeros((n, j), dtype=bool)
        wrong = np.zeros((n, j), dtype=np.float32)
        view = np.zeros((n, j, 3), dtype=np.float32)
        point = np.zeros((n, t, 3), dtype=np.float32)
        normal = np.zeros((n, t, 3), dtype=np.float32)
        for i in range(t):
            point[:, i] = interpolate(self.vertices[i], self.faces, face, weights)
            normal[:, i] = normalize(interpolate(self.normals[i], self.faces, face, weights))

        def place(image: SurfaceImage) -> Placed:
            return Placed.of(image, point[:, image.step].astype(np.float64), normal[:, image.step], face)

        def read(number: int) -> None:
            view[:, number] = placed[number].view
            placed[number].read(self.trust, colour[:, number], weight[:, number], clipped[:, number], wrong[:, number])

        placed = on_all_cores(place, self._images)
        # Rays take all cores by themselves.
        placed = [each.seen(self.scenes[each.image.step]) for each in placed]
        on_all_cores(read, range(j))
        step = np.array([m.step for m in self._images])
        right = np.float32(1.0) - wrong
        if self.trust:
            rows = [slice(at, at + JUDGED) for at in range(0, n, JUDGED)]
            parts = on_all_cores(lambda r: agreement(colour[r], weight[r], wrong[r], clipped[r], step), rows)
            right = np.concatenate(parts) if parts else right
            weight *= np.minimum(right, 1.0 - wrong)  # confirmed or not, a twin of a view adds nothing new
        return Observations(
            texel,
            face,
            weights,
            step,
            np.array([m.camera_index for m in self._images]),
            colour,
            weight,
            clipped,
            right,
            point,
            normal,
            view,
        )
