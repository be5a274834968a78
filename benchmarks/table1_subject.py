"""One subject of `benchmarks.table1`, fitted and judged."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mifit
from benchmarks.matt import as_chosen, infer_matt
from benchmarks.record import machine
from benchmarks.truth import truth_errors
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.output.evaluate import evaluate

BUMP_UNIT = 0.1
"""Centimetres per unit of the painted bump."""
CAMERAS = ("left", "right")


def fits(
    folder: Path, model: MorphableModel, config: FitConfig, paper: bool
) -> dict[str, tuple[Reconstruction, Capture]]:
    """The reconstructions of a subject: in full, without specular reflection, by the paper, from perfect landmarks."""
    capture, perfect = Capture.load(folder / "capture"), Capture.load(folder / "perfect")
    full = mifit.fit(capture, model, CAMERAS, capture.timesteps, config)
    matt = infer_matt(capture, model, full.geometry, CAMERAS, as_chosen(full, config.reflectance))
    normals = mifit.refine_normals(capture, model, full.geometry, matt, CAMERAS, config.normals)
    residual = mifit.find_residual(capture, model, full.geometry, matt, normals, CAMERAS, config.residual)
    found = {
        "full": (full, capture),
        "diffuse": (replace(full, reflectance=matt, normals=normals, mesh=None, residual=residual), capture),
        "perfect": (mifit.fit(perfect, model, CAMERAS, perfect.timesteps, config), perfect),
    }
    if paper:
        written = FitConfig.paper()
        size = config.reflectance.texture_size
        written = replace(written, reflectance=replace(written.reflectance, texture_size=size))
        found["paper"] = (mifit.fit(capture, model, CAMERAS, capture.timesteps, written), capture)
    return found


def judge(folder: Path, found: dict[str, tuple[Reconstruction, Capture]]) -> dict[str, Any]:
    """Figures of all rows, over the face area of the true mesh."""
    methods: dict[str, Any] = {}
    for name, (result, capture) in found.items():
        measured = evaluate(result, capture, "third", region="truth")["methods"]
        if name == "full":
            methods["pca"], methods["dropped"] = measured["pca"], measured["diffuse"]
        methods[name] = measured["full"]
    return {
        "methods": methods,
        "truth": {name: truth_errors(result, folder / "capture", BUMP_UNIT) for name, (result, _) in found.items()},
        "unconverged": {
            name: [stage for stage, report in result.reports.items() if report.outcome != "converged"]
            for name, (result, _) in found.items()
        },
        "seconds": {name: round(result.seconds, 1) for name, (result, _) in found.items()},
        "warnings": {name: [one.text for one in result.diagnostics] for name, (result, _) in found.items()},
        "commit": machine()["commit"],
    }


def main() -> None:
    folder, model, texels = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    mifit.set_variant("auto")
    config = FitConfig()
    config = replace(config, reflectance=replace(config.reflectance, texture_size=texels))
    found = fits(folder, MorphableModel.load(model), config, paper=sys.argv[4] == "paper")
    found["full"][0].save(folder / "result", force=True)  # `benchmarks.relight` puts it under another light
    figures = judge(folder, found)
    write_text(folder / "figures.json", json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
