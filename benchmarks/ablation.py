"""What each part of a fit buys: heads fitted without it, one part at a time, and its cost.

    python -m benchmarks.ablation [--heads scan_city gloss] [--parts TEXT ...] [--size 256]

`PARTS` is the table: a name, and how the part is switched off, by settings or by what stands in for a function of the
package. Steps of a fit that a part doesn't touch are run once per head. Judged by the held-out view over skin and over
the whole face, relit views, the scan's albedo, separation of the specular image, and distances from the scan; cost is
processor seconds of the whole fit. A part that the package doesn't have is named as gone. Rows that aren't asked for
keep their figures. Writes ``benchmarks/results/ablation.json`` and ``ablation.md``.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import numpy as np

import mifit
from benchmarks import heads, judge
from benchmarks.foreign import replace_size, separation_of
from benchmarks.heads import ICT, Case
from benchmarks.judge import Row
from benchmarks.record import RESULTS, conditions, machine, record
from mifit import Capture, FitConfig, MorphableModel, Reconstruction, fitting
from mifit.core.files import write_text
from mifit.core.process import one_blas_thread
from mifit.errors import MifitError
from mifit.output.truth import relit_truths, true_passes
from mifit.progress import silent
from mifit.stages.reflectance.compact_lights import ITERATIONS
from mifit.stages.reflectance.lighting import LightingSolution, fit_lighting
from mifit.stages.surface.outline import joined

SEED, SIZE, LIGHTS = 0, 256, 2
BASE = "base"


@dataclass(frozen=True)
class Part:
    """One part of a fit and how it is switched off.

    Attributes
    ----------
    label : str
    settings : dict of str to value
        ``stage.setting``, instead of the defaults.
    patches : dict of str to value
        What stands in for names of the package.
    step : str
        The first step of a fit that the patches touch.
    without : tuple of str
        Steps that are left out.
    moving : bool
        Whether it does nothing for a head of one timestep.
    photometry : bool
        Whether it is tried on changed photographs too.
    """

    label: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    patches: Mapping[str, Any] = field(default_factory=dict)
    step: str = ""
    without: tuple[str, ...] = ()
    moving: bool = False
    photometry: bool = False

    def config(self, size: int) -> FitConfig:
        """The settings; TypeError for one that there is no more."""
        config, changes = replace_size(FitConfig(), size), dict[str, dict[str, Any]]()
        for name, value in self.settings.items():
            stage, _, key = name.partition(".")
            changes.setdefault(stage, {})[key] = value
        parts = {stage: replace(getattr(config, stage), **values) for stage, values in changes.items()}
        return replace(config, **parts)

    @contextmanager
    def applied(self) -> Iterator[None]:
        """The package with the patches; AttributeError for a name that there is no more."""
        started = [patch(name, value) for name, value in self.patches.items()]
        begun = []
        try:
            for each in started:
                each.start()
                begun.append(each)
            yield
        finally:
            for each in begun:
                each.stop()


def _smooth_light_alone(seen: Any, forward: Any, expected: Any) -> tuple[tuple[()], LightingSolution]:
    """In place of `compact_lights.find_lights`."""
    return (), fit_lighting(seen, forward, expected, True, ITERATIONS)


FIND, INFER = "mifit.stages.find_surface", "mifit.stages.infer_reflectance"
PARTS = (
    Part(BASE),
    Part("surface: off", {"surface.enabled": False}),
    Part("surface: outlines", patches={f"{FIND}.find_borders": lambda *given: joined([])}, step="surface"),
    Part("surface: walls keep a thickness", patches={f"{FIND}.WALL_MM": 1e-3}, step="surface"),
    Part("surface: sheen left out at coarse levels", patches={"mifit.stages.surface.band.SHEEN": 0.0}, step="surface"),
    Part("surface: shading and highlights", {"surface.shading": False}),
    Part("surface: lids and lips closed", {"surface.close_lids": False, "surface.close_lips": False}),
    Part(
        "surface: timesteps aligned",
        patches={f"{FIND}.align_timesteps": lambda model, fit, texels, posed, **_: fit},
        step="surface",
        moving=True,
    ),
    Part(
        "surface: pairs across time",
        patches={f"{FIND}.across_time": lambda posed, turned: ()},
        step="surface",
        moving=True,
    ),
    Part("stage 1: eyes that are added", {"geometry.eyes": False}),
    Part(
        "light: compact lights",
        patches={"mifit.stages.reflectance.als.find_lights": _smooth_light_alone},
        step="reflectance",
    ),
    Part("light: shadows", {"reflectance.shading": "prefiltered"}),
    Part("light: specular reflection", {"reflectance.specular": False}),
    Part("light: bands beyond three", {"reflectance.bands": 3}),
    Part("light: exponent (20)", {"reflectance.exponent": 20.0}),
    Part("stage 2: segmentation", {"reflectance.segment": False}),
    Part("stage 2: robust weights and what needs them", {"reflectance.robust": False}),
    Part("stage 2: residual shading", {"reflectance.residual_shading": False}),
    Part(
        "stage 2: filling of what no light reached",
        patches={f"{INFER}.light_known": lambda *given: 1.0},
        step="reflectance",
    ),
    Part(
        "stage 2: filling of colours that no pigment makes",
        patches={"mifit.stages.reflectance.fill.pigment_weight": lambda texels, albedo, *_: np.ones(len(albedo))},
        step="reflectance",
    ),
    Part("stage 2: hair", patches={f"{INFER}.find_hair": lambda *given: None}, step="reflectance"),
    Part("stage 2: difference term", {"reflectance.specular_difference_weight": 0.0}),
    Part("stage 3: off", without=("normals", "mesh", "residual")),
    Part("stage 3: mesh", without=("mesh",)),
    Part("residual", {"residual.enabled": False}),
    Part("photometry: gains and exposures", {"photometry.enabled": False}, moving=True, photometry=True),
)
"""Every part, switched off alone."""

TWO = (0, 1)
HEADS = {
    "scan_city": Case("scan_city", timesteps=(0,), development=True),
    "emily 3, 4": Case("emily", ICT, ("c3", "c4"), ("c2", "c5"), (0,), development=True),
    "gloss": Case("gloss", ICT, timesteps=(0,), development=True),
    "scan_sun": Case("scan_sun", timesteps=TWO),
    "scan_studio": Case("scan_studio", timesteps=(0,)),
    "emily 2, 5": Case("emily", ICT, ("c2", "c5"), ("c3", "c4"), (0,)),
    "soft": Case("soft", ICT, timesteps=(0,)),
    "hard": Case("hard", ICT, timesteps=(0,)),
    **{name: Case(name, timesteps=(0,)) for name in ("table1_5", "table1_6", "table1_7", "table1_8")},
}
PHOTOGRAPHED = {
    f"scan_studio, {change or 'as it is'}": Case("scan_studio", timesteps=TWO, changed=change)
    for change in ("", *heads.CHANGES)
}
"""Heads by which photometric parts are tried, and with photographs as they are those that need several timesteps."""


class Fits:
    """Fits of one head; steps that several parts have in common are run once."""

    def __init__(self, case: Case) -> None:
        self.case, self.capture = case, Capture.load(case.path)
        self.model = MorphableModel.load(case.model)
        self._digest = self.capture.digest(case.fitted, case.timesteps)
        self._kept: dict[str, tuple[Any, float]] = {}

    @one_blas_thread()
    def fit(self, part: Part, size: int) -> tuple[Reconstruction, float]:
        """A result without the part, and the processor seconds of all its steps."""
        config = part.config(size)
        model = fitting.fitted_model(self.model, config)
        source = fitting.Source(self.capture, self._digest, model, self.case.fitted, self.case.timesteps, SEED)
        listed = [step for step in fitting.steps(config) if step.name not in part.without]
        keys, touched, spent = fitting.keys(listed, source), False, 0.0
        found: dict[Any, Any] = {}
        for step in listed:
            touched = touched or step.name == part.step
            key = keys[step.name] + (part.label if touched else "")
            if key not in self._kept:
                inputs: Any = {name: found[name] for name in step.inputs}
                began = time.process_time()
                done = step.run(source.seen(inputs), inputs, silent, *step.settings)
                self._kept[key] = done, time.process_time() - began
            found[step.part], seconds = self._kept[key]
            spent += seconds
        result = Reconstruction(
            model=model,
            **found,
            config={**dataclasses.asdict(config), "seed": SEED},
            cameras=tuple(self.capture.camera(name) for name in self.case.fitted),
            units=self.capture.units,
            unit_mm=self.capture.unit_mm,
        )
        return result, spent


def figures(case: Case, result: Reconstruction) -> dict[str, Any]:
    """Errors of one result; held-out photographs and truth are never changed."""
    capture = Capture.load(case.path)
    rows = {"full": Row.of(result), "alone": Row.of(replace(result, residual=None))}
    views = judge.judge_views(case, capture, rows, case.held_out)
    out: dict[str, Any] = {
        "skin": views["full"]["skin"]["psnr"],
        "whole": views["full"]["whole"]["psnr"],
        "alone": views["alone"]["skin"]["psnr"],
        "based": views[f"image-based, our mesh, {judge.best_blend(views, 'our mesh')}"]["skin"]["psnr"],
    }
    if judge.scan_of(case, capture, case.timesteps[0]) is not None:
        out["mm"] = judge.judge_mesh(case, capture, rows["full"])["mean_mm"]
        albedo = judge.judge_surface(case, capture, rows["full"]).get("albedo_psnr")
        out |= {} if albedo is None else {"albedo": albedo}
    if relit_truths(capture) and not case.changed:
        relit = judge.judge_relit(case, capture, {"full": rows["full"]}, ("local",), 1, LIGHTS)
        out["relit"] = relit["full, local"]["mean"]
    if true_passes(capture, case.held_out[0]) is not None:
        found = separation_of(result, capture, case.held_out[0])
        out["separation"] = found["correlation_smooth"]
    return out


def row_of(part: Part, fits: Fits, size: int) -> dict[str, Any]:
    """One row; a part that can't be switched off so says why."""
    try:
        with part.applied():
            result, cpu = fits.fit(part, size)
            return {**figures(fits.case, result), "cpu": round(cpu, 1)}
    except (TypeError, AttributeError, ModuleNotFoundError) as error:
        return {"gone": str(error)}
    except MifitError as error:
        return {"failed": str(error)}


MEASURES: dict[str, tuple[str, int]] = {
    "skin": ("skin dB", 2), "alone": ("model alone", 2), "whole": ("whole face", 2), "relit": ("relit dB", 2),
    "albedo": ("albedo dB", 2), "mm": ("mm", 3), "separation": ("separation", 2), "cpu": ("cpu s", 0),
}  # fmt: skip


def markdown(measured: Mapping[str, Mapping[str, Any]], size: int) -> str:
    """Mean change over the heads of each set and the worst one, then every head, part by part."""
    lines = [
        f"One part switched off at a time; maps of {size} texels a side. Changes against the head's own base: dB and"
    ]
    lines += ["separation below 0 and mm above 0 are worse without the part; cpu s below 0 is what it costs.", ""]
    sets = {name: [h for h, one in measured.items() if one["set"] == name] for name in ("development", "locked")}
    titles = [f"{name}: {title}" for name in sets for title, _ in MEASURES.values()]
    lines += [f"| part switched off | {' | '.join(titles)} |", "|---|" + "---|" * len(titles)]
    for part in PARTS[1:]:
        cells = []
        for members in sets.values():
            changes = [_change(measured[h]["rows"], part.label) for h in members if not measured[h]["changed"]]
            for key, (_, digits) in MEASURES.items():
                values = [c[key] for c in changes if c is not None and key in c]
                cells.append(f"{float(np.mean(values)):+.{digits}f}" if values else "")
        lines.append(f"| {part.label} | {' | '.join(cells)} |")
    for name, one in measured.items():
        base = one["rows"].get(BASE, {})
        lines += ["", f"`{name}` ({one['set']}, commit {one['commit']}): " + ", ".join(
            f"{title} {base[key]:.{digits}f}" for key, (title, digits) in MEASURES.items() if key in base
        ) + f", image-based {base.get('based', float('nan')):.2f} dB", ""]  # fmt: skip
        lines += [f"| part | {' | '.join(t for t, _ in MEASURES.values())} |", "|---|" + "---|" * len(MEASURES)]
        for part in PARTS[1:]:
            row, change = one["rows"].get(part.label), _change(one["rows"], part.label)
            if row is None:
                continue
            cells = [next(iter(row.items()))[0]] if change is None else [
                f"{change[key]:+.{digits}f}" if key in change else "" for key, (_, digits) in MEASURES.items()
            ]  # fmt: skip
            lines.append(f"| {part.label} | {' | '.join([*cells, *[''] * (len(MEASURES) - len(cells))])} |")
    return "\n".join(lines) + "\n"


def _change(rows: Mapping[str, Any], label: str) -> dict[str, float] | None:
    """A row minus the base; None for one that isn't there, is gone or failed."""
    row, base = rows.get(label), rows.get(BASE)
    if not row or not base or "skin" not in row or "skin" not in base:
        return None
    return {key: row[key] - base[key] for key in MEASURES if key in row and key in base}


def run(
    cases: Mapping[str, Case], size: int, wanted: Callable[[str], bool], stored: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """All heads' rows so far, after each that is done."""
    for name, case in cases.items():
        if case.missing:
            print(f"left out: {name}: {case.missing} is not there", file=sys.stderr, flush=True)
            continue
        one = stored.setdefault(name, {"rows": {}})
        one |= {"set": case.set, "changed": case.changed, "label": case.label, "commit": machine()["commit"]}
        fits, photographed = Fits(case), name in PHOTOGRAPHED
        for part in PARTS:
            useless = part.moving and len(case.timesteps) == 1
            tried = part.label == BASE or part.photometry or (part.moving and not case.changed)
            if (photographed and not tried) or useless:
                continue
            if part.label != BASE and not wanted(part.label):
                continue
            one["rows"][part.label] = row_of(part, fits, size)
            print(f"{name}: {part.label}: {one['rows'][part.label]}", file=sys.stderr, flush=True)
            yield stored


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heads", nargs="+", help=f"default: all of {', '.join(HEADS)} and the changed ones")
    parser.add_argument("--parts", nargs="+", default=[], help="renew rows whose labels have one of these texts alone")
    parser.add_argument("--size", type=int, default=SIZE)
    a = parser.parse_args()
    every = {**HEADS, **PHOTOGRAPHED}
    unknown = [name for name in a.heads or () if name not in every]
    if unknown:
        parser.error(f"no head {unknown[0]!r}; there are {', '.join(every)}")
    cases = {name: every[name] for name in a.heads or every}
    mifit.set_variant("auto")
    path, stored = RESULTS / "ablation.json", dict[str, Any]()
    if path.exists() and (a.heads or a.parts):
        known = json.loads(path.read_text())["figures"]
        stored = known["heads"] if known.get("size") == a.size else {}
    before = conditions()
    for measured in run(cases, a.size, _wanted(a.parts), stored):
        out = {"size": a.size, "heads": measured, "conditions": {"before": before, "after": conditions()}}
        record("ablation", out, seeds=SEED)
        write_text(RESULTS / "ablation.md", markdown(measured, a.size))
    print(markdown(stored, a.size))
    return 0


def _wanted(texts: Sequence[str]) -> Callable[[str], bool]:
    return lambda label: not texts or any(text in label for text in texts)


if __name__ == "__main__":
    sys.exit(main())
