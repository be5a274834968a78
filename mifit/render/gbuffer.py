"""Primary visibility, found once per geometry and cached as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import OFFSET, aligned, dr, mi, on_device
from mifit.core.arrays import Recent
from mifit.core.camera import Camera
from mifit.core.mesh import lengths
from mifit.errors import InputError

MESH_POSITIONS = "vertex_positions"
MESH_FACES = "faces"
MESH_TEXCOORDS = "vertex_texcoords"
MESH_NORMALS = "vertex_normals"
MESH_BUFFERS = (MESH_POSITIONS, MESH_FACES, MESH_TEXCOORDS, MESH_NORMALS)

_Hits = tuple[tuple[slice, slice], NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Pixels, and for each of them face, two barycentric weights and depth."""


@dataclass(frozen=True)
class GBuffer:
    """What each pixel's central ray hits first.

    ``face`` (H, W), -1 where nothing is hit; ``weights`` (H, W, 3) of the face's corners; ``depth`` (H, W) along the
    camera's z axis in the scene's units, infinite where nothing is hit.
    """

    face: NDArray[np.int32]
    weights: NDArray[np.float32]
    depth: NDArray[np.float32]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """(H, W) pixels that see the mesh."""
        return self.face >= 0


def make_mesh(
    vertices: NDArray,
    faces: NDArray,
    uv: NDArray | None = None,
    normals: NDArray | None = None,
    bsdf: mi.BSDF | None = None,
) -> mi.Mesh:
    """An ``mi.Mesh`` from arrays, with one UV pair and normal per vertex where given; without normals it is shaded
    flat.

    InputError for wrong shapes, indices out of range or positions that are not finite.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise InputError(f"vertices: found shape {vertices.shape}, expected (V, 3)")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise InputError(f"faces: found shape {faces.shape}, expected (F, 3)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"faces: found indices {faces.min()} to {faces.max()}, expected 0 to {len(vertices) - 1}")
    if not np.isfinite(vertices).all():
        raise InputError("vertices: found values that are not finite")
    properties = mi.Properties()
    if bsdf is not None:
        properties["mesh_bsdf"] = bsdf
    mesh = mi.Mesh(
        "surface",
        vertex_count=len(vertices),
        face_count=len(faces),
        props=properties,
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(mesh)
    parameters[MESH_POSITIONS] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    parameters[MESH_FACES] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    if uv is not None:
        parameters[MESH_TEXCOORDS] = np.ascontiguousarray(uv, dtype=np.float32).ravel()
    if normals is not None:
        parameters[MESH_NORMALS] = np.ascontiguousarray(normals, dtype=np.float32).ravel()
    parameters.update()
    return mesh


class SurfaceScene:
    """A mesh that rays can be sent at: ``vertices`` (V, 3) in world space and ``faces`` (F, 3).

    ``rays`` is the ``mi.Scene``. InputError for wrong shapes, indices out of range or positions that are not finite.
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        self._mesh = make_mesh(vertices, faces)
        self.vertices, self.faces = np.asarray(vertices), np.asarray(faces)
        self.rays = mi.load_dict({"type": "scene", "mesh": self._mesh})
        self._parameters = mi.traverse(self.rays)
        self._key = next(k for k in self._parameters.keys() if k.endswith(MESH_POSITIONS))
        self._diagonal = _diagonal(vertices)
        self._kept = Recent[_Hits](4)

    def update(self, vertices: NDArray) -> None:
        """Move the mesh to new positions (V, 3) and rebuild what rays are traced against."""
        vertices = np.asarray(vertices)
        if vertices.shape != (len(self.vertices), 3):
            raise InputError(f"vertices: found shape {vertices.shape}, expected ({len(self.vertices)}, 3)")
        if not np.isfinite(vertices).all():
            raise InputError("vertices: found values that are not finite")
        self._parameters[self._key] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
        self._parameters.update()
        self.vertices = vertices
        self._diagonal = _diagonal(vertices)
        self._kept.clear()

    def gbuffer(self, camera: Camera) -> GBuffer:
        """Intersect the rays through all pixel centres of an undistorted camera; InputError for lens distortion."""
        if any(camera.distortion):
            raise InputError(f"camera {camera.name}: found lens distortion, expected an undistorted camera")
        box, face, u, v, depth = self._hits(camera)
        shape = (camera.height, camera.width)
        out = GBuffer(
            np.full(shape, -1, np.int32), np.zeros((*shape, 3), np.float32), np.full(shape, np.inf, np.float32)
        )
        out.face[box], out.depth[box] = face, depth
        weights = out.weights[box]
        weights[..., 1], weights[..., 2] = u, v
        np.subtract(1.0 - u, v, out=weights[..., 0], where=face >= 0)
        return out

    def _hits(self, camera: Camera) -> _Hits:
        """What a camera's rays hit; the last ones are kept, since stages, pictures and masks ask for the same."""
        if camera.width * camera.height > 1 << 20:  # four of them would fill the memory
            return self._traced(camera)
        key = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        full = (*key, camera.rotation.tobytes(), camera.position.tobytes())
        return self._kept.get(full, lambda: self._traced(camera))

    def _traced(self, camera: Camera) -> _Hits:
        box = self._box(camera)
        part = tuple(len(range(size)[side]) for side, size in zip(box, (camera.height, camera.width), strict=True))
        if not all(part):
            nothing = np.zeros(part, np.float32)
            return box, np.full(part, -1, np.int32), nothing, nothing, nothing
        directions, along = _box_rays(camera, box)
        ray = mi.Ray3f(mi.Point3f(camera.position), directions)
        hit = self.rays.ray_intersect_preliminary(ray, coherent=True)
        z = hit.t * along
        dr.eval(hit.t, z, hit.prim_uv, hit.prim_index)  # one kernel: each array read would trace the rays again
        t = np.array(hit.t, dtype=np.float32)
        valid = np.isfinite(t)
        face = np.where(valid, np.array(hit.prim_index).astype(np.int32), -1)
        # Rays that hit nothing hold any bits in their coordinates: zeros, so that no sum of them warns.
        u, v = (np.where(valid, np.array(x, dtype=np.float32), np.float32(0)) for x in hit.prim_uv)
        depth = np.where(valid, np.array(z, dtype=np.float32), np.float32(np.inf))
        return box, face.reshape(part), u.reshape(part), v.reshape(part), depth.reshape(part)

    def _box(self, camera: Camera) -> tuple[slice, slice]:
        """Rows and columns of the pixels that can show the mesh."""
        q = camera.to_camera(np.asarray(self.vertices, dtype=np.float64))
        if not (q[:, 2] > 1e-6 * self._diagonal).all():
            return slice(None), slice(None)  # what lies beside or behind the camera has no outline in the image
        x, y = camera.fx * q[:, 0] / q[:, 2] + camera.cx, camera.fy * q[:, 1] / q[:, 2] + camera.cy
        # a pixel to spare: rays are sent at vertices in single precision
        ends = [
            [int(np.clip(f, 0, size)) for f in (np.floor(p.min()) - 1, np.ceil(p.max()) + 1)]
            for p, size in ((y, camera.height), (x, camera.width))
        ]
        return slice(*ends[0]), slice(*ends[1])

    def visible_from(self, points: NDArray, origin: NDArray) -> NDArray[np.bool_]:
        """(N,) bool: nothing of the mesh lies between surface points (N, 3) and an origin (3,) outside the mesh.

        The far end of each ray, `OFFSET` of the scene's diagonal, is left out, so that a point isn't hidden
        by its own surface. A point that faces away is hidden by what lies in front of it; at silhouettes the caller
        should test the normal as well.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(points):
            return np.zeros(0, dtype=bool)
        direction = points - np.asarray(origin, dtype=np.float64)
        distance = lengths(direction)
        direction /= np.maximum(distance, 1e-30)[:, None]
        reach = np.maximum(distance - OFFSET * self._diagonal, 0.0)
        ray = mi.Ray3f(mi.Point3f(np.asarray(origin, dtype=np.float64)), on_device(mi.Vector3f, direction))
        ray.maxt = mi.Float(aligned(reach))
        hit = self.rays.ray_test(ray)
        return ~np.array(hit).astype(bool)

    def open_towards(self, points: NDArray, normals: NDArray, directions: NDArray) -> NDArray[np.uint32]:
        """(N,) uint32 whose bit d says whether a surface point sees the distant direction d past the mesh.

        Rays start off the surface by `OFFSET` of the scene's diagonal along the normal. A direction below
        the horizon counts as hidden. ``points`` and unit ``normals`` are (N, 3), unit ``directions`` (D, 3), at most
        32.
        """
        if len(directions) > 32:
            raise InputError(f"directions: found {len(directions)}, expected at most 32")
        if not len(points):
            return np.zeros(0, np.uint32)
        n = on_device(mi.Vector3f, normals)
        # Opaque: the kernel is compiled once, not once for every mesh.
        origin = on_device(mi.Vector3f, points) + dr.opaque(mi.Float, OFFSET * self._diagonal) * n
        toward = mi.Float(aligned(directions).ravel())

        def body(i: mi.UInt, bits: mi.UInt) -> tuple[mi.UInt, mi.UInt]:
            d = mi.Vector3f(*(dr.gather(mi.Float, toward, 3 * i + k) for k in range(3)))
            above = dr.dot(n, d) > 0.0
            seen = above & ~self.rays.ray_test(mi.Ray3f(mi.Point3f(origin), d), active=above)
            return i + 1, bits | dr.select(seen, mi.UInt(1) << i, mi.UInt(0))

        start = (mi.UInt(0), dr.zeros(mi.UInt, len(points)))
        _, bits = dr.while_loop(state=start, cond=lambda i, bits: i < dr.opaque(mi.UInt, len(directions)), body=body)
        return np.array(bits, dtype=np.uint32)


def _box_rays(camera: Camera, box: tuple[slice, slice]) -> tuple[mi.Vector3f, mi.Float]:
    """Unit directions through the centres of a box of pixels, row by row, and their parts along the camera's axis."""
    rows, columns = (range(size)[side] for side, size in zip(box, (camera.height, camera.width), strict=True))
    number = dr.arange(mi.UInt32, len(rows) * len(columns))
    width = dr.opaque(mi.UInt32, len(columns))
    row = number // width
    first, focal = ((rows.start + 0.5 - camera.cy, columns.start + 0.5 - camera.cx), (camera.fy, camera.fx))
    y, x = (
        (mi.Float64(i) + dr.opaque(mi.Float64, start)) / dr.opaque(mi.Float64, f)
        for i, start, f in zip((row, number - row * width), first, focal, strict=True)
    )
    along = dr.rcp(dr.sqrt(x * x + y * y + 1.0))
    turn = [[dr.opaque(mi.Float64, float(value)) for value in line] for line in camera.rotation]
    world = [mi.Float(along * (x * turn[0][k] + y * turn[1][k] + turn[2][k])) for k in range(3)]
    return mi.Vector3f(*world), mi.Float(along)


def _diagonal(vertices: NDArray) -> float:
    return float(np.linalg.norm(np.ptp(np.asarray(vertices, dtype=np.float64), axis=0)))
