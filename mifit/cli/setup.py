"""Commands that look at the machine and at models. Arguments are parsed; bad input raises InputError."""

from __future__ import annotations

import json
from argparse import Namespace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

import mifit
from mifit.cli.arguments import console_progress, tell, use_variant, writes
from mifit.core.diagnostics import worst_first
from mifit.core.files import Document

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel


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
    from mifit.extras.fetch_model import ADDRESS, fetch_ict
    from mifit.morphable.openings import with_eyes

    if arguments.action == "fetch":
        path = fetch_ict(arguments.address or ADDRESS, console_progress(arguments.quiet))
        print(f"Model: {path}; --model auto, the default, takes it from now on")
    elif arguments.action == "info":
        loaded = mifit.MorphableModel.load(arguments.model)
        print(model_info(loaded))
    else:
        options: Document = {"kind": arguments.kind} if arguments.kind else {}
        loaded = mifit.MorphableModel.load(arguments.source, **options)
        (with_eyes(loaded) if arguments.eyes else loaded).save(arguments.out)
        print(f"Model: {arguments.out}")


def model_info(model: MorphableModel) -> str:
    """Return a table of sizes, extents and anything odd, one fact per line."""
    size = np.ptp(model.mean, axis=0) * model.unit_mm

    def spread(modes: NDArray, unit: float) -> str:
        if modes.shape[2] == 0:
            return "none"
        deviation = unit * np.sqrt((modes.astype(np.float64) ** 2).sum((1, 2)).mean())
        return f"{modes.shape[2]} modes, {deviation:.3g} rms"

    bounded = np.isfinite(model.expression_bounds).all(1).sum()
    skin = model.mean_albedo[np.unique(model.faces[model.face_mask])].mean(0)
    expression = spread(model.expression, model.unit_mm)
    rows = [
        ("name", model.name),
        ("digest", model.digest),
        ("vertices", f"{model.n_vertices}"),
        ("faces", f"{len(model.faces)}, of which {model.face_mask.sum()} in the face area"),
        ("texture vertices", f"{len(model.uv)}"),
        ("unit", f"{model.unit_mm:g} mm"),
        ("size", " x ".join(f"{s:.0f}" for s in size) + " mm"),
        ("identity", spread(model.identity, model.unit_mm) + (" mm" if model.n_identity else "")),
        ("expression", expression + (f" mm, {bounded} bounded" if model.n_expression else "")),
        ("albedo", spread(model.albedo_modes, 1.0)),
        ("mean albedo", " ".join(f"{c:.3f}" for c in skin)),
        ("symmetry", "known" if model.symmetry is not None else "unknown"),
        *(("notice", n) for n in notices(model)),
    ]
    width = max(len(k) for k, _ in rows)
    return "\n".join(f"{k:<{width}}  {v}" for k, v in rows)


def notices(model: MorphableModel) -> list[str]:
    """Things about a valid model that a person should know."""
    from mifit.morphable.openings import lacks_eyes

    out = []
    if lacks_eyes(model):
        out.append("its eyes are holes; a fit, and mifit model convert --eyes, put simple ones there")
    if len(model.degenerate_faces):
        out.append(
            f"{len(model.degenerate_faces)} faces of the mean have no area, the first is {model.degenerate_faces[0]}"
        )
    return out
