"""What mkdocs does to pages while it builds: entries of the API become their docstrings, formulas become MathML."""

from __future__ import annotations

import html
import re
from typing import Any

ENTRY = re.compile(r"^- `(mifit\.[\w.]+)`.*$", re.MULTILINE)
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put docstrings in the place of the entries of api.md (mkdocs calls this)."""
    if page.file.src_uri != "api.md":
        return markdown
    return ENTRY.sub(r"\n::: \1\n", markdown)


def with_formulas(page: str) -> str:
    """Turn the LaTeX of a page's formulas into MathML, which browsers show without scripts or a network."""
    from latex2mathml.converter import convert

    def made(found: re.Match[str]) -> str:
        return convert(html.unescape(found[3]), display="block" if found[2] == "[" else "inline")

    return FORMULA.sub(made, page)


def on_page_content(content: str, **_: Any) -> str:
    """Fill in a page that has become HTML (mkdocs calls this)."""
    return with_formulas(content)
