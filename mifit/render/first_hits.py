"""What primary rays meet, kept while neither they nor the meshes move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mifit.core.files import Document
from mifit.render.gbuffer import MESH_BUFFERS

if TYPE_CHECKING:
    import mitsuba as mi

KEPT_RAYS = 2**22
"""Rays whose hits are kept at most, a dozen views of 680 x 480: a gigabyte."""


def _number_of(pointer: mi.ShapePtr) -> int:
    """The number by which kernels know a shape or a sensor."""
    import drjit as dr
    import mitsuba as mi

    return int(np.array(dr.reinterpret_array(mi.UInt32, pointer))[0])


def recording() -> bool:
    """Are operations noted down for later, so that no value can be looked at?"""
    import drjit as dr

    return bool(dr.flag(dr.JitFlag.SymbolicScope) or dr.flag(dr.JitFlag.FreezingScope))


class FirstHits:
    """What primary rays meet, kept for as long as neither they nor the meshes move.

    Optimisers of light and skin look from the same few cameras at the same surface again and again. Rays are
    compared one by one, which costs a fiftieth of tracing them. Hits hold no derivatives; the point that is made
    of them does.
    """

    def __init__(self) -> None:
        self.sensor: mi.Sensor = None
        self.kept: dict[tuple[int, int], Document] = {}

    def find(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.UInt32 | None, mi.SurfaceInteraction3f]:
        """The points that a sensor's rays meet, and the numbers of their rays; None where each ray has an entry."""
        import drjit as dr
        import mitsuba as mi

        shapes = scene.shapes()
        plain = dr.is_jit_v(mi.Float) and all(shape.is_mesh() for shape in shapes)
        if not plain or recording() or self.sensor is None:
            return None, scene.ray_intersect(ray, active)
        with dr.suspend_grad():
            still = mi.Ray3f(dr.detach(ray))
            meshes = [mi.traverse(shape) for shape in shapes]
            buffers = [mesh[key] for mesh in meshes for key in MESH_BUFFERS if key in mesh]
            moved = (*(_number_of(mi.ShapePtr(shape)) for shape in shapes), *(buffer.index for buffer in buffers))
            name = _number_of(mi.SensorPtr(self.sensor)), dr.width(still.d)
            kept = self.kept.get(name)
            if kept is None or kept["moved"] != moved or not _same_rays(kept["ray"], still):
                hits = scene.ray_intersect_preliminary(still, coherent=True)
                index: mi.UInt32 = dr.compress(hits.is_valid())
                kept = {"ray": still, "moved": moved, "index": index}
                if dr.width(index) > 0:
                    kept["hits"] = dr.gather(type(hits), hits, index)
                    kept["si"] = kept["hits"].compute_surface_interaction(dr.gather(mi.Ray3f, still, index))
                dr.eval(kept)
                # While a buffer is kept, no other one can have its index. The scene is not kept: it holds us.
                kept["buffers"] = buffers
                self.kept.pop(name, None)
                self.kept[name] = kept
                while sum(rays for _, rays in self.kept) > KEPT_RAYS and len(self.kept) > 1:
                    self.kept.pop(next(iter(self.kept)))
        index = kept["index"]
        if dr.width(index) == 0:
            return None, dr.zeros(mi.SurfaceInteraction3f, dr.width(still.d))
        if dr.grad_enabled(ray, buffers):
            return index, kept["hits"].compute_surface_interaction(dr.gather(mi.Ray3f, mi.Ray3f(ray), index))
        return index, mi.SurfaceInteraction3f(kept["si"])

    def hit(self, index: mi.UInt32 | None, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> mi.Bool:
        """Which rays meet something, given what `find` found."""
        import drjit as dr
        import mitsuba as mi

        if index is None:
            return si.is_valid()
        met = dr.zeros(mi.Bool, dr.width(ray))
        dr.scatter(met, mi.Bool(True), index, mode=dr.ReduceMode.Permute)
        return met


def _same_rays(one: mi.Ray3f, other: mi.Ray3f) -> bool:
    """Are two sets of rays equal, each ray and number of them?"""
    import drjit as dr
    import mitsuba as mi

    pairs = ((one.o, other.o), (one.d, other.d), (one.maxt, other.maxt))
    equal = mi.Bool(True)
    for a, b in pairs:
        equal &= dr.all(a == b) if dr.depth_v(a) > 1 else a == b
    return bool(dr.all(equal))
