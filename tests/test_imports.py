"""Imports go one way, and importing mifit loads no Mitsuba."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "mifit"
BASE = {"errors", "config", "progress"}
MAY_IMPORT = {
    "core": BASE | {"core"},
    "morphable": BASE | {"core", "morphable"},
    "capture": BASE | {"core", "capture"},
    "solve": BASE | {"core", "solve"},
    "render": BASE | {"core", "render"},
    "synth": BASE | {"core", "morphable", "capture", "render", "synth"},
    "stages": BASE | {"core", "morphable", "capture", "solve", "render", "stages"},
    "output": BASE | {"core", "morphable", "capture", "solve", "render", "stages", "output"},
}
FILES = sorted(p for part in MAY_IMPORT for p in (PACKAGE / part).rglob("*.py"))


def imported_names(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names.update(f"{node.module}.{alias.name}" for alias in node.names if node.module == "mifit")
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_one_way(path):
    part = path.relative_to(PACKAGE).parts[0]
    names = imported_names(path)
    parts = {name.split(".")[1] for name in names if name.startswith("mifit.")}
    assert parts - {"__version__"} <= MAY_IMPORT[part]
    if part != "render":
        assert not {name.split(".")[0] for name in names} & {"mitsuba", "drjit"}


def test_importing_mifit_leaves_mitsuba_unloaded():
    code = "import sys, mifit, mifit.cli, mifit.commands; sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_public_name_loads():
    code = "import mifit\nfor n in mifit.__all__: getattr(mifit, n)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
