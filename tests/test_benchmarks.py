"""What the pages quote is what the benchmarks wrote."""

import shutil
from pathlib import Path

from benchmarks.record import RESULTS, renew_tables

README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_readme_quotes_the_benchmarks_tables(tmp_path):
    page = Path(shutil.copy(README, tmp_path))
    assert "captures" in renew_tables(page, RESULTS)
    assert page.read_text() == README.read_text()


def test_tables_are_renewed_between_their_marks_alone(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- one -->\nold\n<!-- /one -->\nb\n<!-- two -->\nkept\n<!-- /two -->\n")
    (tmp_path / "one.md").write_text("| new |\n")
    assert renew_tables(page, tmp_path) == ["one"]
    assert page.read_text() == "a\n<!-- one -->\n| new |\n<!-- /one -->\nb\n<!-- two -->\nkept\n<!-- /two -->\n"
