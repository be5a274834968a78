"""Faces that this project did not make: measured and scanned heads, photographed or path traced elsewhere.

    python -m benchmarks.foreign [--captures emily scan_city ...] [--rows full refit ...] [--size 512]
        [--timesteps 0,1] [--cameras left,right] [--config FILE.toml] [--judge RESULT] [--pictures DIR]
    python -m benchmarks.foreign --captures FOLDER --cameras a,b --held-out c [--model M]

Fits the named cameras and judges by the others: fitted and held-out views of the stage-1 model (`pca`), of a fit
without specular reflection (`refit`), of the full fit and of image-based rendering on our mesh and on the scan, all
on the same pixels; distances from the scan to the mesh; relit views against path-traced ones; albedo, specular map and
normals at the scan's own surface points. Landmarks are a detector's, no head is in the span of a model, and no image
is lit by a shading model of this project. ``--judge`` judges a result folder in place of fitting. With nothing but
defaults the figures become ``benchmarks/results/foreign.json``, ``foreign.md`` and ``foreign_short.md``.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import mifit
from benchmarks import foreign_tables, judge
from benchmarks.matt import as_chosen, infer_matt
from benchmarks.measure import conditions
from benchmarks.record import RESULTS, SHARED, record
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.core.image import write_image
from mifit.core.process import set_threads, threads
from mifit.errors import MifitError
from mifit.render.image_based import image_based

ICT = str(SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz")
FITS = ("full", "refit", "paper")
JUDGED = ("views", "mesh", "surface", "relit")
RELIT_SAMPLES = 64
SIZE = FitConfig().reflectance.texture_size
"""Texels along the side of the maps, unless --size says otherwise: what a user gets who says nothing."""
SEED = 0


@dataclass(frozen=True)
class Case:
    """One fit of one capture.

    Attributes
    ----------
    capture : str
        A folder, or the name of one of the shared captures.
    model : str
    fitted, held_out : tuple of str
        Cameras; the held-out ones are never read by a fit.
    timesteps : tuple of int
    """

    capture: str
    model: str
    fitted: tuple[str, ...]
    held_out: tuple[str, ...]
    timesteps: tuple[int, ...]

    @property
    def path(self) -> Path:
        """The capture's folder."""
        shared = SHARED / "captures" / self.capture
        return shared if shared.is_dir() else Path(self.capture)

    @property
    def label(self) -> str:
        """What a table calls it."""
        model = "ICT" if self.model == ICT else Path(self.model).stem
        steps = "" if len(self.timesteps) > 1 or self.fitted[0].startswith("c") else ", one timestep"
        return f"{Path(self.capture).name}{steps} ({model}), {','.join(self.fitted)} → {','.join(self.held_out)}"


CASES = (
    Case("scan_city", "builtin", ("left", "right"), ("third",), (0, 1, 2, 3)),
    Case("emily", ICT, ("c3", "c4"), ("c2", "c5"), (0,)),
    Case("scan_studio", "builtin", ("left", "right"), ("third",), (0, 1, 2, 3)),
    Case("scan_city", ICT, ("left", "right"), ("third",), (0,)),
    Case("emily", "builtin", ("c3", "c4"), ("c2", "c5"), (0,)),
    Case("emily", ICT, ("c2", "c5"), ("c3", "c4"), (0,)),
)


def fits_of(case: Case, wanted: Sequence[str], config: FitConfig) -> dict[str, Reconstruction]:
    """The reconstructions that the rows show; only fitted cameras are read."""
    capture, model = Capture.load(case.path), MorphableModel.load(case.model)
    found = {}
    full = mifit.fit(capture, model, case.fitted, case.timesteps, config, seed=SEED)
    if "full" in wanted:
        found["full"] = full
    if "refit" in wanted:
        whole = full.model  # with eyes, if it had none
        matt = infer_matt(capture, whole, full.geometry, case.fitted, as_chosen(full, config.reflectance), SEED)
        normals = mifit.refine_normals(capture, whole, full.geometry, matt, case.fitted, config.normals, seed=SEED)
        residual = full.residual  # of the refit's own, so that both rows show what theirs leaves unexplained
        if residual is not None:
            given = full.geometry, matt, normals, case.fitted
            residual = mifit.find_residual(capture, whole, *given, config.residual, SEED)
        found["refit"] = replace(full, reflectance=matt, normals=normals, mesh=None, residual=residual)
    if "paper" in wanted and hasattr(FitConfig, "paper"):
        paper = replace_size(FitConfig.paper(), config.reflectance.texture_size)
        found["paper"] = mifit.fit(capture, model, case.fitted, case.timesteps, paper, seed=SEED)
    return found


def replace_size(config: FitConfig, size: int) -> FitConfig:
    """The same settings with maps of another size."""
    return replace(config, reflectance=replace(config.reflectance, texture_size=size))


def rows_of(fits: dict[str, Reconstruction]) -> dict[str, tuple[Reconstruction, Any]]:
    """Rows of a table: reconstruction and method."""
    rows: dict[str, tuple[Reconstruction, Any]] = {}
    for name, result in fits.items():
        rows[name] = (result, "full")
        if name == "refit":
            continue
        if result.residual is not None:
            rows[f"{name}: model alone"] = (replace(result, residual=None), "full")
        rows[f"{name}: pca"] = (result, "pca")
        rows[f"{name}: specular dropped"] = (result, "diffuse")
    return {label: row for label, row in rows.items() if row[1] in row[0].methods}


def judge_case(
    case: Case, fits: dict[str, Reconstruction], parts: Sequence[str], samples: int = RELIT_SAMPLES
) -> dict[str, Any]:
    """All figures of one case."""
    capture = Capture.load(case.path)
    rows, main = rows_of(fits), next(iter(fits.values()))
    has_scan = judge.scan.read_scan(capture, case.timesteps[0]) is not None
    found: dict[str, Any] = {"label": case.label, "model": case.model if case.model == "builtin" else "ICT"}
    if "views" in parts:
        found["held_out"] = judge.judge_views(rows, capture, case.held_out, case.timesteps, case.fitted)
        some = {label: row for label, row in rows.items() if not label.endswith(("dropped", "alone"))}
        found["fitted"] = judge.judge_views(some, capture, case.fitted, case.timesteps, case.fitted, perceptual=False)
        found["fitted"] = {k: v for k, v in found["fitted"].items() if not k.startswith("image-based")}
    if "mesh" in parts and has_scan:
        meshes = {name: result for name, result in fits.items() if name != "refit"} or {"refit": main}
        found["mesh"] = {name: judge.judge_mesh(result, capture, case.fitted) for name, result in meshes.items()}
    if "surface" in parts and has_scan:
        found["surface"] = {name: judge.judge_surface(r, capture, case.fitted) for name, r in fits.items()}
    if "relit" in parts and judge.scan.relit_truths(capture):
        alike = ("pca", "alone", "paper: specular dropped")  # under another light there is no residual
        lit = {label: row for label, row in rows.items() if not label.endswith(alike)}
        found["relit"] = judge.judge_relit(
            lit, capture, case.held_out[0], case.timesteps[0], ("local", "path"), samples
        )
    found["fits"] = {name: outcome(result) for name, result in fits.items()}
    return found


def outcome(result: Reconstruction) -> dict[str, Any]:
    """How the stages of a fit ended."""
    reports = result.reports
    return {
        "unconverged": [name for name, report in reports.items() if report.outcome != "converged"],
        "seconds": {name: round(report.seconds, 1) for name, report in reports.items()},
        "shading": reports["reflectance"].details.get("shading", {}).get("chosen")
        if "reflectance" in reports
        else None,
        "exponent": result.reflectance.lobe.typical if result.reflectance else None,
        "warnings": [one.text for one in result.diagnostics],
    }


def write_pictures(folder: Path, case: Case, fits: dict[str, Reconstruction]) -> None:
    """One strip: photograph, image-based rendering on our mesh, then every row, of the first held-out view."""
    capture, timestep = Capture.load(case.path), case.timesteps[0]
    at = judge.view(capture, case.held_out[0], timestep)
    first = next(iter(fits.values()))
    vertices = first.geometry.vertices[first.index(timestep)]
    cameras = [capture.camera(c) for c in case.fitted]
    base = image_based(capture, cameras, at.camera, timestep, vertices, first.model.faces)
    tiles = [capture.frame(at.name, timestep).image[at.box], base.colour]
    tiles += [r.render(at.camera, timestep, m)[..., :3] for r, m in rows_of(fits).values()]
    name = "".join(c if c.isalnum() else "_" for c in case.label)
    write_image(folder / f"{name}.png", np.concatenate([np.asarray(t, np.float32) for t in tiles], axis=1))


def cases_of(arguments: argparse.Namespace) -> tuple[list[Case], list[str]]:
    """The cases asked for, and why others are left out."""
    known = {case.capture for case in CASES}
    cases, skipped = [], []
    for name in arguments.captures:
        if name in known:
            cases += [case for case in CASES if case.capture == name]
        else:
            if not (arguments.cameras and arguments.held_out):
                raise SystemExit(f"--captures {name}: no known capture; name --cameras and --held-out for a folder")
            cases.append(Case(name, arguments.model or "builtin", (), (), arguments.timesteps or (0,)))
    changes: dict[str, Any] = {
        "fitted": arguments.cameras,
        "held_out": arguments.held_out,
        "timesteps": arguments.timesteps,
        "model": ICT if arguments.model == "ict" else arguments.model,
    }
    changes = {key: value for key, value in changes.items() if value}
    if arguments.cameras:  # the other cameras of a shared capture are held out
        for i, case in enumerate(cases):
            rest = tuple(c for c in (*case.fitted, *case.held_out) if c not in arguments.cameras)
            cases[i] = replace(case, held_out=rest)
    cases = list(dict.fromkeys(replace(case, **changes) for case in cases))
    for case in list(cases):
        missing = next((p for p in (case.path, Path(case.model)) if not p.exists() and str(p) != "builtin"), None)
        if missing is not None:
            skipped.append(f"{case.label}: {missing} is not there")
            cases.remove(case)
    return cases, skipped


def run_case(case: Case, arguments: argparse.Namespace, config: FitConfig) -> dict[str, Any]:
    """Fit and judge one case; one that fails stays in the table as failing."""
    set_threads(max(1, threads() // arguments.jobs))
    mifit.set_variant("auto")
    began, used = time.perf_counter(), time.process_time()
    try:
        if arguments.judge:
            fits = {"full": Reconstruction.load(arguments.judge)}
        else:
            fits = fits_of(case, arguments.rows, config)
        figures = judge_case(case, fits, arguments.parts, arguments.relit_samples)
        if arguments.pictures:
            write_pictures(arguments.pictures, case, fits)
    except MifitError as error:
        return {"label": case.label, "failed": str(error)}
    spent = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - used}
    return {**figures, **{key: round(value, 1) for key, value in spent.items()}}


def main() -> int:
    def names(text: str) -> tuple[str, ...]:
        return tuple(text.split(","))

    def numbers(text: str) -> tuple[int, ...]:
        return tuple(map(int, text.split(",")))

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", nargs="+", default=list(dict.fromkeys(case.capture for case in CASES)))
    parser.add_argument("--rows", nargs="+", choices=FITS, default=list(FITS), help="fits to make")
    parser.add_argument("--parts", nargs="+", choices=JUDGED, default=list(JUDGED), help="what to judge")
    parser.add_argument("--size", type=int, default=SIZE, help="texels along the side of the maps")
    parser.add_argument("--timesteps", type=numbers, help="0,1,... instead of each case's")
    parser.add_argument("--cameras", type=names, help="cameras to fit, instead of each case's")
    parser.add_argument("--held-out", type=names, help="cameras to judge by")
    parser.add_argument("--model", help="builtin, ict or a file, instead of each case's")
    parser.add_argument("--config", type=Path, help="settings of the fit")
    parser.add_argument("--judge", type=Path, help="a result folder to judge in place of fitting")
    parser.add_argument("--relit-samples", type=int, default=RELIT_SAMPLES)
    parser.add_argument("--pictures", type=Path, help="folder for one strip of images per case")
    parser.add_argument("--record", action="store_true", help="write the tables whatever the options; they say which")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time, each in a process of its own")
    parser.add_argument("--json", type=Path, help="write the figures to a file of one's own")
    a = parser.parse_args()
    before = conditions()
    config = FitConfig.load(a.config) if a.config else FitConfig()
    config = replace_size(config, a.size)
    cases, skipped = cases_of(a)
    started = time.perf_counter()
    for text in skipped:
        print(f"left out: {text}", file=sys.stderr, flush=True)
    whole = all(
        getattr(a, k) == parser.get_default(k) for k in vars(a) if k not in ("pictures", "json", "jobs", "record")
    )
    found: list[dict[str, Any]] = []
    with ProcessPoolExecutor(a.jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(run_case, case, a, config) for case in cases]
        for case, future in zip(cases, waiting, strict=True):
            found.append(future.result())
            text = json.dumps({k: v for k, v in found[-1].items() if k != "fits"})
            print(f"{case.label}: {found[-1].get('seconds', 0):.0f} s\n{text}", file=sys.stderr, flush=True)
            out = {
                "settings": {"texels": a.size, "fits": a.rows, "parts": a.parts, "relit_samples": a.relit_samples},
                "cases": found,
                "left_out": [*skipped, *(f"{c.label}: the run was broken off" for c in cases[len(found) :])],
                "seconds": round(time.perf_counter() - started, 1),
                "jobs": a.jobs,
                "conditions": {"before": before, "after": conditions()},
            }
            if a.record or (
                whole and not skipped
            ):  # after each case, so that a run that is broken off leaves what it measured
                record("foreign", out, seeds=SEED)
                write_text(RESULTS / "foreign.md", foreign_tables.markdown(found, out))
                write_text(RESULTS / "foreign_short.md", foreign_tables.short(found))
    if a.json:
        write_text(a.json, json.dumps(out, indent=2) + "\n")
    print(foreign_tables.markdown(found))
    return 1 if any("failed" in case for case in found) else 0


if __name__ == "__main__":
    sys.exit(main())
