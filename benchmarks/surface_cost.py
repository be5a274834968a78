"""What the surface stage costs: processor time by part, how much each part looks at, and what that needs at least.

    python -m benchmarks.surface_cost [--captures gloss scan_city]

Fits four timesteps from two views, the surface stage under a profiler of processor time, counts what it looks at, and
writes ``benchmarks/results/surface_cost.json`` and ``.md``. Parts are with all that they call: what is marked with a
dash is inside the part above, and rays and texels' views are inside those that ask for them. What sweeps need at least
is their bytes over the bandwidth of one thread, measured in the same run, or their operations over that thread's
arithmetic, whichever is longer.
"""

from __future__ import annotations

import argparse
import cProfile
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from unittest import mock

import mifit
from benchmarks.foreign import ICT
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.roofline import limits
from mifit.config import GeometryConfig
from mifit.core.files import write_text
from mifit.render.gbuffer import SurfaceScene
from mifit.stages import find_surface
from mifit.stages.surface import coarse_to_fine, outline

MODELS = {"scan_city": "builtin", "scan_studio": "builtin"}
"""Models of the captures; the others have the ICT model."""
PARTS = {
    "the stage": ("find_surface.py", "find_surface"),
    "refit of the model": ("model_fit.py", "fit_model"),
    "- its colours": ("rendering.py", "linearize"),
    "- its texture": ("consistency.py", "linearize"),
    "guard of the refit": ("prediction_between_views.py", "errors_between_views"),
    "alignment of the timesteps": ("align_timesteps.py", "align_timesteps"),
    "sweeps": ("sweep.py", "sweep"),
    "texels as the views see them": ("views.py", "pose_texels"),
    "borders of the head": ("outline.py", "find_borders"),
    "displacements": ("displace.py", "solve_displacement"),
    "openings": ("close_openings.py", "close_openings"),
    "rays: scenes built": ("scenes.py", "at"),
    "rays: pixels": ("gbuffer.py", "gbuffer"),
}
SAMPLED = 4.0 * (4 * 4 + 4)
"""Bytes of a texel at an offset in a view: four neighbours of four values, and what is kept of them."""
COMPARED = 60.0
"""Operations of a texel at an offset for a pair of views: five running sums along a window's sides, and a ratio."""


def count_work(amounts: dict[str, float], stack: ExitStack) -> None:
    """Count what sweeps and borders look at while the stack is open."""

    def wrap(place: Any, name: str, note: Callable[..., None]) -> None:
        original = getattr(place, name)

        def counted(*arguments: Any, **named: Any) -> Any:
            note(*arguments, **named)
            return original(*arguments, **named)

        stack.enter_context(mock.patch.object(place, name, counted))

    def swept(texels: Any, steps: Any, offsets: Any, window: int, pairs: Any) -> None:
        looks = len(texels.index) * len(offsets)
        amounts["sweeps"] += 1
        amounts["sweeps: texels x offsets x views"] += looks * len({view for pair in pairs for view in pair})
        amounts["sweeps: texels x offsets x pairs"] += looks * len(pairs)

    def bordered(capture: Any, scene: SurfaceScene, names: Any, timestep: int, factor: float) -> None:
        amounts["borders: images"] += len(names)

    def looked(scene: SurfaceScene, camera: Any) -> None:
        amounts["rays: images"] += 1
        box = scene._box(camera)
        amounts["rays: pixels"] += camera.pixel_centres()[box].size / 2

    wrap(coarse_to_fine, "sweep", swept)
    wrap(coarse_to_fine, "find_borders", bordered)
    wrap(SurfaceScene, "gbuffer", looked)
    assert outline.find_borders is not coarse_to_fine.find_borders


def measure(name: str, peak: dict[str, Any]) -> dict[str, Any]:
    """Seconds and amounts of one capture's surface stage."""
    capture = mifit.Capture.load(SHARED / "captures" / name)
    model = mifit.MorphableModel.load(MODELS.get(name, ICT))
    start = mifit.fit_geometry(capture, model, ("left", "right"), (0, 1, 2, 3), GeometryConfig())
    amounts: dict[str, float] = defaultdict(float)
    profile = cProfile.Profile(time.process_time)
    with ExitStack() as stack:
        count_work(amounts, stack)
        wall = time.perf_counter()
        profile.enable()
        found = find_surface.find_surface(capture, model, start, ("left", "right"))
        profile.disable()
        wall = time.perf_counter() - wall
    return {"wall_seconds": wall, **figures(profile, amounts, peak), "phase": found.report.details["phases"][-1]}


def figures(profile: cProfile.Profile, amounts: dict[str, float], peak: dict[str, Any]) -> dict[str, Any]:
    """By part: processor seconds, calls, and the least that sweeps and rays need."""
    profile.create_stats()
    spent = {label: [0.0, 0] for label in PARTS}
    for (file, _, function), (_, calls, _, cumulative, _) in profile.stats.items():  # type: ignore[attr-defined]
        for label, (module, wanted) in PARTS.items():
            if function == wanted and file.endswith(f"/{module}"):
                spent[label][0] += cumulative
                spent[label][1] += calls
    moved = SAMPLED * amounts["sweeps: texels x offsets x views"]
    operations = COMPARED * amounts["sweeps: texels x offsets x pairs"]
    least = max(moved / peak["bandwidth"]["one"], operations / peak["arithmetic"]["one"])
    return {
        "processor_seconds": {label: round(seconds, 3) for label, (seconds, _) in spent.items()},
        "calls": {label: calls for label, (_, calls) in spent.items()},
        "amounts": dict(amounts),
        "sweeps_bytes": moved,
        "sweeps_operations": operations,
        "sweeps_least_seconds": least,
    }


def markdown(rows: dict[str, dict[str, Any]]) -> str:
    """One column a capture."""
    names = list(rows)
    lines = [f"| processor seconds (calls) | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    for label in PARTS:
        cells = [f"{r['processor_seconds'][label]:.1f} ({r['calls'][label]})" for r in rows.values()]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    least = [f"{r['sweeps_least_seconds']:.2f}" for r in rows.values()]
    lines.append(f"| sweeps need at least | {' | '.join(least)} |")
    for label in ("sweeps: texels x offsets x views", "rays: pixels"):
        cells = [f"{r['amounts'].get(label, 0.0) / 1e6:.1f} million" for r in rows.values()]
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", nargs="+", default=["gloss", "scan_city"])
    a = parser.parse_args()
    mifit.set_variant()
    peak = limits(1 << 24)
    rows = {}
    for name in a.captures:
        rows[name] = measure(name, peak)
        print(name, rows[name]["processor_seconds"], file=sys.stderr, flush=True)
    record("surface_cost", {"limits": peak, "captures": rows})
    write_text(RESULTS / "surface_cost.md", markdown(rows))
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
