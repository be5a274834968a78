"""What further frames of a video buy: normals, maps and a held-out view over the number of frames.

    python -m benchmarks.video [--subjects 5] [--scan] [--frames 40] [--texels 256] [--work out/video]

The first heads of `benchmarks.table1` with more timesteps, at half its image size. Four timesteps are fitted, the
others are followed and absorbed on the fit's surface, and the result is judged on the fitted timesteps every so often.
Then all frames are absorbed once more by `mifit.refine`, which sweeps the surface with some of them first.
With ``--scan`` also a scanned head, rendered as they are, whose normals are compared with the scan's.
Videos, fits and figures stay in the work folder, so that a stopped benchmark goes on. ``--plot`` draws
``docs/images/video.png`` from the committed figures.
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
from benchmarks.figure import figure
from benchmarks.judge import judge_mesh, judge_surface, judge_views
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.scan import nearest
from benchmarks.table1 import ENVIRONMENTS, LANDMARK_BIAS, SEED, TONES, mifit, outside
from benchmarks.table1_subject import BUMP_UNIT
from benchmarks.truth import angle, bumped_normals, truth_errors
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.extras.refine import Refinement, refine
from mifit.fitting import fit_into
from mifit.output.evaluate import evaluate

CAMERAS = ("left", "right")
FITTED = 4
JUDGED = (1, 2, 4, 8, 16, 40)
"""Numbers of frames at which the result is judged."""
SIZE = {"width": 340, "height": 240, "spp": 64}
"""With 16 samples a pixel the noise of the path tracer alone holds every held-out view at 29 dB."""
SCAN_UNIT_MM = 37.0
"""Of the scan's file."""
SCAN_MAPS = {
    "albedo": "Map-COL.jpg",
    "specular": "Map-SPEC.jpg",
    "displacement": "Infinite-Level_02_Disp_NoSmoothUV-4096.jpg",
}
PLOT = Path("docs/images/video.png")
POINTS = 3000
"""Points at which the bound of the normals is measured."""


def video(subject: int, frames: int, work: Path) -> Path:
    """Folder of a head's video, rendered once."""
    folder = work / f"subject_{subject:02d}" / "capture"
    if not (folder / "transforms.json").exists():
        environment = SHARED / "hdri" / f"{ENVIRONMENTS[subject % len(ENVIRONMENTS)]}.hdr"
        light = ["--env", environment] if environment.exists() else []
        options = [part for key, value in SIZE.items() for part in (f"--{key}", value)]
        mifit("synth", "--out", folder, "--seed", SEED + subject, "--force", "--tone", TONES[subject % len(TONES)],
              "--outside", outside(subject), "--landmark-bias", LANDMARK_BIAS, "--timesteps", frames, *options,
              *light)  # fmt: skip
    return folder


def scan_video(frames: int, work: Path) -> Path:
    """Folder of the shared scan's video, rendered once, with detected landmarks."""
    folder, source = work / "scan" / "capture", SHARED / "models" / "lee_perry_smith"
    if not (folder / "landmarks").exists():
        options = [part for key, value in SIZE.items() for part in (f"--{key}", value)]
        maps = [f"{name}={source / file}" for name, file in SCAN_MAPS.items()]
        mifit("synth", "--out", folder, "--head", source / "LeePerrySmith.glb", "--unit-mm", SCAN_UNIT_MM, "--flip-v",
              "--maps", *maps, "--env", SHARED / "hdri" / "city.hdr", "--timesteps", frames, "--force",
              *options)  # fmt: skip
        mifit("landmarks", folder)
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
        found.append(nearest(points, result.geometry.vertices[i], model.faces)[0].mean())
    return round(float(np.mean(found)) * result.unit_mm, 4)


def judge_scan(result: Reconstruction, capture: Capture) -> dict[str, float]:
    """Errors against the scan at the points that all fitted views see, and of the held-out view's skin."""
    assert result.reflectance is not None
    view = judge_views({"full": (result, "full")}, capture, ("third",), range(FITTED), CAMERAS)["full"]["skin"]
    confidence = result.reflectance.confidence[result.reflectance.diffuse.any(-1)]
    return {
        **judge_surface(result, capture, CAMERAS),
        "surface_mm": judge_mesh(result, capture, CAMERAS)["mean_mm"],
        "third_full_db": round(view["psnr"], 3),
        "confidence": round(float(confidence.mean()), 4),
    }


def normals_of_what_is_seen(result: Reconstruction, capture: Capture) -> float:
    """Degrees by which perfect normals of the surface that each texel lies on would differ from the truth at its place.

    A texel of the fit lies on another point of the true face, a millimetre or two along it: landmarks have a bias. No
    image tells which point it should be.
    """
    model, vertices = result.model, result.geometry.vertices[0].astype(np.float64)
    assert result.reflectance is not None
    texels = rasterize_uv(model.uv, model.faces_uv, len(result.reflectance.diffuse), model.face_mask)
    true = bumped_normals(model, Path(capture.path), 0, texels, BUMP_UNIT)
    with np.load(Path(capture.path) / "truth" / "0000.npz") as stored:
        surface = stored["vertices"].astype(np.float64)
    rows = np.random.default_rng(0).choice(len(true), min(POINTS, len(true)), replace=False)
    points = interpolate(vertices, model.faces, texels.face, texels.weights)[rows]
    faces = model.faces[model.face_mask]
    _, face, weights = nearest(points, surface, faces)
    normals = normalize(interpolate(vertex_normals(surface, model.faces), faces, face, weights))
    return round(angle(normals, true[rows]), 3)


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
    found: dict[str, Any] = {"video": name, "fit": judged(result, capture), "frames": {}}
    refinement, seconds = Refinement(result, capture), []
    for timestep in range(frames):
        began, cpu = time.perf_counter(), time.process_time()
        refinement.add(timestep)
        seconds.append((time.perf_counter() - began, time.process_time() - cpu))
        if timestep + 1 in JUDGED or timestep + 1 == frames:
            found["frames"][str(timestep + 1)] = judged(refinement.refined(), capture)
            print(name, timestep + 1, found["frames"][str(timestep + 1)], flush=True)
    followed = np.array(seconds[FITTED:])
    found["seconds_per_pair"], found["processor_seconds_per_pair"] = np.median(followed, axis=0).round(3).tolist()
    found["left_out"] = {str(t): why for t, why in refinement.left_out.items()}
    cpu = time.process_time()
    mended = refine(result, capture, range(frames))
    found["processor_seconds_with_surface"] = round(time.process_time() - cpu, 1)
    found["with_surface"] = judged(mended, capture)
    found["sweeps"] = mended.geometry.report.details["phases"][-1]
    print(name, "surface swept again", found["with_surface"], flush=True)
    write_text(figures, json.dumps(found, indent=1) + "\n")
    return found


def run_subject(subject: int, frames: int, work: Path, texels: int) -> dict[str, Any]:
    """Figures of one of Table 1's heads."""
    capture = Capture.load(video(subject, frames, work))
    name = f"subject_{subject:02d}"
    found = run_video(name, capture, judge, frames, work, texels)
    bound = normals_of_what_is_seen(fitted(capture, work / name, texels), capture)
    return {"subject": subject, **found, "normal_degrees_of_what_is_seen": bound}


def means(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean of every figure over the heads: of the fit, by number of frames, and of all with the surface swept first."""
    counts = [n for n in rows[0]["frames"] if all(n in row["frames"] for row in rows)]
    groups = {"fit": [row["fit"] for row in rows]} | {n: [row["frames"][n] for row in rows] for n in counts}
    groups["with_surface"] = [row["with_surface"] for row in rows]
    return {
        name: {key: round(statistics.fmean(f[key] for f in figures), 4) for key in figures[0]}
        for name, figures in groups.items()
    }


def draw(figures: dict[str, Any]) -> None:
    """Error and confidence over the number of frames, from the committed figures."""
    titles = {
        "normal_degrees": "normals, degrees",
        "diffuse_rmse": "albedo, RMSE",
        "specular_correlation": "specular albedo, correlation",
        "third_full_db": "held-out view, dB",
        "confidence": "confidence",
    }
    counts = [n for n in figures["means"] if n.isdigit()]
    with figure(PLOT, (3.0 * len(titles), 2.8), len(titles)) as axes:
        _curves(axes, figures, titles, counts)


def _curves(axes: Any, figures: dict[str, Any], titles: dict[str, str], counts: list[str]) -> None:
    """One panel per figure: heads in grey, their mean, and the fit of four timesteps as a line."""
    for axis, (key, title) in zip(axes, titles.items(), strict=True):
        for row in figures["rows"]:
            axis.plot([int(n) for n in counts], [row["frames"][n][key] for n in counts], color="0.8", lw=1)
        axis.plot([int(n) for n in counts], [figures["means"][n][key] for n in counts], "o-", ms=3)
        axis.axhline(figures["means"]["fit"][key], color="tab:orange", lw=1, ls="--")
        axis.set(title=title, xlabel="frames", xscale="log")
        axis.set_xticks([1, 4, 10, 30], ["1", "4", "10", "30"])
        axis.minorticks_off()


def main() -> None:
    """Run the benchmark, or draw its figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--subjects", type=int, default=5)
    parser.add_argument("--scan", action="store_true", help="the shared scan too")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--texels", type=int, default=256)
    parser.add_argument("--work", type=Path, default=Path("out/video"))
    parser.add_argument("--plot", action="store_true", help="only draw the committed figures")
    arguments = parser.parse_args()
    if not arguments.plot:
        mi.set_variant("auto")
        rows = [run_subject(i, arguments.frames, arguments.work, arguments.texels) for i in range(arguments.subjects)]
        figures = {"size": SIZE, "texels": arguments.texels, "rows": rows, "means": means(rows)}
        if arguments.scan:
            capture = Capture.load(scan_video(arguments.frames, arguments.work))
            figures["scan"] = run_video("scan", capture, judge_scan, arguments.frames, arguments.work, arguments.texels)
        record("video", figures, [SEED + row["subject"] for row in rows])
    draw(json.loads((RESULTS / "video.json").read_text())["figures"])


if __name__ == "__main__":
    main()
