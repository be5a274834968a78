"""What the pages quote is what the benchmarks wrote; tables, parts and changes do what they say."""

import ast
import json
import re
import shutil
from pathlib import Path
from unittest.mock import patch

import pytest

from benchmarks import ablation, mutations
from benchmarks.mutations import Mutation
from benchmarks.record import RESULTS, renew_tables
from mifit.stages import find_surface

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS_PAGE = ROOT / "README.md", ROOT / "docs" / "results.md"


@pytest.mark.parametrize(
    ("page", "table"), [(README, "foreign_short"), (RESULTS_PAGE, "foreign"), (RESULTS_PAGE, "table1_short")]
)
def test_pages_quote_the_benchmarks_tables(page, table, tmp_path):
    copied = Path(shutil.copy(page, tmp_path))
    assert table in renew_tables(copied, RESULTS)
    assert copied.read_text() == page.read_text()


def test_tables_are_renewed_between_their_marks_alone(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- one -->\nold\n<!-- /one -->\nb\n<!-- two -->\nkept\n<!-- /two -->\n")
    (tmp_path / "one.md").write_text("| new |\n")
    assert renew_tables(page, tmp_path) == ["one"]
    assert page.read_text() == "a\n<!-- one -->\n| new |\n<!-- /one -->\nb\n<!-- two -->\nkept\n<!-- /two -->\n"


def test_every_quoted_table_has_figures_with_machine_of_one_commit():
    pages = [README, *(ROOT / "docs").glob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    quoted = {*re.findall(r"<!-- (\w+) -->\n", text), *re.findall(r"benchmarks/results/(\w+)\.(?:md|json)", text)}
    commits = {}
    quoted = {name.removesuffix("_short") for name in quoted - {"given"}}
    for name in quoted:
        stored = json.loads((RESULTS / f"{name}.json").read_text())
        assert {"machine", "figures"} <= set(stored) and stored["machine"]["commit"], name
        commits[name] = stored["machine"]["commit"]
    assert len(set(commits.values())) == 1, commits
    written = {path.stem for path in RESULTS.glob("*.json")}
    # The ablation is of the code that it judged, with parts that are gone since.
    assert written <= quoted | {"ablation"}, "figures that no page quotes"


# -- the ablation ------------------------------------------------------------


def row(**figures):
    return {"skin": 30.0, "alone": 29.0, "whole": 25.0, "cpu": 40.0, **figures}


def test_parts_are_told_against_the_base_of_their_head_and_set():
    one, two = (part.label for part in ablation.PARTS[1:3])
    rows = {"base": row(), one: row(skin=29.0, cpu=30.0), two: {"gone": "no such setting"}}
    other = {"base": row(skin=20.0, mm=0.5), one: row(skin=20.5, mm=0.6)}
    heads = {
        "a": {"set": "locked", "changed": "", "commit": "1234567", "rows": rows},
        "b": {"set": "locked", "changed": "", "commit": "1234567", "rows": other},
        "c": {"set": "development", "changed": "", "commit": "1234567", "rows": other},
    }
    lines = ablation.markdown(heads, 256).splitlines()
    means = next(line for line in lines if line.startswith(f"| {one} |"))
    assert means.startswith(f"| {one} | +0.50 |") and "| -0.25 |" in means and "| -5 |" in means
    assert any(line.startswith(f"| {two} | gone |") for line in lines)
    assert len({line.count("|") for line in lines if line.startswith("| part switched off") or line == means}) == 1


def test_a_part_is_off_only_while_its_row_is_fitted():
    (part,) = (part for part in ablation.PARTS if "mifit.stages.find_surface.align_timesteps" in part.patches)
    before = find_surface.align_timesteps
    with part.applied():
        assert find_surface.align_timesteps is not before
    assert find_surface.align_timesteps is before


def test_a_part_that_there_is_no_more_is_named(monkeypatch):
    gone = ablation.Part("x", {"reflectance.no_such_setting": 1}), ablation.Part("y", patches={"mifit.config.No": 1})
    for part in gone:
        assert "gone" in ablation.row_of(part, fits=None, size=64) or "gone" in ablation.row_of(part, _Fits(), 64)


class _Fits:
    case = None

    def fit(self, part, size):
        part.config(size)
        raise AssertionError("expected to be named as gone")


# -- changes that tests must notice ------------------------------------------------------------


SOURCE = '''
WIDE = 2


class Thing:
    def area(self, x):
        """ä before the code."""
        return (self.a * x   +
                1)


def area(x):
    return x + 1
'''


@pytest.fixture
def package(tmp_path):
    (tmp_path / "mifit" / "deep").mkdir(parents=True)
    (tmp_path / "mifit" / "deep" / "shape.py").write_text(SOURCE)
    return tmp_path


@pytest.mark.parametrize(
    "function, old, new, expected",
    [
        ("shape.Thing.area", "self.a * x + 1", "0", "return (0)"),
        ("shape.area", "x + 1", "x - 1", "    return x - 1\n"),
        ("shape.area", "return x + 1", "pass", "    pass\n"),
        ("shape", "WIDE = 2", "WIDE = 3", "WIDE = 3\n"),
    ],
)
def test_a_change_is_found_by_its_function_however_the_code_is_laid_out(package, function, old, new, expected):
    path, text, changed = Mutation("", function, old, new, "").find(package)
    assert path.name == "shape.py" and text == SOURCE and expected in changed and changed != text
    ast.parse(changed)


@pytest.mark.parametrize("function, old", [("shape.area", "x + 2"), ("shape.volume", "x + 1"), ("form.area", "x + 1")])
def test_a_change_that_finds_no_code_is_lost(package, function, old):
    assert Mutation("", function, old, "0", "").find(package) is None
    with patch.object(mutations, "ROOT", package):
        assert mutations.judge(Mutation("", function, old, "0", ""), package)["verdict"] == mutations.LOST


def test_code_in_two_places_of_a_function_is_lost(package):
    text = SOURCE + "\n\ndef twice(x):\n    return (x + 1) * (x + 1)\n"
    (package / "mifit" / "deep" / "shape.py").write_text(text)
    assert Mutation("", "shape.twice", "x + 1", "0", "").find(package) is None
