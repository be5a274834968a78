"""What further frames of a video buy: maps, normals and a held-out view of a fit, before and after `mifit.refine`.

    python -m benchmarks.video [--subjects 5] [--scan] [--frames 40] [--texels 256] [--work out/video]

The first heads of `benchmarks.table1` with more timesteps, at half its image size. Four timesteps are fitted, and the
result is judged on these. With ``--scan`` also a scanned head, rendered as they are, whose normals are compared with
the scan's. Videos, fits and figures stay in the work folder, so that a stopped benchmark goes on.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mifit as mi
from benchmarks.heads import BIAS, Case, Subject
from benchmarks.judge import Row, judge_mesh, judge_surface, judge_views
from benchmarks.record import SHARED, record
from benchmarks.table1 import BUMP_UNIT, command
from benchmarks.truth import truth_errors
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.extras.refine import refine
from mifit.fitting import fit_into
from mifit.output.evaluate import evaluate
from mifit.output.truth import nearest_points

CAMERAS = ("left", "right")
FITTED = 4
SIZE = {"width": 340, "height": 240, "spp": 64}
"""With 16 samples a pixel the noise of the path tracer alone holds every held-out view at 29 dB."""
OPTIONS = [part for key, value in SIZE.items() for part in (f"--{key}", value)]
SCAN_UNIT_MM = 37.0
"""Of the scan's file."""
SCAN_MAPS = {
    "albedo": "Map-COL.jpg",
    "specular": "Map-SPEC.jpg",
    "displacement": "Infinite-Level_02_Disp_NoSmoothUV-4096.jpg",
}


def video(subject: int, frames: int, work: Path) -> Path:
    """Folder of a head's video, rendered once."""
    folder = work / f"subject_{subject:02d}" / "capture"
    if not (folder / "transforms.json").exists():
        made = Subject(subject)
        environment = made.light()
        light = ["--env", environment] if environment.exists() else []
        command("synth", "--out", folder, "--seed", made.seed, "--force", "--tone", made.tone,
              "--outside", made.outside, "--landmark-bias", BIAS, "--timesteps", frames, *OPTIONS,
              *light)  # fmt: skip
    return folder


def scan_video(frames: int, work: Path) -> Path:
    """Folder of the shared scan's video, rendered once, with detected landmarks."""
    folder, source = work / "scan" / "capture", SHARED / "models" / "lee_perry_smith"
    if not (folder / "landmarks").exists():
        maps = [f"{name}={source / file}" for name, file in SCAN_MAPS.items()]
        command("synth", "--out", folder, "--head", source / "LeePerrySmith.glb", "--unit-mm", SCAN_UNIT_MM, "--flip-v",
              "--maps", *maps, "--env", SHARED / "hdri" / "city.hdr", "--timesteps", frames, "--force",
              *OPTIONS)  # fmt: skip
        command("landmarks", folder)
    return folder


def fitted(capture: Capture, folder: Path, texels: int) -> Reconstruction:
    """The fit of the first timesteps, made once."""
    out = folder / f"fit_{texels}"
    if (out / "result.json").exists():
        return Reconstruction.load(out)
    config = FitConfig()
    config = replace(config, reflectance=replace(config.reflectance, texture_size=texels))
    return fit_into(out, capture, MorphableModel.load("builtin"), CAMERAS, range(FITTED), config)


def judge(result: Reconstruction, capture: Capture) -> dict[str, float]:
    """Errors against the truth and of the held-out view, on the fitted timesteps."""
    assert result.reflectance is not None
    errors = truth_errors(result, Path(capture.path), BUMP_UNIT)
    view = evaluate(result, capture, "third", range(FITTED), region="truth")["methods"]
    confidence = result.reflectance.confidence[result.reflectance.diffuse.any(-1)]
    return {
        **errors,
        "surface_mm": surface_error(result, Path(capture.path)),
        "third_full_db": round(view["full"]["psnr"], 3),
        "third_diffuse_db": round(view["diffuse"]["psnr"], 3),
        "confidence": round(float(confidence.mean()), 4),
    }


def surface_error(result: Reconstruction, folder: Path) -> float:
    """Mean distance (mm) from the face area's true vertices to the fitted mesh, without any alignment."""
    model, found = result.model, []
    for i, timestep in enumerate(result.timesteps):
        with np.load(folder / "truth" / f"{timestep:04d}.npz") as stored:
            true = stored["vertices"].astype(np.float64)
        area = np.unique(model.faces[model.face_mask])
        points = true[area[area < len(true)]]  # eyes that a fit added come after
        found.append(nearest_points(points, result.geometry.vertices[i], model.faces)[0].mean())
    return round(float(np.mean(found)) * result.unit_mm, 4)


def judge_scan(result: Reconstruction, capture: Capture) -> dict[str, float]:
    """Errors against the scan at the points that all fitted views see, and of the held-out view's skin."""
    assert result.reflectance is not None
    case, row = Case(str(capture.path), timesteps=tuple(range(FITTED))), Row.of(result)
    view = judge_views(case, capture, {"full": row}, case.held_out)["full"]["skin"]
    confidence = result.reflectance.confidence[result.reflectance.diffuse.any(-1)]
    return {
        **judge_surface(case, capture, row),
        "surface_mm": judge_mesh(case, capture, row)["mean_mm"],
        "third_full_db": round(view["psnr"], 3),
        "confidence": round(float(confidence.mean()), 4),
    }


def run_video(
    name: str,
    capture: Capture,
    judged: Callable[[Reconstruction, Capture], dict[str, float]],
    frames: int,
    work: Path,
    texels: int,
) -> dict[str, Any]:
    """Figures of one video; those of a finished one are read."""
    folder = work / name
    figures = folder / f"figures_{texels}_{frames}.json"
    if figures.exists():
        return dict(json.loads(figures.read_text()))
    result = fitted(capture, folder, texels)
    cpu = time.process_time()
    refined = refine(result, capture, range(frames))
    assert refined.reflectance is not None
    found: dict[str, Any] = {
        "video": name,
        "fit": judged(result, capture),
        "refined": judged(refined, capture),
        "processor_seconds": round(time.process_time() - cpu, 1),
        **refined.reflectance.report.details["refined"],
    }
    print(name, found, flush=True)
    write_text(figures, json.dumps(found, indent=1) + "\n")
    return found


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subjects", type=int, default=5)
    parser.add_argument("--scan", action="store_true", help="the shared scan too")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--texels", type=int, default=256)
    parser.add_argument("--work", type=Path, default=Path("out/video"))
    arguments = parser.parse_args()
    mi.set_variant("auto")
    given = arguments.frames, arguments.work, arguments.texels
    rows = [
        run_video(f"subject_{i:02d}", Capture.load(video(i, *given[:2])), judge, *given)
        for i in range(arguments.subjects)
    ]
    means = {
        kind: {key: round(statistics.fmean(row[kind][key] for row in rows), 4) for key in rows[0][kind]}
        for kind in ("fit", "refined")
    }
    figures = {"size": SIZE, "texels": arguments.texels, "rows": rows, "means": means}
    if arguments.scan:
        figures["scan"] = run_video("scan", Capture.load(scan_video(*given[:2])), judge_scan, *given)
    record("video", figures, [Subject(i).seed for i in range(arguments.subjects)])


if __name__ == "__main__":
    main()
