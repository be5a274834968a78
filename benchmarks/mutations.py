"""Small changes to the code that some test must notice.

    python -m benchmarks.mutations [--only WORDS] [--jobs 1] [--list]

Copies package, benchmarks and tests to a temporary folder, makes one change at a time (`benchmarks.mutation_list`) and
runs the few tests that should notice. A change *survives* when they pass; it is *lost* when its pattern doesn't match
exactly once any more, because the code was rewritten: both fail the run. A change counts as noticed only when a test
fails, not when the code can't be imported. Writes ``benchmarks/results/mutations.json`` and ``mutations.md``.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.measure import conditions
from benchmarks.record import RESULTS, record
from mifit.core.files import write_text

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("mifit", "benchmarks", "tests", "scenes", "docs", "README.md", "pyproject.toml")
TIMEOUT = 600
NOTICED, SURVIVED, LOST, BROKEN = "noticed", "survived", "lost", "not importable"


@dataclass(frozen=True)
class Mutation:
    """One change.

    Attributes
    ----------
    name : str
        What the change does, in words.
    files : str
        Glob below the root; wide enough that the code may move.
    pattern, replacement : str
        Regular expression, multi-line, that must match exactly once in all files together, and what takes its place.
    tests : str
        Arguments of pytest: the tests that should notice.
    """

    name: str
    files: str
    pattern: str
    replacement: str
    tests: str

    def find(self, root: Path) -> tuple[Path, str, str] | None:
        """The file that holds the pattern, its text and the changed text; None where there isn't exactly one place."""
        places = []
        for path in sorted(root.glob(self.files)):
            text = path.read_text(encoding="utf-8")
            count = len(re.findall(self.pattern, text, flags=re.MULTILINE))
            places += [(path, text)] * count
        if len(places) != 1:
            return None
        path, text = places[0]
        return path, text, re.sub(self.pattern, self.replacement, text, flags=re.MULTILINE)


def copy_project(folder: Path) -> Path:
    """A copy of what the tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.svg", "*.gif"))
        elif source.exists():
            shutil.copy(source, folder / name)
    return folder


def run_tests(folder: Path, tests: str) -> tuple[int, str]:
    """Exit code of pytest in a copy, and its last line."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"stopped after {TIMEOUT} s"
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode, (lines or done.stdout.splitlines() or [""])[-1]


def judge(mutation: Mutation, folder: Path) -> dict[str, Any]:
    """Make a change in a copy, run its tests, and undo it."""
    began = time.perf_counter()
    row: dict[str, Any] = {"change": mutation.name, "tests": mutation.tests}
    found = mutation.find(folder)
    if found is None:
        return {**row, "verdict": LOST}
    path, text, changed = found
    row["file"] = str(path.relative_to(folder))
    path.write_text(changed, encoding="utf-8")
    try:
        code, said = run_tests(folder, mutation.tests)
    finally:
        path.write_text(text, encoding="utf-8")
    verdict = {0: SURVIVED, 1: NOTICED}.get(code, BROKEN)
    return {**row, "verdict": verdict, "by": said[:160], "seconds": round(time.perf_counter() - began, 1)}


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table: what was changed, where, and what noticed it."""
    counts = Counter(row["verdict"] for row in rows)
    lines = [
        f"{counts[NOTICED]} of {len(rows)} changes are noticed; {counts[SURVIVED]} survive.",
        "",
        "| change | in | verdict |",
        "|---|---|---|",
    ]
    for row in rows:
        verdict = row["verdict"] if row["verdict"] == NOTICED else f"**{row['verdict']}**"
        lines.append(f"| {row['change']} | `{row.get('file', '-')}` | {verdict} |")
    return "\n".join(lines) + "\n"


def run(mutations: list[Mutation], jobs: int) -> list[dict[str, Any]]:
    """Judge all changes, each job in a copy of its own; tests that fail in an unchanged copy notice nothing."""
    with tempfile.TemporaryDirectory(prefix="mifit-mutations-") as temporary:
        folders = [copy_project(Path(temporary) / str(i)) for i in range(jobs)]
        free = list(folders)

        def one(mutation: Mutation) -> dict[str, Any]:
            folder = free.pop()
            try:
                row = judge(mutation, folder)
            finally:
                free.append(folder)
            print(f"{row['verdict']:<14} {row['change']} ({row.get('seconds', 0)} s)", file=sys.stderr, flush=True)
            return row

        with ThreadPoolExecutor(jobs) as pool:
            rows = list(pool.map(one, mutations))
        # A test that fails without the change notices nothing: all of them together, and apart where that fails.
        noticed = [row for row in rows if row["verdict"] == NOTICED]
        sets = list(dict.fromkeys(row["tests"] for row in noticed))
        every = " ".join(dict.fromkeys(part for tests in sets for part in tests.split()))
        whole = not sets or run_tests(folders[0], every)[0] == 0
        failing = set() if whole else {tests for tests in sets if run_tests(folders[0], tests)[0] != 0}
        for row in noticed:
            if row["tests"] in failing:
                row["verdict"], row["by"] = BROKEN, "its tests fail without the change"
        return rows


def main() -> int:
    from benchmarks.mutation_list import MUTATIONS

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="changes whose name holds this text; nothing is recorded")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="say where each change would be made, and run nothing")
    a = parser.parse_args()
    chosen = [m for m in MUTATIONS if not a.only or a.only in m.name]
    if a.list:
        for mutation in chosen:
            found = mutation.find(ROOT)
            print(f"{mutation.name}: {found[0].relative_to(ROOT) if found else LOST}")
        return 1 if any(m.find(ROOT) is None for m in chosen) else 0
    rows = run(chosen, a.jobs)
    if not a.only:
        record("mutations", {"changes": rows, "conditions": conditions()})
        write_text(RESULTS / "mutations.md", markdown(rows))
    print(markdown(rows))
    return 1 if any(row["verdict"] != NOTICED for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
