"""Error over time of every stage and solver, cost as the work grows, first call and steady cost, peak memory.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed_error [--only geometry,reflectance,normals,work,growth,first]

All on the path-traced capture ``gloss`` with cameras ``left`` and ``right``; the held-out third view and the true mesh
are compared with, never fitted. Parts that aren't named keep the figures of the last run. Every row has wall time,
wall time without compilation, processor time of all threads and peak memory. Writes
``benchmarks/results/speed_error.json`` and draws ``docs/images/speed_*.svg`` from it.

What other benchmarks measure isn't measured again: Adam on stage 1's objective (``benchmarks.fit_geometry``),
stage 2's solvers at equal objective (``benchmarks.reflectance``), stage 3's accuracy and tracking
(``benchmarks.normals``), the plain Mitsuba loop (``benchmarks.plain_loop``) and ``prb`` against the cached shading
(``benchmarks.shading_speed``).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

import mifit
from benchmarks.ablation import MODEL
from benchmarks.fit_geometry import vertex_errors
from benchmarks.measure import Cost, conditions, exponent, measured
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.third_view import ThirdView, pooled_psnr
from benchmarks.truth import true_geometry
from mifit import Capture, MorphableModel, Reconstruction
from mifit.config import SHADINGS, GeometryConfig, NormalsConfig, ReflectanceConfig
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate
from mifit.core.files import write_text
from mifit.core.mesh import vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.stages.fit_geometry import fit_geometry
from mifit.stages.normals.normal_refinement import frame_problem, refine_normals
from mifit.stages.normals.solvers import adam_steps, gauss_newton

CAPTURE, CAMERAS = "gloss", ("left", "right")
TIMESTEPS = (0, 1, 2, 3)
VIEWS = {1: "1 view", 2: "2 views"}
SIZE, ADAM_SIZE = 128, 64
Row = dict[str, Any]


def choices(config: type, name: str) -> tuple[str, ...]:
    """Values that a setting can take."""
    return typing.get_args(typing.get_type_hints(config)[name])


@dataclass(frozen=True)
class Data:
    """The capture with its model and true geometry."""

    capture: Capture
    model: MorphableModel
    truth: GeometryEstimate
    judge: ThirdView

    def reflectance(
        self, config: ReflectanceConfig, geometry: GeometryEstimate | None = None, cameras: Sequence[str] = CAMERAS
    ) -> ReflectanceEstimate:
        """Stage 2 with the true geometry."""
        return mifit.infer_reflectance(self.capture, self.model, geometry or self.truth, cameras, config)

    def third_db(self, reflectance: ReflectanceEstimate) -> float:
        """Held-out view, true geometry at all timesteps."""
        result = Reconstruction(model=self.model, geometry=self.truth, reflectance=reflectance)
        return round(pooled_psnr(self.judge.errors(result).values()), 3)


@lru_cache(maxsize=1)
def data() -> Data:
    """Read once."""
    capture, model = Capture.load(SHARED / "captures" / CAPTURE), MorphableModel.load(MODEL)
    return Data(capture, model, true_geometry(capture, model, TIMESTEPS), ThirdView(capture))


@lru_cache(maxsize=4)
def maps_of(size: int) -> ReflectanceEstimate:
    """Maps and lighting for parts that start from them."""
    return data().reflectance(ReflectanceConfig(texture_size=size, shading="prefiltered"))


def note(part: str, row: Row) -> Row:
    """Show a row as it is measured."""
    print(part, row, file=sys.stderr, flush=True)
    return row


def best(run: Callable[[], object], repeats: int = 3) -> Cost:
    """The cheapest of several calls after one that isn't counted: steady cost of something short."""
    run()
    costs = []
    for _ in range(repeats):
        with measured() as cost:
            run()
        costs.append(cost)
    return min(costs, key=lambda c: c.processor_seconds)


def grown(rows: list[Row], by: str) -> Row:
    """Rows of growing work with the exponent of their costs."""
    sizes = [row[by] for row in rows]
    return {
        "rows": rows,
        "exponent": exponent(sizes, [row["steady_seconds"] for row in rows]),
        "processor_exponent": exponent(sizes, [row["processor_seconds"] for row in rows]),
    }


def geometry() -> Row:
    """Stage 1, two timesteps: error of the mesh over time as more iterations are allowed."""
    d = data()
    fit_geometry(d.capture, d.model, CAMERAS, TIMESTEPS[:1], GeometryConfig(max_iterations=1))
    configs = [("landmarks alone", GeometryConfig(rounds=0))]
    for objective in choices(GeometryConfig, "objective"):
        for limit in (1, 2, 4, 8, 30):
            configs.append((objective, GeometryConfig(objective=objective, max_iterations=limit)))  # type: ignore
    rows = []
    for label, config in configs:
        with measured() as cost:
            found = fit_geometry(d.capture, d.model, CAMERAS, TIMESTEPS[:2], config)
        errors = vertex_errors(d.capture, found)
        row = {
            "objective": label,
            "max_iterations": config.max_iterations,
            "iterations": sum(p["iterations"] for p in found.report.details["phases"]),
            "mesh_mm": round(errors["mean_mm"], 4),
            "rotation_degrees": round(errors["rotation_max_degrees"], 4),
            **cost.figures(),
        }
        rows.append(note("geometry", row))
    return {"rows": rows}


def reflectance() -> Row:
    """Stage 2 with the true geometry: held-out error over time for every solver and shading model."""
    d = data()
    configs = []
    for shading in SHADINGS:
        if shading != "auto":
            for limit in (1, 3, 8, 30):
                configs.append(ReflectanceConfig(texture_size=SIZE, shading=shading, max_iterations=limit))  # type: ignore
    for shading in ("paper", "prefiltered"):
        exponent_used = None if shading == "paper" else 150.0
        small = ReflectanceConfig(texture_size=ADAM_SIZE, shading=shading, bands=5, exponent=exponent_used)  # type: ignore
        configs += [small, *(replace(small, solver="adam", max_iterations=limit) for limit in (3, 10, 30))]
    rows = []
    for config in configs:
        adam = config.solver == "adam"
        if adam:
            d.reflectance(replace(config, max_iterations=1))
        with measured(history=not adam) as cost:
            found = d.reflectance(config)
        row = {
            "solver": config.solver,
            "shading": config.shading,
            "size": config.texture_size,
            "max_iterations": config.max_iterations,
            "third_db": d.third_db(found),
            "outcome": found.report.outcome,
            **cost.figures(),
        }
        rows.append(note("reflectance", row))
    return {"rows": rows}


def normals() -> Row:
    """Stage 3, one timestep: energy over time of both solvers on one problem, with warm kernels."""
    d = data()
    texels = rasterize_uv(d.model.uv, d.model.faces_uv, SIZE, d.model.face_mask)
    problem, rows, _ = frame_problem(
        d.capture, d.model, d.truth.at(d.truth.timesteps[:1]), maps_of(SIZE), CAMERAS, NormalsConfig(), texels
    )
    assert problem is not None
    adam_steps(problem, 2)
    gauss_newton(problem, 2)
    out = []
    for solver, limits in (("gauss_newton", (1, 2, 3, 5, 8)), ("adam", (5, 10, 20, 50, 100))):
        for limit in limits:
            with measured() as cost:
                found = adam_steps(problem, limit) if solver == "adam" else gauss_newton(problem, limit, tolerance=0.0)
            row = {"solver": solver, "iterations": limit, "energy": found.energy, **cost.figures()}
            out.append(note("normals", row))
    start = sum(problem.energies(np.zeros((len(rows), 2))).values())
    return {"rows": out, "texels": len(rows), "start_energy": start}


def work() -> Row:
    """Texture size, views and timesteps: cost and what they buy."""
    d = data()
    out: Row = {}
    rows = []
    maps_of(64)  # kernels
    for size in (64, 128, 256, 512):
        with measured() as cost:
            found = d.reflectance(ReflectanceConfig(texture_size=size, shading="prefiltered"))
        seen = int(found.report.details["texels"])
        rows.append({"size": size, "texels": seen, "third_db": d.third_db(found), **cost.figures()})
        note("work", rows[-1])
    out["stage 2 over texels"] = grown(rows, "texels")
    rows, frame = [], d.truth.at(d.truth.timesteps[:1])
    for size in (64, 128, 256):
        maps = maps_of(size)
        cost = best(lambda m=maps: refine_normals(d.capture, d.model, frame, m, CAMERAS, NormalsConfig()), 1)
        texels = int((maps.confidence > 0).sum())
        rows.append(note("work", {"size": size, "texels": texels, **cost.figures()}))
    out["stage 3 over texels"] = grown(rows, "texels")
    config = ReflectanceConfig(texture_size=SIZE, shading="prefiltered")
    for views in VIEWS:
        rows = []
        for count in (1, 2, 4):
            used = d.truth.at(d.truth.timesteps[:count])
            with measured() as cost:
                found = d.reflectance(config, used, CAMERAS[:views])
            row = {"views": views, "timesteps": count, "third_db": d.third_db(found), **cost.figures()}
            rows.append(note("work", row))
        out[f"stage 2 over timesteps, {VIEWS[views]}"] = grown(rows, "timesteps")
        rows = []
        for count in (1, 2, 4, 8) if views == 2 else (1, 2, 4):
            with measured() as cost:
                fitted = fit_geometry(d.capture, d.model, CAMERAS[:views], range(count), GeometryConfig())
            millimetres = round(vertex_errors(d.capture, fitted)["mean_mm"], 3)
            rows.append(note("work", {"views": views, "timesteps": count, "mesh_mm": millimetres, **cost.figures()}))
        out[f"stage 1 over timesteps, {VIEWS[views]}"] = grown(rows, "timesteps")
    return out


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view with more or fewer pixels."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    x, y = width / camera.width, height / camera.height
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )


def growth() -> Row:
    """Steady cost of the kernels and of stage 1 as pixels, vertices and surface points grow."""
    import trimesh

    from mifit.appearance.occlusion import trace_transfer
    from mifit.render.gbuffer import SurfaceScene

    d = data()
    camera = d.capture.camera("third")
    vertices, faces = d.truth.vertices[0], d.model.faces
    out: Row = {}
    scene = SurfaceScene(vertices, faces)
    result = Reconstruction(model=d.model, geometry=d.truth, reflectance=maps_of(SIZE))
    traced, rendered = [], []
    for factor in (0.25, 0.5, 1.0, 2.0):
        view = scaled(camera, factor)
        pixels = {"pixels": view.width * view.height}
        traced.append({**pixels, **best(lambda v=view: scene.gbuffer(v)).figures()})
        rendered.append({**pixels, **best(lambda v=view: result.render(v, 0, "full", samples=1), 1).figures()})
        note("growth", rendered[-1])
    out["G-buffer over pixels"], out["local render over pixels"] = grown(traced, "pixels"), grown(rendered, "pixels")
    meshes = [(vertices, faces)]
    for _ in range(2):
        meshes.append(trimesh.remesh.subdivide(*meshes[-1]))
    buffers, transfers = [], []
    for mesh, triangles in meshes:
        size = {"vertices": len(mesh)}
        buffers.append({**size, **best(lambda m=mesh, t=triangles: SurfaceScene(m, t).gbuffer(camera)).figures()})
        smooth = vertex_normals(mesh, triangles)
        cost = best(lambda m=mesh, t=triangles, n=smooth: trace_transfer(SurfaceScene(m, t), m, n, 10), 1)
        transfers.append(note("growth", {**size, **cost.figures()}))
    out["mesh set-up and G-buffer over vertices"] = grown(buffers, "vertices")
    out["shadowed transfer over vertices"] = grown(transfers, "vertices")
    rows = []
    for points in (750, 3000, 12000):
        config = GeometryConfig(rounds=1, surface_points=points)
        with measured() as cost:
            fit_geometry(d.capture, d.model, CAMERAS, TIMESTEPS[:1], config)
        rows.append(note("growth", {"surface_points": points, **cost.figures()}))
    out["stage 1 over surface points"] = grown(rows, "surface_points")
    rows = []
    for name in ("builtin:coarse", "builtin"):
        model = MorphableModel.load(name)
        with measured() as cost:
            fit_geometry(d.capture, model, CAMERAS, TIMESTEPS[:1], GeometryConfig())
        rows.append(note("growth", {"model": name, "vertices": model.n_vertices, **cost.figures()}))
    out["stage 1 over vertices"] = grown(rows, "vertices")
    return out


def first() -> Row:
    """First and second call of each stage in a fresh process without any stored kernel."""
    with tempfile.TemporaryDirectory() as home:  # Dr.Jit keeps kernels below the home folder
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.speed_error", "--cold"],
            env={**os.environ, "HOME": home},
            capture_output=True,
            text=True,
            check=True,
        )
    return note("first", json.loads(done.stdout))


def cold() -> Row:
    """What `first` runs in its process."""
    d = data()
    frame = d.truth.at(d.truth.timesteps[:1])
    maps = {name: ReflectanceConfig(texture_size=64, shading=name) for name in ("paper", "prefiltered", "shadowed")}  # type: ignore
    camera = d.capture.camera("third")
    found: dict[str, ReflectanceEstimate] = {}

    def stage2(name: str) -> None:
        found[name] = d.reflectance(maps[name])

    def render() -> None:
        Reconstruction(model=d.model, geometry=d.truth, reflectance=found["prefiltered"]).render(camera, 0)

    stages: dict[str, Callable[[], object]] = {
        "stage 1": lambda: fit_geometry(d.capture, d.model, CAMERAS, TIMESTEPS[:1], GeometryConfig()),
        **{f"stage 2, {name}": (lambda name=name: stage2(name)) for name in maps},
        "stage 3": lambda: refine_normals(d.capture, d.model, frame, found["prefiltered"], CAMERAS, NormalsConfig()),
        "local render": render,
    }
    out = {}
    for name, run in stages.items():
        costs = []
        for _ in range(2):
            with measured() as cost:
                run()
            costs.append(cost.figures())
        out[name] = {"first": costs[0], "second": costs[1]}
    return out


PARTS: dict[str, Callable[[], Row]] = {
    "geometry": geometry,
    "reflectance": reflectance,
    "normals": normals,
    "work": work,
    "growth": growth,
    "first": first,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(PARTS))
    parser.add_argument("--cold", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--plots", action="store_true", help="draw the stored figures again, measure nothing")
    a = parser.parse_args()
    from benchmarks.speed_plots import draw, markdown

    stored = RESULTS / "speed_error.json"
    if not a.plots:
        if not SHARED.is_dir():
            print(f"speed_error: left out, it needs the data folder {SHARED}", file=sys.stderr)
            return 0
        mifit.set_variant("auto")
        if a.cold:
            print(json.dumps(cold()))
            return 0
        for name in a.only.split(","):
            before = conditions()
            found = PARTS[name]()
            figures = json.loads(stored.read_text())["figures"] if stored.exists() else {}
            record("speed_error", {**figures, name: {**found, "conditions": [before, conditions()]}})
    figures = json.loads(stored.read_text())["figures"]
    draw(figures)
    write_text(RESULTS / "speed_error.md", markdown(figures))
    print(markdown(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
