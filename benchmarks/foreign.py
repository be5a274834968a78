"""Heads that this project did not make, fitted and judged by photographs, path-traced truth and scans.

    python -m benchmarks.foreign [--own] [--reduced] [--captures scan_city emily] [--rows full refit paper]
    python -m benchmarks.foreign --captures FOLDER --cameras left,right --held-out third [--timesteps 0]

Rows: ``full`` with all defaults, the same without its residual, the stage-1 model, light and albedo fitted again
without specular reflection, one albedo for the whole head under the recovered light, the paper as it is written
(literal units, and colours and pixels both normalised; each pair of photographs by itself, scale free), and
image-based rendering by three blends on our mesh and on the scan. All on the same pixels, with the same samples per
pixel. ``--own`` takes the path-traced heads that the fitted model holds. With nothing but defaults (or ``--own`` or
``--reduced``) the figures become ``benchmarks/results/foreign.json`` (``captures.json``) and the tables beside them;
``--seeds`` writes ``seeds.json`` too.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import mifit
from benchmarks import heads, judge
from benchmarks.heads import ICT, Case
from benchmarks.judge import Row
from benchmarks.record import RESULTS, conditions, record
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.core.process import set_threads, threads
from mifit.errors import MifitError
from mifit.output.evaluate import separation_of
from mifit.output.truth import relit_truths, true_passes

FITS = ("full", "refit", "paper")
RELIT_SAMPLES = 64
SCALE_DEVIATION = 0.2
"""Of the paper's scale, which it estimates: logarithm."""
SEED = 0
FURTHER_SEEDS = 1, 2
"""Of fits whose spread is shown; the tables are the first seed's."""
REDUCED_TEXELS = 256


# -- fits ------------------------------------------------------------


def rows_of(case: Case, wanted: Sequence[str], config: FitConfig) -> dict[str, Row]:
    """The rows of a case's tables; only fitted cameras are read."""
    capture, model = Capture.load(case.path), MorphableModel.load(case.model)
    full = mifit.fit(capture, model, case.fitted, case.timesteps, config, seed=SEED)
    rows = {"full": Row.of(full)}
    if full.residual is not None:
        rows["model alone"] = Row.of(replace(full, residual=None))
    rows["pca"] = Row.of(full, "pca")
    if "refit" in wanted:
        rows["refit"] = Row.of(without_specular(full, capture, case.fitted, config))
        rows["constant albedo"] = Row.of(constant_albedo(full))
    if "paper" in wanted:
        for name, paper in paper_settings(case, capture).items():
            paper = replace_size(paper, config.reflectance.texture_size)
            with suppress(MifitError):  # it may end without a face; the row then has no figures
                rows[name] = Row(
                    {t: mifit.fit(capture, model, case.fitted, (t,), paper, seed=SEED) for t in case.timesteps}
                )
    return rows


def without_specular(
    full: Reconstruction, capture: Capture, cameras: Sequence[str], config: FitConfig
) -> Reconstruction:
    """The same mesh with light, albedo, normals and residual fitted again, without specular reflection."""
    given = capture, full.model, full.geometry
    settings = replace(config.reflectance, specular=False)
    reflectance = mifit.infer_reflectance(*given, cameras, settings, seed=SEED)
    normals = mifit.refine_normals(*given, reflectance, cameras, config.normals, seed=SEED)
    residual = full.residual
    if residual is not None:
        residual = mifit.find_residual(*given, reflectance, normals, cameras, config.residual)
    return replace(full, reflectance=reflectance, normals=normals, mesh=None, residual=residual)


def constant_albedo(full: Reconstruction) -> Reconstruction:
    """The recovered light on a head of one colour: what the albedo's detail is worth."""
    assert full.reflectance is not None
    seen = full.reflectance.confidence > 0.5
    diffuse, specular = full.reflectance.diffuse.copy(), full.reflectance.specular.copy()
    painted = diffuse.any(-1)
    diffuse[painted], specular[painted] = diffuse[seen].mean(0), specular[seen].mean()
    flat = replace(full.reflectance, diffuse=diffuse, specular=specular, residual_shading=None)
    return replace(full, reflectance=flat, residual=None)


def paper_settings(case: Case, capture: Capture) -> dict[str, FitConfig]:
    """The paper as written, in its literal units, and with colours and image coordinates both normalised to 0..1.

    Dividing colours by 255 and pixels by the picture's width is the same as keeping both and raising the prior by 255^2
    and the landmarks' weight by the square of 255 over the width.
    """
    width = capture.camera(case.fitted[0]).width
    literal = FitConfig.paper()
    geometry = replace(literal.geometry, scale_deviation=SCALE_DEVIATION)
    ours = geometry.landmark_weight * (255.0 / width) ** 2, geometry.prior_weight * 255.0**2
    normalised = replace(geometry, landmark_weight=ours[0], prior_weight=ours[1])
    return {
        "paper": replace(literal, geometry=geometry),
        "paper, normalised": replace(literal, geometry=normalised),
    }


def replace_size(config: FitConfig, size: int) -> FitConfig:
    """The same settings with maps of another size."""
    return replace(config, reflectance=replace(config.reflectance, texture_size=size))


# -- judging ------------------------------------------------------------


def over_seeds(case: Case, first: dict[str, Any], config: FitConfig) -> list[dict[str, float]]:
    """Error over skin of `full`: the first seed's, which is known, and that of further ones; no mesh depends on it."""
    capture, model, found = Capture.load(case.path), MorphableModel.load(case.model), [first]
    for seed in FURTHER_SEEDS:
        row = {"full": Row.of(mifit.fit(capture, model, case.fitted, case.timesteps, config, seed=seed))}
        found.append({"held_out": judge.judge_views(case, capture, row, case.held_out)})
    return [{"skin": one["held_out"]["full"]["skin"]["psnr"]} for one in found]


def judge_case(
    case: Case, rows: Mapping[str, Row], integrators: Sequence[str], samples: int, lights: int
) -> dict[str, Any]:
    """All figures of one case."""
    capture, full = Capture.load(case.path), rows["full"].first
    found: dict[str, Any] = {"held_out": judge.judge_views(case, capture, rows, case.held_out)}
    fitted = {"full": rows["full"]}
    found["fitted"] = {"full": judge.judge_views(case, capture, fitted, case.fitted)["full"]}
    if judge.scan_of(case, capture, case.timesteps[0]) is not None:
        made = {name: row for name, row in rows.items() if name in ("full", "refit") or name.startswith("paper")}
        found["mesh"] = {n: judge.judge_mesh(case, capture, row) for n, row in made.items() if n != "refit"}
        found["surface"] = {n: judge.judge_surface(case, capture, row) for n, row in made.items()}
    if relit_truths(capture):
        alike = ("pca", "model alone")  # under another light there is no residual
        lit = {name: row for name, row in rows.items() if name not in alike}
        found["relit"] = judge.judge_relit(case, capture, lit, integrators, samples, lights)
    if true_passes(capture, case.held_out[0]) is not None and capture.timesteps[0] in case.timesteps:
        found["separation"] = separation_of(full, capture, case.held_out[0])
    found["fits"] = {name: outcome(row.first) for name, row in rows.items() if row.method == "full"}
    return found


def outcome(result: Reconstruction) -> dict[str, Any]:
    """How the stages of a fit ended."""
    reports = result.reports
    lights = result.reflectance.illumination.lights if result.reflectance else ()
    return {
        "unconverged": [name for name, report in reports.items() if report.outcome != "converged"],
        "seconds": {name: round(report.seconds, 1) for name, report in reports.items()},
        "compact_lights": len(lights),
        "exponent": result.reflectance.lobe.exponent if result.reflectance else None,
        "warnings": [one.text for one in result.diagnostics],
    }


def run_case(case: Case, arguments: argparse.Namespace, config: FitConfig) -> dict[str, Any]:
    """Fit and judge one case; one that fails stays in the table as failing."""
    set_threads(max(1, threads() // arguments.jobs))
    mifit.set_variant("auto")
    began, used = time.perf_counter(), time.process_time()
    named = {"label": case.label, "set": case.set, "development": case.development}
    try:
        rows = rows_of(case, arguments.rows, config)
        fitted = time.process_time() - used
        integrators = ("local",) if arguments.reduced else ("local", "path")
        figures = judge_case(case, rows, integrators, RELIT_SAMPLES, 2 if arguments.reduced else 9)
        if arguments.seeds:
            figures["seeds"] = over_seeds(case, figures, config)
    except MifitError as error:
        return {**named, "failed": str(error)}
    spent = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - used, "fit_cpu": fitted}
    return {**named, **figures, **{key: round(value, 1) for key, value in spent.items()}}


# -- tables ------------------------------------------------------------

Columns = dict[str, Callable[[dict[str, Any]], str]]


def _figure(case: dict[str, Any], digits: int, *keys: str) -> str:
    found: Any = case
    for key in keys:
        found = found.get(key, {}) if isinstance(found, dict) else {}
    return f"{found:.{digits}f}" if isinstance(found, (int, float)) else "-"


def _psnr(case: dict[str, Any], row: str, region: str = "skin") -> str:
    return _figure(case, 1, "held_out", row, region, "psnr")


def _based(case: dict[str, Any], mesh: str, region: str = "skin", measure: str = "psnr", digits: int = 1) -> str:
    """The best blend by skin on a mesh, which is named where the region is skin."""
    blend = judge.best_blend(case.get("held_out", {}), mesh)
    text = _figure(case, digits, "held_out", f"image-based, {mesh}, {blend}", region, measure)
    return f"{text} ({blend})" if blend and (region, measure) == ("skin", "psnr") else text


def _millimetres(case: dict[str, Any], row: str) -> str:
    return " / ".join(_figure(case, 2, "mesh", row, key) for key in ("median_mm", "mean_mm", "p90_mm"))


def _spread(case: dict[str, Any]) -> str:
    """Largest less smallest error over skin of the seeds, dB."""
    values = [seed["skin"] for seed in case.get("seeds", ())]
    return f"{max(values) - min(values):.1f}" if values else "-"


def _relit(case: dict[str, Any], row: str) -> str:
    """Path traced where that was done, else by local shading."""
    how = "path" if f"{row}, path" in case.get("relit", {}) else "local"
    return _mean_relit(case, f"{row}, {how}")


def _mean_relit(case: dict[str, Any], row: str) -> str:
    return _figure(case, 1, "relit", row, "mean")


def _unconverged(case: dict[str, Any]) -> str:
    fits = {name: fit for name, fit in case["fits"].items() if name in FITS}  # other rows are parts of these
    found = [f"{name}: {', '.join(fit['unconverged'])}" for name, fit in fits.items() if fit["unconverged"]]
    return "; ".join(found) or "none"


HELD_OUT: Columns = {
    "set": lambda c: c["set"],
    "`full`": lambda c: _psnr(c, "full"),
    "spread": lambda c: _spread(c),
    "`full`, model alone": lambda c: _psnr(c, "model alone"),
    "refitted without specular": lambda c: _psnr(c, "refit"),
    "one albedo": lambda c: _psnr(c, "constant albedo"),
    "stage 1's model": lambda c: _psnr(c, "pca"),
    "paper, literal units": lambda c: _psnr(c, "paper"),
    "paper, normalised": lambda c: _psnr(c, "paper, normalised"),
    "image-based, our mesh": lambda c: _based(c, "our mesh"),
    "image-based, scan": lambda c: _based(c, "scan"),
}
SURFACE: Columns = {
    "scan to mesh, median / mean / 90 % mm": lambda c: _millimetres(c, "full"),
    "paper, literal: mean mm": lambda c: _figure(c, 2, "mesh", "paper", "mean_mm"),
    "paper, normalised": lambda c: _figure(c, 2, "mesh", "paper, normalised", "mean_mm"),
    "normals °": lambda c: _figure(c, 1, "surface", "full", "normal_degrees"),
    "stage 1's normals °": lambda c: _figure(c, 1, "surface", "full", "normal_degrees_stage1"),
    "albedo dB, scaled / as it is": lambda c: " / ".join(
        _figure(c, 1, "surface", "full", key) for key in ("albedo_psnr", "albedo_psnr_unscaled")
    ),
    "unconverged": _unconverged,
}
RELIT: Columns = {
    f"{title}, {how}": partial(_mean_relit, row=f"{row}, {how}")
    for how in ("local", "path")
    for title, row in (("`full`", "full"), ("refitted", "refit"), ("one albedo", "constant albedo"), ("paper", "paper"))
    if how == "local" or row in ("full", "refit")
}
SEPARATION: Columns = {
    "corr., raw / smoothed": lambda c: " / ".join(
        _figure(c, 2, "separation", key) for key in ("correlation", "correlation_smooth")
    ),
    "error (even image)": lambda c: (
        f"{_figure(c, 2, 'separation', 'error')} ({_figure(c, 2, 'separation', 'error_flat')})"
    ),
    "share (truth)": lambda c: f"{_figure(c, 3, 'separation', 'share')} ({_figure(c, 3, 'separation', 'share_truth')})",
    "diffuse dB (no separation)": lambda c: (
        f"{_figure(c, 1, 'separation', 'diffuse_psnr')} ({_figure(c, 1, 'separation', 'diffuse_psnr_unseparated')})"
    ),
}


def _table(cases: Sequence[dict[str, Any]], columns: Columns) -> list[str]:
    """A row per case; columns that no case has are left out."""
    fitted = [case for case in cases if "failed" not in case]
    columns = {title: cell for title, cell in columns.items() if any(cell(case).strip("-/ ") for case in fitted)}
    lines = ["| head (fitted model) | " + " | ".join(columns) + " |"]
    lines.append("|---|" + "---|" * len(columns))
    for case in cases:
        start = f"| {case['label']} |"
        if "failed" in case:
            cells = [case["set"]] * ("set" in columns) + [f"failed: {case['failed'].replace('|', '/')}"]
            lines.append(f"{start} " + " | ".join([*cells, *[""] * (len(columns) - len(cells))]) + " |")
        else:
            lines.append(f"{start} " + " | ".join(cell(case) for cell in columns.values()) + " |")
    return lines


def spread(cases: Sequence[dict[str, Any]]) -> str:
    """How far `full` is above the best image-based rendering on its mesh: worst, middle and best head of each set."""
    lines = []
    for name in ("development", "locked"):
        over = {}
        for case in cases:
            blend = judge.best_blend(case.get("held_out", {}), "our mesh")
            if case["set"] == name and blend:
                base = case["held_out"][f"image-based, our mesh, {blend}"]["skin"]["psnr"]
                over[case["label"]] = case["held_out"]["full"]["skin"]["psnr"] - base
        if over:
            worst = min(over, key=lambda label: over[label])
            values = sorted(over.values())
            middle = float(np.median(values))
            lines.append(
                f"`full` against the best image-based rendering on its mesh, {len(values)} {name} rows: worst "
                f"{values[0]:+.1f} dB ({worst}), median {middle:+.1f} dB, best {values[-1]:+.1f} dB."
            )
    return "\n\n".join(lines)


def markdown(cases: Sequence[dict[str, Any]], run: Mapping[str, Any] | None = None) -> str:
    """All tables; ``run`` says how and under which load they were made."""
    lines = []
    if run is not None:
        load = [run["conditions"][when]["load_average"][0] for when in ("before", "after")]
        cpu = sum(case.get("cpu_seconds", 0) for case in cases) / 60
        lines = [
            f"Maps of {run['settings']['texels']} texels a side; {run['seconds'] / 60:.0f} minutes, {cpu:.0f} of "
            f"processor time, at load averages of {load[0]:.1f} to {load[1]:.1f}.",
            *(f"Left out: {text}." for text in run["left_out"]),
            "",
        ]
    lines += [
        spread(cases),
        "",
        "Held-out views: PSNR in dB of 8-bit sRGB over skin: the hull of the landmarks without eyes and",
        "inner mouth, where a fitted view sees the scan.",
        "",
        *_table(cases, HELD_OUT),
    ]
    lines += ["", "The surface at the scan's points that all fitted views see, without alignment:", ""]
    lines += _table(cases, SURFACE)
    for key, columns, title in (
        ("relit", RELIT, "Relit held-out view against path-traced truth, one factor per channel, mean PSNR in dB:"),
        ("separation", SEPARATION, "Diffuse and specular image of the held-out view against the renderer's passes:"),
    ):
        some = [case for case in cases if case.get(key)]
        lines += ["", title, "", *_table(some, columns)] if some else []
    return "\n".join(lines) + "\n"


def short(cases: Sequence[dict[str, Any]]) -> str:
    """One table for the front page: the heads that chose nothing, worst rows included."""
    locked = [case for case in cases if case["set"] == "locked"]
    columns: Columns = {
        **{key: HELD_OUT[key] for key in ("`full`", "image-based, our mesh")},
        "scan to mesh, median / mean mm": lambda c: " / ".join(
            _figure(c, 2, "mesh", "full", key) for key in ("median_mm", "mean_mm")
        ),
        "relit": lambda c: _relit(c, "full"),
        "fit, s": lambda c: f"{sum(c['fits']['full']['seconds'].values()):.0f}",
    }
    return "\n".join([spread(locked), "", *_table(locked, columns)]) + "\n"


# -- the command ------------------------------------------------------------


def cases_of(arguments: argparse.Namespace) -> tuple[list[Case], list[str]]:
    """The cases asked for, and why others are left out."""
    known = heads.OWN if arguments.own else heads.FOREIGN
    cases: list[Case] = [] if arguments.captures else list(known)
    for name in arguments.captures or ():
        found = [case for case in (*known, *heads.OWN, *heads.FOREIGN) if case.capture == name]
        if not found and not (arguments.cameras and arguments.held_out):
            raise SystemExit(f"--captures {name}: no known capture; name --cameras and --held-out for a folder")
        cases += found or [Case(name, arguments.model or "builtin", (), (), arguments.timesteps or (0,))]
    changes: dict[str, Any] = {
        "fitted": arguments.cameras,
        "held_out": arguments.held_out,
        "timesteps": arguments.timesteps or ((0,) if arguments.reduced else None),
        "model": ICT if arguments.model == "ict" else arguments.model,
    }
    changes = {key: value for key, value in changes.items() if value}
    if arguments.cameras:  # the other cameras of a known capture are held out
        for i, case in enumerate(cases):
            rest = tuple(c for c in (*case.fitted, *case.held_out) if c not in arguments.cameras)
            cases[i] = replace(case, held_out=rest)
    cases = list(dict.fromkeys(replace(case, **changes) for case in cases))
    skipped = [f"{case.label}: {case.missing} is not there" for case in cases if case.missing]
    return [case for case in cases if not case.missing], skipped


def main() -> int:
    def names(text: str) -> tuple[str, ...]:
        return tuple(text.split(","))

    def numbers(text: str) -> tuple[int, ...]:
        return tuple(map(int, text.split(",")))

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", nargs="+", help="default: all of the table")
    parser.add_argument("--own", action="store_true", help="the path-traced heads in the span of the fitted model")
    parser.add_argument("--reduced", action="store_true", help="one timestep, small maps, two lights, no path tracing")
    parser.add_argument("--rows", nargs="+", choices=FITS, default=list(FITS), help="fits to make")
    parser.add_argument("--timesteps", type=numbers, help="0,1,... instead of each case's")
    parser.add_argument("--cameras", type=names, help="cameras to fit, instead of each case's")
    parser.add_argument("--held-out", type=names, help="cameras to judge by")
    parser.add_argument("--model", help="builtin, ict or a file, instead of each case's")
    parser.add_argument("--config", type=Path, help="settings of the fit")
    parser.add_argument("--seeds", action="store_true", help="three seeds, whose spread the tables show")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time, each in a process of its own")
    parser.add_argument("--json", type=Path, help="write the figures to a file of one's own")
    a = parser.parse_args()
    before, started = conditions(), time.perf_counter()
    config = FitConfig.load(a.config) if a.config else FitConfig()
    config = replace_size(config, REDUCED_TEXELS) if a.reduced else config
    cases, skipped = cases_of(a)
    for text in skipped:
        print(f"left out: {text}", file=sys.stderr, flush=True)
    free = ("own", "reduced", "jobs", "json", "rows", "seeds")
    whole = all(getattr(a, key) == parser.get_default(key) for key in vars(a) if key not in free)
    found: list[dict[str, Any]] = []
    for case in cases:
        if case.made:
            mifit.set_variant("auto")
            _ = case.path  # rendered once, before processes ask for it
    with ProcessPoolExecutor(a.jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(run_case, case, a, config) for case in cases]
        for case, future in zip(cases, waiting, strict=True):
            found.append(future.result())
            print(f"{case.label}: {found[-1].get('seconds', 0):.0f} s", file=sys.stderr, flush=True)
            settings = {"texels": config.reflectance.texture_size, "fits": a.rows, "reduced": a.reduced}
            out = {
                "settings": settings,
                "cases": found,
                "left_out": [*skipped, *(f"{c.label}: the run was broken off" for c in cases[len(found) :])],
                "seconds": round(time.perf_counter() - started, 1),
                "conditions": {"before": before, "after": conditions()},
            }
            if whole and not skipped:  # after each case, so that a run that is broken off leaves what it measured
                name = "captures" if a.own else "foreign"
                record(name, out, seeds=SEED)
                if a.seeds and not a.own:
                    over = [{key: one.get(key) for key in ("label", "set", "seeds")} for one in found]
                    record("seeds", {"settings": settings, "cases": over}, seeds=[SEED, *FURTHER_SEEDS])
                write_text(RESULTS / f"{name}.md", short(found) if a.own else markdown(found, out))
                if not a.own:
                    write_text(RESULTS / "foreign_short.md", short(found))
    if a.json:
        write_text(a.json, json.dumps(out, indent=2) + "\n")
    print(markdown(found))
    return 1 if any("failed" in case for case in found) else 0


if __name__ == "__main__":
    sys.exit(main())
