"""Register the built-in model to random ICT-FaceKit heads and write the distances that remain.

Run: python benchmarks/register_builtin.py [--heads 20] [--model builtin:coarse]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import numpy as np

from mifit.core.files import write_text
from mifit.morphable import MorphableModel
from mifit.morphable.register import distance_to_surface, register

ROOT = Path(__file__).resolve().parents[1]
ICT = ROOT.parent / "shared" / "models" / "ict_facekit" / "ict_facekit_head.npz"


def measure(model: MorphableModel, ict: MorphableModel, seed: int) -> dict[str, float]:
    """Fit the model to one random head; distances in mm, both ways, over the area that both surfaces share."""
    head = ict.unit_mm * ict.shape(ict.sample(seed)[0]).astype(np.float64)
    start = time.perf_counter()
    fit = register(model, head, ict.faces, ict.landmarks)
    seconds = time.perf_counter() - start
    skin = ict.faces[ict.face_mask]
    on_face = np.unique(model.faces[model.face_mask])
    there = distance_to_surface(fit.vertices[on_face], head, ict.faces)
    # back: the head's face between its contour landmarks, forehead included, without ears and neck
    p = head[ict.landmarks]
    brow, chin = p[17:27, 1].max(), p[8, 1]
    inside = (head[:, 1] > chin) & (head[:, 1] < brow + 35) & (head[:, 2] > p[[0, 16], 2].mean())
    region = np.intersect1d(np.unique(skin), np.flatnonzero(inside))
    back = distance_to_surface(head[region], fit.vertices, model.faces[model.face_mask])
    return {
        "seed": seed,
        "model_to_head_mean_mm": float(there.mean()),
        "head_to_model_mean_mm": float(back.mean()),
        "head_to_model_p95_mm": float(np.percentile(back, 95)),
        "coefficients_rms": float(np.sqrt((fit.identity**2).mean())),
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--heads", type=int, default=20)
    parser.add_argument("--model", default="builtin:coarse")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "register_builtin.json")
    arguments = parser.parse_args()
    model, ict = MorphableModel.load(arguments.model), MorphableModel.load(ICT)
    rows = [measure(model, ict, seed) for seed in range(arguments.heads)]
    keys = [k for k in rows[0] if k != "seed"]
    result = {
        "model": arguments.model,
        "heads": arguments.heads,
        "mean": {k: float(np.mean([r[k] for r in rows])) for k in keys},
        "worst": {k: float(np.max([r[k] for r in rows])) for k in keys},
        "machine": {"python": platform.python_version(), "numpy": np.__version__, "cores": os.cpu_count()},
        "per_head": rows,
    }
    write_text(arguments.out, json.dumps(result, indent=1) + "\n")
    print(json.dumps({k: result[k] for k in ("mean", "worst")}, indent=1))


if __name__ == "__main__":
    main()
