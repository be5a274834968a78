"""What the pages say agrees with the code."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from mifit.config import FitConfig
from mifit.plan import Experiment
from mifit.schema import list_settings

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
