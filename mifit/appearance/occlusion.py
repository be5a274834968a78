"""What of a mesh stands between points on it and the light: paid for once per geometry.

Smooth light has traced transfer vectors, found at the mesh's vertices and interpolated; compact lights have the part of
their extent that a point sees, found at the points themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from mifit.appearance.arrays import OFFSET, Jit, dr, mi, on_device, stored
from mifit.appearance.illumination import Illumination
from mifit.appearance.kernels import diffuse_transfer, sh_basis
from mifit.core.mesh import vertex_normals
from mifit.core.sh import check_order
from mifit.errors import InputError
from mifit.morphable.pigment import SKIN

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

BOUNCE = float(SKIN.mean())
"""Albedo with which the mesh lights itself: skin of medium pigmentation, mean of the channels. Part of the light in
the folds of a face has come this way; without it their albedo has to be too bright."""


@dataclass(frozen=True)
class MeshPoints:
    """N points on a mesh: ``position`` and the mesh's own unit ``normal`` (N, 3), world space, and where they lie.

    ``face`` (N,) are faces, ``barycentric`` (N, 3) weights of their corners.
    """

    position: NDArray
    normal: NDArray
    face: NDArray
    barycentric: NDArray


class OccludingMesh:
    """A mesh, as rays meet it, that shadows itself; what is traced at its vertices is kept."""

    def __init__(self, scene: SurfaceScene) -> None:
        self.scene = scene
        self._transfer: dict[tuple[int, int], NDArray[np.float32]] = {}

    def transfer(self, order: int, seed: int = 0) -> NDArray[np.float32]:
        """(V, B*B) shadowed diffuse transfer at the vertices, with light that the mesh throws on itself once."""
        if (order, seed) not in self._transfer:
            vertices = np.asarray(self.scene.vertices, dtype=np.float64)
            normals = vertex_normals(vertices, self.scene.faces)
            self._transfer[order, seed] = trace_transfer(
                self.scene, vertices, normals, order, seed=seed, bounce_albedo=BOUNCE
            )
        return self._transfer[order, seed]


@dataclass(frozen=True)
class VertexTransfer:
    """Shadowed diffuse transfer of N points: ``values`` (V, B*B) that were traced at the vertices.

    Shading reads those at the ``corners`` (N, 3) of the faces that the points lie on itself, with barycentric
    ``weights`` (N, 3): those of every point are some hundred numbers, which take longer to write down and read again
    than all that is done with them.
    """

    values: NDArray[np.float32]
    corners: NDArray
    weights: NDArray[np.float32]

    def take(self, rows: NDArray) -> VertexTransfer:
        """That of some of the points."""
        return VertexTransfer(self.values, self.corners[rows], self.weights[rows])

    @classmethod
    def joined(cls, parts: Sequence[VertexTransfer], step: NDArray[np.int64]) -> VertexTransfer:
        """Of points that were looked up on several meshes: for each of ``step`` its mesh's, side by side per point."""
        starts = np.cumsum([0, *(len(part.values) for part in parts)])
        corners = np.stack([parts[s].corners + starts[s] for s in step], axis=1).reshape(-1, 3)
        weights = np.stack([parts[s].weights for s in step], axis=1).reshape(-1, 3)
        return cls(np.concatenate([part.values for part in parts]), corners, weights)


@dataclass(frozen=True)
class Occlusion:
    """Shadows of a mesh on N points of it; the default is none.

    ``transfer`` is shadowed diffuse transfer, for models that need it; ``visible`` has per compact light (N,) uint32,
    which of its samples each point sees.
    """

    transfer: VertexTransfer | None = None
    visible: tuple[NDArray[np.uint32], ...] = ()

    @classmethod
    def trace(
        cls, mesh: OccludingMesh, points: MeshPoints, illumination: Illumination, seed: int = 0, smooth: bool = True
    ) -> Occlusion:
        """Trace what points of a mesh see of an illumination: of its bands, and of its compact lights.

        The same ``seed`` gives the same shadows. ``smooth`` says whether smooth light is wanted: models without shadows
        do without.
        """
        transfer = None
        if smooth:
            at_vertices = mesh.transfer(illumination.order, seed)
            transfer = VertexTransfer(at_vertices, mesh.scene.faces[points.face], points.barycentric)
        return cls(transfer, tuple(_visible(mesh.scene, points, [light.samples() for light in illumination.lights])))

    def take(self, rows: NDArray) -> Occlusion:
        """That of some of the points."""
        return Occlusion(self.transfer and self.transfer.take(rows), tuple(bits[rows] for bits in self.visible))


def _visible(scene: SurfaceScene, points: MeshPoints, samples: Sequence[NDArray]) -> list[NDArray[np.uint32]]:
    """Per light, which of its samples (D, 3) each point sees; rays towards 32 directions are sent at once."""
    groups: list[list[NDArray]] = []
    for directions in samples:
        if not groups or sum(map(len, groups[-1])) + len(directions) > 32:
            groups.append([])
        groups[-1].append(directions)
    found = []
    for group in groups:
        bits = scene.open_towards(points.position, points.normal, np.concatenate(group))
        for directions in group:
            found.append(bits & np.uint32((1 << len(directions)) - 1))
            bits = bits >> np.uint32(len(directions) % 32)
    return found


def trace_transfer(
    scene: SurfaceScene,
    points: ArrayLike,
    normals: ArrayLike,
    order: int,
    samples: int = 64,
    seed: int = 0,
    bounce_albedo: float | None = None,
) -> NDArray[np.float32]:
    """Trace the shadowed diffuse transfer vectors of surface points.

    ``albedo * (transfer @ coefficients)`` is the radiance that a Lambertian point reflects under SH lighting, with the
    mesh's own shadows. Rays estimate what is seen of the sky, and by as much of it as is seen what they make of the
    whole sky is replaced by its closed form: points that see all of it carry no noise, and those in deep folds little.

    ``points`` and ``normals`` (N, 3) lie on the mesh that casts shadows; ``order`` is the number of bands B,
    ``samples`` that of rays per point; the same ``seed`` gives the same result (N, B*B). ``bounce_albedo`` adds the
    light that reaches the points after one diffuse reflection off the mesh, with this albedo. InputError for points and
    normals of unequal shapes, no sample, or no band.
    """
    check_order(order)
    vertices, faces = np.asarray(scene.vertices, dtype=np.float64), np.asarray(scene.faces)
    p, n = np.asarray(points, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or p.shape != n.shape:
        raise InputError(f"points and normals: found shapes {p.shape} and {n.shape}, expected (N, 3) each")
    if samples < 1:
        raise InputError(f"samples: found {samples}, expected 1 or more")
    offset = OFFSET * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    hits = _Hits(len(p), samples) if bounce_albedo and len(p) else None
    result = _trace(scene.rays, offset, p, n, order, samples, seed + 1, hits)
    if hits is not None:
        facing = vertex_normals(vertices, faces)
        if np.array_equal(p, vertices) and np.array_equal(n, facing):
            first = result.copy()  # what the vertices get from the sky is what they throw on one another
        else:
            first = _trace(scene.rays, offset, vertices, facing, order, samples, seed)
        result += np.float32((bounce_albedo or 0.0) / samples) * (hits.matrix(faces, len(vertices)) @ first)
    dr.flush_malloc_cache()
    return result


class _Hits:
    """What each of the rays of N points hits, filled in by `_trace`."""

    def __init__(self, count: int, samples: int) -> None:
        self._samples = samples
        self._face = dr.full(mi.UInt, 0xFFFFFFFF, count * samples)
        self._u, self._v = dr.zeros(mi.Float, count * samples), dr.zeros(mi.Float, count * samples)
        dr.eval(self._face, self._u, self._v)

    def keep(self, point: Jit, ray: Jit, hit: Jit, blocked: Jit) -> None:
        """Write down the hit of one ray of each point."""
        at = point * self._samples + ray
        dr.scatter(self._face, hit.prim_index, at, blocked)
        dr.scatter(self._u, hit.prim_uv.x, at, blocked)
        dr.scatter(self._v, hit.prim_uv.y, at, blocked)

    def matrix(self, faces: NDArray, vertices: int) -> sp.csr_matrix:
        """(N, V) sums over the rays of each point of the barycentric weights of what they hit."""
        face = np.array(self._face)
        blocked = face != 0xFFFFFFFF
        u, v = np.array(self._u)[blocked], np.array(self._v)[blocked]
        start = np.concatenate([[0], 3 * np.cumsum(blocked.reshape(-1, self._samples).sum(axis=1))])
        weights = np.stack([1.0 - u - v, u, v], axis=1)
        return sp.csr_matrix((weights.ravel(), faces[face[blocked]].ravel(), start), shape=(len(start) - 1, vertices))


def _trace(
    scene: Jit, offset: float, points: NDArray, normals: NDArray, order: int, samples: int, seed: int, hits: Jit = None
) -> NDArray[np.float32]:
    """One kernel: a thread per point, a loop over its rays, B*B sums in registers.

    What the rays hit is kept, not gathered: B*B numbers at three corners for each take six times as long as tracing.
    """
    count, size = len(points), order * order
    if not count:
        return np.zeros((0, size), np.float32)
    n = on_device(mi.Vector3f, np.asarray(normals, dtype=np.float32))
    origin = on_device(mi.Vector3f, np.asarray(points + offset * normals, dtype=np.float32))
    frame = mi.Frame3f(n)
    shift = mi.PCG32(size=count, initstate=seed)  # type: ignore[operator]
    shift_u, shift_v = shift.next_float32(), shift.next_float32()
    point = dr.arange(mi.UInt, count)

    def body(i: Jit, seen: Jit, whole: list[Jit], sums: list[Jit]) -> tuple[Jit, Jit, list[Jit], list[Jit]]:
        # A rank-1 lattice, shifted at random per point: far less noise than independent rays.
        u = dr.fma(mi.Float(i), 0.7548776662466927, shift_u)
        v = dr.fma(mi.Float(i), 0.5698402909980532, shift_v)
        sample = mi.Point2f(u - dr.floor(u), v - dr.floor(v))
        w = frame.to_world(mi.warp.square_to_cosine_hemisphere(sample))
        ray = mi.Ray3f(mi.Point3f(origin), w)
        y = sh_basis(w, order)
        if hits is None:
            blocked = scene.ray_test(ray)
        else:
            hit = scene.ray_intersect_preliminary(ray)
            blocked = hit.is_valid()
            hits.keep(point, i, hit, blocked)
        sums = [s + dr.select(blocked, 0.0, yk) for s, yk in zip(sums, y, strict=True)]
        whole = [s + yk for s, yk in zip(whole, y, strict=True)]
        return i + 1, seen + dr.select(blocked, 0.0, 1.0), whole, sums

    zeros = [dr.zeros(mi.Float, count) for _ in range(2 * size + 1)]
    _, seen, whole, sums = dr.while_loop(
        state=(mi.UInt(0), zeros[0], zeros[1 : size + 1], zeros[size + 1 :]), cond=lambda i, *_: i < samples, body=body
    )
    # A control variate whose integral is known: the weight with the least variance is the part that is seen, as far as
    # which directions are blocked has nothing to do with the value there.
    seen /= samples
    unshadowed = diffuse_transfer(n, order)
    return stored(
        [dr.fma(seen, t, (s - seen * w) / samples) for t, w, s in zip(unshadowed, whole, sums, strict=True)], count
    )
