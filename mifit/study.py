"""What a sweep says over subjects: means with confidence intervals, and plots of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from mifit.core.files import replacing

SUBJECTS = ("fit.capture", "fit.synth.seed")
"""Swept keys whose values are subjects: figures are averaged over them."""
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Group:
    """One setting of a sweep over all its subjects.

    Attributes
    ----------
    settings : dict
        Swept keys other than `SUBJECTS`, with their values.
    subjects : int
        How many there are.
    metrics : dict
        Metric -> (mean, half the width of its confidence interval), None for the half width of a single subject.
    """

    settings: dict[str, Any]
    subjects: int
    metrics: dict[str, tuple[float, float | None]]


def over_subjects(rows: Sequence[dict[str, Any]]) -> list[Group]:
    """Mean and Student's t interval at `CONFIDENCE` of each metric over the subjects of every setting.

    Parameters
    ----------
    rows : sequence of dict
        A run each: ``swept`` and ``metrics``.

    Returns
    -------
    list of Group
        In the order of the runs; empty where no run names a subject. A metric that a subject lacks is left out.
    """
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        if set(row["swept"]) & set(SUBJECTS):
            found.setdefault(str(_settings(row)), []).append(row)
    groups = []
    for members in found.values():
        shared = [m for m in members[0]["metrics"] if all(m in row["metrics"] for row in members)]
        metrics = {name: interval([row["metrics"][name] for row in members]) for name in shared}
        groups.append(Group(_settings(members[0]), len(members), metrics))
    return groups


def _settings(row: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in row["swept"].items() if key not in SUBJECTS}


def interval(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and half the width of its interval, t((1 + `CONFIDENCE`) / 2, n - 1) s / sqrt(n); None for one value."""
    n = len(values)
    if n < 2:
        return float(values[0]), None
    return float(np.mean(values)), float(stats.t.ppf(0.5 * (1 + CONFIDENCE), n - 1) * np.std(values, ddof=1) / n**0.5)


def subjects_table(groups: Sequence[Group]) -> list[str]:
    """Lines of a Markdown table: a row per setting, mean ± half width per metric."""
    if not groups:
        return []
    keys, metrics = list(groups[0].settings), list(groups[0].metrics)
    lines = ["", f"Mean and {CONFIDENCE:.0%} confidence interval over subjects:", ""]
    lines.append("| " + " | ".join([*keys, "subjects", *metrics]) + " |")
    lines.append("|" + " --- |" * len(keys) + " ---: |" * (1 + len(metrics)))
    for group in groups:
        cells = [*(str(group.settings.get(key, "")) for key in keys), str(group.subjects)]
        for name in metrics:
            mean, half = group.metrics.get(name, (float("nan"), None))
            cells.append(f"{mean:.4g}" if half is None else f"{mean:.4g} ± {half:.2g}")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def draw(folder: Path, rows: Sequence[dict[str, Any]], groups: Sequence[Group]) -> list[Path]:
    """Plot every metric over the first swept setting, with intervals where there are subjects; a line per other one.

    Returns
    -------
    list of path
        ``METRIC.svg`` files; empty without matplotlib (extra ``bench``), or with fewer than two settings.
    """
    points = list(groups) or [Group(row["swept"], 1, {k: (v, None) for k, v in row["metrics"].items()}) for row in rows]
    if len(points) < 2 or not points[0].settings:
        return []
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        return []
    first = next(iter(points[0].settings))
    numeric = all(isinstance(p.settings.get(first), (int, float)) for p in points)
    places: list[Any] = list(
        dict.fromkeys(p.settings.get(first) for p in points if not isinstance(p.settings.get(first), list))
    )
    series: dict[str, list[Group]] = {}
    for point in points:
        rest = ", ".join(f"{k.rsplit('.', 1)[-1]} {v}" for k, v in point.settings.items() if k != first)
        series.setdefault(rest, []).append(point)
    written = []
    for metric in points[0].metrics:
        figure = Figure(figsize=(5, 3.2), layout="constrained")
        axes = figure.subplots()
        for label, members in series.items():
            shown = [p for p in members if metric in p.metrics and p.settings.get(first) in places]
            x = [p.settings[first] if numeric else places.index(p.settings[first]) for p in shown]
            y = [p.metrics[metric][0] for p in shown]
            axes.errorbar(x, y, [p.metrics[metric][1] or 0.0 for p in shown], marker="o", capsize=3, label=label)
        if not numeric:
            axes.set_xticks(range(len(places)), [Path(str(p)).name for p in places])
        axes.set(xlabel=first, ylabel=metric)
        if len(series) > 1:
            axes.legend()
        path = folder / f"{metric}.svg"
        with replacing(path) as temporary, rc_context({"svg.hashsalt": "mifit"}):  # the same runs, the same file
            figure.savefig(temporary, format="svg", metadata={"Date": None})
        written.append(path)
    return written
