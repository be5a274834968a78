"""Write the parts of docs/settings.md and docs/api.md that the code itself says.

    python docs/build_reference.py

Between ``<!-- settings of NAME -->`` and its end stands a table of all settings; every line of docs/api.md that starts
with a name of the package ends with the first line of its docstring. Both are committed, so that the pages read well
without a build.
"""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

from mifit.config import FitConfig, list_settings
from mifit.experiments.plan import Experiment

DOCS = Path(__file__).resolve().parent
ENTRY = re.compile(r"^- `(mifit\.[\w.]+)`.*$", re.MULTILINE)


def settings_page(text: str) -> str:
    """The page of settings with its tables as the code has them."""
    stages = {f"fit.{key}" for key, *_ in list_settings(FitConfig)}
    rows = [row for row in list_settings(Experiment) if row[0] not in stages]
    for name, table in (("fit", list_settings(FitConfig)), ("experiment", rows)):
        begin, end = f"<!-- settings of {name} -->", f"<!-- /settings of {name} -->"
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found:
            raise ValueError(f"docs/settings.md: found no {begin} ... {end}")
        lines = [f"|`{key}`|{_toml(value)}|{_short(expected)}|{meaning}|" for key, value, expected, meaning in table]
        text = "\n".join([before + begin, "", "|key|default|expected|meaning|", "|---|---|---|---|", *lines, "", end])
        text += after
    return text


def api_page(text: str) -> str:
    """The page of the API with the first lines of today's docstrings."""
    return ENTRY.sub(lambda found: f"- `{found[1]}`: {_summary(found[1])}", text)


def _summary(name: str) -> str:
    """First sentence of what a dotted name says of itself."""
    module, _, attribute = name.rpartition(".")
    try:
        thing = importlib.import_module(name)
    except ModuleNotFoundError:
        thing = getattr(importlib.import_module(module), attribute)
    paragraph = (inspect.getdoc(thing) or "").split("\n\n")[0]
    return re.split(r"\. (?=[A-Z`])", " ".join(paragraph.split()))[0].rstrip(".:").replace("``", "`")


def _short(expected: str) -> str:
    """What a setting takes, as an interval."""
    text = re.sub(r"^a (?:finite|whole) number ", "", expected).replace("1e+09", "1e9").replace("true or false", "bool")
    text = re.sub(r"^from (\S+) to (\S+)", r"\1..\2", text)
    return re.sub(r"^above (\S+), at most (\S+)", r">\1..\2", text)


def _toml(value: Any) -> str:
    return "" if value is None else f"`{_literal(value)}`"


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return f"[{', '.join(map(_literal, value))}]"
    return f'"{value}"' if isinstance(value, str) else str(value)


def main() -> None:
    """Write both pages."""
    for name, page in (("settings", settings_page), ("api", api_page)):
        path = DOCS / f"{name}.md"
        path.write_text(page(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
