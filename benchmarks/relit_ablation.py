"""What each part of stage 2 buys under another light: foreign captures fitted without it, in decibels of relit views.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.relit_ablation [scan_city scan_studio] [--size 256] [--samples 64]
        [--rows TEXT ...] [--work out/relit_ablation]

Geometry is fitted once per capture and kept in the work folder. Each row fits reflectance and normals again with one
part left out or forced, and everything else chosen anew; the held-out view of the first timestep is relit by path
traced environments that no fit has seen, by local shading and path traced, and compared as in `benchmarks.foreign`.
A row whose fit is the base's own, because the base does without that part, says so instead of a figure. Captures and
rows that aren't named keep the figures that they had. Writes ``benchmarks/results/relit_ablation.json`` and
``relit_ablation.md``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import mifit
from benchmarks import judge
from benchmarks.foreign import CASES, Case
from benchmarks.matt import infer_matt
from benchmarks.measure import conditions, measured
from benchmarks.record import RESULTS, SHARED, record
from mifit import Capture, FitConfig, MorphableModel, Reconstruction
from mifit.config import ReflectanceConfig
from mifit.core.estimate import ReflectanceEstimate
from mifit.core.files import write_text
from mifit.core.sh import LUMINANCE
from mifit.errors import MifitError

SEED = 0
BASE = "base"


@dataclass(frozen=True)
class Part:
    """One way to fit without a part, or with one that the base does without.

    Attributes
    ----------
    label : str
    settings : dict
        Of stage 2, instead of the defaults.
    patches : dict
        What stands in for names of the package.
    matt : bool
        Fit lighting and albedo anew without specular reflection.
    normals : bool
        Refine normals.
    level : float
        Of stage 1's albedo, relative to the one found.
    """

    label: str
    settings: dict[str, Any] = field(default_factory=dict)
    patches: dict[str, Any] = field(default_factory=dict)
    matt: bool = False
    normals: bool = True
    level: float = 1.0

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The package with the patches."""
        started = [patch(name, value) for name, value in self.patches.items()]
        for each in started:
            each.start()
        try:
            yield
        finally:
            for each in started:
                each.stop()


PARTS = (
    Part(BASE),
    Part("lights: no compact one", {"shading": "shadowed"}),
    Part("lights: one compact one at the most", patches={"mifit.stages.reflectance.choice.LIGHTS": 1}),
    Part("lights: a distant compact one, whatever it predicts", {"shading": "keyed"}),
    Part("near: a compact one at a place, whatever it predicts", {"shading": "near"}),
    Part("lighting: three bands", {"bands": 3}),
    Part("lighting: six bands", {"bands": 6}),
    Part("shadows: none", {"shading": "prefiltered"}),
    Part("roughness: the one expected of skin (exponent 20)", {"exponent": 20.0}),
    Part("roughness: exponent 10", {"exponent": 10.0}),
    Part("roughness: exponent 160", {"exponent": 160.0}),
    Part("scale: an albedo half as bright in brighter light", level=0.5),
    Part("specular reflection: none, all refitted", matt=True),
    Part("relief: left in the albedo", {"relief": False}),
    Part("what hides the face: left in", {"segment": False}),
    Part("robust weights and what goes with them: off", {"robust": False}),
    Part("normals: the mesh's", normals=False),
)


def fit_without(part: Part, capture: Capture, base: Reconstruction, case: Case, size: int) -> Reconstruction:
    """Reflectance and normals on a geometry that is given."""
    config = replace(ReflectanceConfig(texture_size=size), **part.settings)
    geometry = replace(base.geometry, vertex_albedo=np.float32(part.level) * base.geometry.vertex_albedo)
    given = capture, base.model, geometry
    with part.applied():
        infer = infer_matt if part.matt else mifit.infer_reflectance
        reflectance = infer(*given, case.fitted, config, seed=SEED)
        normals = None
        if part.normals:
            normals = mifit.refine_normals(*given, reflectance, case.fitted, FitConfig().normals, seed=SEED)
    return replace(base, reflectance=reflectance, normals=normals)


def same(a: ReflectanceEstimate, b: ReflectanceEstimate) -> bool:
    """Whether two fits are one and the same."""
    return bool(np.array_equal(a.diffuse, b.diffuse) and np.array_equal(a.specular, b.specular))


def figures(result: Reconstruction, capture: Capture, case: Case, samples: int) -> dict[str, Any]:
    """Relit and held-out errors of a fit, and what it chose."""
    reflectance = result.reflectance
    assert reflectance is not None
    rows: judge.Methods = {"full": (result, "full")}
    step = case.timesteps[0]
    relit = judge.judge_relit(rows, capture, case.held_out[0], step, ("local", "path"), samples)
    views = judge.judge_views(rows, capture, case.held_out, case.timesteps, case.fitted, perceptual=False)
    seen = reflectance.confidence > 0.5
    return {
        "relit": {key.removeprefix("full, "): value for key, value in relit.items()},
        "held_out_db": views["full"]["skin"]["psnr"],
        "shading": reflectance.report.details["shading"]["chosen"],
        "lights": len(reflectance.illumination.lights),
        "exponent": reflectance.lobe.typical,
        "albedo": round(float((reflectance.diffuse[seen] @ LUMINANCE).mean()), 4),
        "specular": round(float(reflectance.specular[seen].mean()), 4),
    }


def ablate(case: Case, size: int, samples: int, work: Path, wanted: Sequence[str], kept: dict[str, Any]) -> Iterator:
    """Rows of one capture so far, after each that is done."""
    capture, model = Capture.load(case.path), MorphableModel.load(case.model)
    folder = work / case.capture
    base = mifit.fit(
        capture, model, case.fitted, case.timesteps, until="geometry", seed=SEED, checkpoints=folder, shared=True
    )
    rows = dict(kept)
    first: Reconstruction | None = None
    for part in PARTS:
        if part.label != BASE and wanted and not any(text in part.label for text in wanted):
            continue
        try:
            with measured(history=False) as cost:
                result = fit_without(part, capture, base, case, size)
            first = first or result
            if result is not first and part.normals and same(result.reflectance, first.reflectance):  # type: ignore[arg-type]
                rows[part.label] = {"same": True}
            else:
                found = figures(result, capture, case, samples)
                rows[part.label] = {**found, "processor_seconds": round(cost.processor_seconds, 1)}
        except MifitError as error:
            rows[part.label] = {"failed": str(error)}
        print(f"{case.capture}: {part.label}: {rows[part.label]}", file=sys.stderr, flush=True)
        yield {part.label: rows[part.label] for part in PARTS if part.label in rows}


def markdown(captures: dict[str, dict[str, Any]], size: int, samples: int) -> str:
    """A line per part: for each capture what it changes in relit views, path traced and local, and in the held-out."""
    lines = []
    for name, found in captures.items():
        base = found["rows"][BASE]
        lights = ", ".join(key for key in base["relit"]["path"] if key != "mean")
        lines.append(
            f"`{name}`, base: `{base['shading']}` with {base['lights']} compact lights and exponent "
            f"{base['exponent']:.0f}; relit by {lights} {base['relit']['path']['mean']:.2f} dB on average path traced, "
            f"{base['relit']['local']['mean']:.2f} dB by local shading; held-out skin {base['held_out_db']:.2f} dB.\n"
        )
    head = " | ".join(f"{name}: relit, path | relit, local | held out" for name in captures)
    lines += [f"| changed part | {head} |", "|---|" + "---|---|---|" * len(captures)]
    for label in (part.label for part in PARTS if part.label != BASE):
        cells = []
        for found in captures.values():
            row, base = found["rows"].get(label), found["rows"][BASE]
            if row is None:
                cells += ["", "", ""]
            elif "failed" in row:
                cells += ["failed", "", ""]
            elif "same" in row:
                cells += ["same fit", "", ""]
            else:
                cells += [f"{row['relit'][k]['mean'] - base['relit'][k]['mean']:+.2f}" for k in ("path", "local")]
                cells.append(f"{row['held_out_db'] - base['held_out_db']:+.2f}")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    lines.append(
        f"\nDecibels against the base (below 0: worse), maps of {size} texels a side, {samples} samples per pixel of "
        "path-traced views, without the residual. Same fit: the base does without that part by its own choice."
    )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["scan_city", "scan_studio"])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--samples", type=int, default=64, help="per pixel of path-traced relit views")
    parser.add_argument("--rows", nargs="*", default=[], help="renew rows whose labels have one of these texts alone")
    parser.add_argument("--work", type=Path, default=Path("out/relit_ablation"))
    a = parser.parse_args()
    if not SHARED.is_dir():
        print(f"relit_ablation: left out, it needs the data folder {SHARED}", file=sys.stderr)
        return 0
    mifit.set_variant("auto")
    captures: dict[str, dict[str, Any]] = {}
    stored = RESULTS / "relit_ablation.json"
    if stored.exists():
        kept = json.loads(stored.read_text())["figures"]
        captures = kept["captures"] if (kept["size"], kept["samples"]) == (a.size, a.samples) else {}
    for name in a.names:
        case = next(case for case in CASES if case.capture == name)
        rows, before = captures.get(name, {}).get("rows", {}), conditions()
        for done in ablate(case, a.size, a.samples, a.work, a.rows, rows if a.rows else {}):
            captures[name] = {"rows": done, "conditions": [before, conditions()]}
            # After each row, so that a run that is broken off leaves what it measured.
            record("relit_ablation", {"size": a.size, "samples": a.samples, "captures": captures}, seeds=SEED)
            write_text(RESULTS / "relit_ablation.md", markdown(captures, a.size, a.samples))
    print(markdown(captures, a.size, a.samples))
    return 0


if __name__ == "__main__":
    sys.exit(main())
