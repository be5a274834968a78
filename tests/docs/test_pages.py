"""What the pages say agrees with the code."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

from mifit.config import FitConfig, list_settings
from mifit.experiments.plan import Experiment

DOCS = Path(__file__).resolve().parents[2] / "docs"


def script(name: str):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["settings", "api"])
def test_the_page_is_what_the_code_says(name):
    written = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    made = getattr(script("build_reference"), f"{name}_page")(written)
    assert written == made, "run: python docs/build_reference.py"


def test_every_setting_is_on_its_page():
    page = (DOCS / "settings.md").read_text(encoding="utf-8")
    keys = [key for key, *_ in list_settings(FitConfig)] + [key for key, *_ in list_settings(Experiment)]
    fit = {f"fit.{key}" for key, *_ in list_settings(FitConfig)}
    assert all(f"|`{key}`|" in page for key in keys if key not in fit)
    assert "|`reflectance.bands`|`10`|3..10|" in page


def test_a_setting_that_changed_makes_the_page_old():
    page = (DOCS / "settings.md").read_text(encoding="utf-8")
    old = page.replace("|`reflectance.bands`|`10`|", "|`reflectance.bands`|`9`|")
    assert old != page and script("build_reference").settings_page(old) == page


@pytest.mark.parametrize("name", ["blinnphong", "shdirect", "shenv", "pinhole"])
def test_formulas_are_shown_and_not_their_source(name):
    markdown = pytest.importorskip("markdown")
    pytest.importorskip("latex2mathml")
    extension = "pymdownx.arithmatex"
    text = (DOCS / "plugins" / f"{name}.md").read_text()
    made = markdown.markdown(
        text, extensions=[extension, "pymdownx.superfences"], extension_configs={extension: {"generic": True}}
    )
    page = script("hooks").on_page_content(made)
    assert page.count("<math") == made.count('class="arithmatex"') and (name != "blinnphong" or "<mfrac>" in page)
    assert "arithmatex" not in page and not re.search(
        r"\\[a-z]+|\$\$", re.sub(r"<code.*?</code>", "", page, flags=re.S)
    )
