"""What a fit costs: by step, as the work grows, error against seconds, the first call, and rendering against `prb`.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.speed [--reduced] [--only steps growth error first render]

On the path-traced capture ``gloss`` with cameras ``left`` and ``right``; the third view and the true mesh are compared
with, never fitted. Seconds are of the processor, all threads, which other programs disturb least; the JSON has wall
time beside them. Parts that aren't named keep their figures. Writes ``benchmarks/results/speed.json`` and ``speed.md``
and draws ``docs/images/speed_growth.svg`` and ``speed_error.svg``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import mifit
from benchmarks.heads import ICT
from benchmarks.record import RESULTS, SHARED, exponent, figure, measured, record
from benchmarks.truth import mesh_error
from mifit import Capture, FitConfig, MorphableModel, Reconstruction, fitting
from mifit.core.camera import Camera
from mifit.core.files import write_text
from mifit.core.mesh import vertex_normals
from mifit.output.evaluate import evaluate
from mifit.progress import silent

CAMERAS, IMAGES = ("left", "right"), Path(__file__).resolve().parents[1] / "docs" / "images"
COLUMNS = {"processor_seconds": "cpu s", "steady_seconds": "wall s", "peak_mb": "MB"}
ERRORS = {"mesh_mm": "mesh, mm from the truth", "third_db": "third view, dB"}
Figures = dict[str, Any]


@lru_cache(maxsize=1)
def data() -> tuple[Capture, MorphableModel]:
    """The capture and the model that is fitted."""
    return Capture.load(SHARED / "captures" / "gloss"), MorphableModel.load(ICT)


def settings(texels: int = 256, **stages: Mapping[str, Any]) -> FitConfig:
    """Defaults with maps of a size and some settings of some stages."""
    config = FitConfig()
    stages = {"reflectance": {}, **stages}
    config = replace(config, **{name: replace(getattr(config, name), **v) for name, v in stages.items()})
    return replace(config, reflectance=replace(config.reflectance, texture_size=texels))


def by_step(config: FitConfig, timesteps: int, until: Any = "normals") -> tuple[Reconstruction, dict[str, Figures]]:
    """A fit, and the cost of each of its steps."""
    capture, model = data()
    steps = tuple(range(timesteps))
    source = fitting.Source(capture, capture.digest(CAMERAS, steps), model, CAMERAS, steps, 0)
    found, costs = dict[Any, Any](), {}
    for step in fitting.steps(config, until):
        inputs: Any = {part: found[part] for part in step.inputs}
        with measured(history=False) as cost:
            found[step.part] = step.run(source.seen(inputs), inputs, silent, *step.settings)
        costs[step.name] = cost.figures()
    cameras = tuple(capture.camera(name) for name in CAMERAS)
    return Reconstruction(model=model, **found, cameras=cameras, unit_mm=capture.unit_mm), costs


def total(costs: Mapping[str, Figures]) -> Figures:
    """Cost of all steps together."""
    sums = {key: round(sum(c[key] for c in costs.values()), 3) for key in ("processor_seconds", "steady_seconds")}
    return {**sums, "peak_mb": max(c["peak_mb"] for c in costs.values())}


def held_out(result: Reconstruction) -> float:
    """PSNR (dB) of the third view over the true face area."""
    found = evaluate(result, data()[0], "third", result.timesteps, region="truth")
    return round(found["methods"]["full"]["psnr"], 3)


# -- parts ------------------------------------------------------------


def steps(reduced: bool) -> Figures:
    """A default fit of four timesteps, by step, with warm kernels."""
    by_step(settings(64), 1)
    result, costs = by_step(settings(256 if reduced else 512), 2 if reduced else 4)
    return {"timesteps": len(result.timesteps), "steps": costs, "total": total(costs), "third_db": held_out(result)}


def growth(reduced: bool) -> Figures:
    """Cost over timesteps and over texels, with the exponents of their growth."""
    out: Figures = {}
    series = {
        "timesteps": [(n, settings(128), n) for n in ((1, 2) if reduced else (1, 2, 4))],
        "texels": [(n * n, settings(n), 1) for n in ((128, 256) if reduced else (128, 256, 512))],
    }
    for by, runs in series.items():
        rows = []
        for size, config, count in runs:
            _, costs = by_step(config, count)
            rows.append({by: size, **total(costs), "steps": {k: c["processor_seconds"] for k, c in costs.items()}})
            print("growth", rows[-1], file=sys.stderr, flush=True)
        power = exponent([r[by] for r in rows], [r["processor_seconds"] for r in rows])
        out[by] = {"rows": rows, "exponent": power}
    return out


def error(reduced: bool) -> Figures:
    """Error of the mesh and of the third view as images and maps are larger, one timestep."""
    geometry, reflectance = [], []
    for finest in (2, 0) if reduced else (3, 2, 1, 0):
        result, costs = by_step(settings(surface={"finest": finest}), 1, "geometry")
        millimetres = mesh_error(result, Path(data()[0].path))["mesh_mm"]
        geometry.append({"number": finest, "mesh_mm": millimetres, **total(costs)})
    for texels in (64, 256) if reduced else (64, 128, 256, 512):
        result, costs = by_step(settings(texels), 1)
        reflectance.append({"number": texels, "third_db": held_out(result), **total(costs)})
    return {"surface, halvings of images": geometry, "whole fit, texels a side": reflectance}


def first(reduced: bool) -> Figures:
    """First and second fit of one timestep in a fresh process without any stored kernel."""
    with tempfile.TemporaryDirectory() as home:  # Dr.Jit keeps kernels below the home folder
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.speed", "--cold"],
            env={**os.environ, "HOME": home}, capture_output=True, text=True, check=True,
        )  # fmt: skip
    return dict(json.loads(done.stdout))


def cold() -> None:
    """What `first` runs in its process."""
    runs = [total(by_step(settings(128), 1)[1]) for _ in range(2)]
    print(json.dumps({"first": runs[0], "second": runs[1]}))


def render(reduced: bool) -> Figures:
    """Gradients of a view by albedo maps and lighting: ``mi.render`` with `shdirect` and with `prb` at 4 samples."""
    import drjit as dr
    import mitsuba as mi

    from mifit.render.gbuffer import make_mesh
    from mifit.render.scene import make_sensor

    mifit.register_plugins()
    model = data()[1]
    size, width, height, count = (256, 340, 240, 2) if reduced else (512, 680, 480, 8)
    # One vertex per corner pair of position and texture coordinate, as Mitsuba's meshes have it.
    corners = np.stack([model.faces.ravel(), model.faces_uv.ravel()], 1)
    pairs, index = np.unique(corners, axis=0, return_inverse=True)
    vertices = model.mean.astype(np.float64) - model.mean.mean(0)
    rng = np.random.default_rng(0)

    def bitmap(low: float, high: float, channels: int) -> Figures:
        pixels = rng.uniform(low, high, (size, size, channels)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "format": "variant"}

    maps = {"diffuse_reflectance": bitmap(0.3, 0.6, 3), "specular_reflectance": bitmap(0.3, 0.6, 1)}
    bsdf = mi.load_dict({"type": "blinnphong", "exponent": 20.0, **maps})
    normals = vertex_normals(vertices, model.faces)[pairs[:, 0]]
    mesh = make_mesh(vertices[pairs[:, 0]], index.reshape(-1, 3), model.uv[pairs[:, 1]], normals, bsdf)
    light = 0.1 * rng.normal(size=(9, 3)).astype(np.float32)
    light[0] = 3.0
    emitter = {"type": "shenv", "coefficients": mi.TensorXf(light)}
    scene = mifit.load_scene({"type": "scene", "mesh": mesh, "light": emitter})
    parameters = mi.traverse(scene)
    keys = [k for k in parameters.keys() if k.endswith(("reflectance.data", "coefficients"))]
    views = []
    for angle in np.radians(np.linspace(-30, 30, count)):
        pose = np.eye(4)
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]) @ turn, (0, 0, 60)
        focal = width * 1000 / 680
        views.append(Camera(f"{angle:.2f}", width, height, focal, focal, width / 2, height / 2, pose))

    def seconds(integrator: Figures, spp: int, repeats: int) -> float:
        chosen, sensors = mi.load_dict({**integrator, "hide_emitters": True}), [make_sensor(c, spp) for c in views]
        times = []
        for _ in range(repeats + 1):  # the first one compiles
            with measured(history=False) as cost:
                for key in keys:
                    dr.enable_grad(parameters[key])
                    dr.set_grad(parameters[key], 0.0)
                parameters.update()
                for seed, sensor in enumerate(sensors):
                    image = mi.render(scene, parameters, sensor=sensor, integrator=chosen, spp=spp, seed=seed)
                    dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
                dr.eval([dr.grad(parameters[key]) for key in keys])
            times.append(cost.seconds)
        return float(np.median(times[1:]))

    closed, replay = seconds({"type": "shdirect"}, 1, 5), seconds({"type": "prb", "max_depth": 2}, 4, 1)
    again = seconds({"type": "shdirect"}, 1, 5)  # on both sides of the long one, so that a change of load shows
    return {"shdirect": closed, "shdirect, again": again, "prb, 4 spp": replay, "ratio": 2 * replay / (closed + again)}


PARTS: dict[str, Callable[[bool], Figures]] = {f.__name__: f for f in (steps, growth, error, first, render)}


# -- tables and plots ------------------------------------------------------------


def markdown(figures: Figures) -> str:
    """Tables of the parts that are there."""
    head = " | ".join(COLUMNS.values())
    lines: list[str] = []

    def row(name: str, cost: Mapping[str, float]) -> None:
        lines.append(f"| {name} | " + " | ".join(f"{cost[key]:.1f}" for key in COLUMNS) + " |")

    if "steps" in figures:
        part = figures["steps"]
        lines += [f"| a fit of {part['timesteps']} timesteps | {head} |", "|---|---|---|---|"]
        for name, cost in {**part["steps"], "all": part["total"]}.items():
            row(name, cost)
    if "growth" in figures:
        powers = ", ".join(f"{by} to the power of {part['exponent']:.2f}" for by, part in figures["growth"].items())
        lines += ["", f"Processor time grows with {powers}."]
    if "first" in figures:
        costs = [figures["first"][name]["processor_seconds"] for name in ("first", "second")]
        text = "The first fit of a process takes {:.1f} cpu s, the second {:.1f} (one timestep, 128 texels)."
        lines += ["", text.format(*costs)]
    if "render" in figures:
        part = figures["render"]
        lines += [
            "",
            f"Gradients through `mi.render` with `shdirect`: {part['shdirect']:.2f} s; with `prb` at 4 samples per "
            f"pixel: {part['prb, 4 spp']:.1f} s, {part['ratio']:.0f} times as long.",
        ]
    return "\n".join(lines).strip() + "\n"


def draw(figures: Figures, folder: Path = IMAGES) -> list[Path]:
    """Plots of the parts that are there."""
    out = []
    if "growth" in figures:
        out.append(folder / "speed_growth.svg")
        with figure(out[-1], (9, 3.6), len(figures["growth"])) as axes:
            for axis, (by, part) in zip(axes, figures["growth"].items(), strict=True):
                sizes = [r[by] for r in part["rows"]]
                for name in part["rows"][0]["steps"]:
                    worked = [(r[by], r["steps"][name]) for r in part["rows"] if r["steps"][name] > 0.01]
                    axis.plot(*np.reshape(worked, (-1, 2)).T, "o-", label=name)
                axis.set(xlabel=by, ylabel="processor seconds", xscale="log", yscale="log")
                axis.set_xticks(sizes, sizes)
                axis.set_xticks([], minor=True)
            axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    if "error" in figures:
        out.append(folder / "speed_error.svg")
        with figure(out[-1], (9, 3.6), 2) as axes:
            for axis, (stage, rows) in zip(axes, figures["error"].items(), strict=True):
                measure = next(key for key in ERRORS if key in rows[0])
                axis.plot([r["processor_seconds"] for r in rows], [r[measure] for r in rows], "o-")
                for r in rows:
                    axis.annotate(r["number"], (r["processor_seconds"], r[measure]), (3, 4), textcoords="offset points")
                axis.set(xlabel="processor seconds", ylabel=ERRORS[measure], title=stage)
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--reduced", action="store_true", help="fewer timesteps, smaller maps and images")
    parser.add_argument("--cold", action="store_true", help=argparse.SUPPRESS)
    a = parser.parse_args()
    if not SHARED.is_dir():
        print(f"speed: left out, it needs the data folder {SHARED}", file=sys.stderr)
        return 0
    mifit.set_variant("auto")
    if a.cold:
        cold()
        return 0
    path = RESULTS / "speed.json"
    kept = json.loads(path.read_text())["figures"] if path.exists() and set(a.only) != set(PARTS) else {}
    for name in a.only:
        kept[name] = PARTS[name](a.reduced)
        record("speed", kept)
        write_text(RESULTS / "speed.md", markdown(kept))
        draw(kept)
    print(markdown(kept))
    return 0


if __name__ == "__main__":
    sys.exit(main())
