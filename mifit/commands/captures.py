"""Commands that make captures or complete them. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from mifit.commands.common import use_variant
from mifit.console import console_progress
from mifit.errors import InputError

if TYPE_CHECKING:
    pass


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
    use_variant(arguments)
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
    use_variant(arguments)
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
        metashape=arguments.metashape,
        realitycapture=arguments.realitycapture,
        vhap=arguments.vhap,
        nersemble=arguments.nersemble,
        photos=arguments.photos,
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
    from mifit.pipeline import calibrated, choose, choose_timesteps

    capture = mifit.Capture.load(arguments.capture)
    if capture.calibrated:
        raise InputError(f"{arguments.capture}: is calibrated already; nothing to do")
    cameras = choose("camera", capture.cameras, arguments.cameras, 2)
    timesteps = choose_timesteps(capture, arguments.timesteps)
    use_variant(arguments)
    model = mifit.MorphableModel.load(arguments.model)
    dense = calibrated(capture, model, cameras, timesteps, console_progress(arguments.quiet))
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
