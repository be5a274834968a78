"""The main job on the path-traced captures: fit two views, judge on the held-out third.

    python -m benchmarks.captures [soft gloss hard] [--work out/captures]

Runs the command line as a user would, over the face area of the true mesh, and writes
``benchmarks/results/captures.json`` and ``captures.md`` with the error of the mesh beside the images'.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from benchmarks.record import RESULTS, SHARED, record
from benchmarks.table1 import METHODS, mifit
from benchmarks.truth import mesh_error
from mifit import Reconstruction
from mifit.core.files import write_text

MODEL = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
TIMESTEPS = (0, 1, 2, 3)


def run_capture(name: str, work: Path) -> dict[str, Any]:
    """Fit and evaluate one capture; figures of images, mesh, time and memory."""
    capture, out = SHARED / "captures" / name, work / name
    mifit("fit", capture, "--model", MODEL, "--cameras", "left,right",
          "--timesteps", ",".join(map(str, TIMESTEPS)), "--out", out, "--force")  # fmt: skip
    mifit("evaluate", out, "--capture", capture, "--camera", "third", "--region", "truth", "--json", out / "third.json",
          "--force")  # fmt: skip
    found = json.loads((out / "third.json").read_text())
    result = Reconstruction.load(out)
    return {
        **{key: found[key] for key in ("region", "region_pixels", "methods")},
        **mesh_error(result, capture),
        "shading": result.reports["reflectance"].details["shading"]["chosen"],
        "seconds": {stage: round(report.seconds, 1) for stage, report in result.reports.items()},
        "outcomes": {stage: report.outcome for stage, report in result.reports.items()},
        "peak_memory_mb": round(result.peak_memory / 2**20),
    }


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    lines = [
        "| capture | pca dB | specular dropped dB | full dB | full RMSE | mesh mm | rotation ° | shading | unconverged "
        "| seconds | MB |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        stopped = ", ".join(stage for stage, outcome in row["outcomes"].items() if outcome != "converged") or "none"
        psnr = " | ".join(f"{row['methods'][m]['psnr']:.2f}" for m in METHODS)
        lines.append(
            f"| {name} | {psnr} | {row['methods']['full']['rmse']:.2f} | {row['mesh_mm']:.2f} "
            f"| {row['rotation_degrees']:.2f} | {row['shading']} | {stopped} | {sum(row['seconds'].values()):.0f} "
            f"| {row['peak_memory_mb']} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["soft", "gloss", "hard"])
    parser.add_argument("--work", type=Path, default=Path("out/captures"))
    a = parser.parse_args()
    rows = {}
    for name in a.names:
        rows[name] = run_capture(name, a.work)
        print(f"{name}: full {rows[name]['methods']['full']['psnr']:.2f} dB", file=sys.stderr, flush=True)
    record("captures", rows)
    write_text(RESULTS / "captures.md", markdown(rows))
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
