"""Stage 2 on the path-traced captures with the true geometry: error on the held-out view against seconds.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.reflectance [soft gloss hard] [--size 256] [--adam-size 64]

Every shading model with the fast solver, and the paper's solver beside it on the paper's objective at a small map.
The third view is rendered by `mifit.output` and compared over the true face area; it is never fitted. Writes
``benchmarks/results/reflectance.json``, ``.md`` and ``.png``.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mifit
from benchmarks.figure import figure
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.truth import map_errors, true_geometry
from mifit import Capture, MorphableModel, Reconstruction
from mifit.config import ReflectanceConfig
from mifit.core.files import write_text
from mifit.output.evaluate import evaluate

MODEL = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
CAMERAS = ("left", "right")
TIMESTEPS = (0, 1, 2, 3)


def run(name: str, config: ReflectanceConfig, model: MorphableModel) -> dict[str, Any]:
    """One fit: held-out errors, map errors, time."""
    capture = Capture.load(SHARED / "captures" / name)
    geometry = true_geometry(capture, model, TIMESTEPS)
    found = mifit.infer_reflectance(capture, model, geometry, CAMERAS, config)
    result = Reconstruction(
        model=model, geometry=geometry, reflectance=found, cameras=tuple(capture.camera(c) for c in CAMERAS)
    )
    methods = evaluate(result, capture, "third", region="truth")["methods"]
    return {
        "diffuse_db": round(methods["diffuse"]["psnr"], 2),
        "full_db": round(methods["full"]["psnr"], 2),
        **map_errors(capture, model, found),
        "shading": found.shading_model,
        "outcome": found.report.outcome,
        "objective": found.report.details.get("objective", {}).get("total"),
        "seconds": round(found.report.seconds, 1),
    }


def plot(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Held-out PSNR against seconds."""
    with figure(path, (7, 4.5)) as axes:
        for name in dict.fromkeys(key.split("/")[0] for key in rows):
            part = {k: r for k, r in rows.items() if k.startswith(name + "/")}
            axes.scatter([r["seconds"] for r in part.values()], [r["full_db"] for r in part.values()], label=name)
            for key, row in part.items():
                axes.annotate(key.split("/", 1)[1], (row["seconds"], row["full_db"]), fontsize=7)
        axes.set(xlabel="seconds", ylabel="held-out view, PSNR (dB)", xscale="log")
        axes.legend()


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    lines = [
        "| capture / run | diffuse dB | full dB | albedo RMSE | specular correlation | objective | seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for key, r in rows.items():
        objective = "" if r["objective"] is None else f"{r['objective']:.2f}"
        lines.append(
            f"| {key} | {r['diffuse_db']:.2f} | {r['full_db']:.2f} | {r['diffuse_rmse']:.4f} "
            f"| {r['specular_correlation']:.2f} | {objective} | {r['seconds']:.1f} |"
        )
    return "\n".join(lines) + "\n"


def recorded_rows(size: int, adam_size: int) -> dict[str, dict[str, Any]]:
    """Rows of an earlier run at the same sizes: captures that are not named now keep them."""
    path = RESULTS / "reflectance.json"
    figures = json.loads(path.read_text())["figures"] if path.exists() else {}
    return figures["rows"] if (figures.get("size"), figures.get("adam_size")) == (size, adam_size) else {}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["soft", "gloss", "hard"])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--adam-size", type=int, default=64)
    a = parser.parse_args()
    mifit.set_variant("auto")
    model = MorphableModel.load(MODEL)
    rows = recorded_rows(a.size, a.adam_size)
    base = ReflectanceConfig(texture_size=a.size)
    small = ReflectanceConfig(texture_size=a.adam_size, shading="paper", robust=False, specular_smoothness=30.0)
    for name in a.names:
        runs = {
            f"als {shading}": replace(base, shading=shading)
            for shading in ("paper", "prefiltered", "shadowed", "keyed")
        }
        if a.adam_size and name == "gloss":
            runs["als paper objective"] = small
            runs["adam paper objective"] = replace(small, solver="adam")
            runs["als prefiltered objective"] = replace(small, shading="prefiltered", bands=5, exponent=150.0)
            runs["adam prefiltered objective"] = replace(runs["als prefiltered objective"], solver="adam")
        for label, config in runs.items():
            rows[f"{name}/{label}"] = run(name, config, model)
            print(name, label, rows[f"{name}/{label}"], file=sys.stderr, flush=True)
        # After each capture, so that a run that is broken off leaves what it measured.
        record("reflectance", {"size": a.size, "adam_size": a.adam_size, "rows": rows})
        write_text(RESULTS / "reflectance.md", markdown(rows))
        plot(rows, RESULTS / "reflectance.png")
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
