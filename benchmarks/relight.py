"""Relighting judged by path-traced photographs: heads of Table 1 under a light that their fit never saw.

    python -m benchmarks.relight [--subjects 3] [--work out/table1] [--reduced]

Needs finished subjects of `benchmarks.table1`. Each head is path traced again, in the same poses, under the next of
the table's environments; its fitted result is relit by that environment and compared with camera ``third``, with one
exposure factor per method from the two fitted cameras. Figures for local shading and for path tracing of the result.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path
from typing import Any

from benchmarks.record import RESULTS, SHARED, record
from benchmarks.table1 import ENVIRONMENTS, FULL_SIZE, REDUCED, SEED, TONES, mifit, outside
from mifit import Capture, Reconstruction, set_variant
from mifit.core.files import write_text
from mifit.output.relight import evaluate_relit

TIMESTEPS = 2


def run_subject(subject: int, work: Path, model: str, size: dict[str, int]) -> dict[str, Any]:
    """Path trace one head under another light and judge its relit result."""
    environment = SHARED / "hdri" / f"{ENVIRONMENTS[(subject + 1) % len(ENVIRONMENTS)]}.hdr"
    folder = work / f"subject_{subject:02d}"
    if not (folder / "relit" / "transforms.json").exists():
        mifit("synth", "--out", folder / "relit", "--seed", SEED + subject, "--model", model, "--env", environment,
              "--tone", TONES[subject % len(TONES)], "--outside", outside(subject), "--timesteps", TIMESTEPS,
              "--width", size["width"], "--height", size["height"], "--spp", size["spp"])  # fmt: skip
    result, capture = Reconstruction.load(folder / "result"), Capture.load(folder / "relit")
    return {
        "subject": subject,
        "fitted_under": ENVIRONMENTS[subject % len(ENVIRONMENTS)],
        "relit_by": environment.stem,
        **{
            integrator: evaluate_relit(result, environment, capture, "third", integrator=integrator)["methods"]
            for integrator in ("local", "path")
        },
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    """One line per head, then the mean."""
    kinds = [(integrator, method) for integrator in ("local", "path") for method in ("diffuse", "full")]
    table = [[row[i][m]["psnr"] for i, m in kinds] for row in rows]
    lines = [
        "| subject | fitted under | relit by | " + " | ".join(f"{m}, {i} dB" for i, m in kinds) + " |",
        "|---|---|---|" + "---|" * len(kinds),
    ]
    for row, figures in zip(rows, table, strict=True):
        cells = " | ".join(f"{f:.2f}" for f in figures)
        lines.append(f"| {row['subject']} | {row['fitted_under']} | {row['relit_by']} | {cells} |")
    means = " | ".join(f"{statistics.fmean(column):.2f}" for column in zip(*table, strict=True))
    return "\n".join([*lines, f"| mean | | | {means} |"]) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=3)
    parser.add_argument("--work", type=Path, default=Path("out/table1"))
    parser.add_argument("--model", default="builtin")
    parser.add_argument("--reduced", action="store_true", help="of a reduced table: small images")
    a = parser.parse_args()
    if not (SHARED / "hdri").is_dir():
        print(f"needs the environments in {SHARED / 'hdri'}", file=sys.stderr)
        return 1
    set_variant("auto")
    rows = []
    for subject in range(a.subjects):
        rows.append(run_subject(subject, a.work, a.model, REDUCED if a.reduced else FULL_SIZE))
        print(f"subject {subject}: full {rows[-1]['local']['full']['psnr']:.2f} dB", file=sys.stderr, flush=True)
    record(
        "relight",
        {"subjects": rows, "timesteps": TIMESTEPS, "reduced": a.reduced},
        seeds=[SEED + row["subject"] for row in rows],
    )
    write_text(RESULTS / "relight.md", markdown(rows))
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
