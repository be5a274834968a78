"""Commands about a result folder. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import TYPE_CHECKING

import mifit
from mifit.cli.arguments import console_progress, given, say, tell, use_variant, writes
from mifit.core.diagnostics import Diagnostic
from mifit.core.files import write_json
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Reconstruction


@writes("json")
def evaluate(arguments: Namespace) -> int:
    """Error on a held-out view: a table on stdout, JSON on request, the report renewed."""
    result = mifit.Reconstruction.load(arguments.result)
    capture = mifit.Capture.load(arguments.capture)
    use_variant(arguments)
    return judge(arguments, result, capture)


def judge(arguments: Namespace, result: Reconstruction, capture: Capture) -> int:
    """`evaluate` of a result that has been read, or just been made and written into ``arguments.result``."""
    from mifit.fitting import fitted_to
    from mifit.output.evaluate import Comparison, evaluate
    from mifit.output.report import SHOWN_TIMESTEPS, write_report
    from mifit.result.ownership import replacing_files

    if arguments.camera in [camera.name for camera in result.cameras] and not arguments.fitted:
        raise InputError(
            f"camera {arguments.camera!r} was fitted, so this is no held-out error; name another one, or --fitted to "
            "see how well it was fitted"
        )
    shown: list[Comparison] = []
    found = evaluate(
        result,
        capture,
        **given(arguments, "camera", "timesteps", "region", "passes"),
        progress=console_progress(arguments.quiet),
        baseline=True,
        watch=lambda one: shown.append(one) if len(shown) < SHOWN_TIMESTEPS else None,
    )
    said = list(result.diagnostics)
    if not fitted_to(result, capture):
        text = f"{arguments.capture}: isn't the capture that was fitted, or has changed since"
        said.append(Diagnostic("capture-changed", text))
    code = tell(arguments, said)
    if arguments.json:
        asked = {key: value for key, value in found.items() if key != "baseline" or arguments.baseline}
        write_json(arguments.json, asked, indent=2)
    print(f"camera {found['camera']}, timesteps {found['timesteps']}, {found['region_pixels']} pixels")
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
    capture = mifit.Capture.load(arguments.capture)
    model = None if arguments.model is None else mifit.MorphableModel.load(arguments.model)
    use_variant(arguments)
    from mifit.output.score import score as scored
    from mifit.output.score import summary

    found = scored(capture, arguments.images, arguments.cameras, model, console_progress(arguments.quiet))
    for name in found["ignored"]:
        text = f"{arguments.images / name}: its name says nothing that is scored; left out"
        print(f"mifit: warning: {text}", file=sys.stderr)
    if arguments.json:
        write_json(arguments.json, found, indent=2)
    print(summary(found))


@writes("out", outside="capture")
def render(arguments: Namespace) -> None:
    """Render one timestep from a camera of the capture."""
    from mifit.core.image import write_image

    turned = {k: v for k, v in given(arguments, "yaw", "pitch", "distance").items() if v is not None}
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
    result = mifit.Reconstruction.load(arguments.result)
    use_variant(arguments)
    return result


@writes("out")
def turntable(arguments: Namespace) -> None:
    """Write novel views about the vertical axis."""
    result = _result_and_variant(arguments)
    from mifit.output.views import write_turntable

    if arguments.env:
        result = result.relight(arguments.env, arguments.rotate, arguments.exposure)
    elif arguments.rotate or arguments.exposure != 1.0:
        raise InputError("--rotate and --exposure: found without --env, the light that they are of")
    progress = console_progress(arguments.quiet)
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
    rotations = [arguments.rotate + 360.0 * k / turns for k in range(turns)]
    options = given(arguments, "exposure", "video", "fps", "integrator", "check", "seed")
    progress = console_progress(arguments.quiet)
    found = write_relit(result, arguments.env, arguments.out, cameras, rotations, progress=progress, **options)
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

    options = given(arguments, "timestep", "mesh", "animate", "fps", "units")
    export(result, arguments.format, arguments.out, **options)
    print(f"Export: {arguments.out}")
