"""What each ``mifit`` command does, given its parsed arguments. Raises InputError for bad input."""

from __future__ import annotations

import json
import shutil
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mifit.config import PRESETS, FitConfig, NormalsConfig, from_mapping
from mifit.console import console_progress
from mifit.core.files import check_file, write_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.reconstruction import Reconstruction

DEMO = {"model": "builtin:coarse", "width": 340, "height": 240, "spp": 32, "timesteps": 3}
"""Size of the capture that ``mifit demo`` makes: small enough for seconds, large enough to show a face."""


def _use_variant(arguments: Namespace) -> str:
    from mifit.render.variant import set_fitting_variant

    return set_fitting_variant(arguments.variant)


def _say(arguments: Namespace, text: str) -> None:
    if not arguments.quiet:
        print(text, file=sys.stderr, flush=True)


def doctor(arguments: Namespace) -> int:
    """Print what works; exit code 1 when the pipeline can't run."""
    from mifit.capture.face_networks import install_networks, missing, networks_folder
    from mifit.render.variant import doctor

    if arguments.install == "landmarks":
        install_networks()
    problem = missing()
    found = "not ready" if problem else str(networks_folder())
    checks = [*doctor(), {"check": "landmarks", "ok": not problem, "required": False, "found": found, "fix": problem}]
    if arguments.json:
        print(json.dumps(checks, indent=2))
    else:
        width = max(len(check["check"]) for check in checks)
        for check in checks:
            mark = "ok  " if check["ok"] else ("FAIL" if check["required"] else "-   ")
            print(f"{mark} {check['check']:<{width}}  {check['found']}")
            if not check["ok"] and check["fix"]:
                print(f"     {'':<{width}}  mend: {check['fix']}")
    return 0 if all(check["ok"] for check in checks if check["required"]) else 1


def demo(arguments: Namespace) -> None:
    """Synthesise, fit, evaluate, report."""
    out = arguments.out
    capture = out / "capture"
    progress = console_progress(arguments.quiet)
    _use_variant(arguments)
    from mifit.result.ownership import MARK, check_ours, claim, clear, remember
    from mifit.synth import synthesize

    check_ours(out)
    if (out / "result.json").exists() and not (capture / MARK).is_dir():
        raise InputError(f"--out {out}: holds a result that isn't the demo's; name another folder")
    clear(capture)
    claim(out)
    _say(arguments, "Rendering a capture: two cameras to fit, a third to judge by")
    made = out / MARK / "capture"
    shutil.rmtree(made, ignore_errors=True)  # of a demo that was killed
    synthesize(made, seed=arguments.seed, progress=progress, **DEMO)  # type: ignore[arg-type]
    claim(made, force=True)
    remember(
        made, [p.relative_to(made).as_posix() for p in made.rglob("*") if p.is_file() and MARK not in p.parts[-2:]]
    )
    made.rename(capture)
    common = {
        "quiet": arguments.quiet,
        "debug": arguments.debug,
        "variant": arguments.variant,
        "seed": arguments.seed,
    }
    fit(
        Namespace(
            **common,
            capture=capture,
            out=out,
            config=None,
            preset=None,
            model=DEMO["model"],
            cameras=["left", "right"],
            timesteps=None,
            until="normals",
            resume=False,
            force=True,
        )
    )
    evaluate(
        Namespace(
            **common,
            result=out,
            capture=capture,
            camera="third",
            timesteps=None,
            region="model",
            baseline=True,
            json=out / "third.json",
        )
    )
    print(f"Report: {out / 'report.html'}")


def synth(arguments: Namespace) -> None:
    """Write path-traced captures."""
    out: Path = arguments.out
    if out.exists() and not arguments.force and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is there already and not empty; --force writes into it, or name another folder")
    if arguments.head is not None:
        _synth_scan(arguments)
        return
    if arguments.maps or arguments.relit:
        raise InputError("--maps and --relit belong to --head, which is missing")
    _use_variant(arguments)
    from mifit.synth import synthesize

    synthesize(
        arguments.out,
        subjects=arguments.subjects,
        timesteps=arguments.timesteps,
        env=arguments.env,
        model=arguments.model,
        seed=arguments.seed,
        width=arguments.width,
        height=arguments.height,
        spp=arguments.spp,
        tone=arguments.tone,
        motion=arguments.motion,
        outside=arguments.outside,
        landmark_bias=arguments.landmark_bias,
        progress=console_progress(arguments.quiet),
    )
    print(f"Capture: {arguments.out}")


def _synth_scan(arguments: Namespace) -> None:
    """A capture of a scanned head."""
    for name, default in (("subjects", 1), ("motion", "poses"), ("tone", None), ("landmark_bias", 0.0)):
        if getattr(arguments, name) != default:
            option = name.replace("_", "-")
            raise InputError(f"--{option}: found with --head, whose shape and skin are the scan's; leave it out")
    from mifit.synth.compose import place_cameras, read_environment
    from mifit.synth.scanned import ScannedHead, maps_of, synthesize_scan
    from mifit.synth.studio import studio_environment

    head = ScannedHead.load(arguments.head, maps_of(arguments.maps), arguments.unit_mm, arguments.flip_v)
    environment = read_environment(arguments.env) if arguments.env else studio_environment(arguments.seed)
    relit = {path.stem: read_environment(path) for path in arguments.relit}
    _use_variant(arguments)
    synthesize_scan(
        arguments.out,
        head,
        place_cameras(arguments.width, arguments.height),
        environment,
        relit,
        arguments.timesteps,
        arguments.seed,
        arguments.spp,
        console_progress(arguments.quiet),
    )
    print(f"Capture: {arguments.out}; it has no landmarks yet: mifit landmarks {arguments.out}")


def import_(arguments: Namespace) -> None:
    """Make a capture from other files."""
    if arguments.digital_emily is not None:
        from mifit.capture.digital_emily import import_digital_emily

        import_digital_emily(arguments.digital_emily, arguments.out)
        print(f"Capture: {arguments.out}; it has no landmarks yet: mifit landmarks {arguments.out}")
        return
    from mifit.capture import import_capture

    import_capture(
        arguments.out,
        videos=arguments.video,
        calibration=arguments.calibration,
        images=arguments.images,
        colmap=arguments.colmap,
        transforms=arguments.transforms,
        every=arguments.every,
        start=arguments.start,
        count=arguments.count,
        units=arguments.units,
        progress=console_progress(arguments.quiet),
    )
    print(f"Capture: {arguments.out}")


def calibrate(arguments: Namespace) -> None:
    """Cameras from a board, or from the heads of an uncalibrated capture."""
    if (arguments.capture is None) == (arguments.board is None):
        raise InputError("expected one of CAPTURE and --board")
    if arguments.capture is not None:
        _calibrate_from_heads(arguments)
        return
    from mifit.capture.board_calibration import calibrate_boards, write_calibration
    from mifit.capture.boards import Board
    from mifit.capture.sources import open_sources

    out: Path | None = arguments.out
    board = Board.parse(arguments.board)
    if out is None:
        raise InputError("--board needs --out, the folder to write")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is there already and not empty; name another folder")
    if not arguments.video and not arguments.images:
        for path in board.write(out):
            print(f"Board: {path}")
        print("Print it at 100 per cent, glue it onto something flat, and measure a square.")
        return
    calibration = calibrate_boards(
        open_sources(arguments.video, arguments.images), board, arguments.units, console_progress(arguments.quiet)
    )
    write_calibration(calibration, out, arguments.units)
    print(calibration.summary())
    print(f"Calibration: {out}")


def _calibrate_from_heads(arguments: Namespace) -> None:
    import mifit
    from mifit.capture.place import calibrate_others, write_cameras
    from mifit.pipeline import calibrated, choose

    capture = mifit.Capture.load(arguments.capture)
    if capture.calibrated:
        raise InputError(f"{arguments.capture}: is calibrated already; nothing to do")
    cameras = choose("camera", capture.cameras, arguments.cameras, 2)
    timesteps = choose("timestep", capture.timesteps, arguments.timesteps, 4)
    capture = calibrated(capture, mifit.MorphableModel.load(arguments.model), cameras, timesteps)
    found = calibrate_others(capture, cameras, timesteps)
    write_cameras(arguments.capture, capture, [camera for camera, _ in found.values()])
    for name, (camera, error) in found.items():
        role = "decided" if name in cameras else "placed"
        print(f"{name}: {role}, focal length {camera.fx:.0f} pixels, landmarks {error:.1f} pixels beside the others'")
    print(f"Capture: {arguments.capture}; its scale is the model's, its cameras are estimates")


def landmarks(arguments: Namespace) -> None:
    """Detect landmarks and write them into the capture."""
    from mifit.capture import detect_landmarks

    print(detect_landmarks(arguments.capture, arguments.detector, progress=console_progress(arguments.quiet)))


def fit(arguments: Namespace) -> None:
    """Run the stages and write the result folder."""
    import mifit
    from mifit.result.ownership import check_ours

    out: Path = arguments.out
    check_ours(out, arguments.force)
    if arguments.config:
        check_file(arguments.config, MAX_SETTINGS_BYTES, "configuration file")
    if arguments.config and arguments.preset:
        raise InputError(
            f"--preset {arguments.preset}: found with --config {arguments.config}, expected one of the two"
        )
    config = FitConfig.load(arguments.config) if arguments.config else PRESETS[arguments.preset or "default"]()
    capture = mifit.Capture.load(arguments.capture)
    model = mifit.MorphableModel.load(arguments.model)
    _use_variant(arguments)
    from mifit.fitting import fit_into
    from mifit.output.report import write_report

    result = fit_into(
        out,
        capture,
        model,
        cameras=arguments.cameras,
        timesteps=arguments.timesteps,
        config=config,
        until=arguments.until,
        seed=arguments.seed,
        progress=console_progress(arguments.quiet),
        resume=arguments.resume,
        force=arguments.force,
    )
    write_report(out, result, capture)
    print(f"Result: {out}")


def track(arguments: Namespace) -> None:
    """Extend a result by further timesteps."""
    import mifit
    from mifit.pipeline import choose

    result = mifit.Reconstruction.load(arguments.result)
    capture = mifit.Capture.load(arguments.capture)
    _use_variant(arguments)
    from mifit.output.sequence import write_moving_pictures
    from mifit.result.ownership import remember
    from mifit.tracking import sequence_left, track_into

    for name in arguments.overlay or ():
        capture.with_fitted(result.cameras).camera(name)  # an unknown one is refused now, not after the work
    timesteps = sequence_left(result, capture, arguments.resume)
    if arguments.timesteps:
        timesteps = choose("timestep", capture.timesteps, arguments.timesteps, 0)
    progress = console_progress(arguments.quiet)
    result = track_into(
        arguments.result,
        result,
        capture,
        timesteps,
        config=from_mapping(NormalsConfig, result.config.get("normals", {}), "result.json: config: normals"),
        seed=arguments.seed,
        resume=arguments.resume,
        progress=progress,
    )
    written = write_moving_pictures(arguments.result, result, capture, arguments.overlay, arguments.fps, progress)
    remember(arguments.result, [path.name for path in written])
    print(f"Result: {arguments.result}")


def evaluate(arguments: Namespace) -> None:
    """Error on a held-out view: a table on stdout, JSON on request, the report renewed."""
    import mifit

    result = mifit.Reconstruction.load(arguments.result)
    capture = mifit.Capture.load(arguments.capture)
    _use_variant(arguments)
    from mifit.output.evaluate import evaluate
    from mifit.output.report import write_report
    from mifit.pipeline import fitted_to

    found = evaluate(
        result,
        capture,
        arguments.camera,
        timesteps=arguments.timesteps,
        region=arguments.region,
        progress=console_progress(arguments.quiet),
        baseline=arguments.baseline,
    )
    if not fitted_to(result, capture):
        _say(arguments, f"mifit: warning: {arguments.capture}: isn't the capture that was fitted, or has changed since")
    if arguments.camera in [camera.name for camera in result.cameras]:
        _say(arguments, f"mifit: warning: camera {arguments.camera!r} was fitted, so this is no held-out error")
    if arguments.json:
        write_text(arguments.json, json.dumps(found, indent=2) + "\n")
    print(f"camera {found['camera']}, timesteps {found['timesteps']}, {found['region_pixels']} pixels")
    if "resected" in found:
        print(
            f"camera {found['camera']} is not calibrated: placed from its landmarks against the fitted head, "
            f"{found['resected']['landmark_pixels']:.1f} pixels beside them"
        )
    _print_measures(found["methods"])
    if "baseline" in found:
        print(f"image-based rendering on the same mesh, {found['baseline']['region_pixels']} pixels that it can fill")
        _print_measures(found["baseline"]["methods"])
    write_report(arguments.result, result, capture, evaluation=found)


def _print_measures(methods: dict[str, dict[str, float]]) -> None:
    print(f"{'method':<12}{'PSNR dB':>9}{'RMSE':>8}{'SSIM':>8}{'FLIP':>8}")
    for method, f in methods.items():
        print(f"{method:<12}{f['psnr']:>9.2f}{f['rmse']:>8.2f}{f['ssim']:>8.4f}{f['flip']:>8.4f}")


def render(arguments: Namespace) -> None:
    """Render one timestep from a camera of the capture."""
    import mifit
    from mifit.core.image import write_image

    turned = {name: getattr(arguments, name) for name in ("yaw", "pitch", "distance")}
    turned = {name: value for name, value in turned.items() if value is not None}
    if arguments.camera and turned:
        raise InputError(f"--camera {arguments.camera}: found --{next(iter(turned))} beside it, expected one of both")
    result = mifit.Reconstruction.load(arguments.result)
    timestep = result.timesteps[0] if arguments.timestep is None else arguments.timestep
    if not arguments.camera:
        camera = result.orbit(**turned, timestep=timestep)
    elif arguments.capture:
        camera = mifit.Capture.load(arguments.capture).with_fitted(result.cameras).camera(arguments.camera)
    else:
        camera = result.camera(arguments.camera)
    _use_variant(arguments)
    image = result.render(camera, timestep, method=arguments.method, integrator=arguments.integrator)
    write_image(arguments.out, image)
    print(f"Image: {arguments.out}")


def _result_and_variant(arguments: Namespace) -> Reconstruction:
    import mifit

    result = mifit.Reconstruction.load(arguments.result)
    _use_variant(arguments)
    return result


def turntable(arguments: Namespace) -> None:
    """Write novel views about the vertical axis."""
    result = _result_and_variant(arguments)
    from mifit.output.sequence import write_sequence
    from mifit.output.turntable import write_turntable

    progress = console_progress(arguments.quiet)
    if arguments.sequence:
        path, methods = arguments.out / "sequence.mp4", result.methods[:0:-1] or result.methods
        write_sequence(
            result, path, arguments.start, arguments.stop, methods=methods, fps=arguments.fps, progress=progress
        )
    else:
        write_turntable(result, arguments.out, arguments.start, arguments.stop, arguments.steps, progress=progress)
    print(f"Views: {arguments.out}")


def view(arguments: Namespace) -> None:
    """Show a result in the browser until the user ends it."""
    result = _result_and_variant(arguments)
    from mifit.output.live_view import LiveView

    live = LiveView(result, arguments.host, arguments.port)
    print(f"View: {live.address} (end with Ctrl+C)", flush=True)
    try:
        live.run()
    except KeyboardInterrupt:
        pass
    finally:
        live.close()


def relight(arguments: Namespace) -> None:
    """Write views under another environment."""
    result = _result_and_variant(arguments)
    from mifit.output.relight import AGREEMENT, write_relit
    from mifit.output.sequence import write_sequence

    progress = console_progress(arguments.quiet)
    found = write_relit(
        result, arguments.env, arguments.out, rotate=arguments.rotate, seed=arguments.seed, progress=progress
    )
    print(f"Fast against path-traced views: {found['psnr']:.1f} dB")
    if found["psnr"] < AGREEMENT:
        print(
            f"mifit: warning: fast and path-traced views agree to less than {AGREEMENT:g} dB; use the latter",
            file=sys.stderr,
        )
    if arguments.sequence:
        lit = result.relight(arguments.env, rotate=arguments.rotate)
        write_sequence(lit, arguments.out / "sequence.mp4", fps=arguments.fps, progress=progress)
    print(f"Views: {arguments.out}")


def export(arguments: Namespace) -> None:
    """Write geometry and maps for another program."""
    result = _result_and_variant(arguments)
    from mifit.output.export import export

    export(
        result,
        arguments.format,
        arguments.out,
        arguments.timestep,
        mesh=arguments.mesh,
        animate=arguments.animate,
        fps=arguments.fps,
    )
    print(f"Export: {arguments.out}")


def run(arguments: Namespace) -> None:
    """Run an experiment or a sweep."""
    from mifit.experiment import run_experiment

    summary = run_experiment(
        arguments.experiment,
        overrides=arguments.overrides,
        out=arguments.out,
        dask=arguments.dask,
        variant=arguments.variant,
        seed=arguments.seed,
        progress=console_progress(arguments.quiet),
    )
    print(summary)


def model(arguments: Namespace) -> None:
    """Inspect or convert a morphable model."""
    import mifit
    from mifit.morphable import describe

    if arguments.action == "info":
        loaded = mifit.MorphableModel.load(arguments.model)
        print(describe.model_info(loaded))
        if arguments.preview:
            describe.save_preview(loaded, arguments.preview)
            print(f"Preview: {arguments.preview}")
    else:
        options: dict[str, Any] = {"kind": arguments.kind} if arguments.kind else {}
        mifit.MorphableModel.load(arguments.source, **options).save(arguments.out)
        print(f"Model: {arguments.out}")
