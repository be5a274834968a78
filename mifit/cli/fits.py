"""Commands that fit. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mifit
from mifit.cli.arguments import console_progress, given, say, tell, use_variant
from mifit.cli.clips import capture_of
from mifit.cli.results import judge
from mifit.config import PRESETS, FitConfig, NormalsConfig, ReflectanceConfig, from_mapping
from mifit.core.diagnostics import Diagnostic
from mifit.core.files import Document, check_file, write_bytes
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.capture.choose_frames import FrameChoice
    from mifit.progress import Progress
    from mifit.result import Reconstruction


DEMO: Document = {
    "model": "builtin:coarse",
    "width": 340,
    "height": 240,
    "spp": 32,
    "timesteps": 2,
    "tone": 0.2,
    "portrait": True,
}
"""Size of the capture that ``mifit demo`` makes: small enough for seconds, large enough to show a face."""


def demo(arguments: Namespace) -> None:
    """Synthesise, fit, evaluate, report."""
    out = arguments.out
    capture = out / "capture"
    progress = console_progress(arguments.quiet)
    use_variant(arguments)
    from mifit.result.ownership import MARK, add_folder, check_ours, clear
    from mifit.synth import synthesize

    check_ours(out)
    if (out / "result.json").exists() and not (capture / MARK).is_dir():
        raise InputError(f"--out {out}: holds a result that isn't the demo's; name another folder")
    clear(capture)
    say(arguments, "Rendering a capture: two cameras to fit, a third to judge by")
    add_folder(out, capture.name, lambda made: synthesize(made, seed=arguments.seed, progress=progress, **DEMO))
    _fit_and_judge(arguments, capture, progress)
    print(f"Report: {out / 'report.html'}")


def _fit_and_judge(arguments: Namespace, folder: Path, progress: Progress) -> None:
    """Fit two cameras of the demo's capture, judge by the third; a picture of the first step comes at once."""
    from mifit.core.image import encode_png
    from mifit.fitting import fit_into
    from mifit.output.views import beside
    from mifit.result.ownership import remember

    out: Path = arguments.out
    capture = mifit.Capture.load(folder)
    picture, shown = out / "first.png", list[bytes]()

    def show(result: Reconstruction) -> None:
        if not shown:
            shown.append(encode_png(beside(result, capture, result.cameras[0], result.timesteps[0])))
            write_bytes(picture, shown[0])
            say(arguments, f"First picture, of the model before light and skin are found: {picture}")

    model, config = mifit.MorphableModel.load(DEMO["model"]), FitConfig(reflectance=ReflectanceConfig(texture_size=256))
    options: Document = {"seed": arguments.seed, "progress": progress, "force": True, "watch": show}
    result = fit_into(out, capture, model, cameras=("left", "right"), config=config, **options)
    for content in shown:  # again: the fit deletes the files of an earlier result, and this one if it is the same
        write_bytes(picture, content)
        remember(out, [picture.name])
    judged: Document = {"timesteps": None, "passes": False, "fitted": False, "strict": False, "baseline": True}
    judged |= {"camera": "third", "region": "face", "capture": folder, "json": out / "third.json"}
    judge(Namespace(quiet=arguments.quiet, result=out, **judged), result, capture)


def fit(arguments: Namespace) -> int:
    """Run the stages and write the result folder."""
    from mifit.result.ownership import check_ours, replacing_files

    out: Path = arguments.out
    check_ours(out, arguments.force)
    if arguments.config:
        check_file(arguments.config, MAX_SETTINGS_BYTES, "configuration file")
    if arguments.config and arguments.preset:
        raise InputError(
            f"--preset {arguments.preset}: found with --config {arguments.config}, expected one of the two"
        )
    config = FitConfig.load(arguments.config) if arguments.config else PRESETS[arguments.preset or "default"]()
    model = mifit.MorphableModel.load(arguments.model)
    better = (
        "; mifit model fetch ict fetches a better one" if (arguments.model, model.source) == ("auto", "builtin") else ""
    )
    folder = capture_of(arguments)
    capture = mifit.Capture.load(folder)
    say(arguments, f"Model: {model.name}, {model.source}{better}")
    use_variant(arguments)
    from mifit.fitting import fit_into
    from mifit.output.report import write_report

    timesteps = arguments.timesteps
    if timesteps is None and folder not in arguments.capture:
        timesteps = 4  # of clips, the most informative moments
    if isinstance(timesteps, int):
        timesteps = _chosen(arguments, capture, timesteps)
    progress = console_progress(arguments.quiet)
    told: list[Diagnostic] = []

    def tell_now(found: Sequence[Diagnostic]) -> None:
        told.extend(found)
        tell(arguments, found)

    result = fit_into(
        out,
        capture,
        model,
        **given(arguments, "cameras", "until", "seed", "resume", "force"),
        timesteps=timesteps,
        config=config,
        progress=progress,
        tell=tell_now,
    )
    with replacing_files(out, force=arguments.force) as new:
        write_report(new, result, capture)
    code = tell(arguments, result.diagnostics, told)
    print(f"Result: {out}", flush=True)
    return code


def _chosen(arguments: Namespace, capture: Capture, count: int) -> FrameChoice:
    """The most informative frames, named on standard error."""
    from mifit.capture.choose_frames import choose_frames
    from mifit.fitting import choose

    found = choose_frames(capture, choose("camera", capture.cameras, arguments.cameras, 2), count)
    for timestep, why in found.why.items():
        say(arguments, f"Timestep {timestep}: {why}")
    for timestep, why in found.left_out.items():
        say(arguments, f"Timestep {timestep} left out: {why}")
    return found


def track(arguments: Namespace) -> int:
    """Extend a result by further timesteps."""
    from mifit.fitting import choose
    from mifit.result.ownership import finish, replacing_files

    finish(arguments.result)
    result = mifit.Reconstruction.load(arguments.result)
    if not result.cameras:
        raise InputError(f"{arguments.result}: found a result without cameras, expected those that it was fitted with")
    capture = mifit.Capture.load(arguments.capture)
    use_variant(arguments)
    from mifit.output.report import write_report
    from mifit.output.views import write_moving_pictures
    from mifit.tracking import sequence_left, track_into

    for name in arguments.overlay or ():  # an unknown one is refused now, not after the work
        capture.with_fitted(result.cameras).camera(name)
    progress = console_progress(arguments.quiet)
    wanted = choose("timestep", capture.timesteps, arguments.timesteps, 0) if arguments.timesteps else ()
    if arguments.refine:
        result, wanted = _with_refined(arguments, result, capture, wanted, progress)
    timesteps = wanted or sequence_left(result, capture, arguments.resume)
    result = track_into(
        arguments.result,
        result,
        capture,
        timesteps,
        config=from_mapping(NormalsConfig, result.config.get("normals", {}), "result.json: config: normals"),
        **given(arguments, "seed", "resume"),
        progress=progress,
    )
    with replacing_files(arguments.result) as new:
        write_report(new, result, capture)
        write_moving_pictures(new, result, capture, arguments.overlay, arguments.fps, progress)
    code = tell(arguments, result.diagnostics)
    print(f"Result: {arguments.result}")
    return code


def _with_refined(
    arguments: Namespace, result: Reconstruction, capture: Capture, wanted: tuple[int, ...], progress: Progress
) -> tuple[Reconstruction, tuple[int, ...]]:
    """The result with maps, lighting and normals from further frames too, in its folder, and what is to be tracked."""
    from mifit.extras.refine import refine
    from mifit.result.ownership import locked

    if result.reflectance is not None and result.reflectance.report.detail("refined"):
        return result, wanted  # by a run before, which goes on here
    found = refine(result, capture, sorted({*result.timesteps, *wanted}) if wanted else None, arguments.seed, progress)
    with locked(arguments.result):
        found.save(arguments.result)
    again = {t for t in result.timesteps if t not in found.timesteps}
    return found, tuple(sorted({*wanted, *again})) if wanted else ()


def run(arguments: Namespace) -> None:
    """Run an experiment or a sweep."""
    from mifit.experiments import run_experiment

    options = given(arguments, "overrides", "out", "dask", "variant", "seed")
    print(run_experiment(arguments.experiment, **options, progress=console_progress(arguments.quiet)))
