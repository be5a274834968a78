"""What a mesh's vertices receive from all around: the part of transport that no light changes.

Which directions a vertex sees, and which other parts of the mesh, depends on the mesh alone. It is traced once; after
that each light, and each rotation of one, costs a product.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mifit.appearance.arrays import OFFSET, Jit, aligned, dr, mi, on_device, stored
from mifit.core.mesh import normalize, vertex_normals
from mifit.core.sh import LUMINANCE

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

DIRECTIONS = 512
"""Directions of the sky, a multiple of 32: 7 degrees apart."""
GATHERS = 64
"""Directions in which light from the mesh is gathered at a vertex."""
_kept: WeakKeyDictionary[SurfaceScene, tuple[NDArray, Reception]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Reception:
    """What V vertices, with unit ``normals`` (V, 3), see of the sky and of one another.

    ``directions`` (D, 3) are spread evenly over the sphere, world axes; a vertex sees those whose
    bits are set in ``open_sky`` (V, D / 32). ``exchange`` (V, V) is irradiance of vertices per radiance of vertices.
    """

    directions: NDArray[np.float64]
    normals: NDArray[np.float64]
    open_sky: NDArray[np.uint32]
    exchange: csr_matrix

    def from_sky(self, toward: NDArray, power: NDArray) -> NDArray[np.float32]:
        """(V, 3) irradiance from a distant soft light, given as many directions (M, 3) with power (M, 3).

        Each has the shadows of the nearest of `directions`; those of one cell shine from their common middle.
        """
        nearest = (toward @ self.directions.T).argmax(axis=1)

        def summed(values: NDArray) -> NDArray[np.float64]:
            return np.stack([np.bincount(nearest, column, minlength=len(self.directions)) for column in values.T], 1)

        middle = normalize(summed(toward * (power @ LUMINANCE)[:, None]) + 1e-12 * self.directions)
        n, words = on_device(mi.Vector3f, self.normals), self.open_sky.shape[1]
        bits, vertex = mi.UInt(aligned(self.open_sky, np.uint32).ravel()), dr.arange(mi.UInt, len(self.normals))
        lights = mi.Float(aligned(np.concatenate([middle, summed(power)], axis=1)).ravel())

        def body(i: Jit, total: Jit) -> tuple[Jit, Jit]:
            x, y, z, *colour = (dr.gather(mi.Float, lights, 6 * i + k) for k in range(6))
            open_bit = (dr.gather(mi.UInt, bits, vertex * words + i // 32) >> (i % 32)) & 1
            return i + 1, total + dr.maximum(n.x * x + n.y * y + n.z * z, 0.0) * open_bit * mi.Color3f(*colour)

        start = (mi.UInt(0), dr.zeros(mi.Color3f, len(self.normals)))
        count = dr.opaque(mi.UInt, len(self.directions))
        _, total = dr.while_loop(state=start, cond=lambda i, total: i < count, body=body)
        return stored([total.x, total.y, total.z], len(self.normals))


def reception(scene: SurfaceScene) -> Reception:
    """That of a mesh; kept with it until its vertices move."""
    kept = _kept.get(scene)
    if kept is None or kept[0] is not scene.vertices:
        kept = _kept[scene] = scene.vertices, _trace(scene)
    return kept[1]


def _trace(scene: SurfaceScene) -> Reception:
    positions, corners = np.asarray(scene.vertices, dtype=np.float64), np.asarray(scene.faces, dtype=np.int64)
    normals = vertex_normals(positions, corners)
    directions = fibonacci_sphere(DIRECTIONS)
    parts = range(0, DIRECTIONS, 32)
    bits = [scene.open_towards(positions, normals, directions[start : start + 32]) for start in parts]
    return Reception(directions, normals, np.stack(bits, axis=1), _exchange(scene, positions, normals))


def _exchange(scene: SurfaceScene, positions: NDArray, normals: NDArray) -> csr_matrix:
    """Cosine-distributed rays of every vertex, as a matrix over the vertices that they meet."""
    count = len(positions)
    # Opaque: the kernel is compiled once, not once for every mesh.
    offset: Jit = dr.opaque(mi.Float, OFFSET * float(np.linalg.norm(np.ptp(positions, axis=0))))
    number = dr.arange(mi.UInt, count * GATHERS)
    vertex, ray = number // GATHERS, mi.Float(number % GATHERS)
    n = dr.gather(mi.Vector3f, on_device(mi.Vector3f, normals), vertex)
    origin = dr.gather(mi.Vector3f, on_device(mi.Vector3f, positions), vertex) + offset * n
    u, v = dr.fma(ray, 0.7548776662466927, 0.5), dr.fma(ray, 0.5698402909980532, 0.5)
    d = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u - dr.floor(u), v - dr.floor(v))))
    hit = scene.rays.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(origin), d))
    dr.eval(hit.t, hit.prim_uv, hit.prim_index)  # one kernel: each array read would trace the rays again
    met = np.flatnonzero(np.asarray(hit.is_valid()))
    faces = np.asarray(scene.faces)[np.asarray(hit.prim_index)[met]]
    x, y = (np.asarray(part)[met].astype(np.float64) for part in (hit.prim_uv.x, hit.prim_uv.y))
    share = np.stack([1.0 - x - y, x, y], axis=1) * (np.pi / GATHERS)
    rows = np.repeat(met // GATHERS, 3)
    return csr_matrix((share.ravel().astype(np.float32), (rows, faces.ravel())), shape=(count, count))


def fibonacci_sphere(count: int) -> NDArray[np.float64]:
    """Evenly spread unit directions (Fibonacci lattice), (count, 3)."""
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    phi = i * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
