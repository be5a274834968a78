"""Imports go one way; Mitsuba and Dr.Jit come late and only where images are formed."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mifit

PACKAGE = Path(mifit.__file__).parent
LAYERS = (
    {"errors", "progress"},
    {"config"},
    {"core"},
    {"optim"},
    {"morphable", "capture"},
    {"appearance"},
    {"cache"},
    {"render"},
    {"sampling"},
    {"synth", "stages", "result"},
    {"output"},
    {"tracking"},
    {"extras"},
    {"fitting"},
    {"experiments"},
)
"""Parts from the lowest to the highest: a part imports only those of lower rows."""
TOP = {"cli", "__main__", "__init__"}  # may import everything
NEVER = {"result": {"render"}, "output": {"stages"}}
"""Lower parts that a part has no business with: a result renders nothing, what is written fits nothing."""
KERNELS = {"render", "appearance"}
"""Parts whose functions may import Mitsuba and Dr.Jit."""

LATE = {"result/reconstruction.py"}
"""Files whose functions may import what is above them: the methods of a result that show, read and write it."""

FILES = {str(path.relative_to(PACKAGE)): path for path in sorted(PACKAGE.rglob("*.py"))}
MODULES = {
    ".".join(("mifit", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): name
    for name, path in FILES.items()
}


@functools.cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


def imported_names(tree: ast.AST, types: bool = True, late: bool = True) -> set[str]:
    """Every module or name of one that a file imports; ``types``: for type checkers too, ``late``: in functions too."""
    names, nodes = set(), [tree]
    while nodes:
        node = nodes.pop()
        if not late and (
            isinstance(node, ast.FunctionDef)
            or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        ):
            continue
        if not types and isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        nodes.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports within the package are absolute"
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "mifit":
            names.add(f"{mifit._EXPORTS.get(node.attr, 'mifit')}.{node.attr}")  # what the package loads on demand
    return names


def imports_of(tree: ast.AST, types: bool = True, late: bool = True) -> set[str]:
    """Modules of the package that a file imports."""
    modules = set()
    for name in imported_names(tree, types, late):
        while name not in MODULES and "." in name:
            name = name.rpartition(".")[0]
        modules.add(name)
    return modules & set(MODULES)


def part_of(name: str) -> str:
    """The part of the package that a file, by its path in it, belongs to."""
    return Path(name).parts[0].removesuffix(".py")


@pytest.mark.parametrize("name", FILES)
def test_imports_go_one_way(name):
    """Downwards in LAYERS; so nothing of the core imports extras, and no two parts import one another."""
    part = part_of(name)
    if part in TOP:
        return
    rows = [row for row, parts in enumerate(LAYERS) if part in parts]
    assert len(rows) == 1, f"say in LAYERS where mifit.{part} stands"
    lower = set().union(*LAYERS[: rows[0]]) - NEVER.get(part, set())
    parts = {module.split(".")[1] for module in imports_of(tree_of(name), False, name not in LATE) if module != "mifit"}
    assert parts <= lower | {part}


@pytest.mark.parametrize("name", FILES)
def test_mitsuba_and_drjit_are_imported_late_and_only_by_what_forms_images(name):
    kernels = {"mitsuba", "drjit"}
    names = imported_names(tree_of(name))
    found = {n.split(".")[0] for n in names} & kernels | names & {f"mifit.appearance.arrays.{n}" for n in ("dr", "mi")}
    assert part_of(name) in KERNELS or not found
    for node in tree_of(name).body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            assert not {n.split(".")[0] for n in imported_names(node)} & kernels


def test_the_core_does_without_extras():
    """Commands load them when they are wanted, and `mifit.fit` for a capture without calibration."""
    users = {part_of(name) for name in FILES if any(m.startswith("mifit.extras") for m in imports_of(tree_of(name)))}
    assert users <= {"extras", "cli", "fitting"}
    for name in FILES:
        top = [node for node in tree_of(name).body if isinstance(node, (ast.Import, ast.ImportFrom))]
        early = {found for node in top for found in imports_of(ast.Module([node], []))}
        assert part_of(name) == "extras" or not any(module.startswith("mifit.extras") for module in early)


def test_no_modules_import_one_another():
    """Not even for types: what two modules say about one another belongs in a third."""
    reach = {module: imports_of(tree_of(name), late=name not in LATE) - {module} for module, name in MODULES.items()}
    changed = True
    while changed:
        changed = False
        for targets in reach.values():
            more = set().union(*(reach[t] for t in targets)) - targets
            changed |= bool(more)
            targets |= more
    assert [sorted(o for o in reach[m] if m in reach[o]) for m in reach if m in reach[m]] == []


def test_importing_mifit_leaves_mitsuba_unloaded():
    code = "import sys, mifit, mifit.cli; sys.exit(bool({'mitsuba', 'drjit'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_public_name_loads():
    code = "import mifit\nfor n in mifit.__all__: getattr(mifit, n)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_api_page_has_every_public_name():
    page = (PACKAGE.parent / "docs" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^- `([\w.]+)`", page, re.MULTILINE))
    for name in set(mifit.__all__) - {"__version__"}:
        value = getattr(mifit, name)
        assert {f"{value.__module__}.{value.__qualname__}", value.__module__} & listed, name


def test_no_module_depends_on_a_backend() -> None:
    """Which of Dr.Jit's backends runs is the variant's business: code that names one breaks under the other."""
    tests = Path(__file__).parent
    knows = {PACKAGE / "render" / "variant.py", tests / "variant.py", tests / "conftest.py", Path(__file__)}
    knows |= {tests / "render" / "test_variant.py", tests / "render" / "test_blinnphong.py"}
    knows |= {tests / "hostile" / "test_readers.py"}  # the choice of a backend itself; other variants of plugins
    words = ("llvm_ad", "cuda_ad", "drjit.llvm", "drjit.cuda", "dr.llvm", "dr.cuda")
    for path in [*PACKAGE.rglob("*.py"), *tests.rglob("*.py")]:
        found = [word for word in words if path not in knows and word in path.read_text()]
        assert not found, f"{path}: names {found[0]}"
