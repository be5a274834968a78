"""What primary rays meet, kept while neither their camera nor the meshes move."""

from __future__ import annotations

from typing import Any

from mifit.appearance.arrays import dr, mi
from mifit.core.files import Document
from mifit.render.gbuffer import MESH_BUFFERS

KEPT_RAYS = 2**22
"""Rays whose hits are kept at most, a dozen views of 680 x 480: a gigabyte."""


def recording() -> bool:
    """Are operations noted down for later, so that no value can be looked at?"""
    return bool(dr.flag(dr.JitFlag.SymbolicScope) or dr.flag(dr.JitFlag.FreezingScope))


class FirstHits:
    """What primary rays meet, kept for as long as neither their camera nor the meshes move.

    Optimisers of light and skin look from the same few cameras at the same surface again and again. Nothing is
    read back to compare, so that a view is prepared while the last one is computed. Hits hold no derivatives; the
    point that is made of them does.
    """

    def __init__(self) -> None:
        self.last: tuple[mi.Sensor, mi.Ray3f] | None = None
        """The camera whose rays were sampled last, and these rays."""
        self.kept: dict[tuple[int, int], Document] = {}

    def find(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.UInt32 | None, mi.SurfaceInteraction3f]:
        """The points that a sensor's rays meet, and the numbers of their rays; None where each ray has an entry."""
        shapes, last, self.last = scene.shapes(), self.last, None
        plain = dr.is_jit_v(mi.Float) and all(shape.is_mesh() for shape in shapes)
        if not plain or recording() or last is None or last[1] is not ray or (camera := _state(last[0])) is None:
            return None, scene.ray_intersect(ray, active)
        with dr.suspend_grad():
            still = mi.Ray3f(dr.detach(ray))
            meshes = [mi.traverse(shape) for shape in shapes]
            buffers = [mesh[key] for mesh in meshes for key in MESH_BUFFERS if key in mesh]
            moved = (*(shape.ptr for shape in shapes), *(v.index if dr.is_jit_v(v) else v for v in buffers + camera))
            name = last[0].ptr, dr.width(still.d)
            kept = self.kept.get(name)
            if kept is None or kept["moved"] != moved:
                hits = scene.ray_intersect_preliminary(still, coherent=True)
                index: mi.UInt32 = dr.compress(hits.is_valid())
                kept = {"moved": moved, "index": index}
                if dr.width(index) > 0:
                    kept["hits"] = dr.gather(type(hits), hits, index)
                    kept["si"] = kept["hits"].compute_surface_interaction(dr.gather(mi.Ray3f, still, index))
                dr.eval(kept)
                # While an array is kept, no other one can have its index. The scene is not kept: it holds us.
                kept["arrays"] = buffers, camera
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
        if index is None:
            return si.is_valid()
        met = dr.zeros(mi.Bool, dr.width(ray))
        dr.scatter(met, mi.Bool(True), index, mode=dr.ReduceMode.Permute)
        return met


def _state(sensor: mi.Sensor) -> list[Any] | None:
    """What a camera's rays follow from; None for a plugin that may not show all of it."""
    if sensor.class_name() != "PerspectiveCamera" and type(sensor).__name__ != "Pinhole":
        return None
    matrix = sensor.world_transform().matrix
    values = [value for _, value in mi.traverse(sensor) if not isinstance(value, mi.Transform4f)]
    values = [value if dr.is_jit_v(value) else str(value) for value in values]
    return values + [matrix[row, column] for row in range(4) for column in range(4)]
