"""Commands that look at the machine and at models. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import json
from argparse import Namespace

from mifit.cli.arguments import tell, use_variant, writes
from mifit.cli.console import console_progress
from mifit.core.diagnostics import worst_first
from mifit.core.files import Document


def doctor(arguments: Namespace) -> int:
    """Print what works, exit code 1 when the pipeline can't run; or what is wrong with a capture."""
    if arguments.capture is not None:
        return _examine(arguments)
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


def _examine(arguments: Namespace) -> int:
    """Print how well each camera agrees with the others, what is wrong, and what would explain it; exit code 0 or 3."""
    import mifit
    from mifit.fitting import choose, choose_timesteps
    from mifit.stages.checks.capture_checks import check_capture, landmark_offsets

    capture, model = mifit.Capture.load(arguments.capture), mifit.MorphableModel.load(arguments.model)
    cameras = choose("camera", capture.cameras, arguments.cameras, 2)
    timesteps = choose_timesteps(capture, arguments.timesteps)
    found = check_capture(capture, model, cameras, timesteps)
    figures: Document = {"cameras": {}}
    if capture.calibrated:
        figures["cameras"] = landmark_offsets(capture, model, cameras, timesteps)
    if arguments.dense:
        use_variant(arguments)
        progress = console_progress(arguments.quiet)
        from mifit.extras.check_calibration import check_calibration

        fitted = mifit.fit(capture, model, cameras, timesteps[:4], until="geometry", progress=progress)
        named = any(one.severity == "fault" for one in found)  # then the fit is of something else
        tested = [] if named else cameras
        checked = check_calibration(fitted.seen(capture), model, fitted.geometry, tested, progress)
        found = worst_first([*found, *fitted.diagnostics, *checked.diagnostics])
        surface = fitted.geometry.report.phase("surface")
        figures |= {key: surface.get(key, {}) for key in ("epipolar_pixels", "likeness")}
        figures["calibration"] = checked.document()
    if arguments.json:
        print(json.dumps({"findings": [one.document() for one in found], **figures}, indent=2))
    else:
        for name in cameras:
            mine = {one.severity for one in found if one.camera in (name, None)}
            verdict = "wrong" if "fault" in mine else "doubtful" if "warning" in mine else "sound"
            pixels = figures["cameras"].get(name)
            text = "landmarks not judged" if pixels is None else f"landmarks {pixels:.1f} pixels from a face"
            print(f"camera {name}: {verdict}, {text}")
        for names, value in figures.get("epipolar_pixels", {}).items():
            alike = figures["likeness"][names]
            if value is not None and alike is not None:
                print(f"cameras {names}: {value:.2f} pixels off epipolar lines, images correlate by {alike:.2f}")
        for line in checked.lines if arguments.dense else ():
            print(line)
    return tell(arguments, found)


@writes("out")
def model(arguments: Namespace) -> None:
    """Inspect, convert or fetch a morphable model."""
    import mifit
    from mifit.extras.fetch_model import ADDRESS, fetch_ict
    from mifit.morphable import describe
    from mifit.morphable.openings import with_eyes

    if arguments.action == "fetch":
        path = fetch_ict(arguments.address or ADDRESS, console_progress(arguments.quiet))
        print(f"Model: {path}; --model auto, the default, takes it from now on")
    elif arguments.action == "info":
        loaded = mifit.MorphableModel.load(arguments.model)
        print(describe.model_info(loaded))
    else:
        options: Document = {"kind": arguments.kind} if arguments.kind else {}
        loaded = mifit.MorphableModel.load(arguments.source, **options)
        (with_eyes(loaded) if arguments.eyes else loaded).save(arguments.out)
        print(f"Model: {arguments.out}")
