"""Commands about a result folder. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import argparse
import json
import sys
from argparse import Namespace
from typing import TYPE_CHECKING

from mifit.cli import arguments as types
from mifit.cli.arguments import add_force, say, tell, use_variant, writes
from mifit.cli.console import console_progress
from mifit.core.diagnostics import Diagnostic
from mifit.core.files import write_text
from mifit.core.limits import MAX_RENDERED_PIXELS
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.reconstruction import Reconstruction


@writes("json")
def evaluate(arguments: Namespace) -> int:
    """Error on a held-out view: a table on stdout, JSON on request, the report renewed."""
    import mifit

    result = mifit.Reconstruction.load(arguments.result)
    capture = mifit.Capture.load(arguments.capture)
    use_variant(arguments)
    return judge(arguments, result, capture)


def judge(arguments: Namespace, result: Reconstruction, capture: Capture) -> int:
    """`evaluate` of a result that has been read, or just been made and written into ``arguments.result``."""
    from mifit.fitting import fitted_to
    from mifit.output.evaluate import Comparison, evaluate, held_out
    from mifit.output.report import SHOWN_TIMESTEPS, write_report
    from mifit.result.ownership import replacing_files

    judged = {"camera": arguments.camera, "timesteps": arguments.timesteps or result.timesteps}
    if not held_out(result, judged) and not arguments.fitted:
        raise InputError(
            f"camera {arguments.camera!r} was fitted, so this is no held-out error; name another one, or --fitted to "
            "see how well it was fitted"
        )
    shown: list[Comparison] = []
    found = evaluate(
        result,
        capture,
        arguments.camera,
        timesteps=arguments.timesteps,
        region=arguments.region,
        progress=console_progress(arguments.quiet),
        baseline=True,
        passes=arguments.passes,
        watch=lambda one: shown.append(one) if len(shown) < SHOWN_TIMESTEPS else None,
    )
    said = list(result.diagnostics)
    if not fitted_to(result, capture):
        text = f"{arguments.capture}: isn't the capture that was fitted, or has changed since"
        said.append(Diagnostic("capture-changed", text))
    code = tell(arguments, said)
    if arguments.json:
        asked = {key: value for key, value in found.items() if key != "baseline" or arguments.baseline}
        write_text(arguments.json, json.dumps(asked, indent=2) + "\n")
    print(f"camera {found['camera']}, timesteps {found['timesteps']}, {found['region_pixels']} pixels")
    if "resected" in found:
        print(
            f"camera {found['camera']} is not calibrated: placed from its landmarks against the fitted head, "
            f"{found['resected']['landmark_pixels']:.1f} pixels beside them"
        )
    for timestep, placed in found.get("posed", {}).items():
        print(
            f"timestep {timestep} was not fitted: the head was placed by its landmarks, "
            f"{placed['landmark_pixels']:.1f} pixels beside them"
        )
    _print_measures(found["methods"])
    if arguments.baseline:
        print(f"image-based rendering on the same mesh, {found['baseline']['region_pixels']} pixels that it can fill")
        _print_measures(found["baseline"]["methods"])
    if "passes" in found:
        from mifit.output.score import summary

        print(summary({"passes": {found["camera"]: found["passes"]}}))
    if not arguments.fitted:  # the report keeps the held-out view
        with replacing_files(arguments.result) as new:
            write_report(new, result, capture, found, shown)
    return code


def _print_measures(methods: dict[str, dict[str, float]]) -> None:
    print(f"{'method':<20}{'PSNR dB':>9}{'RMSE':>8}{'SSIM':>8}{'FLIP':>8}")
    for method, f in methods.items():
        print(f"{method:<20}{f['psnr']:>9.2f}{f['rmse']:>8.2f}{f['ssim']:>8.4f}{f['flip']:>8.4f}")


@writes("json")
def score(arguments: Namespace) -> None:
    """Score any program's images and meshes, in plain files, against a capture's truth."""
    import mifit

    capture = mifit.Capture.load(arguments.capture)
    model = None if arguments.model is None else mifit.MorphableModel.load(arguments.model)
    use_variant(arguments)
    from mifit.output.score import score as scored
    from mifit.output.score import summary

    found = scored(capture, arguments.images, arguments.cameras, model, console_progress(arguments.quiet))
    for name in found["ignored"]:
        print(
            f"mifit: warning: {arguments.images / name}: its name says nothing that is scored; left out",
            file=sys.stderr,
        )
    if arguments.json:
        asked = {key: value for key, value in found.items() if key != "baseline" or arguments.baseline}
        write_text(arguments.json, json.dumps(asked, indent=2) + "\n")
    print(summary(found))


@writes("out", outside="capture")
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
        capture = mifit.Capture.load(arguments.capture).with_fitted(result.cameras)
        camera = capture.camera(arguments.camera)
    else:
        camera = result.camera(arguments.camera)
    use_variant(arguments)
    image = result.render(camera, timestep, method=arguments.method, integrator=arguments.integrator)
    write_image(arguments.out, image)
    print(f"Image: {arguments.out}")


def _result_and_variant(arguments: Namespace) -> Reconstruction:
    import mifit

    result = mifit.Reconstruction.load(arguments.result)
    use_variant(arguments)
    return result


@writes("out")
def turntable(arguments: Namespace) -> None:
    """Write novel views about the vertical axis."""
    result = _result_and_variant(arguments)
    from mifit.output.views import write_sequence, write_turntable

    if arguments.env:
        result = result.relight(arguments.env, arguments.rotate, arguments.exposure)
    elif arguments.rotate or arguments.exposure != 1.0:
        raise InputError("--rotate and --exposure: found without --env, the light that they are of")
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
    from mifit.extras.live_view import LiveView, serve

    live = LiveView(result, arguments.host, arguments.port)
    print(f"View: {live.address}", flush=True)
    serve(live)


@writes("out", "video")
def relight(arguments: Namespace) -> None:
    """Write views under another environment."""
    if arguments.camera and arguments.yaw is not None:
        raise InputError(f"--camera {arguments.camera}: found --yaw beside it, expected one of both")
    if arguments.video and not arguments.turn:
        raise InputError(f"--video {arguments.video}: found without --turn, the number of rotations that it shows")
    result = _result_and_variant(arguments)
    from mifit.output.relight import AGREEMENT, write_relit

    cameras = list(result.cameras)
    if arguments.camera:
        cameras = [result.camera(arguments.camera)]
    elif arguments.yaw is not None or arguments.turn:
        cameras = [result.orbit(arguments.yaw or 0.0)]
    if arguments.size:
        cameras = [camera.resized(arguments.size / camera.width) for camera in cameras]
    turns = arguments.turn or 1
    found = write_relit(
        result,
        arguments.env,
        arguments.out,
        cameras,
        [arguments.rotate + 360.0 * k / turns for k in range(turns)],
        arguments.exposure,
        arguments.video,
        arguments.fps,
        arguments.integrator,
        check=arguments.check,
        seed=arguments.seed,
        progress=console_progress(arguments.quiet),
    )
    say(
        arguments,
        f"Exposure: {found['exposure']:.3g} times the file's own radiance; "
        f"the capture's level is {found['capture_exposure']:.3g} (--exposure auto)",
    )
    if arguments.check:
        agreement = found["check"]["psnr"]
        print(f"Fast view against path tracing: {agreement:.1f} dB")
        if agreement < AGREEMENT:
            print(f"mifit: warning: they agree to less than {AGREEMENT:g} dB; use --integrator path", file=sys.stderr)
    print(f"Views: {arguments.video or arguments.out}")


@writes("out")
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
        units=arguments.units,
    )
    print(f"Export: {arguments.out}")


def add_commands(add: types.Add) -> None:
    """Add these commands to the parser."""
    p = add("evaluate", evaluate, "error on a held-out view")
    p.add_argument("result", type=types.path, help="result folder of mifit fit")
    p.add_argument("--capture", type=types.path, required=True, help="capture that has the view")
    p.add_argument("--camera", required=True, help="camera to judge by, one that was not fitted")
    p.add_argument(
        "--timesteps",
        type=types.timesteps,
        help="default: all of the result; at one without a fit landmarks place the head",
    )
    p.add_argument(
        "--region",
        choices=["face", "skin", "truth"],
        default="face",
        help="the fitted model's face area (default); skin, as the benchmarks have it; the truth's face area",
    )
    p.add_argument("--fitted", action="store_true", help="of a camera that was fitted: its error is no held-out one")
    p.add_argument("--baseline", action="store_true", help="compare image-based rendering on the same mesh and pixels")
    p.add_argument(
        "--passes",
        action="store_true",
        help="compare diffuse and specular images of the capture's first timestep with the truth's",
    )
    p.add_argument("--json", type=types.path, help="file to write the figures to")
    add_force(p)
    types.add_strict(p)

    p = add("score", score, "any program's images, relit views, passes or meshes against a capture's truth")
    p.add_argument("capture", type=types.path, help="capture folder with truth, or its transforms.json")
    p.add_argument(
        "--images",
        type=types.path,
        required=True,
        help="folder with CAMERA_TTTT.png, relit_ENV.exr, diffuse_CAMERA.exr, specular_CAMERA.exr, TTTT.ply",
    )
    p.add_argument("--cameras", type=types.listed, help="cameras that the program was given; default: the first two")
    p.add_argument("--model", help="morphable model that the capture was made with, if its truth has no triangles")
    p.add_argument("--json", type=types.path, help="file to write the scores to")
    add_force(p)

    p = add("render", render, "render a reconstruction from a camera of the capture, or from any side")
    p.add_argument("result", type=types.path, help="result folder of mifit fit")
    p.add_argument("--capture", type=types.path, help="capture that --camera is of; default: the fitted cameras")
    p.add_argument("--camera", help="default: a view of the face from --yaw, --pitch and --distance")
    p.add_argument("--yaw", type=types.real, help="degrees about the vertical; 0 is the front")
    p.add_argument("--pitch", type=types.real, help="degrees upwards")
    p.add_argument(
        "--distance", type=types.positive, help="from the face, the result's units; default: the fitted cameras'"
    )
    p.add_argument("--timestep", type=types.at_least(0), help="default: the first of the result")
    p.add_argument("--out", type=types.path, required=True, help="image to write: .png (8-bit sRGB) or .exr (linear)")
    add_force(p)
    p.add_argument(
        "--method",
        choices=["full", "diffuse", "pca"],
        default="full",
        help="everything (default), without specular, the model alone",
    )
    p.add_argument(
        "--integrator", choices=["local", "path"], default="local", help="closed form (default) or path tracing"
    )

    p = add("turntable", turntable, "novel views about the vertical axis, with and without specular")
    p.add_argument("result", type=types.path, help="result folder of mifit fit")
    p.add_argument("--out", type=types.path, required=True, help="folder to write")
    add_force(p)
    p.add_argument("--from", dest="start", type=types.real, default=-35.0, help="first angle in degrees (default: -35)")
    p.add_argument("--to", dest="stop", type=types.real, default=35.0, help="last angle in degrees (default: 35)")
    p.add_argument("--steps", type=types.at_least(1), default=7, help="number of views (default: 7)")
    p.add_argument(
        "--sequence",
        action="store_true",
        help="play the timesteps while the camera turns: sequence.mp4, one frame per timestep in place of --steps",
    )
    _add_light(p, False)
    types.add_rate(p)

    p = add("view", view, "a live view in the browser: turn the head and the light, switch parts, load an environment")
    p.add_argument("result", type=types.path, help="result folder")
    types.add_address(p)

    p = add("relight", relight, "relit views under a measured environment")
    p.add_argument("result", type=types.path, help="result folder of mifit fit")
    p.add_argument("--out", type=types.path, required=True, help="folder to write")
    add_force(p)
    _add_light(p, True)
    p.add_argument("--turn", type=types.at_least(1), help="number of rotations of the light about the vertical")
    p.add_argument("--video", type=types.path, help="of --turn: .mp4 or .webp to write in place of images")
    p.add_argument("--camera", help="a fitted camera; default: all of them, with --turn the front")
    p.add_argument("--yaw", type=types.real, help="a view of the face from so many degrees about the vertical")
    p.add_argument("--size", type=types.whole(16, MAX_RENDERED_PIXELS // 16), help="width in pixels")
    p.add_argument("--integrator", choices=["local", "path"], default="local", help="fast (default) or path tracing")
    p.add_argument("--check", action="store_true", help="compare both integrators in one small view")
    types.add_rate(p)

    p = add("export", export, "geometry with its maps for other programs")
    p.add_argument("result", type=types.path, help="result folder of mifit fit")
    p.add_argument("--format", choices=["glb", "obj", "ply", "mitsuba"], required=True, help="kind of file")
    p.add_argument("--out", type=types.path, required=True, help="file to write")
    add_force(p)
    p.add_argument("--timestep", type=types.at_least(0), help="default: the first of the result")
    p.add_argument("--units", choices=["m", "cm", "mm"], help="of obj and ply; default: the result's")
    p.add_argument("--animate", action="store_true", help="glb: play all timesteps, from --timestep's maps")
    types.add_rate(p)
    p.add_argument(
        "--mesh",
        choices=["fitted", "refined"],
        default="fitted",
        help="refined: with the refined normals as shape, and its displacement map (default: fitted)",
    )


def _add_light(p: argparse.ArgumentParser, required: bool) -> None:
    """Add the options of an environment."""
    p.add_argument("--env", type=types.path, required=required, help="lat-long environment, .hdr or .exr")
    p.add_argument("--rotate", type=types.real, default=0.0, help="of --env: degrees about the vertical (default: 0)")
    p.add_argument(
        "--exposure",
        type=types.exposure,
        default=1.0,
        help="of --env: factor on the file's radiance (default: 1), or auto: the capture's level",
    )
