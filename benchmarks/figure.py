"""Plots of the benchmarks: drawn without a screen, and the same file from the same figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def figure(
    path: Path, size: tuple[float, float], columns: int = 1, style: Mapping[str, Any] | None = None
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
