"""The paper's Table 1 on data that can be made: subjects, three views, the third one held out.

    python -m benchmarks.table1 [--subjects 15] [--jobs 1] [--no-paper] [--reduced] [--relight] [--work out/table1]

Each subject is a random identity with its own skin, path traced with detail that the fitted model doesn't have, under
one of three set-ups of light; every third head leaves the model's span by well over half a millimetre. Landmarks are
those of a model of a detector: a bias per landmark and head, and noise (`mifit.synth.head`); the row with perfect
landmarks says what that costs. Cameras ``left`` and ``right`` are fitted, ``third`` is only compared with, over the
face area of the true mesh; image-based rendering shows only what a fitted view sees of it, and there `full` is judged
once more. A finished subject is not run again, so that a stopped benchmark goes on; its figures stay in the work
folder. With ``--relight`` the heads are path traced again, in the same poses, under the next of the environments, and
their fitted results are relit by it and compared with ``third``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import mifit
from benchmarks.foreign import replace_size, without_specular
from benchmarks.heads import BIAS, DEVELOPMENT_SUBJECTS, Subject
from benchmarks.record import RESULTS, conditions, machine, record
from benchmarks.truth import truth_errors
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.core.image import to_8_bit
from mifit.core.metrics import psnr, rmse
from mifit.errors import InputError
from mifit.output.evaluate import evaluate, face_area
from mifit.result import Method

ROWS = {
    "pca": "stage 1's model",
    "image_based": "image-based rendering on our mesh, where a fitted view sees it",
    "diffuse": "without specular reflection, refitted",
    "full": "everything",
    "full_seen": "`full` on image-based rendering's pixels",
    "dropped": "`full` without its specular part and residual, nothing refitted",
    "paper": "the paper as written (`--preset paper`)",
    "perfect": "`full` from perfect landmarks",
}
CAMERAS = ("left", "right")
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
PAPER = {"pca": (24.6, 15.0), "diffuse": (26.8, 11.6), "full": (28.3, 9.8)}
FULL_SIZE = {"timesteps": 4, "width": 680, "height": 480, "spp": 64}
REDUCED = {"timesteps": 3, "width": 340, "height": 240, "spp": 32}
TEXELS = 256
"""More show little at these pictures' sizes."""
BUMP_UNIT = 0.1
"""Centimetres per unit of the painted bump."""
RELIT_TIMESTEPS = 2


def command(*arguments: object) -> None:
    """Run the command line in a process of its own; its last line of stderr is the error."""
    done = subprocess.run(
        [sys.executable, "-m", "mifit", *map(str, arguments), "--quiet"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"mifit {arguments[0]}: {(done.stderr.strip() or 'no message').splitlines()[-1]}")


def run_subject(subject: int, work: Path, size: dict[str, int], model: str, texels: int, paper: bool) -> dict[str, Any]:
    """Synthesise, fit and judge one subject in a process of its own; what is done already is kept."""
    folder = work / f"subject_{subject:02d}"
    figures = folder / "figures.json"
    made = Subject(subject)
    environment = made.light()
    light = ["--env", environment] if environment.exists() else []
    for name, bias in (("capture", BIAS), ("perfect", 0.0)):
        if not (folder / name / "transforms.json").exists():
            if name == "perfect":  # the same images: only the landmarks are other ones
                perfect_landmarks(folder / "capture", folder / name, size, model, subject)
                continue
            options = [part for key, value in size.items() for part in (f"--{key}", value)]
            command("synth", "--out", folder / name, "--seed", made.seed, "--model", model, "--force",
                  "--tone", made.tone, "--outside", made.outside, "--landmark-bias", bias,
                  *options, *light)  # fmt: skip
    if not figures.exists():
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.table1", "--subject", str(folder), "--model", model, "--texels",
             str(texels), *([] if paper else ["--no-paper"])],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError((done.stderr.strip() or "no message").splitlines()[-1])
    return {
        "subject": subject,
        "set": "development" if subject < DEVELOPMENT_SUBJECTS else "locked",
        "light": environment.stem if light else "procedural",
        "tone": made.tone,
        "outside_mm": made.outside,
        **json.loads(figures.read_text()),
    }


def fits(
    folder: Path, model: MorphableModel, config: FitConfig, paper: bool
) -> dict[str, tuple[Reconstruction, Capture]]:
    """The reconstructions of a subject: in full, without specular reflection, by the paper, from perfect landmarks."""
    capture, perfect = Capture.load(folder / "capture"), Capture.load(folder / "perfect")
    full = mifit.fit(capture, model, CAMERAS, capture.timesteps, config)
    found = {
        "full": (full, capture),
        "diffuse": (without_specular(full, capture, CAMERAS, config), capture),
        "perfect": (mifit.fit(perfect, model, CAMERAS, perfect.timesteps, config), perfect),
    }
    if paper:
        written = replace_size(FitConfig.paper(), config.reflectance.texture_size)
        found["paper"] = (mifit.fit(capture, model, CAMERAS, capture.timesteps, written), capture)
    return found


def judge(folder: Path, found: dict[str, tuple[Reconstruction, Capture]]) -> dict[str, Any]:
    """Figures of all rows, over the face area of the true mesh."""
    methods: dict[str, Any] = {}
    for name, (result, capture) in found.items():
        measured = evaluate(result, capture, "third", region="truth", baseline=name == "full")
        if name == "full":
            methods |= {"pca": measured["methods"]["pca"], "dropped": measured["methods"]["diffuse"]}
            based = [v for k, v in measured["baseline"]["methods"].items() if k.startswith("image_based")]
            methods["image_based"] = max(based, key=lambda found: found["psnr"])
            methods["full_seen"] = measured["baseline"]["methods"]["full"]
        methods[name] = measured["methods"]["full"]
    return {
        "methods": methods,
        "truth": {name: truth_errors(result, folder / "capture", BUMP_UNIT) for name, (result, _) in found.items()},
        "unconverged": {
            name: [stage for stage, report in result.reports.items() if report.outcome != "converged"]
            for name, (result, _) in found.items()
        },
        "seconds": {name: round(result.seconds, 1) for name, (result, _) in found.items()},
        "warnings": {name: [one.text for one in result.diagnostics] for name, (result, _) in found.items()},
        "commit": machine()["commit"],
    }


def fit_subject(folder: Path, model: str, texels: int, paper: bool) -> None:
    """Fit and judge one subject in this process; write its figures and its full result."""
    mifit.set_variant("auto")
    found = fits(folder, MorphableModel.load(model), replace_size(FitConfig(), texels), paper)
    found["full"][0].save(folder / "result", force=True)  # to be put under another light
    write_text(folder / "figures.json", json.dumps(judge(folder, found), indent=2) + "\n")


def perfect_landmarks(capture: Path, out: Path, size: dict[str, int], model: str, subject: int) -> None:
    """The same capture with landmarks at the true vertices, a detector's noise on top."""
    from mifit.capture.landmark_files import Landmarks, write_landmarks
    from mifit.synth.head import LANDMARK_NOISE

    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(capture, out)
    loaded, vertices = Capture.load(out), MorphableModel.load(model).landmarks
    (out / "transforms.json").unlink()  # written last: a broken-off folder isn't taken for whole
    for (camera, timestep), shot in loaded.shots.items():
        with np.load(out / "truth" / f"{timestep:04d}.npz") as truth:
            points = loaded.camera(camera).project(truth["vertices"][vertices].astype(np.float64))
        rng = np.random.default_rng([Subject(subject).seed, timestep, len(camera), 23])
        points += LANDMARK_NOISE * size["width"] / 680 * rng.standard_normal(points.shape)
        found = loaded.landmarks(camera, timestep)
        assert found is not None and shot.landmarks is not None
        write_landmarks(shot.landmarks, Landmarks(points, found.visible))
    shutil.copyfile(capture / "transforms.json", out / "transforms.json")


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Mean and spread over the subjects, per row and measure, and of the errors against the truth per fit."""
    groups = {name: [row["methods"][name] for row in rows] for name in ROWS if name in rows[0]["methods"]}
    for fit in rows[0]["truth"]:
        groups[f"truth of {fit}"] = [row["truth"][fit] for row in rows]
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
            f"`full` is {over['pca']:.2f} dB above `pca` and {over['diffuse']:.2f} dB above a refit without specular",
            "reflection. The paper's figures are on its own recordings. Pixels: the face area of the true mesh.",
            "",
            "| row | "
            + " | ".join(title for title, _ in MEASURES.values())
            + " | paper PSNR | paper RMSE | unconverged |",
            "|---|" + "---|" * (len(MEASURES) + 3),
        ]
        row_fits = rows[0]["unconverged"]
        for name, text in ROWS.items():
            if name in table:
                cells = [_mean(table[name], key, digits) for key, (_, digits) in MEASURES.items()]
                theirs = PAPER.get(name, ("", ""))
                fit = name if name in row_fits else "full"
                stopped = sum(bool(row["unconverged"][fit]) for row in rows)
                lines.append(
                    f"| `{name}`: {text} | {' | '.join(cells)} | {theirs[0]} | {theirs[1]} | {stopped} of {len(rows)} |"
                )
        fits = list(rows[0]["truth"])
        lines += ["", "| against the truth (true geometry is used here) | " + " | ".join(f"`{f}`" for f in fits) + " |"]
        lines += ["|---|" + "---|" * len(fits)]
        for key, (_, text, digits) in TRUTHS.items():
            cells = [_mean(table[f"truth of {fit}"], key, digits) for fit in fits]
            lines.append(f"| {text} | {' | '.join(cells)} |")
        shown = [name for name in ROWS if name in table]
        lines += ["", "| mean dB of | subjects | " + " | ".join(shown) + " |", "|---|---|" + "---|" * len(shown)]
        for kind in ("set", "light", "tone", "outside_mm"):
            for value in dict.fromkeys(sorted(row[kind] for row in rows)):
                of = [row for row in rows if row[kind] == value]
                means = (statistics.fmean(row["methods"][m]["psnr"] for row in of) for m in shown)
                lines.append(f"| {kind} {value} | {len(of)} | " + " | ".join(f"{x:.2f}" for x in means) + " |")
        titles = ["subject", "set", "light", "tone", "outside mm", *shown]
        titles += [short for short, _, _ in TRUTHS.values()] + ["unconverged", "seconds"]
        lines += ["", "| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
        for row in rows:
            cells = [str(row["subject"]), row["set"], row["light"], f"{row['tone']:g}", f"{row['outside_mm']:g}"]
            cells += [f"{row['methods'][m]['psnr']:.2f}" for m in shown]
            cells += [f"{row['truth']['full'][key]:.{digits}f}" for key, (_, _, digits) in TRUTHS.items()]
            cells += [", ".join(row["unconverged"]["full"]) or "none", f"{row['seconds']['full']:.0f}"]
            lines.append("| " + " | ".join(cells) + " |")
    else:
        titles = ["subject", "failed"]
        lines += ["", "| subject | failed |", "|---|---|"]
    lines += [f"| {subject} | failed: {text} |" + " |" * (len(titles) - 2) for subject, text in failures.items()]
    return "\n".join(lines) + "\n"


def short(rows: list[dict[str, Any]], failed: int) -> str:
    """The rows' PSNR alone, beside the paper's."""
    table = summary(rows)
    lines = [f"| {len(rows)} of {len(rows) + failed} heads, mean ± spread | PSNR dB | paper's |", "|---|---|---|"]
    for name, text in ROWS.items():
        if name in table and name != "dropped":
            lines.append(f"| {text} | {_mean(table[name], 'psnr', 1)} | {PAPER.get(name, ('-',))[0]} |")
    return "\n".join(lines) + "\n"


def _mean(table: dict[str, float], key: str, digits: int) -> str:
    return f"{table[f'{key}_mean']:.{digits}f} ± {table[f'{key}_spread']:.{digits}f}"


def run(
    subjects: int, jobs: int, work: Path, size: dict[str, int], model: str, texels: int, name: str, paper: bool = True
) -> dict[str, Any]:
    """Run all subjects and write ``benchmarks/results/NAME.json`` and ``.md``.

    Raises
    ------
    RuntimeError
        Subjects of the work folder were judged at different commits: one table has one.
    """
    rows, failures, before = [], {}, conditions()
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(run_subject, i, work, size, model, texels, paper): i for i in range(subjects)}
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
    commits = {row["commit"] for row in rows}
    if len(commits) > 1:
        raise RuntimeError(f"subjects were judged at the commits {', '.join(sorted(commits))}; use another --work")
    failures = dict(sorted(failures.items()))
    figures: dict[str, Any] = {
        "size": {**size, "texels": texels},
        "model": model,
        "landmark_bias_mm": BIAS,
        "region": "true geometry",
        "subjects": rows,
        "failures": failures,
        "conditions": {"before": before, "after": conditions()},
    }
    if rows:
        figures["summary"] = summary(rows)
    write_text(RESULTS / f"{name}.md", markdown(rows, failures))
    if rows:
        write_text(RESULTS / f"{name}_short.md", short(rows, len(failures)))
    record(name, figures, seeds=[Subject(i).seed for i in range(subjects)])
    return figures


def relight(subjects: Iterable[int], work: Path, model: str, size: dict[str, int]) -> list[dict[str, Any]]:
    """Finished subjects path traced under another light, and their relit results beside it."""
    mifit.set_variant("auto")
    rows = []
    for subject in subjects:
        made = Subject(subject)
        environment, folder = made.light(1), work / f"subject_{subject:02d}"
        if not (folder / "relit" / "transforms.json").exists():
            command("synth", "--out", folder / "relit", "--seed", made.seed, "--model", model,
                    "--env", environment, "--tone", made.tone, "--outside", made.outside,
                    "--timesteps", RELIT_TIMESTEPS, "--width", size["width"], "--height", size["height"],
                    "--spp", size["spp"], "--force")  # fmt: skip
        result, capture = Reconstruction.load(folder / "result"), Capture.load(folder / "relit")
        judged = {
            integrator: evaluate_relit(result, environment, capture, "third", integrator=integrator)["methods"]
            for integrator in ("local", "path")
        }
        kinds = {"fitted_under": made.light().stem, "relit_by": environment.stem}
        rows.append({"subject": subject, **kinds, **judged})
    return rows


def evaluate_relit(
    result: Reconstruction,
    environment: str | Path | NDArray,
    capture: Capture,
    camera: str,
    integrator: Literal["local", "path"] = "local",
) -> dict[str, Any]:
    """Errors of a relit result against photographs of the same head, in the same poses, under that environment.

    The two captures' exposures are not known to each other, so each method gets one factor on its brightness: the
    least-squares one over the cameras that were fitted, in the new capture. InputError where the judged camera was
    fitted, or a camera or timestep is missing in the capture.

    Returns
    -------
    dict
        ``camera``, ``timesteps``, ``region_pixels`` and ``methods``: PSNR (dB), RMSE (0..255) in 8-bit sRGB over the
        fitted model's face area, and the exposure, for ``diffuse`` and ``full``.
    """
    if camera in [c.name for c in result.cameras]:
        raise InputError(f"camera {camera}: was fitted; expected another one to judge by")
    lit = result.relight(environment)
    capture = capture.with_fitted(result.cameras)
    steps = [t for t in lit.timesteps if t in capture.timesteps]
    if not steps:
        raise InputError(f"the capture has none of the timesteps {', '.join(map(str, lit.timesteps))}")

    def views(name: str, timesteps: list[int], method: Method) -> tuple[NDArray, NDArray]:
        """Photographed and rendered linear colours (N, 3) in the face area."""
        view = capture.camera(name)
        photographs, renders = [], []
        for t in timesteps:
            frame = capture.frame(name, t)
            vertices = lit.geometry.vertices[lit.index(t)]
            area = face_area(vertices, lit.model.faces, lit.model.face_mask, view) & frame.valid
            shown = lit.render(view, t, method, integrator)
            photographs.append(frame.image[area])
            renders.append(shown[area][:, :3])
        return np.concatenate(photographs), np.concatenate(renders)

    methods = {}
    for method in ("diffuse", "full"):
        pairs = [views(c.name, steps[:1], method) for c in result.cameras]
        photograph, render = (np.concatenate(part).astype(np.float64) for part in zip(*pairs, strict=True))
        exposure = float((photograph * render).sum() / max(float((render * render).sum()), 1e-12))
        photograph, render = views(camera, steps, method)
        codes, expected = to_8_bit(exposure * render)[None], to_8_bit(photograph)[None]
        methods[method] = {"psnr": psnr(codes, expected), "rmse": rmse(codes, expected), "exposure": exposure}
    return {"camera": camera, "timesteps": steps, "region_pixels": len(photograph), "methods": methods}


def relit_markdown(rows: list[dict[str, Any]]) -> str:
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
    parser.add_argument("--subjects", type=int, default=15)
    parser.add_argument("--jobs", type=int, default=1, help="subjects at a time, each in processes of its own")
    parser.add_argument("--work", type=Path, default=Path("out/table1"))
    parser.add_argument("--model", default="builtin")
    parser.add_argument("--no-paper", action="store_true", help="leave out the paper as written, most of the time")
    parser.add_argument("--reduced", action="store_true", help="small images and maps, for a quick look")
    parser.add_argument("--relight", action="store_true", help="put the fitted heads under another light as well")
    parser.add_argument("--texels", type=int, default=TEXELS)
    parser.add_argument("--subject", type=Path, help="fit and judge the subject of this folder alone, in this process")
    a = parser.parse_args()
    if a.subject:
        fit_subject(a.subject, a.model, a.texels, not a.no_paper)
        return 0
    size, name = (REDUCED, "table1_reduced") if a.reduced else (FULL_SIZE, "table1")
    figures = run(a.subjects, a.jobs, a.work, size, a.model, a.texels, name, not a.no_paper)
    print((RESULTS / f"{name}.md").read_text())
    if a.relight:
        rows = relight([row["subject"] for row in figures["subjects"]], a.work, a.model, size)
        record(
            "relight", {"subjects": rows, "reduced": a.reduced}, seeds=[Subject(row["subject"]).seed for row in rows]
        )
        write_text(RESULTS / "relight.md", relit_markdown(rows))
    return 1 if figures["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
