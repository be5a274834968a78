"""Scene-file driven experiments: one TOML file names inputs, stages, a sweep, metrics and outputs.

The file is validated whole before anything runs. Every run has a folder of its own, named by the digest of all
that it is computed from; a run whose folder holds a finished ``run.json`` is not computed again. Runs go through
processes of this machine or through a Dask cluster, by the same function. docs/formats.md lists the keys.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import platform
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mifit
from mifit import cache
from mifit.core.files import FULL, Document, file_name, read_json, read_text, write_json, write_text
from mifit.core.image import write_image
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.core.metrics import psnr, rmse
from mifit.core.process import no_chatter, set_decoding_context
from mifit.errors import InputError, MifitError
from mifit.experiments.plan import Experiment, Plan, Run, SynthRun, load_plan
from mifit.experiments.tables import draw, over_subjects, runs_table, subjects_table
from mifit.output.evaluate import evaluate
from mifit.output.relight import write_relit
from mifit.output.report import write_report
from mifit.progress import Progress, silent
from mifit.render.scene import render_scene
from mifit.render.variant import set_fitting_variant


def run_experiment(
    path: str | Path,
    overrides: Sequence[str] = (),
    out: str | Path | None = None,
    dask: str | None = None,
    variant: str = "auto",
    seed: int = 0,
    progress: Progress = silent,
) -> str:
    """The table of all runs of an experiment file in Markdown, once those that are left of it have run.

    ``overrides`` are ``KEY=VALUE`` settings that replace the file's; ``out`` is the folder for the runs, ``summary.md``
    and ``summary.json``, by default ``out/NAME``; ``dask`` the address of a scheduler whose workers see the same files,
    by default processes of this machine; ``seed`` that of runs where the file gives none.

    InputError for a bad file or input, before anything runs. MifitError for runs that failed, after all others have
    finished; InputError where inputs or a full disk were the reason of all.
    """
    plan = load_plan(path, overrides, seed)
    folder = Path(out) if out is not None else Path("out") / file_name(plan.name)
    todo = [run for run in plan.runs if finished(folder / "runs" / run.folder, run) is None]
    total = len(plan.runs)
    progress("Runs", total - len(todo), total)
    failures: list[str] = []
    inputs_alone = True
    for done, (run, error) in enumerate(_execute_all(todo, folder, plan.jobs, dask, variant)):
        if error is not None:
            failures.append(f"{run.folder}: {type(error).__name__}: {' '.join(str(error).split())}")
            inputs_alone &= isinstance(error, InputError) or (isinstance(error, OSError) and error.errno in FULL)
        progress("Runs", total - len(todo) + done + 1, total)
    summary = _summary(plan, folder)
    write_text(folder / "summary.md", summary + "\n")
    if failures:
        kind = InputError if inputs_alone else MifitError
        raise kind(f"{len(failures)} of {total} runs failed; the others are in {folder}; " + "; ".join(failures))
    return summary


def finished(folder: Path, run: Run) -> Document | None:
    """The record of a run that ended well, or None."""
    try:
        record = read_json(folder / "run.json", MAX_SETTINGS_BYTES)
    except InputError:
        return None
    return record if isinstance(record, dict) and record.get("digest") == run.digest else None


def _execute_all(
    runs: Sequence[Run], folder: Path, jobs: int, dask: str | None, variant: str
) -> Iterator[tuple[Run, BaseException | None]]:
    """Execute runs and yield each with its error, or None, as it ends."""
    if not runs:
        return
    arguments = [(run, str((folder / "runs" / run.folder).resolve()), str(folder.resolve()), variant) for run in runs]
    for run in runs:
        if run.experiment.fit and run.experiment.fit.synth:
            _synthetic_capture(run.experiment.fit.synth, folder, variant)
    with _executor(min(jobs, len(runs)), dask) as executor:
        futures: dict[Future, Run] = {executor.submit(execute, *a): a[0] for a in arguments}
        for future in as_completed(futures):
            yield futures[future], future.exception()


@contextmanager
def _executor(jobs: int, dask: str | None) -> Iterator[Executor]:
    """What runs go through: processes of this machine, or the workers of a Dask scheduler."""
    if dask is None:
        # A process per run, never a forked one: Mitsuba's threads don't survive a fork, and its memory goes with it.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, context, set_decoding_context, (no_chatter,), max_tasks_per_child=1) as pool:
            yield pool
        return
    try:
        from distributed import Client

        client = Client(dask, timeout=20)
    except ModuleNotFoundError:
        raise InputError('--dask needs Dask: install it with pip install "mifit[cluster]"') from None
    except (OSError, ValueError) as error:
        raise InputError(f"--dask {dask}: no Dask scheduler answers there ({error})") from None
    with client, client.get_executor(pure=False) as executor:
        yield executor


def _synthetic_capture(synth: SynthRun, folder: Path, variant: str) -> Path:
    """The synthetic capture of some settings, made once and shared by all runs that name it."""
    path = folder / "captures" / cache.digest(dataclasses.asdict(synth))[:10]
    if not (path / "transforms.json").exists():
        set_fitting_variant(variant)
        from mifit.synth import synthesize

        synthesize(path, **dataclasses.asdict(synth))
    return path


def execute(run: Run, folder: str, experiment_folder: str, variant: str) -> None:
    """Execute one run in this process and write its ``run.json`` last."""
    started = time.perf_counter()
    where = Path(folder)
    where.mkdir(parents=True, exist_ok=True)
    active = set_fitting_variant(variant)
    job = _execute_fit if run.experiment.fit else _execute_render
    metrics = job(run.experiment, where, Path(experiment_folder), active)
    record = {
        "format_version": 1,
        "digest": run.digest,
        "swept": run.swept,
        "settings": dataclasses.asdict(run.experiment),
        "metrics": metrics,
        "seconds": time.perf_counter() - started,
        "versions": {
            "mifit": mifit.__version__,
            "python": platform.python_version(),
            **{name: metadata.version(name) for name in ("mitsuba", "drjit", "numpy")},
            "variant": active,
        },
        "machine": f"{platform.machine()}, {os.cpu_count()} processors",
    }
    write_json(where / "run.json", record)


def _execute_fit(e: Experiment, folder: Path, experiment_folder: Path, variant: str) -> dict[str, float]:
    """Fit, evaluate and relight; returns the figures of the table."""
    fit = e.fit
    assert fit is not None
    source = fit.capture or _synthetic_capture(fit.synth, experiment_folder, variant)  # type: ignore[arg-type]
    capture = mifit.Capture.load(source)
    result = mifit.fit(
        capture,
        mifit.MorphableModel.load(fit.model),
        cameras=fit.cameras,
        timesteps=fit.timesteps,
        config=fit.config,
        until=fit.until,
        seed=fit.seed,
        checkpoints=experiment_folder / "stages",
        shared=True,
    )
    metrics = {"fit_seconds": result.seconds}
    evaluation = None
    if e.outputs.result:
        result.save(folder / "result")
    if e.evaluate:
        evaluation = evaluate(result, capture, e.evaluate.camera, e.evaluate.timesteps, e.evaluate.region)
        write_json(folder / "evaluation.json", evaluation)
        for method, figures in evaluation["methods"].items():
            metrics |= {f"psnr_{method}": figures["psnr"], f"rmse_{method}": figures["rmse"]}
    if e.relight:
        found = write_relit(
            result,
            e.relight.env,
            folder / "relit",
            rotations=[e.relight.rotate],
            exposure="auto",
            check=True,
            seed=fit.seed,
        )
        metrics["relight_fast_vs_path_psnr"] = found["check"]["psnr"]
    if e.outputs.report:
        write_report(folder, result, capture, evaluation)
    return metrics


@dataclass(frozen=True)
class _Reference:
    image: NDArray


def _execute_render(e: Experiment, folder: Path, experiment_folder: Path, variant: str) -> dict[str, float]:
    """Render a scene and compare it with its reference; returns the figures of the table."""
    run = e.render
    assert run is not None
    render_scene(run.scene, run.parameters, spp=1, seed=run.seed)  # compiles, so that the time below is steady
    started = time.perf_counter()
    image = render_scene(run.scene, run.parameters, spp=run.spp, seed=run.seed)
    metrics = {"render_seconds": time.perf_counter() - started}
    if e.outputs.images:
        write_image(folder / "image.exr", image)
        write_image(folder / "image.png", image)
    if (reference := e.reference) is not None:
        key = cache.digest(
            [run.scene, read_text(run.scene, MAX_SETTINGS_BYTES), run.parameters, dataclasses.asdict(reference)]
        )

        def render() -> _Reference:
            parameters = {**run.parameters, **reference.parameters}
            return _Reference(render_scene(run.scene, parameters, spp=reference.spp, seed=reference.seed))

        kept = cache.Cache(experiment_folder / "references", shared=True)
        expected = kept.get("reference", _Reference, key, render).image
        peak = float(np.quantile(expected[..., :3], 0.999))
        metrics["rmse"] = rmse(image[..., :3], expected[..., :3])
        metrics["psnr"] = psnr(image[..., :3], expected[..., :3], peak=peak)
    return metrics


def _summary(plan: Plan, folder: Path) -> str:
    """Markdown tables of all finished runs in the order of the sweep; also writes ``summary.json`` and plots."""
    rows = []
    for run in plan.runs:
        record = finished(folder / "runs" / run.folder, run)
        if record is not None:
            rows.append({"run": run.folder, "swept": run.swept, "metrics": record["metrics"]})
    groups = over_subjects(rows)
    document = {"name": plan.name, "runs": rows, "over_subjects": [dataclasses.asdict(group) for group in groups]}
    write_json(folder / "summary.json", document)
    draw(folder / "plots", rows, groups)
    lines = [f"# {plan.name}: {len(rows)} of {len(plan.runs)} runs", "", *runs_table(rows), *subjects_table(groups)]
    return "\n".join(lines)
