"""Tables of `benchmarks.foreign`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Case = dict[str, Any]


def _psnr(case: Case, views: str, row: str, region: str = "skin") -> str:
    found = case.get(views, {}).get(row, {}).get(region)
    return f"{found['psnr']:.1f}" if found else "-"


def _figure(case: Case, digits: int, *keys: str) -> str:
    found: Any = case
    for key in keys:
        found = found.get(key, {}) if isinstance(found, dict) else {}
    return f"{found:.{digits}f}" if isinstance(found, (int, float)) else "-"


def _unconverged(case: Case) -> str:
    found = [f"{name}: {', '.join(fit['unconverged'])}" for name, fit in case["fits"].items() if fit["unconverged"]]
    return "; ".join(found) or "none"


Columns = dict[str, Callable[[Case], str]]

HELD_OUT: Columns = {
    "pca": lambda c: _psnr(c, "held_out", "full: pca"),
    "diffuse, refitted": lambda c: _psnr(c, "held_out", "refit"),
    "`full`": lambda c: _psnr(c, "held_out", "full"),
    "`full`, model alone": lambda c: _psnr(c, "held_out", "full: model alone"),
    "paper's settings": lambda c: _psnr(c, "held_out", "paper"),
    "image-based, our mesh": lambda c: _psnr(c, "held_out", "image-based, mesh of full"),
    "image-based, scan's mesh": lambda c: _psnr(c, "held_out", "image-based, scan"),
    "`full` SSIM": lambda c: _figure(c, 3, "held_out", "full", "skin", "ssim"),
    "`full` FLIP": lambda c: _figure(c, 3, "held_out", "full", "skin", "flip"),
    "`full`, whole face": lambda c: _psnr(c, "held_out", "full", "face"),
    "`full`, fitted views": lambda c: _psnr(c, "fitted", "full"),
}
SURFACE: Columns = {
    "scan to mesh, median / mean / 90 % mm": lambda c: " / ".join(
        _figure(c, 2, "mesh", "full", key) for key in ("median_mm", "mean_mm", "p90_mm")
    ),
    "paper's settings": lambda c: " / ".join(
        _figure(c, 2, "mesh", "paper", key) for key in ("median_mm", "mean_mm", "p90_mm")
    ),
    "normals °": lambda c: _figure(c, 1, "surface", "full", "normal_degrees"),
    "stage 1's normals °": lambda c: _figure(c, 1, "surface", "full", "normal_degrees_stage1"),
    "albedo RMSE": lambda c: _figure(c, 3, "surface", "full", "albedo_rmse"),
    "refitted": lambda c: _figure(c, 3, "surface", "refit", "albedo_rmse"),
    "specular RMSE": lambda c: _figure(c, 3, "surface", "full", "specular_rmse"),
    "corr.": lambda c: _figure(c, 2, "surface", "full", "specular_correlation"),
    "unconverged": _unconverged,
    "s": lambda c: _figure(c, 0, "seconds"),
}
RELIT: Columns = {
    f"{title}, {how}": lambda c, row=row, how=how: _figure(c, 1, "relit", f"{row}, {how}", "mean")
    for how in ("local", "path")
    for title, row in (
        ("`full`", "full"),
        ("specular dropped", "full: specular dropped"),
        ("refitted", "refit"),
        ("paper's settings", "paper"),
    )
    if how == "local" or row in ("full", "refit")
}


def _table(cases: list[Case], columns: Columns, first: str = "capture (model), fitted → held out") -> list[str]:
    lines = [f"| {first} | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for case in cases:
        if "failed" in case:
            lines.append(
                f"| {case['label']} | failed: {case['failed'].replace('|', '/')} |" + " |" * (len(columns) - 1)
            )
        else:
            lines.append(f"| {case['label']} | " + " | ".join(cell(case) for cell in columns.values()) + " |")
    return lines


def markdown(cases: list[Case], run: dict[str, Any] | None = None) -> str:
    """Three tables: held-out views, the surface, relit views; ``run`` says how and under which load they were made."""
    lines = [
        *(_conditions(run) if run else []),
        "Held-out views, PSNR in dB of 8-bit sRGB over skin (the hull of the landmarks without eyes and inner mouth,",
        "where a fitted view sees the scan), the same pixels in every column but the last two:",
        "",
        *_table(cases, HELD_OUT),
        "",
        "The surface at the scan's points that all fitted views see, without alignment:",
        "",
        *_table(cases, SURFACE),
    ]
    lit = [case for case in cases if case.get("relit")]
    if lit:
        lines += [
            "",
            "Relit held-out view against path-traced truth, one factor per channel, mean PSNR in dB over the lights:",
            "",
            *_table(lit, RELIT),
        ]
    return "\n".join(lines) + "\n"


def _conditions(run: dict[str, Any]) -> list[str]:
    load = run["conditions"]["before"]["load_average"][0], run["conditions"]["after"]["load_average"][0]
    minutes, cpu = run["seconds"] / 60, sum(case.get("cpu_seconds", 0) for case in run["cases"]) / 60
    texels, samples = run["settings"]["texels"], run["settings"]["relit_samples"]
    lines = [
        f"Maps of {texels} texels a side, {samples} samples per pixel of relit views; "
        f"{minutes:.0f} minutes, {cpu:.0f} of processor time, at load averages of {load[0]:.1f} to {load[1]:.1f}.",
    ]
    lines += [f"Left out: {text}." for text in run["left_out"]]
    return [*lines, ""]


def short(cases: list[Case]) -> str:
    """One table for the front page, worst rows included."""
    columns: Columns = {
        "`full`": HELD_OUT["`full`"],
        "`full`, model alone": HELD_OUT["`full`, model alone"],
        "diffuse, refitted": HELD_OUT["diffuse, refitted"],
        "image-based, our mesh": HELD_OUT["image-based, our mesh"],
        "image-based, scan's mesh": HELD_OUT["image-based, scan's mesh"],
        "scan to mesh, median / mean mm": lambda c: " / ".join(
            _figure(c, 2, "mesh", "full", key) for key in ("median_mm", "mean_mm")
        ),
        "relit: `full`": lambda c: _figure(c, 1, "relit", "full, path", "mean"),
        "relit: refitted": lambda c: _figure(c, 1, "relit", "refit, path", "mean"),
        "unconverged": _unconverged,
    }
    return "\n".join(_table(cases, columns)) + "\n"
