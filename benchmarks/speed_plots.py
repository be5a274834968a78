"""Plots and Markdown tables of what `benchmarks.speed_error` measured."""

from __future__ import annotations

from collections.abc import Iterable
from operator import itemgetter
from pathlib import Path
from typing import Any

from benchmarks.figure import figure

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKS = ("o", "s", "^", "D", "v", "P", "X")
STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "figure.facecolor": "white",
}
TIME = "processor seconds, all threads"
Row = dict[str, Any]


def draw(figures: Row, folder: Path = IMAGES) -> list[Path]:
    """SVG plots of the parts that are there."""
    out = []
    plots = {"geometry": _geometry, "reflectance": _reflectance, "normals": _normals, "growth": _growth}
    for name, plot in plots.items():
        if name in figures:
            out.append(folder / f"speed_{name}.svg")
            with figure(out[-1], (9, 4.2) if name == "growth" else (7, 4.2), style=STYLE) as axes:
                plot(axes, figures)
                _plain_ticks(axes)
    return out


def _plain_ticks(axes: Any) -> None:
    """Numbers as people write them at 1, 2 and 5 of each decade of a logarithmic axis of time or work."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    if axes.get_xscale() == "log":
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())


def _series(axes: Any, points: Iterable[tuple[float, float]], number: int, label: str, **style: Any) -> None:
    x, y = zip(*points, strict=True)
    axes.plot(x, y, marker=MARKS[number % 7], color=COLOURS[number % 7], label=label, markersize=5, **style)


def _geometry(axes: Any, figures: Row) -> None:
    rows = figures["geometry"]["rows"]
    for number, name in enumerate(dict.fromkeys(row["objective"] for row in rows)):
        part = [row for row in rows if row["objective"] == name]
        _series(axes, [(r["processor_seconds"], r["mesh_mm"]) for r in part], number, name)
        for row in part if len(part) > 1 else []:
            at = row["processor_seconds"], row["mesh_mm"]
            axes.annotate(row["max_iterations"], at, (3, 4), textcoords="offset points", fontsize=7)
    axes.set(xlabel=TIME, ylabel="mesh error, mm", title="Stage 1 (numbers: iterations allowed per round)")
    axes.set_ylim(bottom=0)
    axes.legend()


def _reflectance(axes: Any, figures: Row) -> None:
    rows = figures["reflectance"]["rows"]
    keys = list(dict.fromkeys((r["solver"], r["shading"], r["size"]) for r in rows))
    for number, (solver, shading, size) in enumerate(keys):
        part = [r for r in rows if (r["solver"], r["shading"], r["size"]) == (solver, shading, size)]
        style = {"linestyle": "--"} if solver == "adam" else {}
        points = [(r["processor_seconds"], r["third_db"]) for r in part]
        _series(axes, points, number, f"{solver}, {shading}, {size}²", **style)
    axes.set(xlabel=TIME, ylabel="held-out view, PSNR in dB", title="Stage 2 (texels a side)", xscale="log")
    axes.legend(fontsize=8)


def _normals(axes: Any, figures: Row) -> None:
    part = figures["normals"]
    floor = min(row["energy"] for row in part["rows"])
    for number, solver in enumerate(dict.fromkeys(row["solver"] for row in part["rows"])):
        rows = [row for row in part["rows"] if row["solver"] == solver]
        points = [(r["processor_seconds"], max(r["energy"] / floor - 1.0, 1e-5)) for r in rows]
        _series(axes, points, number, solver.replace("_", "-"))
        for row, (x, y) in zip(rows, points, strict=True):
            axes.annotate(row["iterations"], (x, y), (4, 4), textcoords="offset points", fontsize=7)
    axes.set(xlabel=TIME, ylabel="energy above the lowest found (drawn at 1e-5)", xscale="log", yscale="log")
    axes.set_title(f"Stage 3, one timestep, {part['texels']} texels (numbers: iterations)")
    axes.legend()


def growing(figures: Row) -> dict[str, Row]:
    """Every series with exponents."""
    found = {**figures.get("work", {}), **figures.get("growth", {})}
    return {label: series for label, series in found.items() if "exponent" in series}


def _growth(axes: Any, figures: Row) -> None:
    for number, (label, series) in enumerate(growing(figures).items()):
        rows = series["rows"]
        by = _variable(label)
        smallest = min(rows, key=lambda r: r[by])
        x = [row[by] / smallest[by] for row in rows]
        y = [row["processor_seconds"] / smallest["processor_seconds"] for row in rows]
        style = {"linestyle": "-" if number < 7 else "--"}
        name = f"{label}: {series['processor_exponent']:.2f}"
        _series(axes, zip(x, y, strict=True), number, name, **style)
    edge = axes.get_xlim()[1]
    axes.plot([1, edge], [1, edge], color="grey", linewidth=1, zorder=0)
    axes.set(xlabel="work over the smallest", ylabel="processor time over the smallest", xscale="log", yscale="log")
    axes.set_title("Growth with fitted exponents; grey: proportional")
    axes.legend(fontsize=7.5, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _variable(label: str) -> str:
    """What grows in a series, from its name: '... over surface points' -> surface_points."""
    return label.split(" over ", 1)[1].split(",")[0].replace(" ", "_")


def markdown(figures: Row) -> str:
    """Tables of growth, first call and the error-for-cost rows."""
    lines: list[str] = []
    if series := growing(figures):
        lines += [
            "| cost over | range | exponent, wall | exponent, processor | largest: seconds | MB |",
            "|---|---|---|---|---|---|",
        ]
        for label, found in series.items():
            by = _variable(label)
            rows = sorted(found["rows"], key=itemgetter(by))
            last = rows[-1]
            lines.append(
                f"| {label} | {rows[0][by]} to {last[by]} | {found['exponent']:.2f} | "
                f"{found['processor_exponent']:.2f} | {last['steady_seconds']:.2f} | {last['peak_mb']:.0f} |"
            )
        lines.append("")
    if "work" in figures:
        lines += ["| stage 2, maps of | texels | third view dB, true geometry | seconds | cpu s | MB |"]
        lines += ["|---|---|---|---|---|---|"]
        for r in figures["work"]["stage 2 over texels"]["rows"]:
            lines.append(
                f"| {r['size']}² | {r['texels']} | {r['third_db']:.2f} | {r['steady_seconds']:.1f} "
                f"| {r['processor_seconds']:.1f} | {r['peak_mb']:.0f} |"
            )
        lines += [
            "",
            "| views | timesteps | mesh mm | stage 1 cpu s | third view dB, true geometry | stage 2 cpu s |",
            "|---|---|---|---|---|---|",
        ]
        for views, words in ((1, "1 view"), (2, "2 views")):
            first = {r["timesteps"]: r for r in figures["work"][f"stage 1 over timesteps, {words}"]["rows"]}
            second = {r["timesteps"]: r for r in figures["work"][f"stage 2 over timesteps, {words}"]["rows"]}
            for count in sorted(first):
                found = second.get(count)
                more = f"{found['third_db']:.2f} | {found['processor_seconds']:.1f}" if found else " | "
                r = first[count]
                lines.append(f"| {views} | {count} | {r['mesh_mm']:.2f} | {r['processor_seconds']:.1f} | {more} |")
        lines.append("")
    if "first" in figures:
        lines += ["| | first call s | of which compilation | second call s | MB |", "|---|---|---|---|---|"]
        for name, pair in figures["first"].items():
            if isinstance(pair, dict) and "first" in pair:
                a, b = pair["first"], pair["second"]
                lines.append(
                    f"| {name} | {a['seconds']:.1f} | {a['compile_seconds']:.1f} | {b['seconds']:.1f} "
                    f"| {max(a['peak_mb'], b['peak_mb']):.0f} |"
                )
    return "\n".join(lines) + "\n"
