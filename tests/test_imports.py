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
    "appearance": BASE | {"core", "appearance"},
    "render": BASE | {"core", "appearance", "render"},
    "synth": BASE | {"core", "morphable", "capture", "render", "synth"},
    "stages": BASE | {"core", "morphable", "capture", "solve", "appearance", "render", "stages"},
    "result": BASE | {"core", "morphable", "appearance", "result"},
    "output": BASE | {"core", "capture", "morphable", "appearance", "render", "result", "output"},
}
FILES = sorted(p for part in MAY_IMPORT for p in (PACKAGE / part).rglob("*.py"))


def imported_names(path: Path) -> set[str]:
    """Modules that a file imports, inside functions too; what is for type checkers alone is not imported."""
    names, nodes = set(), [ast.parse(path.read_text())]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            continue
        nodes.extend(ast.iter_child_nodes(node))
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
    if part not in ("appearance", "render"):
        assert not {name.split(".")[0] for name in names} & {"mitsuba", "drjit"}


def imports_of(path: Path) -> set[str]:
    """Modules of the package that a file imports, inside functions and for types included."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    modules = set()
    for name in found:
        while name not in MODULES and "." in name:
            name = name.rpartition(".")[0]
        modules.add(name)
    return modules & set(MODULES)


MODULES = {
    ".".join(("mifit", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in PACKAGE.rglob("*.py")
}


def circles() -> list[set[str]]:
    """Sets of modules that import one another, directly or through others."""
    edges = {name: imports_of(path) - {name} for name, path in MODULES.items()}
    reach = {name: set(targets) for name, targets in edges.items()}
    changed = True
    while changed:
        changed = False
        for targets in reach.values():
            more = set().union(*(reach[t] for t in targets)) - targets
            changed |= bool(more)
            targets |= more
    found = {frozenset(other for other in reach[name] if name in reach[other]) for name in reach if name in reach[name]}
    return [set(circle) for circle in found]


def test_no_modules_import_one_another():
    assert circles() == []


def test_importing_mifit_leaves_mitsuba_unloaded():
    code = "import sys, mifit, mifit.cli, mifit.commands; sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_public_name_loads():
    code = "import mifit\nfor n in mifit.__all__: getattr(mifit, n)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
