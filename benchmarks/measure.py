"""Cost of a piece of work: wall and processor time, the compilation in it, and peak memory; fits of growth."""

from __future__ import annotations

import ctypes
import gc
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


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
