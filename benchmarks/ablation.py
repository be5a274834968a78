"""What each part of the model buys: one part changed at a time, its cost and the held-out view's error.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.ablation [gloss hard] [--size 128] [--work out/ablation]

Cameras ``left`` and ``right`` at four timesteps are fitted; ``third`` is rendered at one sample per pixel and compared
over the true face area, and never fitted. Stage 1 is fitted once per capture, and again only where a part changes it;
those fits are kept in the work folder. The base is the default settings with a small map, the shading model that
``auto`` chooses, and the model's normals. Rows that were fitted to fewer timesteps are compared with the base on these
timesteps. Writes ``benchmarks/results/ablation.json`` and ``ablation.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mifit
from benchmarks.matt import infer_matt
from benchmarks.measure import conditions, measured
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.third_view import Error, ThirdView, pooled_psnr
from mifit import Capture, MorphableModel, Reconstruction
from mifit.config import SHADINGS, FitConfig, GeometryConfig, NormalsConfig, ReflectanceConfig
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate
from mifit.core.files import write_text
from mifit.errors import ConvergenceError, InputError
from mifit.morphable.openings import with_eyes

MODEL = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
CAMERAS = ("left", "right")
TIMESTEPS = (0, 1, 2, 3)
GEOMETRY = GeometryConfig()


@dataclass(frozen=True)
class Scene:
    """One capture and how to fit it."""

    name: str
    capture: Capture
    model: MorphableModel
    work: Path

    def geometry(
        self,
        config: GeometryConfig = GEOMETRY,
        cameras: Sequence[str] = CAMERAS,
        timesteps: Sequence[int] = TIMESTEPS,
    ) -> GeometryEstimate:
        """Stage 1, kept in the work folder."""
        label = f"{config.objective}{config.rounds}_{'_'.join(cameras)}_{len(timesteps)}"
        fitted = mifit.fit(
            self.capture,
            self.model,
            cameras,
            timesteps,
            FitConfig(geometry=config),
            until="geometry",
            checkpoints=self.work / self.name / label,
        )
        return fitted.geometry

    def reflectance(
        self, geometry: GeometryEstimate, config: ReflectanceConfig, cameras: Sequence[str] = CAMERAS
    ) -> ReflectanceEstimate:
        """Stage 2."""
        return mifit.infer_reflectance(self.capture, self.model, geometry, cameras, config)

    def diffuse_only(self, geometry: GeometryEstimate, config: ReflectanceConfig) -> ReflectanceEstimate:
        """Stage 2 by the fast solver without any specular reflection: lighting and diffuse map fitted anew."""
        return infer_matt(self.capture, self.model, geometry, CAMERAS, config)


Fitted = tuple[GeometryEstimate, ReflectanceEstimate, NormalsEstimate | None]
Row = dict[str, Any]


class Table:
    """Rows of one capture; each is written into ``rows`` as it is done."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.judge = scene, ThirdView(scene.capture)
        self.rows: dict[str, Row] = {}
        self.base: dict[int, Error] = {}

    def add(self, label: str, fit: Callable[[], Fitted], timesteps: Sequence[int] = TIMESTEPS) -> Fitted | None:
        """Fit, measure and judge; a part that can't be changed so stays in the table as failing."""
        scene = self.scene
        try:
            with measured() as cost:
                geometry, reflectance, normals = fit()
            result = Reconstruction(
                model=scene.model,
                geometry=geometry,
                reflectance=reflectance,
                normals=normals,
                cameras=tuple(scene.capture.camera(c) for c in CAMERAS),
            )
            errors = self.judge.errors(result, timesteps)
            dropped = self.judge.errors(result, timesteps, "diffuse") if not self.base else None
        except (InputError, ConvergenceError) as error:
            self.rows[label] = {"failed": str(error)}
            print(f"{scene.name}: {label}: failed: {error}", file=sys.stderr, flush=True)
            return None
        self.base = self.base or errors
        self.rows[label] = self._row(errors, cost.figures(), reflectance)
        if dropped is not None:
            self.rows["specular: dropped from the base, nothing refitted"] = self._row(dropped, {}, reflectance)
        print(f"{scene.name}: {label}: {self.rows[label]}", file=sys.stderr, flush=True)
        return geometry, reflectance, normals

    def _row(self, errors: dict[int, Error], cost: dict[str, float], reflectance: ReflectanceEstimate) -> Row:
        third = pooled_psnr(errors.values())
        return {
            "third_db": round(third, 3),
            "over_base_db": round(third - pooled_psnr(self.base[t] for t in errors), 3),
            "timesteps_compared": list(errors),
            "shading": reflectance.report.details["shading"]["chosen"],
            "exponent": reflectance.lobe.typical,
            "outcome": reflectance.report.outcome,
            **cost,
        }


def ablate(scene: Scene, size: int, check: int) -> dict[str, Any]:
    """All rows of one capture."""
    table = Table(scene)
    geometry = scene.geometry()
    config = ReflectanceConfig(texture_size=size)
    chosen = scene.reflectance(geometry, config).report.details["shading"]["chosen"]
    config = replace(config, shading=chosen)  # type: ignore[arg-type]

    def stage2(cameras: Sequence[str] = CAMERAS, count: int = len(TIMESTEPS), **changes: Any) -> Callable[[], Fitted]:
        """Stage 2 with changed settings on the base's geometry, of its first timesteps."""

        def fit() -> Fitted:
            used = geometry.at(geometry.timesteps[:count])
            return geometry, scene.reflectance(used, replace(config, **changes), cameras), None

        return fit

    def afresh(
        geometry_config: GeometryConfig = GEOMETRY,
        cameras: Sequence[str] = CAMERAS,
        timesteps: Sequence[int] = TIMESTEPS,
    ) -> Callable[[], Fitted]:
        """Stages 1 and 2 anew; the cost is stage 2's."""
        own = scene.geometry(geometry_config, cameras, timesteps)
        return lambda: (own, scene.reflectance(own, config, cameras), None)

    base = table.add(f"base: {chosen}, {config.bands} bands, {size} texels, model's normals", stage2())
    assert base is not None, "the base must fit"
    reflectance = base[1]
    table.add("specular: none, all refitted", lambda: (geometry, scene.diffuse_only(geometry, config), None))
    table.add("specular difference term: off", stage2(specular_difference_weight=0.0))
    table.add("smoothness of both maps: off", stage2(smoothness_weight=0.0))
    table.add("specular map smoothed like the diffuse one", stage2(specular_smoothness=1.0))
    for shading in SHADINGS:
        if shading != chosen:
            table.add(f"shading: {shading}", stage2(shading=shading))
    if chosen != "paper":
        for bands in (3, 5, 7):
            table.add(f"lighting: {bands} bands", stage2(bands=bands))
    for exponent in (20.0, 150.0):
        table.add(f"exponent: fixed at {exponent:.0f}", stage2(exponent=exponent))
    table.add("robust weights: off", stage2(robust=False))
    table.add("second view: off in stage 2", stage2(cameras=CAMERAS[:1]))
    table.add("second view: off in both stages", afresh(cameras=CAMERAS[:1]))
    for count in (1, 2):
        table.add(f"timesteps: {count} in stage 2", stage2(count=count))
    for count in (1, 2):
        steps = TIMESTEPS[:count]
        table.add(f"timesteps: {count} in both stages", afresh(timesteps=steps), steps)
    table.add("stage 1: paper's objective", afresh(GeometryConfig(objective="paper")))
    table.add("stage 1: landmarks alone", afresh(GeometryConfig(rounds=0)))

    def refined() -> Fitted:
        found = mifit.refine_normals(scene.capture, scene.model, geometry, reflectance, CAMERAS, NormalsConfig())
        return geometry, reflectance, found

    table.add("normals: refined (cost of stage 3)", refined)
    if check != size:
        table.add(f"texture: {check} texels", stage2(texture_size=check))
    return {"rows": table.rows, "geometry_seconds": round(geometry.report.seconds, 2)}


def markdown(captures: dict[str, dict[str, Any]]) -> str:
    """One line per part: dB against the base and cost, for each capture."""
    labels: list[str] = []
    for found in captures.values():
        labels += [label for label in found["rows"] if label not in labels and not label.startswith("base")]
    lines = []
    for name, found in captures.items():
        label, row = next((k, v) for k, v in found["rows"].items() if k.startswith("base"))
        lines.append(
            f"`{name}`: {label}: {row['third_db']:.2f} dB in {row['steady_seconds']:.1f} s of stage 2 "
            f"({row['processor_seconds']:.1f} s of processor time) after {found['geometry_seconds']:.1f} s "
            "of stage 1.\n"
        )
    head = " | ".join(f"{name} dB | {name} s | {name} cpu s" for name in captures)
    lines += [f"| changed part | {head} |", "|---|" + "---|---|---|" * len(captures)]
    for label in labels:
        cells = []
        for found in captures.values():
            row = found["rows"].get(label)
            if row is None:
                cells += ["", "", ""]
            elif "failed" in row:
                cells += ["failed", "", ""]
            elif "seconds" not in row:
                cells += [f"{row['over_base_db']:+.2f}", "", ""]
            else:
                cells += [
                    f"{row['over_base_db']:+.2f}",
                    f"{row['steady_seconds']:.1f}",
                    f"{row['processor_seconds']:.1f}",
                ]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    lines.append(
        "\ndB: held-out third view against the base (below 0: worse). s: wall time of the stage without compilation; "
        "cpu s: processor time of all threads."
    )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["gloss", "hard"])
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument(
        "--check", type=int, default=512, help="map size of the one row that tells whether size matters"
    )
    parser.add_argument("--work", type=Path, default=Path("out/ablation"))
    parser.add_argument("--name", default="ablation", help="of the files in benchmarks/results")
    a = parser.parse_args()
    if not SHARED.is_dir():
        print(f"ablation: left out, it needs the data folder {SHARED}", file=sys.stderr)
        return 0
    mifit.set_variant("auto")
    model = with_eyes(MorphableModel.load(MODEL))  # as a fit has it
    captures: dict[str, dict[str, Any]] = {}
    stored = RESULTS / f"{a.name}.json"
    if stored.exists():  # captures that aren't named keep their figures
        kept = json.loads(stored.read_text())["figures"]
        captures = kept["captures"] if kept["size"] == a.size else {}
    for name in a.names:
        before = conditions()
        scene = Scene(name, Capture.load(SHARED / "captures" / name), model, a.work)
        captures[name] = {**ablate(scene, a.size, a.check), "conditions": [before, conditions()]}
        # After each capture, so that a run that is broken off leaves what it measured.
        record(a.name, {"size": a.size, "captures": captures})
        write_text(RESULTS / f"{a.name}.md", markdown(captures))
    print(markdown(captures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
