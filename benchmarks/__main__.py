"""``make bench``: every table that the pages quote, in reduced size, within an hour on two cores.

``python -m benchmarks --full`` (``make bench-full``) runs them in full size, which takes a night. Runs follow one
another, are of one commit, and leave what they measured when they are broken off.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.record import RESULTS, SHARED, renew_tables

REDUCED = (
    ("foreign", "--reduced --seeds"),
    ("foreign", "--own --reduced --rows full refit"),
    ("table1", "--reduced --subjects 8 --no-paper --relight --jobs 2 --work out/table1_reduced"),
    ("ablation", "--heads scan_studio"),
    ("speed", "--reduced"),
)
FULL = (
    ("foreign", "--seeds"),
    ("foreign", "--own"),
    ("table1", "--relight --jobs 2"),
    ("ablation", ""),
    ("speed", ""),
    ("hard_cases", ""),
    ("video", "--scan"),
    ("mutations", ""),
)
NEED_SHARED = ("foreign", "ablation", "speed")
ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "README.md", ROOT / "docs" / "results.md"
"""Pages that quote tables between marks."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="full size")
    runs, failed = FULL if parser.parse_args().full else REDUCED, []
    for name, options in runs:
        if name in NEED_SHARED and not SHARED.is_dir():
            print(f"{name}: left out, it needs the data folder {SHARED}", file=sys.stderr)
            continue
        started = time.perf_counter()
        done = subprocess.run([sys.executable, "-m", f"benchmarks.{name}", *options.split()], check=False)
        print(f"{name}: {time.perf_counter() - started:.0f} s, exit code {done.returncode}", file=sys.stderr)
        failed += [name] * bool(done.returncode)
        for page in PAGES:
            renew_tables(page, RESULTS)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
