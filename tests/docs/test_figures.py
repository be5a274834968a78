"""Figures that the pages state are figures that a benchmark wrote."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
FIGURE = re.compile(
    r"(?<![\w.])(\d+(?:\.\d+)?)(?: to (\d+(?:\.\d+)?))?\s?(dB|mm|millimetres|degrees|°|seconds|s|ms|%)(?!\w)"
)
GIVEN = "<!-- given -->"
"""Ends a line whose figures are settings or definitions, which no benchmark measures."""
FACTORS = (1.0, 100.0, 1000.0, 10.0)
"""Per cent of a part, milliseconds of seconds, millimetres of centimetres."""


def numbers(value: object) -> Iterator[float]:
    """All numbers in a JSON value, those inside its texts included."""
    if isinstance(value, bool) or value is None:
        return
    if isinstance(value, (int, float)):
        yield float(value)
    elif isinstance(value, str):
        yield from (float(x) for x in re.findall(r"\d+(?:\.\d+)?", value))
    else:
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers(part)


def measured(folder: Path) -> list[float]:
    return [x for path in sorted(folder.glob("*.json")) for x in numbers(json.loads(path.read_text()).get("figures"))]


def figures(text: str) -> list[tuple[str, str]]:
    """The figures of a page: number and unit."""
    found = []
    for line in text.splitlines():
        if not line.endswith(GIVEN):
            found += [(n, unit) for *pair, unit in FIGURE.findall(line) for n in pair if n]
    return found


def unmeasured(text: str, known: list[float]) -> list[str]:
    """Figures of a page that no number rounds to."""
    missing = []
    for number, unit in figures(text):
        digits = len(number.partition(".")[2])
        wanted = float(number)
        if not any(round(abs(x) * factor, digits) == wanted for factor in FACTORS for x in known):
            missing.append(f"{number} {unit}")
    return missing


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_figure_of_a_page_is_in_a_benchmarks_json(page):
    assert unmeasured(page.read_text(encoding="utf-8"), measured(ROOT / "benchmarks" / "results")) == []


def test_a_figure_that_no_benchmark_wrote_is_found():
    known = list(numbers({"a": [28.713, "1.5 mm"], "b": {"c": 0.043}}))
    text = f"It reaches 28.71 dB, 1.5 mm and 4.3 %, but not 28.72 dB.\nA blur of 7 mm. {GIVEN}\nFrom 28.7 to 31.9 dB."
    assert unmeasured(text, known) == ["28.72 dB", "31.9 dB"]
