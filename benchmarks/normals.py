"""Stage 3: speed of the solvers at equal energy, accuracy of normals and meshes, tracking.

    python -m benchmarks.normals --result out/captures/soft [--capture soft] [--track 4,5,6,7]

The result is one of ``mifit fit --model ../shared/models/ict_facekit/ict_facekit_head.npz``; it isn't changed. Writes
``benchmarks/results/normals.json``. Times are of warm kernels: every problem is solved once before it is timed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import RESULTS, SHARED, record
from benchmarks.truth import angle, bumped_normals
from mifit import Capture, Reconstruction, set_variant
from mifit.config import MeshConfig, NormalsConfig
from mifit.core.mesh import face_cross, interpolate, normalize, split_faces, vertex_normals
from mifit.core.mesh_solve import interior_vertices
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.output.evaluate import evaluate
from mifit.stages.normals.mesh_refinement import refine_mesh
from mifit.stages.normals.normal_refinement import frame_problem, refine_normals
from mifit.stages.normals.solvers import adam_steps, gauss_newton
from mifit.tracking import extend, track

WEIGHTS = (0.3, 3.0)
EQUAL = 1e-3
"""Relative difference up to which energies count as equal."""


def solver_speed(result: Reconstruction, capture: Capture, texels: TexelMap) -> dict[str, Any]:
    """Gauss-Newton's time to the energy of the paper's 100 Adam iterations, in one run on one problem."""
    figures = {}
    for weight in WEIGHTS:
        problem, rows, _ = frame_problem(
            capture,
            result.model,
            result.geometry.at(result.geometry.timesteps[:1]),
            result.reflectance,
            [c.name for c in result.cameras],
            NormalsConfig(magnitude_weight=weight),
            texels,
        )
        adam_steps(problem, 2)
        gauss_newton(problem, 2)
        began = time.perf_counter()
        slow = adam_steps(problem, 100)
        adam_seconds = time.perf_counter() - began
        goal = (1 + EQUAL) * slow.energy
        for iterations in range(1, 20):
            began = time.perf_counter()
            fast = gauss_newton(problem, iterations, tolerance=0.0)
            gauss_newton_seconds = time.perf_counter() - began
            if fast.energy <= goal:
                break
        totals = slow.energies["total"]
        reached = next((i for i, e in enumerate(totals) if e <= goal), len(totals) - 1)
        figures[f"w2={weight}"] = {
            "texels": len(rows),
            "start_energy": totals[0],
            "adam_seconds": round(adam_seconds, 3),
            "adam_energy": slow.energy,
            "adam_iterations_to_goal": reached,
            "gauss_newton_seconds": round(gauss_newton_seconds, 3),
            "gauss_newton_iterations": iterations,
            "gauss_newton_energy": fast.energy,
            "ratio": round(adam_seconds / gauss_newton_seconds, 1),
            "ratio_to_goal": round(adam_seconds * reached / 100 / gauss_newton_seconds, 1),
        }
        print("speed", weight, figures[f"w2={weight}"], flush=True)
    return figures


def accuracy(result: Reconstruction, capture: Capture, folder: Path, texels: TexelMap) -> dict[str, Any]:
    """Normal, position and third-view error, unrefined and for several weights."""
    plain = replace(result, normals=None)
    steps = result.timesteps
    truth = [bumped_normals(result.model, folder, t, texels) for t in steps]
    base = [
        normalize(interpolate(vertex_normals(v, result.model.faces), result.model.faces, texels.face, texels.weights))
        for v in result.geometry.vertices
    ]
    figures: dict[str, Any] = {
        "stage 1": {
            "normal_degrees": float(np.mean([angle(b, t) for b, t in zip(base, truth, strict=True)])),
            "mesh_mm": position_error(result, folder, result.geometry.vertices),
            "third_full_db": evaluate(plain, capture, "third")["methods"]["full"]["psnr"],
        }
    }
    for weight in WEIGHTS:
        found = refine_normals(
            capture,
            result.model,
            result.geometry,
            result.reflectance,
            [c.name for c in result.cameras],
            NormalsConfig(magnitude_weight=weight),
        )
        world = [texels.from_map(n) @ result.geometry.rotation[k].T for k, n in enumerate(found.normal_object)]
        refined = replace(result, normals=found)
        figures[f"w2={weight}"] = {
            "normal_degrees": float(np.mean([angle(n, t) for n, t in zip(world, truth, strict=True)])),
            "mesh_mm": position_error(result, folder, refine_mesh(result.model, result.geometry, found).vertices),
            "third_full_db": evaluate(refined, capture, "third")["methods"]["full"]["psnr"],
            "seconds_per_timestep": round(found.report.seconds / len(steps), 2),
        }
        print("accuracy", weight, figures[f"w2={weight}"], flush=True)
    print("stage 1", figures["stage 1"], flush=True)
    return figures


def position_error(result: Reconstruction, folder: Path, vertices: NDArray) -> float:
    """Mean distance in millimetres of the face area's vertices (T, V', 3) from the truth; the model's come first."""
    area = np.unique(result.model.faces[result.model.face_mask])
    errors = []
    for k, t in enumerate(result.timesteps):
        with np.load(folder / "truth" / f"{t:04d}.npz") as true:
            errors.append(np.linalg.norm(vertices[k][area] - true["vertices"][area], axis=1).mean())
    return float(np.mean(errors)) * result.unit_mm


def meshes(result: Reconstruction, folder: Path) -> dict[str, Any]:
    """Position error before and after the mesh update, flipped faces, vertices that must stay, seconds."""
    figures: dict[str, Any] = {"fitted_mm": position_error(result, folder, result.geometry.vertices)}
    for subdivisions in (0, 1):
        found = refine_mesh(result.model, result.geometry, result.normals, MeshConfig(subdivisions))
        top = split_faces(result.model, subdivisions)
        fixed = ~interior_vertices(top.faces, top.face_mask, top.n_vertices)
        before = np.stack([top.matrix @ v for v in result.geometry.vertices])
        flipped = [
            np.sum(np.sum(face_cross(a, top.faces) * face_cross(b, top.faces), axis=1) < 0)
            for a, b in zip(before, found.vertices, strict=True)
        ]
        figures[f"subdivisions={subdivisions}"] = {
            "vertices": top.n_vertices,
            "mesh_mm": position_error(result, folder, found.vertices),
            "largest_displacement_mm": float(np.abs(found.displacement).max()) * result.unit_mm,
            "flipped_faces": int(np.sum(flipped)),
            "border_moved_mm": float(np.abs(found.vertices - before)[:, fixed].max()) * result.unit_mm,
            **{k: round(v, 3) for k, v in found.report.details.items() if k.startswith("seconds")},
        }
        print("mesh", figures[f"subdivisions={subdivisions}"], flush=True)
    return figures


def tracking(result: Reconstruction, capture: Capture, timesteps: list[int]) -> dict[str, Any]:
    """Third-view error of timesteps whose reflectance was never fitted, against those that were."""
    fitted = evaluate(result, capture, "third")["methods"]["full"]["psnr"]
    frames, seconds, errors = result, [], {}
    for frame in track(
        capture,
        result.model,
        result.geometry,
        result.reflectance,
        result.normals,
        [c.name for c in result.cameras],
        timesteps,
    ):
        frames = extend(frames, frame)
        seconds.append(round(frame.seconds, 2))
        errors[frame.timestep] = evaluate(frames, capture, "third", [frame.timestep])["methods"]["full"]["psnr"]
        print("track", frame.timestep, errors[frame.timestep], seconds[-1], flush=True)
    mean = evaluate(frames, capture, "third", timesteps)["methods"]["full"]["psnr"]
    return {
        "fitted_db": fitted,
        "tracked_db": mean,
        "per_timestep_db": errors,
        "seconds_per_pair": seconds,
        "fit_seconds": round(result.seconds, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--result", type=Path, required=True)
    parser.add_argument("--capture", default="soft")
    parser.add_argument("--track", default="4,5,6,7")
    parser.add_argument("--parts", default="speed,accuracy,meshes,tracking")
    a = parser.parse_args()
    variant = set_variant("auto")
    folder = SHARED / "captures" / a.capture
    capture, result = Capture.load(folder), Reconstruction.load(a.result)
    model = result.model
    texels = rasterize_uv(model.uv, model.faces_uv, len(result.reflectance.diffuse), model.face_mask)
    figures: dict[str, Any] = {"capture": a.capture, "variant": variant, "size": texels.size}
    stored = RESULTS / "normals.json"
    if stored.exists():  # parts that aren't run again stay
        before = json.loads(stored.read_text())["figures"]
        if all(before.get(key) == value for key, value in figures.items()):
            figures = before
    parts = {
        "speed": lambda: solver_speed(result, capture, texels),
        "accuracy": lambda: accuracy(result, capture, folder, texels),
        "meshes": lambda: meshes(result, folder),
        "tracking": lambda: tracking(result, capture, [int(t) for t in a.track.split(",")]),
    }
    for name, run in [(n, parts[n]) for n in a.parts.split(",")]:  # written after each part: the run takes minutes
        figures[name] = run()
        print(record("normals", figures), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
