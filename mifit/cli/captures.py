"""Commands that make captures or complete them. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import mifit
from mifit.cli.arguments import check_empty, console_progress, given, use_variant
from mifit.cli.clips import start_times
from mifit.errors import InputError


def synth(arguments: Namespace) -> None:
    """Write path-traced captures."""
    out: Path = arguments.out
    check_empty(out, arguments.force)
    if arguments.head is not None:
        _synth_scan(arguments)
        return
    if arguments.maps or arguments.relit:
        raise InputError("--maps and --relit belong to --head, which is missing")
    use_variant(arguments)
    from mifit.synth import synthesize

    options = given(arguments, "subjects", "timesteps", "env", "model", "seed", "width", "height", "spp")
    subject = given(arguments, "tone", "outside", "landmark_bias", "portrait")
    synthesize(out, **options, **subject, progress=console_progress(arguments.quiet))
    print(f"Capture: {out}")


def _synth_scan(arguments: Namespace) -> None:
    """A capture of a scanned head."""
    for name, default in (("subjects", 1), ("tone", None), ("landmark_bias", 0.0), ("portrait", False)):
        if getattr(arguments, name) != default:
            option = name.replace("_", "-")
            raise InputError(f"--{option}: found with --head, whose shape and skin are the scan's; leave it out")
    from mifit.core.image import read_environment
    from mifit.synth.compose import place_cameras
    from mifit.synth.procedural import studio_environment
    from mifit.synth.scanned import ScannedHead, maps_of, synthesize_scan

    head = ScannedHead.load(arguments.head, maps_of(arguments.maps or ()), arguments.unit_mm, arguments.flip_v)
    own = read_environment(arguments.env) if arguments.env else studio_environment(arguments.seed)
    environments = {"": own, **{path.stem: read_environment(path) for path in arguments.relit or ()}}
    use_variant(arguments)
    cameras, progress = place_cameras(arguments.width, arguments.height), console_progress(arguments.quiet)
    options = given(arguments, "timesteps", "seed", "spp")
    synthesize_scan(arguments.out, head, cameras, environments, **options, progress=progress)
    print(f"Capture: {arguments.out}; it has no landmarks yet: mifit landmarks {arguments.out}")


def import_(arguments: Namespace) -> None:
    """Make a capture from other files."""
    from mifit.capture import import_capture
    from mifit.capture.sources import open_sources
    from mifit.extras.colmap import import_colmap

    sources = given(arguments, "calibration", "transforms", "colmap")
    named = [name for name, path in sources.items() if path is not None]
    if len(named) > 1:
        raise InputError(f"found more than one of {', '.join(named)}, expected one")
    if arguments.photos is not None and arguments.colmap is None:
        raise InputError("--photos: found without a model to go with, expected --colmap")
    progress = console_progress(arguments.quiet)
    options = given(arguments, "images", "every", "start", "count", "trim", "units")
    options |= {"videos": arguments.video, "progress": progress}
    if arguments.video:
        options["starts"] = start_times(arguments, open_sources(arguments.video, ()), arguments.offset, progress)
    if arguments.colmap is not None:
        import_colmap(arguments.colmap, arguments.out, photos=arguments.photos, **options)
    else:
        import_capture(arguments.out, calibration=arguments.calibration, transforms=arguments.transforms, **options)
    print(f"Capture: {arguments.out}")


def calibrate(arguments: Namespace) -> None:
    """Cameras from a board, or from the heads of an uncalibrated capture."""
    if (arguments.capture is None) == (arguments.board is None):
        raise InputError("expected one of CAPTURE and --board")
    if arguments.capture is not None:
        _calibrate_from_heads(arguments)
        return
    from mifit.capture.clips import aligned
    from mifit.capture.sources import open_sources
    from mifit.extras.board_calibration import calibrate_boards, write_calibration
    from mifit.extras.boards import Board

    out: Path | None = arguments.out
    board = Board.parse(arguments.board)
    if out is None:
        raise InputError("--board needs --out, the folder to write")
    check_empty(out, arguments.force)
    if not arguments.video and not arguments.images:
        for path in board.write(out):
            print(f"Board: {path}")
        print("Print it at 100 per cent, glue it onto something flat, and measure a square.")
        return
    sources = open_sources(arguments.video, arguments.images, arguments.names)
    progress = console_progress(arguments.quiet)
    starts = start_times(arguments, sources, arguments.offset, progress)
    calibration = calibrate_boards(aligned(sources, starts), board, arguments.units, progress)
    write_calibration(calibration, out, arguments.units)
    print(calibration.summary())
    print(f"Calibration: {out}")


def _calibrate_from_heads(arguments: Namespace) -> None:
    from mifit.extras.calibrate_densely import calibrate_capture
    from mifit.extras.calibrate_heads import calibrate_others, write_cameras
    from mifit.fitting import choose, choose_timesteps

    capture = mifit.Capture.load(arguments.capture)
    if capture.calibrated:
        raise InputError(f"{arguments.capture}: is calibrated already, expected a capture without cameras")
    cameras = choose("camera", capture.cameras, arguments.cameras, 2)
    timesteps = choose_timesteps(capture, arguments.timesteps)
    use_variant(arguments)
    model = mifit.MorphableModel.load(arguments.model)
    dense = calibrate_capture(capture, model, cameras, timesteps, console_progress(arguments.quiet))
    capture = dense.capture
    found = calibrate_others(capture, cameras, timesteps)
    write_cameras(arguments.capture, capture, [camera for camera, _ in found.values()])
    for name, (camera, error) in found.items():
        role = "decided" if name in cameras else "placed"
        print(f"{name}: {role}, focal length {camera.fx:.0f} pixels, landmarks {error:.1f} pixels beside the others'")
    print(dense.note[0].upper() + dense.note[1:])
    print(f"Capture: {arguments.capture}; its scale is the model's, its cameras are estimates")


def landmarks(arguments: Namespace) -> None:
    """Detect landmarks and write them into the capture."""
    from mifit.capture import detect_landmarks

    print(detect_landmarks(arguments.capture, arguments.detector, progress=console_progress(arguments.quiet)))
