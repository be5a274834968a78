"""What the refinement of calibrated cameras is worth: fits with exact and with wrong calibrations, without and with it.

    python -m benchmarks.wrong_cameras soft:pitch soft:all ... [--work out/wrong_cameras]

The right camera is turned by 0.3 degrees about its own axes, and its focal length is 0.5 % too long (`CASES`). Fits are
of cameras left and right, timesteps 0 to 3, stage 1; one that is in the work folder already is not run again. Judged by
the exact calibration: distances to the true surface, as they are and after one rigid motion of all timesteps, and the
held-out view by image-based rendering on the fitted mesh, through the cameras that the fit had. Writes
``benchmarks/results/wrong_cameras.json`` and ``wrong_cameras.md``; what is there of other cases stays.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mifit
from benchmarks import judge, scan
from benchmarks.captures import MODEL
from benchmarks.record import RESULTS, SHARED, record
from mifit import Capture, FitConfig, GeometryConfig, MorphableModel, Reconstruction
from mifit.core.files import write_text
from mifit.core.image import to_8_bit
from mifit.render.image_based import image_based

CAMERAS, TIMESTEPS, HELD_OUT = ("left", "right"), (0, 1, 2, 3), "third"
DEGREES, FOCAL = 0.3, 1.005
CASES: dict[str, tuple[tuple[int, int, int], bool]] = {
    "exact": ((0, 0, 0), False),
    "pitch": ((1, 0, 0), False),
    "yaw": ((0, 1, 0), False),
    "roll": ((0, 0, 1), False),
    "focal": ((0, 0, 0), True),
    "seen": ((1, 0, 1), True),  # all but the turn that is confounded with depth
    "all": ((1, 1, 1), True),
}
"""Camera axes (x right, y down, z forward) that the camera is turned about, and whether its focal length is off."""
ALIGNING, POINTS = 12, 3000


def wrong(capture: Capture, case: str) -> Capture:
    """A capture whose right camera is off as a case says."""
    axes, zoomed = CASES[case]
    view = capture.views[CAMERAS[1]]
    assert view.intrinsics is not None and view.world_to_camera is not None
    position = -view.world_to_camera[:3, :3].T @ view.world_to_camera[:3, 3]
    pose = view.world_to_camera.copy()
    pose[:3, :3] = Rotation.from_rotvec(DEGREES * np.array(axes), degrees=True).as_matrix() @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ position
    fx, fy, cx, cy = view.intrinsics
    factor = FOCAL if zoomed else 1.0
    changed = replace(view, world_to_camera=pose, intrinsics=(factor * fx, factor * fy, cx, cy))
    return replace(capture, views={**capture.views, view.name: changed}) if case != "exact" else capture


def fitted(name: str, case: str, refine: bool, work: Path) -> Reconstruction:
    """A fit, or the one that is in the work folder."""
    folder = work / f"{name}_{case}_{'on' if refine else 'off'}"
    if not (folder / "result.json").exists():
        mifit.fit(
            wrong(Capture.load(SHARED / "captures" / name), case),
            MorphableModel.load("builtin" if name.startswith("scan") else MODEL),
            cameras=CAMERAS,
            timesteps=TIMESTEPS,
            config=FitConfig(geometry=GeometryConfig(refine_cameras=refine)),
            until="geometry",
            checkpoints=work / "checkpoints",
            shared=True,
        ).save(folder)
    return Reconstruction.load(folder)


def judged(result: Reconstruction, exact: Capture, seen: Capture) -> dict[str, Any]:
    """Figures of one fit; ``seen`` is the capture as the fit had it."""
    near, aligned = _distances(result, _true_points(result, exact), exact.unit_mm)
    tally = judge.Tally()
    both = exact.with_estimate([seen.camera(name) for name in CAMERAS])
    for i, timestep in enumerate(result.timesteps):
        at = judge.view(exact, HELD_OUT, timestep)
        views = [both.camera(name) for name in CAMERAS]
        vertices, gains = result.geometry.vertices[i], result.geometry.gains
        found = image_based(both, views, at.camera, timestep, vertices, result.model.faces, gains)
        tally.add(to_8_bit(found.colour), at.photograph, at.skin & found.seen)
    phases = {phase["name"]: phase for phase in result.geometry.report.details["phases"]}
    keys = ("residual_left_out_pixels", "deviations", "moved", "kept", "seconds")
    return {
        "surface_mm": near,
        "aligned_mm": aligned,
        **tally.figures(),
        "epipolar_pixels": phases["surface"]["epipolar_pixels"],
        "cameras": {key: phases["cameras"].get(key) for key in keys} if "cameras" in phases else None,
        "seconds": round(result.seconds, 1),
    }


def _true_points(result: Reconstruction, exact: Capture) -> list[NDArray]:
    """Points of the true face at each timestep: those that both views see, or the vertices of the model's face area."""
    found = []
    for timestep in result.timesteps:
        truth = scan.read_scan(exact, timestep)
        if truth is not None:
            points = scan.points_seen(truth, exact, CAMERAS, timestep).position
        else:
            with np.load(exact.path / "truth" / f"{timestep:04d}.npz") as stored:
                points = stored["vertices"][np.unique(result.model.faces[result.model.face_mask])].astype(np.float64)
        found.append(points[:: max(1, len(points) // POINTS)])
    return found


def _distances(result: Reconstruction, points: list[NDArray], unit_mm: float) -> tuple[float, float]:
    """Mean distance (mm) of true points to the fitted surface, as they are and after a rigid motion of all of them."""

    def nearest() -> tuple[float, list[NDArray]]:
        distances, at = [], []
        for vertices, some in zip(result.geometry.vertices.astype(np.float64), points, strict=True):
            distance, face, weights = scan.nearest(some, vertices, result.model.faces)
            distances.append(distance)
            at.append(np.einsum("nc,nck->nk", weights, vertices[result.model.faces[face]]))
        return round(float(np.concatenate(distances).mean()) * unit_mm, 3), at

    first, at = nearest()
    last = first
    for _ in range(ALIGNING):
        mine, target = np.concatenate(points), np.concatenate(at)
        turn, _ = Rotation.align_vectors(target - target.mean(0), mine - mine.mean(0))
        points = [turn.apply(some - mine.mean(0)) + target.mean(0) for some in points]
        last, at = nearest()
    return first, last


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    """The table of docs/captures.md."""
    lines = [
        "| capture, camera off by | refined | matches left out, pixels | surface, mm | aligned, mm | held-out dB |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        for state in ("off", "on"):
            one = row[state]
            cameras = one["cameras"]
            pixels = "" if cameras is None else "{:.2f} -> {:.2f}".format(*cameras["residual_left_out_pixels"])
            done = "-" if cameras is None else "kept" if cameras["kept"] else "yes"
            lines.append(
                f"| {name.replace(':', ', ')} | {done} | {pixels} | {one['surface_mm']:.2f} | {one['aligned_mm']:.2f} "
                f"| {one['psnr']:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _place(item: tuple[str, Any]) -> tuple[str, int]:
    """Capture, and a case's place among the cases."""
    name, case = item[0].split(":")
    return name, list(CASES).index(case)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", help="CAPTURE:CASE")
    parser.add_argument("--work", type=Path, default=Path("out/wrong_cameras"))
    a = parser.parse_args()
    mifit.set_variant()
    for label in a.names:
        name, case = label.split(":")
        exact = Capture.load(SHARED / "captures" / name)
        row = {}
        for state in ("off", "on"):
            result = fitted(name, case, state == "on", a.work)
            seen = wrong(exact, case).with_fitted(result.cameras, result.calibration)
            row[state] = judged(result, exact, seen)
        print(markdown({label: row}), file=sys.stderr, flush=True)
        before = RESULTS / "wrong_cameras.json"
        known: dict[str, Any] = json.loads(before.read_text())["figures"] if before.exists() else {}
        rows = dict(sorted({**known, label: row}.items(), key=_place))
        record("wrong_cameras", rows)
        write_text(RESULTS / "wrong_cameras.md", markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
