"""Draw the built-in model's sheets for the documentation and time its evaluation.

Run: python benchmarks/builtin_sheets.py
"""

from __future__ import annotations

import json
import os
import platform
import time
from pathlib import Path

import numpy as np

from mifit.core.files import write_text
from mifit.morphable import MorphableModel
from mifit.morphable.describe import save_png
from mifit.morphable.sketch import sketch

ROOT = Path(__file__).resolve().parents[1]
EXPRESSIONS = [
    ("jawOpen",),
    ("smile_L", "smile_R", "cheekSquint_L", "cheekSquint_R"),
    ("frown_L", "frown_R", "browInnerUp_L", "browInnerUp_R"),
    ("pucker",),
    ("funnel", "browOuterUp_L", "browOuterUp_R"),
    ("browDown_L", "browDown_R", "sneer_L", "sneer_R"),
    ("blink_L",),
    ("cheekPuff_L", "cheekPuff_R"),
]


def main() -> None:
    model = MorphableModel.load("builtin")
    images = ROOT / "docs" / "images"
    save_png(np.concatenate([sketch(model, yaw=y, size=340) for y in (0, 45, 90)], axis=1), images / "builtin_mean.png")
    columns = []
    for seed in range(1, 6):
        identity, _, albedo = model.sample(seed)
        columns.append(np.concatenate([sketch(model, identity, None, albedo, y, 220) for y in (0, 50)], axis=0))
    save_png(np.concatenate(columns, axis=1), images / "builtin_subjects.png")
    tiles = []
    for names in EXPRESSIONS:
        coefficients = np.zeros(model.n_expression)
        coefficients[[model.expression_names.index(n) for n in names]] = 2.0
        tiles.append(sketch(model, None, coefficients, yaw=15, size=240))
    rows = [np.concatenate(tiles[k : k + 4], axis=1) for k in (0, 4)]
    save_png(np.concatenate(rows, axis=0), images / "builtin_expressions.png")

    identity, expression, albedo = model.sample(0)
    residual = np.ones(3 * model.n_vertices, dtype=np.float32)
    timings: dict[str, list[float]] = {
        k: [] for k in ("shape_and_albedo_ms", "shape_and_albedo_cpu_ms", "jacobian_transposed_product_ms")
    }
    for _ in range(30):
        cpu, start = time.process_time(), time.perf_counter()
        model.shape(identity, expression)
        model.albedo(albedo)
        middle = time.perf_counter()
        timings["shape_and_albedo_cpu_ms"].append(1e3 * (time.process_time() - cpu))
        _ = model.identity_jacobian.T @ residual
        timings["shape_and_albedo_ms"].append(1e3 * (middle - start))
        timings["jacobian_transposed_product_ms"].append(1e3 * (time.perf_counter() - middle))
    result = {
        "vertices": model.n_vertices,
        "faces": len(model.faces),
        **{k: {"median": float(np.median(v)), "best": float(min(v))} for k, v in timings.items()},
        "machine": {"python": platform.python_version(), "numpy": np.__version__, "cores": os.cpu_count()},
    }
    write_text(ROOT / "benchmarks" / "results" / "builtin_evaluation.json", json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
