"""Execute every notebook from top to bottom in a scratch folder; a cell that raises fails the run.

    python notebooks/run.py [NAME ...]

Notebooks read ``MIFIT_REDUCED``: with it set, as here, they work at a size that takes seconds. The files here
keep no outputs; the executed copies go to ``out/notebooks``.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "out" / "notebooks"


def main(names: list[str]) -> int:
    """Run the named notebooks, or all."""
    os.environ["MIFIT_REDUCED"] = "1"
    OUT.mkdir(parents=True, exist_ok=True)
    paths = [HERE / f"{Path(name).stem}.ipynb" for name in names] or sorted(HERE.glob("*.ipynb"))
    for path in paths:
        started = time.perf_counter()
        notebook = nbformat.read(path, as_version=4)
        if any(cell.get("outputs") for cell in notebook.cells):
            print(f"{path.name}: holds outputs; strip them before committing", file=sys.stderr)
            return 1
        NotebookClient(notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": OUT}}).execute()
        nbformat.write(notebook, OUT / path.name)
        print(f"{path.name}: {time.perf_counter() - started:.0f} s", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
