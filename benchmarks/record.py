"""Figures on disk with the machine, versions and seeds that they were measured with."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import re
import subprocess
import time
from pathlib import Path
from typing import Any

from benchmarks.measure import conditions
from mifit.core.files import write_text

RESULTS = Path(__file__).parent / "results"
SHARED = Path(__file__).resolve().parents[2] / "shared"
PACKAGES = ("mifit", "mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless")


def machine() -> dict[str, Any]:
    """Processor, cores, memory, operating system, versions and commit."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        cpu = next((line.split(":", 1)[1].strip() for line in info.open() if line.startswith("model name")), cpu)
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=Path(__file__).parent, check=False
    ).stdout.strip()
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "system": platform.system() + " " + platform.release(),
        "python": platform.python_version(),
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": commit,
        "date": time.strftime("%Y-%m-%d"),
    }


def record(name: str, figures: dict[str, Any], seeds: Any = 0) -> Path:
    """Write ``figures`` to ``benchmarks/results/NAME.json`` and return its path."""
    path = RESULTS / f"{name}.json"
    content = {"benchmark": name, "machine": machine(), "load": conditions(), "seeds": seeds, "figures": figures}
    write_text(path, json.dumps(content, indent=2) + "\n")
    return path


def renew_tables(page: Path, results: Path) -> list[str]:
    """Put ``NAME.md`` between the marks ``<!-- NAME -->`` and ``<!-- /NAME -->`` of a page; return the names found."""
    renewed = []

    def table(found: re.Match[str]) -> str:
        source = results / f"{found[1]}.md"
        if not source.exists():
            return found[0]
        renewed.append(found[1])
        return f"<!-- {found[1]} -->\n{source.read_text(encoding='utf-8').strip()}\n<!-- /{found[1]} -->"

    text = page.read_text(encoding="utf-8")
    write_text(page, re.sub(r"<!-- (\w+) -->\n.*?<!-- /\1 -->", table, text, flags=re.DOTALL))
    return renewed
