"""What mkdocs fills in while it builds: tables that are made from the code itself."""

from __future__ import annotations

import html
import re
from typing import Any

SETTINGS = "<!-- settings of {name} -->"


def settings_tables(text: str) -> str:
    """Put a table in the place of every ``<!-- settings of NAME -->``."""
    from mifit import config
    from mifit.experiments.plan import Experiment

    tables = {
        "fit": (config.FitConfig, ""),
        "experiment": (Experiment, ""),
    }
    for name, (cls, prefix) in tables.items():
        text = text.replace(SETTINGS.format(name=name), settings_table(cls, prefix, skip=name == "experiment"))
    return text


def settings_table(cls: type, prefix: str, skip: bool = False) -> str:
    """A Markdown table of all settings below a class; ``skip``: without those of the stages."""
    from mifit.config import FitConfig, list_settings

    stages = {f"fit.{key}" for key, *_ in list_settings(FitConfig)} if skip else set()
    lines = ["| key | default | expected | meaning |", "| --- | --- | --- | --- |"]
    for key, default, expected, meaning in list_settings(cls, prefix):
        if key not in stages:
            shown = "" if default is None else f"`{_toml(default)}`"
            lines.append(f"| `{key}` | {shown} | {expected} | {meaning} |")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in a page (mkdocs calls this)."""
    return settings_tables(markdown)


FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def with_formulas(page: str) -> str:
    """Turn the LaTeX of a page's formulas into MathML, which browsers show without scripts or a network."""
    from latex2mathml.converter import convert

    def made(found: re.Match[str]) -> str:
        return convert(html.unescape(found[3]), display="block" if found[2] == "[" else "inline")

    return FORMULA.sub(made, page)


def on_page_content(content: str, **_: Any) -> str:
    """Fill in a page that has become HTML (mkdocs calls this)."""
    return with_formulas(content)
