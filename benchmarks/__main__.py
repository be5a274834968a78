"""``make bench``: the reduced benchmarks, in minutes on two cores; renews the tables that the README quotes."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from benchmarks.record import RESULTS, SHARED, renew_tables

RUNS = (
    ("table1", ["--reduced", "--subjects", "3", "--jobs", "2", "--work", "out/table1_reduced"]),
    ("captures", []),
)
README = Path(__file__).resolve().parents[1] / "README.md"


def main() -> int:
    failed = []
    for name, options in RUNS:
        if name == "captures" and not SHARED.is_dir():
            print(f"{name}: left out, it needs the data folder {SHARED}", file=sys.stderr)
            continue
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *options], check=False)
        print(f"{name}: {time.perf_counter() - started:.0f} s, exit code {done.returncode}", file=sys.stderr)
        failed += [name] * bool(done.returncode)
    renew_tables(README, RESULTS)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
