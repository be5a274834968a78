"""Tables and plots of a sweep: a row for each run, and means with confidence intervals over subjects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mifit.core.files import Document, replacing

SUBJECTS = ("fit.capture", "fit.synth.seed")
"""Swept keys whose values are subjects: figures are averaged over them."""


@dataclass(frozen=True)
class Group:
    """One setting of a sweep over all its subjects.

    ``settings`` are the swept keys other than `SUBJECTS`; ``metrics`` have for each metric its mean and half the width
    of its 95 % confidence interval, None for a single subject.
    """

    settings: Document
    subjects: int
    metrics: dict[str, tuple[float, float | None]]


def over_subjects(rows: Sequence[Document]) -> list[Group]:
    """Means and Student's t intervals over the subjects of every setting, in the order of the runs.

    ``rows`` are runs with ``swept`` and ``metrics``. Empty where no run names a subject; a metric that a subject lacks
    is left out.
    """
    found: dict[str, list[Document]] = {}
    for row in rows:
        if set(row["swept"]) & set(SUBJECTS):
            found.setdefault(str(_settings(row)), []).append(row)
    groups = []
    for members in found.values():
        shared = [m for m in members[0]["metrics"] if all(m in row["metrics"] for row in members)]
        metrics = {name: interval([row["metrics"][name] for row in members]) for name in shared}
        groups.append(Group(_settings(members[0]), len(members), metrics))
    return groups


def _settings(row: Document) -> Document:
    return {key: value for key, value in row["swept"].items() if key not in SUBJECTS}


def interval(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean, and half the width of its 95 % confidence interval; None for one value."""
    from scipy import stats  # takes as long to import as all else of an experiment

    half = float(stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)) if len(values) > 1 else None
    return float(np.mean(values)), half


def runs_table(rows: Sequence[Document]) -> list[str]:
    """Lines of a Markdown table: a row for each run, its swept values and its metrics."""
    cells = [{k: f"{v:.4g}" for k, v in row["metrics"].items()} for row in rows]
    swept = [{k: str(v) for k, v in row["swept"].items()} for row in rows]
    return _markdown(swept, cells)


def subjects_table(groups: Sequence[Group]) -> list[str]:
    """Lines of a Markdown table: a row for each setting, mean ± half width of each metric."""
    if not groups:
        return []
    settings = [{k: str(v) for k, v in group.settings.items()} for group in groups]
    cells = [
        {"subjects": str(group.subjects)}
        | {k: f"{m:.4g}" if half is None else f"{m:.4g} ± {half:.2g}" for k, (m, half) in group.metrics.items()}
        for group in groups
    ]
    return ["", "Mean and 95% confidence interval over subjects:", "", *_markdown(settings, cells)]


def _markdown(left: Sequence[dict[str, str]], right: Sequence[dict[str, str]]) -> list[str]:
    """A table of named cells, those of ``right`` aligned to the right; a name that a row lacks is left empty."""
    if not left:
        return []
    heads = [list(dict.fromkeys(name for row in side for name in row)) for side in (left, right)]
    lines = [" | ".join(heads[0] + heads[1]), " | ".join(["---"] * len(heads[0]) + ["---:"] * len(heads[1]))]
    for one, other in zip(left, right, strict=True):
        lines.append(" | ".join([*(one.get(n, "") for n in heads[0]), *(other.get(n, "") for n in heads[1])]))
    return [f"| {line} |" for line in lines]


def draw(folder: Path, rows: Sequence[Document], groups: Sequence[Group]) -> None:
    """Write a plot of every metric over the first swept setting, ``METRIC.svg``; a line for each of the other settings.

    Intervals are drawn where there are subjects. Nothing is written without matplotlib (extra ``bench``), or with fewer
    than two settings.
    """
    points = list(groups) or [Group(row["swept"], 1, {k: (v, None) for k, v in row["metrics"].items()}) for row in rows]
    if len(points) < 2 or not points[0].settings:
        return
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError:
        return
    first = next(iter(points[0].settings))
    points = [p for p in points if first in p.settings]
    numeric = all(isinstance(p.settings[first], (int, float)) for p in points)
    names = list(dict.fromkeys(str(p.settings[first]) for p in points))
    series: dict[str, list[Group]] = {}
    for point in points:
        rest = ", ".join(f"{k.rsplit('.', 1)[-1]} {v}" for k, v in point.settings.items() if k != first)
        series.setdefault(rest, []).append(point)
    for metric in points[0].metrics:
        figure = Figure(figsize=(5, 3.2), layout="constrained")
        axes = figure.subplots()
        for label, members in series.items():
            shown = [p for p in members if metric in p.metrics]
            x = [p.settings[first] if numeric else names.index(str(p.settings[first])) for p in shown]
            means, halves = zip(*(p.metrics[metric] for p in shown), strict=True)
            axes.errorbar(x, means, [half or 0.0 for half in halves], marker="o", capsize=3, label=label)
        if not numeric:
            axes.set_xticks(range(len(names)), [Path(name).name for name in names])
        axes.set(xlabel=first, ylabel=metric)
        if len(series) > 1:
            axes.legend()
        path = folder / f"{metric}.svg"
        with replacing(path) as temporary, rc_context({"svg.hashsalt": "mifit"}):  # the same runs, the same file
            figure.savefig(temporary, format="svg", metadata={"Date": None})
