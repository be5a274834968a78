"""The paper's Table 1 on data that can be made: subjects, three views, the third one held out.

    python -m benchmarks.table1 [--subjects 15] [--jobs 1] [--work out/table1]

Each subject is a random identity with its own skin, path traced with detail that the fitted model doesn't have, under
one of three set-ups of light. Cameras ``left`` and ``right`` are fitted, ``third`` is only compared with. A finished
subject is not run again, so that a stopped benchmark goes on; its figures and pictures stay in the work folder.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from benchmarks.record import RESULTS, SHARED, record
from benchmarks.truth import truth_errors
from mifit import Reconstruction
from mifit.core.files import write_text

ENVIRONMENTS = ("apartment", "studio", "softbox")
TONES = (0.0, 0.25, 0.5, 0.75, 1.0)  # fair to deep; three lights and five tones meet once in fifteen subjects
SEED = 100
"""Of subject 0; the others follow."""
METHODS = ("pca", "diffuse", "full")
MEASURES = {"psnr": ("PSNR dB", 2), "rmse": ("RMSE of 255", 2), "ssim": ("SSIM", 4), "flip": ("FLIP", 4)}
TRUTHS = {
    "diffuse_rmse": ("albedo RMSE", "diffuse albedo after one scale per channel, RMSE of linear reflectance", 4),
    "specular_correlation": ("specular corr.", "correlation of the specular albedo with the true lobe weight", 2),
    "normal_degrees_stage1": ("normal ° stage 1", "mean angle of stage 1's normals to the bumped truth, degrees", 2),
    "normal_degrees": ("normal °", "the same of the refined normals, degrees", 2),
    "mesh_mm": ("vertex mm", "mean distance of face-area vertices, no alignment, millimetres", 2),
    "rotation_degrees": ("rotation °", "largest error of the head's rotation, degrees", 2),
}
"""Errors against the truth that only made data have: short name, what it is, decimals."""
BUMP_UNIT = 0.1
"""Centimetres per unit of the painted bump."""
PAPER = {"pca": (24.6, 15.0), "diffuse": (26.8, 11.6), "full": (28.3, 9.8)}
FULL_SIZE = {"timesteps": 4, "width": 680, "height": 480, "spp": 64}
REDUCED = {"timesteps": 3, "width": 340, "height": 240, "spp": 32}


def mifit(*arguments: object) -> None:
    """Run the command line in a process of its own; its last line of stderr is the error."""
    done = subprocess.run(
        [sys.executable, "-m", "mifit", *map(str, arguments), "--quiet"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"mifit {arguments[0]}: {(done.stderr.strip() or 'no message').splitlines()[-1]}")


def run_subject(subject: int, work: Path, size: dict[str, int], model: str) -> dict[str, Any]:
    """Synthesise, fit and evaluate one subject; what is done already is kept."""
    folder = work / f"subject_{subject:02d}"
    figures = folder / "third.json"
    environment = SHARED / "hdri" / f"{ENVIRONMENTS[subject % len(ENVIRONMENTS)]}.hdr"
    light = ["--env", environment] if environment.exists() else []
    if not figures.exists():
        if not (folder / "capture" / "transforms.json").exists():
            options = [part for key, value in size.items() for part in (f"--{key}", value)]
            mifit("synth", "--out", folder / "capture", "--seed", SEED + subject, "--model", model,
                  "--tone", TONES[subject % len(TONES)], *options, *light)  # fmt: skip
        mifit("fit", folder / "capture", "--out", folder / "result", "--model", model, "--cameras", "left,right",
              "--timesteps", f"0-{size['timesteps'] - 1}", "--resume")  # fmt: skip
        mifit("evaluate", folder / "result", "--capture", folder / "capture", "--camera", "third", "--json", figures)
    judged = folder / "truth.json"
    if not judged.exists():
        found = truth_errors(Reconstruction.load(folder / "result"), folder / "capture", BUMP_UNIT)
        write_text(judged, json.dumps(found, indent=2) + "\n")
    result = json.loads((folder / "result" / "result.json").read_text())
    return {
        "subject": subject,
        "light": environment.stem if light else "procedural",
        "tone": TONES[subject % len(TONES)],
        "seconds": round(result["seconds"], 1),
        "peak_memory_mb": round(result["peak_memory"] / 2**20),
        **json.loads(figures.read_text()),
        "truth": json.loads(judged.read_text()),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and spread over the subjects, per method and measure, and of the errors against the truth."""
    groups = {method: [row["methods"][method] for row in rows] for method in METHODS}
    groups["truth"] = [row["truth"] for row in rows]
    return {
        group: {
            f"{name}_{kind}": round(function([f[name] for f in found]), 4)
            for name in found[0]
            for kind, function in (("mean", statistics.fmean), ("spread", statistics.pstdev))
        }
        for group, found in groups.items()
    }


def markdown(rows: list[dict[str, Any]], failures: dict[int, str]) -> str:
    """The table as Markdown, the paper's figures (on its own data) beside it; failed subjects stay in it."""
    lines = [f"Held-out third view, {len(rows)} of {len(rows) + len(failures)} subjects; mean ± spread over subjects."]
    if rows:
        table = summary(rows)
        over = {m: table["full"]["psnr_mean"] - table[m]["psnr_mean"] for m in ("pca", "diffuse")}
        lines += [
            f"`full` is {over['pca']:.2f} dB above `pca` and {over['diffuse']:.2f} dB above `diffuse`. The paper's",
            "figures are on its own recordings.",
            "",
            "| method | " + " | ".join(title for title, _ in MEASURES.values()) + " | paper PSNR | paper RMSE |",
            "|---|" + "---|" * (len(MEASURES) + 2),
        ]
        for method in METHODS:
            cells = [_mean(table[method], key, digits) for key, (_, digits) in MEASURES.items()]
            lines.append(f"| {method} | {' | '.join(cells)} | {PAPER[method][0]} | {PAPER[method][1]} |")
        lines += ["", "| against the truth | mean ± spread |", "|---|---|"]
        lines += [f"| {text} | {_mean(table['truth'], key, digits)} |" for key, (_, text, digits) in TRUTHS.items()]
        lines += ["", "| mean of | subjects | " + " | ".join(METHODS) + " |", "|---|---|" + "---|" * len(METHODS)]
        for kind in ("light", "tone"):
            for value in dict.fromkeys(sorted(row[kind] for row in rows)):
                of = [row for row in rows if row[kind] == value]
                means = (statistics.fmean(row["methods"][m]["psnr"] for row in of) for m in METHODS)
                lines.append(f"| {kind} {value} | {len(of)} | " + " | ".join(f"{x:.2f}" for x in means) + " |")
    titles = ["subject", "light", "tone", *METHODS, "full SSIM", "full FLIP"]
    titles += [short for short, _, _ in TRUTHS.values()] + ["seconds"]
    lines += ["", "| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
    for row in rows:
        full, truth = row["methods"]["full"], row["truth"]
        cells = [str(row["subject"]), row["light"], f"{row['tone']:g}"]
        cells += [f"{row['methods'][m]['psnr']:.2f}" for m in METHODS] + [f"{full['ssim']:.4f}", f"{full['flip']:.4f}"]
        cells += [f"{truth[key]:.{digits}f}" for key, (_, _, digits) in TRUTHS.items()] + [f"{row['seconds']:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    lines += [f"| {subject} | failed: {text} |" + " |" * (len(titles) - 2) for subject, text in failures.items()]
    return "\n".join(lines) + "\n"


def _mean(table: dict[str, float], key: str, digits: int) -> str:
    return f"{table[f'{key}_mean']:.{digits}f} ± {table[f'{key}_spread']:.{digits}f}"


def run(subjects: int, jobs: int, work: Path, size: dict[str, int], model: str, name: str) -> dict[str, Any]:
    """Run all subjects and write ``benchmarks/results/NAME.json`` and ``.md``."""
    rows, failures = [], {}
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(run_subject, i, work, size, model): i for i in range(subjects)}
        for done in as_completed(waiting):
            subject = waiting[done]
            try:
                rows.append(done.result())
                psnr = rows[-1]["methods"]["full"]["psnr"]
                print(f"subject {subject}: full {psnr:.2f} dB", file=sys.stderr, flush=True)
            except Exception as error:  # a subject that fails, for whatever reason, stays in the table as failing
                failures[subject] = " ".join(f"{type(error).__name__}: {error}".split()).replace("|", "/")
                print(f"subject {subject}: {error}", file=sys.stderr, flush=True)
    rows.sort(key=lambda row: row["subject"])
    failures = dict(sorted(failures.items()))
    figures: dict[str, Any] = {"size": size, "model": model, "subjects": rows, "failures": failures}
    if rows:
        figures["summary"] = summary(rows)
    write_text(RESULTS / f"{name}.md", markdown(rows, failures))
    record(name, figures, seeds=[SEED + i for i in range(subjects)])
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=15)
    parser.add_argument("--jobs", type=int, default=1, help="subjects at a time, each in processes of its own")
    parser.add_argument("--work", type=Path, default=Path("out/table1"))
    parser.add_argument("--model", default="builtin")
    parser.add_argument("--reduced", action="store_true", help="small images, for a quick look")
    a = parser.parse_args()
    size, name = (REDUCED, "table1_reduced") if a.reduced else (FULL_SIZE, "table1")
    figures = run(a.subjects, a.jobs, a.work, size, a.model, name)
    print((RESULTS / f"{name}.md").read_text())
    return 1 if figures["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
