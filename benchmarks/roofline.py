"""How far each hot kernel is from what the machine allows: bytes and operations against measured limits.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.roofline [--quick]

Limits are measured in the same run: memory bandwidth by a triad ``a = b + s c`` (NumPy on one thread, Dr.Jit on all),
arithmetic by matrix products (OpenBLAS on one thread and on all, float32 and float64) and by chains of fused
multiply-adds (Dr.Jit on all threads). A kernel's bound is the longer of bytes over bandwidth and operations over
arithmetic; the fraction is that bound over its best time. NumPy kernels are held against one thread's limits.

Counts of NumPy kernels are of the algorithm as it stands: symmetric products once, every array that must exist read
or written once. Those of Dr.Jit's are of its kernel history: operations of the program times its size, and one value
per input and output; Embree's work isn't in it, so rays add `RAY_OPERATIONS`. Dr.Jit counts loads, stores and
conversions as operations too, so its fractions of arithmetic are upper estimates.
Writes ``benchmarks/results/roofline.json`` and ``roofline.md``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import mifit
from benchmarks.ablation import MODEL
from benchmarks.measure import conditions, measured
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.shading_speed import Cached
from benchmarks.truth import true_geometry
from mifit import Capture, MorphableModel
from mifit.appearance import models
from mifit.appearance.lobe import Lobe
from mifit.config import GeometryConfig, NormalsConfig, ReflectanceConfig
from mifit.core.files import write_text
from mifit.core.mesh import vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.stages.geometry.consistency import ConsistencyProblem
from mifit.stages.geometry.landmarks import LandmarkTerm
from mifit.stages.geometry.parameters import Layout
from mifit.stages.geometry.refine import priors_of
from mifit.stages.geometry.start import OUTLIER_PIXELS, initial_state, landmark_views
from mifit.stages.geometry.visibility import Visibility, spread_points
from mifit.stages.normals.normal_refinement import frame_problem
from mifit.stages.normals.solvers import adam_steps, gauss_newton
from mifit.stages.observations import Surface
from mifit.stages.reflectance.als import LIGHTING_TEXELS
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.lighting import solve_lighting
from mifit.stages.reflectance.maps import Smoothness, TexelSystems, solve_maps
from mifit.stages.reflectance.trials import lighting_problem

CAMERAS, TIMESTEPS = ("left", "right"), (0, 1, 2, 3)
RAY_OPERATIONS = 800
"""Assumed per ray: five levels of eight boxes at 16 operations and four triangles at 40."""
REPEATS = 5
MATMUL = """
import json, time, numpy as np
out = {}
for name in ("float32", "float64"):
    a = np.random.default_rng(0).random((768, 768)).astype(name)
    a @ a
    times = []
    for _ in range(40):
        start = time.perf_counter(); a @ a; times.append(time.perf_counter() - start)
    out[name] = 2 * 768**3 / min(times)
print(json.dumps(out))
"""


@dataclass(frozen=True)
class Kernel:
    """What one kernel needs at least and what it took.

    Attributes
    ----------
    seconds : float
        Best wall time of several.
    bytes, operations : float
    threads : {"one", "all"}
        Whose limits it is held against.
    kernel_seconds : float
        Time inside Dr.Jit's kernels; the rest of ``seconds`` is the host's.
    """

    seconds: float
    bytes: float
    operations: float
    threads: str = "one"
    kernel_seconds: float = 0.0


def shortest(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """Best wall time after one call that isn't counted."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def limits(size: int) -> dict[str, Any]:
    """Bandwidth (bytes/s) and arithmetic (operations/s) of this machine."""
    import drjit as dr
    import mitsuba as mi

    b, c, a = (np.ones(size, np.float32) for _ in range(3))
    # NumPy takes two passes: c read, a written; a and b read, a written.
    numpy_time = shortest(lambda: np.add(np.multiply(c, 1.5, out=a), b, out=a), 20)
    x, y = mi.Float(b), mi.Float(c)
    scale = dr.opaque(mi.Float, 0.5)
    dr.eval(x, y)

    def triad() -> None:
        dr.eval(dr.fma(scale, y, x))
        dr.sync_thread()

    triad_time = shortest(triad, 20)
    width, length, chains = 1 << 18, 256, 8

    def multiply_adds() -> None:
        values = [dr.fma(dr.arange(mi.Float, width), 1e-9, k * 0.1) for k in range(chains)]
        for _ in range(length):
            values = [dr.fma(v, scale, 0.25) for v in values]
        dr.eval(sum(values))
        dr.sync_thread()

    fma_time = shortest(multiply_adds, 20)
    matmul = {}
    for label, threads in (("one", "1"), ("all", str(os.cpu_count()))):
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", MATMUL], env=environment, capture_output=True, text=True, check=True
        )
        matmul[label] = json.loads(done.stdout)
    return {
        "bandwidth": {"one": 5 * 4 * size / numpy_time, "all": 3 * 4 * size / triad_time},
        "arithmetic": {
            "one": matmul["one"]["float32"],
            # One thread's is a lower bound, which a busy machine may need.
            "all": max(matmul["one"]["float32"], matmul["all"]["float32"], 2 * width * length * chains / fma_time),
        },
        "matmul": matmul,
        "fused_multiply_add": 2 * width * length * chains / fma_time,
    }


def of_history(run: Callable[[], object], rays: int = 0, inner: float = 1.0) -> Kernel:
    """Count a piece of Dr.Jit's work by its kernel history.

    Parameters
    ----------
    run : callable
    rays : int
        Rays that Embree traces.
    inner : float
        Iterations of the loop inside the kernels, whose body the history counts once.
    """
    run()
    found: list[Kernel] = []
    for _ in range(REPEATS):
        with measured() as cost:
            run()
        kernels = [k for k in cost.kernels if "operation_count" in k]
        moved = sum(4.0 * k["size"] * (k["input_count"] + k["output_count"]) for k in kernels)
        operations = inner * sum(float(k["size"]) * k["operation_count"] for k in kernels)
        inside = 1e-3 * sum(k.get("execution_time", 0.0) for k in cost.kernels)
        found.append(Kernel(cost.seconds, moved, operations + RAY_OPERATIONS * rays, "all", inside))
    return min(found, key=lambda k: k.seconds)


def kernels(quick: bool) -> dict[str, Kernel]:
    """Measure every kernel."""
    capture, model = Capture.load(SHARED / "captures" / "gloss"), MorphableModel.load(MODEL)
    truth = true_geometry(capture, model, TIMESTEPS)
    size = 96 if quick else 256
    return {
        **rendering(capture, model, truth, size),
        **stage1(capture, model),
        **stage2(capture, model, truth, size),
        **stage3(capture, model, truth, size),
    }


def rendering(capture: Capture, model: MorphableModel, truth: Any, size: int) -> dict[str, Kernel]:
    """G-buffer, transfer tracing, and shading with its gradients."""
    from mifit.appearance.occlusion import trace_transfer
    from mifit.render.gbuffer import SurfaceScene

    camera = capture.camera("third")
    vertices = truth.vertices[0]
    scene = SurfaceScene(vertices, model.faces)
    pixels = camera.width * camera.height
    buffer = of_history(lambda: scene.gbuffer(camera), pixels)
    # Compulsory: directions in, face, weights and depth out, the mesh once.
    buffer = replace(buffer, bytes=pixels * (12 + 20) + vertices.size * 4 + model.faces.size * 4)
    smooth = vertex_normals(vertices, model.faces)
    samples, count = 64, len(vertices)
    transfer = of_history(lambda: trace_transfer(scene, vertices, smooth, 10, samples), count * samples, float(samples))
    transfer = replace(transfer, bytes=count * (24 + 400.0) + model.faces.size * 4)
    light = 0.1 * np.random.default_rng(0).normal(size=(9, 3))
    light[0] = 3.0
    mesh = (vertices, model.faces, model.uv, model.faces_uv)
    cached = Cached([capture.camera(c) for c in CAMERAS], mesh, size, light)
    return {
        "G-buffer, one image": buffer,
        "shadowed transfer, 10 bands": transfer,
        "shading with gradients, paper": of_history(lambda: cached.iterate("paper")),
        "shading with gradients, prefiltered": of_history(lambda: cached.iterate("prefiltered")),
        "shading with gradients, shadowed": of_history(lambda: cached.iterate("shadowed")),
    }


def stage1(capture: Capture, model: MorphableModel) -> dict[str, Kernel]:
    """Shape from coefficients, and the normal equations of the consistency objective."""
    config = GeometryConfig()
    steps = TIMESTEPS[:2]
    layout = Layout(len(steps), model.n_identity, model.n_expression)
    views = landmark_views(capture, model, CAMERAS, steps, config.landmark_noise)
    state = initial_state(model, views, len(steps), layout, model.unit_mm / capture.unit_mm).recentred()
    visibility = Visibility(capture, model, CAMERAS, steps)
    seen = visibility.textures(
        state, spread_points(model, config.surface_points, 0), config.texture_sigma, config.texture_window
    )
    term = LandmarkTerm(views, OUTLIER_PIXELS * config.landmark_noise)
    problem = ConsistencyProblem(
        layout,
        state.frames,
        config.surface_points,
        seen,
        0.1,
        3.0,
        config.texture_weight,
        term,
        priors_of(config),
    )
    shared, local = layout.shared_size, layout.local_size
    operations = moved = 0.0
    for view in seen:
        rows = 3 * len(view.points)  # three channels
        moved += 4.0 * rows * (shared + local)  # the basis once, and the rows made of it
        operations += 2.0 * 3 * rows * (shared + local) + rows * (shared + local + 1.0) ** 2
    moved *= 2
    rows = 3 * config.surface_points
    operations += rows * float(layout.size) ** 2  # the eliminated free values
    moved += 4.0 * rows * layout.size
    identity, expression, _ = model.sample(0)
    columns = model.n_identity + model.n_expression
    return {
        "stage 1: shape from coefficients": Kernel(
            shortest(lambda: model.shape(identity, expression)),
            4.0 * model.mean.size * (columns + 2),
            2.0 * model.mean.size * columns,
        ),
        "stage 1: normal equations": Kernel(shortest(lambda: problem.linearize(state.x)), moved, operations),
    }


def stage2(capture: Capture, model: MorphableModel, truth: Any, size: int) -> dict[str, Kernel]:
    """An iteration of the lighting with texels eliminated, and one of the maps' ADMM."""
    surface = Surface(capture, model, truth, CAMERAS, size)
    rng = np.random.default_rng(0)
    subset = surface.sample(LIGHTING_TEXELS, rng)
    seen = surface.observe(subset)
    plain = models.get("prefiltered")
    forward = Forward.of(plain, 10, Lobe(100.0, plain.fresnel))
    albedo = np.full((len(subset), 3), 0.3, np.float32)
    problem = lighting_problem(seen, forward, np.zeros((100, 3)), albedo, True)

    def iterations(count: int) -> float:
        return shortest(lambda: solve_lighting(problem, iterations=count, tolerance=0.0), 3)

    n, _, k = problem.specular.shape
    m, system = int(problem.seen.sum()), 3.0 * k
    once = (iterations(8) - iterations(2)) / 6
    lighting = Kernel(
        once,
        4.0 * (2 * m * k + 2 * 3 * m + 2 * 2 * n * system),
        # reflections; rows; symmetric products; coupling; elimination (symmetric); dense solve
        2 * 2 * 3 * m * k + 9 * m * k + 3 * m * k**2 + 12 * m * k + 3 * n * k**2 + n * system**2 + system**3 / 3,
    )
    whole = surface.observe(np.arange(len(surface)))
    shade, glint = forward.shade(whole, np.eye(100, 3) * 3.0)
    blocks = TexelSystems.accumulate(
        whole.colour, np.repeat(whole.measured[..., None], 3, axis=2), shade, glint, surface.pairs, 0.1
    )
    prior = np.full((size, size, 4), 0.3, np.float32)
    smooth = Smoothness(ReflectanceConfig.smoothness_weight, 30 * ReflectanceConfig.smoothness_weight)

    def admm(count: int) -> float:
        index = surface.texels.index
        return shortest(lambda: solve_maps(blocks, index, prior, smooth, iterations=count, tolerance=0.0), 3)

    values = 4.0 * size * size
    maps = Kernel(
        (admm(12) - admm(2)) / 10,
        # four running maps and their new values, both transforms over both axes, the texels' blocks
        4.0 * (8 * values + 8 * values + 11 * len(surface)),
        # cosine transforms at 2.5 n log2 n, three Laplacians, about 30 more per value, the texels' blocks
        2 * 2.5 * values * np.log2(size * size) + 3 * 6 * values + 30 * values + 60 * len(surface),
    )
    return {"stage 2: lighting, one iteration": lighting, "stage 2: maps, one ADMM iteration": maps}


def stage3(capture: Capture, model: MorphableModel, truth: Any, size: int) -> dict[str, Kernel]:
    """One Gauss-Newton iteration of the normals, conjugate gradients included, and one of Adam's."""
    maps = mifit.infer_reflectance(
        capture, model, truth, CAMERAS, ReflectanceConfig(texture_size=size, shading="prefiltered", max_iterations=3)
    )
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    problem, _, _ = frame_problem(capture, model, truth.at(truth.timesteps[:1]), maps, CAMERAS, NormalsConfig(), texels)
    assert problem is not None
    one, two = (
        of_history(lambda: gauss_newton(problem, 1, tolerance=0.0)),
        of_history(lambda: gauss_newton(problem, 2, tolerance=0.0)),
    )
    step = of_history(lambda: adam_steps(problem, 4))
    return {
        "stage 3: Gauss-Newton, one iteration": Kernel(
            two.seconds - one.seconds,
            two.bytes - one.bytes,
            two.operations - one.operations,
            "all",
            two.kernel_seconds - one.kernel_seconds,
        ),
        "stage 3: Adam, one iteration": Kernel(
            step.seconds / 4, step.bytes / 4, step.operations / 4, "all", step.kernel_seconds / 4
        ),
    }


def row_of(kernel: Kernel, peak: dict[str, Any]) -> dict[str, Any]:
    """The bound of one kernel and the fraction of it that is reached."""
    by_bytes = kernel.bytes / peak["bandwidth"][kernel.threads]
    by_operations = kernel.operations / peak["arithmetic"][kernel.threads]
    bound = max(by_bytes, by_operations)
    return {
        "seconds": kernel.seconds,
        "kernel_seconds": kernel.kernel_seconds,
        "bytes": kernel.bytes,
        "operations": kernel.operations,
        "operations_per_byte": kernel.operations / kernel.bytes,
        "threads": kernel.threads,
        "limited_by": "memory" if by_bytes > by_operations else "arithmetic",
        "bound_seconds": bound,
        "fraction": bound / kernel.seconds,
    }


def markdown(peak: dict[str, Any], rows: dict[str, dict[str, Any]]) -> str:
    """Limits in a sentence, kernels in a table."""
    band, work = peak["bandwidth"], peak["arithmetic"]
    lines = [
        f"Measured limits: {band['one'] / 1e9:.1f} GB/s on one thread, {band['all'] / 1e9:.1f} GB/s on all; "
        f"{work['one'] / 1e9:.0f} GFLOP/s float32 on one thread, {work['all'] / 1e9:.0f} on all; float64 "
        f"{peak['matmul']['one']['float64'] / 1e9:.0f} and {peak['matmul']['all']['float64'] / 1e9:.0f}.",
        "",
        "| kernel | ms | of which in Dr.Jit kernels | MB | Mop | op/byte | threads | limit | bound ms | fraction |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, r in rows.items():
        inside = f"{1e3 * r['kernel_seconds']:.1f}" if r["kernel_seconds"] else ""
        lines.append(
            f"| {name} | {1e3 * r['seconds']:.1f} | {inside} | {r['bytes'] / 1e6:.1f} | {r['operations'] / 1e6:.0f} "
            f"| {r['operations_per_byte']:.1f} | {r['threads']} | {r['limited_by']} | {1e3 * r['bound_seconds']:.2f} "
            f"| {r['fraction']:.0%} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small maps, for a look; writes roofline_quick.*")
    quick = parser.parse_args().quick
    if not SHARED.is_dir():
        print(f"roofline: left out, it needs the data folder {SHARED}", file=sys.stderr)
        return 0
    mifit.set_variant("auto")
    before = conditions()
    peak = limits(1 << (22 if quick else 25))
    rows = {name: row_of(kernel, peak) for name, kernel in kernels(quick).items()}
    name = "roofline_quick" if quick else "roofline"
    record(name, {"limits": peak, "kernels": rows, "conditions": [before, conditions()]})
    write_text(RESULTS / f"{name}.md", markdown(peak, rows))
    print(markdown(peak, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
