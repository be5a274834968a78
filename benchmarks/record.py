"""What benchmarks measure with and leave behind: costs, figures on disk with their machine, tables and plots."""

from __future__ import annotations

import ctypes
import gc
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mifit.core.files import write_text

RESULTS = Path(__file__).parent / "results"
SHARED = Path(__file__).resolve().parents[2] / "shared"
PACKAGES = ("mifit", "mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless")


@dataclass
class Cost:
    """Filled when the block of `measured` ends.

    Attributes
    ----------
    seconds : float
        Wall time.
    processor_seconds : float
        Of all threads; on a shared machine it says more than wall time.
    compile_seconds : float
        Part of the wall time in which Dr.Jit made kernels.
    peak_mb : float
        Largest resident memory during the block; 0 where the system doesn't tell.
    kernels : list of dict
        Dr.Jit's kernel history.
    """

    seconds: float = 0.0
    processor_seconds: float = 0.0
    compile_seconds: float = 0.0
    peak_mb: float = 0.0
    kernels: list[dict[str, Any]] = field(default_factory=list)

    @property
    def steady_seconds(self) -> float:
        """Wall time without compilation."""
        return self.seconds - self.compile_seconds

    def figures(self) -> dict[str, float]:
        """JSON values."""
        found = {**asdict(self), "steady_seconds": self.steady_seconds}
        del found["kernels"]
        return {key: round(value, 4) for key, value in found.items()}


@contextmanager
def measured(history: bool = True) -> Iterator[Cost]:
    """Measure the block; a Mitsuba variant must be active.

    The kernel history keeps the program of every launch: hundreds of megabytes for loops of hundreds of launches. With
    ``history = False`` there is none, and compilation isn't told apart: call the work once before.
    """
    import drjit as dr

    cost = Cost()
    dr.sync_thread()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, history):
        dr.kernel_history_clear()
        _give_back_memory()
        known = _reset_peak()
        wall, processor = time.perf_counter(), time.process_time()
        yield cost
        dr.sync_thread()
        cost.seconds = time.perf_counter() - wall
        cost.processor_seconds = time.process_time() - processor
        cost.peak_mb = _peak_mb() if known else 0.0
        cost.kernels = [{k: v for k, v in kernel.items() if k != "ir"} for kernel in dr.kernel_history()]
        cost.compile_seconds = 1e-3 * sum(k.get("codegen_time", 0.0) + k.get("backend_time", 0.0) for k in cost.kernels)


def _give_back_memory() -> None:
    """Return freed memory to the system, or the peak of the next block would be that of the last one."""
    import drjit as dr

    gc.collect()
    dr.flush_malloc_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


def _reset_peak() -> bool:
    """Start the process's peak memory anew (Linux); whether that worked."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return False
    return True


def _peak_mb() -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return 0.0


def conditions() -> dict[str, Any]:
    """What else was going on: the load averages say whether the machine was shared."""
    load = os.getloadavg() if hasattr(os, "getloadavg") else (0.0, 0.0, 0.0)
    return {
        "load_average": [round(x, 2) for x in load],
        "threads": {name: os.environ.get(name, "default") for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")},
        "shared_machine": load[1] > 1.5 * (os.cpu_count() or 1) or load[0] > 1.5 * (os.cpu_count() or 1),
    }


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """Exponent p of cost ~ size^p by least squares in logarithms; None with fewer than two positive costs."""
    x, y = np.asarray(sizes, dtype=float), np.asarray(costs, dtype=float)
    good = (x > 0) & (y > 0)
    if np.unique(x[good]).size < 2:
        return None
    return float(np.polyfit(np.log(x[good]), np.log(y[good]), 1)[0])


def machine() -> dict[str, Any]:
    """Processor, cores, memory, operating system, versions, and the last commit that changed the package."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        cpu = next((line.split(":", 1)[1].strip() for line in info.open() if line.startswith("model name")), cpu)
    log = ["git", "log", "-1", "--format=%h", "--", "mifit"]
    root = Path(__file__).resolve().parents[1]
    commit = subprocess.run(log, capture_output=True, text=True, cwd=root, check=False).stdout.strip()
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


@contextmanager
def figure(
    path: Path, size: tuple[float, float], columns: int = 1, style: dict[Any, Any] | None = None
) -> Iterator[Any]:
    """Axes (an array of them for several columns) to draw on; written to `path` at the end, in inches of `size`."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.rc_context({"svg.hashsalt": "mifit", **(style or {})}):
        drawn, axes = plt.subplots(1, columns, figsize=size)
        try:
            yield axes
            drawn.tight_layout()
            path.parent.mkdir(parents=True, exist_ok=True)
            drawn.savefig(path, dpi=120, metadata={"Date": None} if path.suffix == ".svg" else None)
        finally:
            plt.close(drawn)
