"""Execute every notebook from top to bottom in a scratch folder; a cell that raises fails the run.

    python notebooks/run.py [--keep] [NAME ...]

Notebooks read ``MIFIT_REDUCED``: with it set, as here, they work at a size that takes seconds. The executed copies go
to ``out/notebooks``; with ``--keep`` their pictures, as small JPEGs, and texts go into the files here as well, so that
a reader sees them without running anything.
"""

from __future__ import annotations

import argparse
import base64
import os
import sys
import time
from pathlib import Path

import cv2
import nbformat
import numpy as np
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "out" / "notebooks"
LARGEST = 400_000
"""Bytes that a notebook may have with its outputs."""


def main() -> int:
    """Run the named notebooks, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*")
    parser.add_argument("--keep", action="store_true", help="put the outputs into the notebooks themselves")
    arguments = parser.parse_args()
    os.environ["MIFIT_REDUCED"] = "1"
    OUT.mkdir(parents=True, exist_ok=True)
    paths = [HERE / f"{Path(name).stem}.ipynb" for name in arguments.names] or sorted(HERE.glob("*.ipynb"))
    for path in paths:
        started = time.perf_counter()
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": OUT}}).execute()
        nbformat.write(notebook, OUT / path.name)
        if arguments.keep:
            keep(notebook, path)
        print(f"{path.name}: {time.perf_counter() - started:.0f} s", file=sys.stderr)
    return 0


def keep(notebook: nbformat.NotebookNode, path: Path) -> None:
    """Write a notebook with its outputs: pictures as JPEG, without progress, counts and times of executions."""
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = {}
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        for output in cell.outputs:
            if "execution_count" in output:
                output.execution_count = None
            if "image/png" in output.get("data", {}):
                data = np.frombuffer(base64.b64decode(output.data.pop("image/png")), np.uint8)
                packed = cv2.imencode(".jpg", cv2.imdecode(data, cv2.IMREAD_COLOR), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
                output.data["image/jpeg"] = base64.b64encode(packed.tobytes()).decode()
    text = nbformat.writes(notebook)
    if len(text) > LARGEST:
        raise SystemExit(f"{path.name}: {len(text)} bytes with outputs, expected at most {LARGEST}")
    if sys.prefix in text or str(HERE.parent) in text:
        raise SystemExit(f"{path.name}: outputs name a folder of this machine, expected none")
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
