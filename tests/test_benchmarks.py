"""What the pages quote is what the benchmarks wrote."""

import shutil
from pathlib import Path

from benchmarks import relit_ablation
from benchmarks.record import RESULTS, renew_tables
from mifit.stages.reflectance import choice

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


def relit_row(path, local, held_out):
    relit = {name: {"city": value, "mean": value} for name, value in (("path", path), ("local", local))}
    return {"relit": relit, "held_out_db": held_out, "shading": "shadowed", "lights": 0, "exponent": 80.0}


def test_rows_of_the_relit_ablation_are_told_against_the_base_of_their_capture():
    base, matt, near, off = (
        next(part.label for part in relit_ablation.PARTS if text in part.label)
        for text in ("base", "specular", "near", "shadows")
    )
    one = {base: relit_row(26.0, 26.5, 35.0), matt: relit_row(25.0, 26.75, 34.5), near: {"same": True}}
    two = {base: relit_row(31.0, 31.5, 30.0), matt: relit_row(31.5, 31.5, 30.0), off: {"failed": "no light"}}
    text = relit_ablation.markdown({"one": {"rows": one}, "two": {"rows": two}}, 256, 64)
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in text.splitlines() if line.startswith("| ")}
    assert lines[matt].endswith("| -1.00 | +0.25 | -0.50 | +0.50 | +0.00 | +0.00 |")
    assert "| same fit |" in lines[near] and "| failed |" in lines[off] and base not in lines
    assert "relit by city 26.00 dB on average path traced, 26.50 dB by local shading; held-out skin 35.00 dB" in text


def test_a_part_of_the_relit_ablation_is_left_out_only_while_its_row_is_fitted():
    (one,) = (part for part in relit_ablation.PARTS if part.patches.get("mifit.stages.reflectance.choice.LIGHTS"))
    before = choice.LIGHTS
    with one.applied():
        assert choice.LIGHTS == 1
    assert choice.LIGHTS == before > 1
