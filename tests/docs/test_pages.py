"""What the pages say agrees with the code."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from mifit.config import FitConfig, list_settings
from mifit.experiments.plan import Experiment

DOCS = Path(__file__).resolve().parents[2] / "docs"


def hooks():
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_setting_is_on_its_page():
    page = hooks().on_page_markdown((DOCS / "settings.md").read_text())
    keys = [key for key, *_ in list_settings(FitConfig)] + [key for key, *_ in list_settings(Experiment)]
    fit = {f"fit.{key}" for key, *_ in list_settings(FitConfig)}
    assert all(f"| `{key}` |" in page for key in keys if key not in fit) and "<!--" not in page
    assert "| `reflectance.bands` | `10` | a whole number from 3 to 10 |" in page


@pytest.mark.parametrize("name", ["blinnphong", "shdirect", "shenv", "pinhole"])
def test_formulas_are_shown_and_not_their_source(name):
    markdown = pytest.importorskip("markdown")
    pytest.importorskip("latex2mathml")
    extension = "pymdownx.arithmatex"
    text = (DOCS / "plugins" / f"{name}.md").read_text()
    made = markdown.markdown(
        text, extensions=[extension, "pymdownx.superfences"], extension_configs={extension: {"generic": True}}
    )
    page = hooks().on_page_content(made)
    assert page.count("<math") == made.count('class="arithmatex"') and (name != "blinnphong" or "<mfrac>" in page)
    assert "arithmatex" not in page and not re.search(
        r"\\[a-z]+|\$\$", re.sub(r"<code.*?</code>", "", page, flags=re.S)
    )
