"""Small changes to the code that some test must notice.

    python -m benchmarks.mutations [--only WORDS] [--jobs 1] [--list]

Copies package, benchmarks and tests to a temporary folder, makes one change of `MUTATIONS` at a time and runs the few
tests that should notice. A change is found by the name of its function, wherever that is in the package, and by an
expression or statement in it, however it is laid out. A change *survives* when the tests pass; it is *lost* when the
function doesn't hold the code exactly once any more: both fail the run. A change counts as noticed only when a test
fails, not when the code can't be imported. Writes ``benchmarks/results/mutations.json`` and ``mutations.md``.
"""

from __future__ import annotations

import argparse
import ast
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.record import RESULTS, conditions, record
from mifit.core.files import write_text

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("mifit", "benchmarks", "tests", "scenes", "docs", "README.md", "pyproject.toml")
TIMEOUT = 600
NOTICED, SURVIVED, LOST, BROKEN = "noticed", "survived", "lost", "not importable"


@dataclass(frozen=True)
class Mutation:
    """One change.

    Attributes
    ----------
    name : str
        What the change does, in words.
    function : str
        ``module.function`` or ``module.Class.method``, the module by its last name; or ``module`` for its own lines.
    old, new : str
        An expression or statement of the function, and what takes its place.
    tests : str
        Arguments of pytest: the tests that should notice.
    """

    name: str
    function: str
    old: str
    new: str
    tests: str

    def find(self, root: Path) -> tuple[Path, str, str] | None:
        """The file that holds the code, its text and the changed text; None where there isn't exactly one place."""
        module, _, qualified = self.function.partition(".")
        places = []
        for path in sorted((root / "mifit").rglob(f"{module}.py")):
            text = path.read_text(encoding="utf-8")
            places += [(path, text, span) for span in _spans(text, qualified, self.old)]
        if len(places) != 1:
            return None
        path, text, (first, last) = places[0]
        return path, text, text[:first] + self.new + text[last:]


def _spans(text: str, function: str, old: str) -> Iterator[tuple[int, int]]:
    """Places of some code in a function of a text, as positions of its first and past its last character."""
    wanted = ast.parse(old).body[0]
    expression = wanted.value if isinstance(wanted, ast.Expr) else None
    sought, starts = ast.dump(expression or wanted), [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    lines = text.splitlines()

    def at(line: int, column: int) -> int:  # the parser counts bytes
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    for name, node in _functions(ast.parse(text), ""):
        if name == function:
            for part in ast.walk(node):
                if isinstance(part, (ast.expr, ast.stmt)) and ast.dump(part) == sought:
                    assert part.end_lineno is not None and part.end_col_offset is not None
                    yield at(part.lineno, part.col_offset), at(part.end_lineno, part.end_col_offset)


def _functions(node: ast.AST, prefix: str) -> Iterator[tuple[str, ast.AST]]:
    """Functions and methods by their qualified names; a module itself has none."""
    if isinstance(node, ast.Module):
        own = [part for part in node.body if not isinstance(part, (ast.FunctionDef, ast.ClassDef))]
        yield "", ast.Module(own, [])
    for part in ast.iter_child_nodes(node):
        if isinstance(part, (ast.FunctionDef, ast.ClassDef)):
            name = f"{prefix}{part.name}"
            yield name, part
            if isinstance(part, ast.ClassDef):
                yield from _functions(part, f"{name}.")


M = Mutation
MUTATIONS = (
    # Shading.
    M("heights tilt normals the wrong way", "refine_surface.Patch.equations",
      "-form_image(0.0, x, slope[:, :3], self.gloss * y[:, None], slope[:, 3:])",
      "form_image(0.0, x, slope[:, :3], self.gloss * y[:, None], slope[:, 3:])", "tests/stages/test_refine_surface.py"),
    M("heights are differentiated the wrong way", "refine_surface.Patch.equations",
      "(ahead - behind) / (2.0 * probe)", "(behind - ahead) / (2.0 * probe)", "tests/stages/test_refine_surface.py"),
    M("light that is off bends the surface", "refine_surface.Patch.equations",
      "self._mean_about(residual, weight) - residual", "-residual", "tests/stages/test_refine_surface.py"),
    # Conventions.
    M("pixel centres at integers", "camera.Camera.pixel_centres", "x + 0.5", "x", "tests/core/test_camera.py"),
    M("camera axes of OpenGL not turned", "camera", "np.diag([1.0, -1.0, -1.0, 1.0])", "np.diag([1.0, 1.0, 1.0, 1.0])",
      "tests/core/test_camera.py"),
    M("maps read upside down", "uv.sample_map", "1.0 - uv[:, 1]", "uv[:, 1]", "tests/core/test_uv.py"),
    M("the basis without the Condon-Shortley phase", "sh._evaluate",
      "q_mm *= -math.sqrt((2.0 * m + 3.0) / (2.0 * m + 2.0))",
      "q_mm *= math.sqrt((2.0 * m + 3.0) / (2.0 * m + 2.0))", "tests/core/test_sh.py"),
    M("clipped pixels count as measured", "capture.Capture._read", "clipped = found.clipped",
      "clipped = found.clipped & False", "tests/capture/test_capture.py"),
    # Measures.
    M("PSNR of powers", "metrics.psnr_from_rmse", "20.0", "10.0", "tests/core/test_metrics.py"),
    M("the evaluated region isn't eroded", "evaluate.face_area", "np.ones((5, 5))", "np.ones((1, 1))",
      "tests/output/test_render_evaluate.py"),
    M("relit views compared without their factors", "compare.scaled_psnr", "_channel_scale(a, b) * a", "a",
      "tests/test_foreign.py"),
    M("separation with the whole image for the specular one", "evaluate.separation_of",
      "full[..., :3] - diffuse[..., :3]", "full[..., :3]", "tests/output/test_render_evaluate.py"),
    M("the photograph's exposure left out of the passes", "truth._image", '_meta(folder).get("exposure", 1.0)', "1.0",
      "tests/score"),
    M("distances to the farthest of the near faces", "truth.nearest_points", "distance.argmin(1)",
      "distance.argmax(1)", "tests/test_foreign.py"),
    M("the baseline takes views that are hidden", "image_based.image_based",
      "there.visible_from(point, view.position)", "True", "tests/test_foreign.py"),
    M("the nearest view is the farthest", "image_based._weight", "2.0 + nearness", "2.0 - nearness",
      "tests/test_foreign.py"),
    # Light, shadow and skin.
    M("shadowed normals see what the mesh's see", "models.ShadowedModel.about", "blocked - passed * open_sky",
      "blocked - open_sky", "tests/appearance/test_models.py"),
    M("the lobe's energy not normalised", "lobe.normalization", "8.0 * np.pi", "4.0 * np.pi",
      "tests/appearance/test_lobe.py"),
    M("lighting turned the wrong way", "sh.SHLighting.rotate", "rotation_matrix(rotation, self.order)",
      "rotation_matrix(np.transpose(rotation), self.order)", "tests/core/test_sh.py"),
    # Observations.
    M("what may show something else counts in full", "observations.Surface._observe", "weight *= inlier",
      "weight *= 1.0", "tests/sampling/test_observations.py"),
    M("texels seen at a slant are of as good a quality", "observations.Surface.quality", "np.clip(cosine, 0.0, 1.0)",
      "1.0", "tests/sampling/test_observations.py"),
    M("distances to the outline in pixels, not in millimetres", "observations.Surface._observe",
      "bilinear(image.outline, *pixel) * depth / camera.fx", "bilinear(image.outline, *pixel)",
      "tests/sampling/test_observations.py"),
    M("normals turned the wrong way for the residual", "find_residual._difference", "seen.normal[:, 0] @ rotation",
      "seen.normal[:, 0] @ rotation.T", "tests/stages/test_find_residual.py"),
    M("images read half a pixel off", "observations.Surface._observe",
      "camera.project(point[rows, image.step]).T - 0.5", "camera.project(point[rows, image.step]).T",
      "tests/sampling/test_observations.py"),
    M("backs of faces cover pixels", "visibility.footprint", "np.maximum(area, 0.0)", "np.abs(area)",
      "tests/sampling/test_visibility.py"),
    M("every oblique surface has outlines", "visibility.outline_distance", "[[1.0, -2.0, 1.0]]", "[[0.0, -1.0, 1.0]]",
      "tests/sampling/test_visibility.py"),
    M("all lights cast the first one's shadows", "occlusion._visible", "bits >> np.uint32(len(directions) % 32)",
      "bits", "tests/appearance/test_occlusion.py"),
    M("all timesteps have the first one's shadows", "occlusion.VertexTransfer.joined", "parts[s].corners + starts[s]",
      "parts[s].corners", "tests/appearance/test_occlusion.py"),
    M("all meshes read the first one's transfer vectors", "shdirect.make", "dr.opaque(mi.UInt32, first)",
      "dr.opaque(mi.UInt32, 0)", "tests/render/test_shdirect.py"),
    M("specular transfers without the lobe's gain", "formation.Appearance.transfers", "found.gain * t", "t",
      "tests/appearance/test_models.py"),
    # Surface and maps.
    M("the surface's search reads half a pixel off", "band.FeatureImage.place", "camera.cx * factor - 0.5",
      "camera.cx * factor", "tests/stages/test_align_timesteps.py"),
    M("expressions creep from one alignment to the next", "align_timesteps.align_timesteps",
      "geometry.expression - expected", "0.0", "tests/stages/test_align_timesteps.py"),
    M("offsets to the wrong side", "sweep._Sweep.matches", "between[found] - np.float32(FARTHEST)",
      "np.float32(FARTHEST) - between[found]", "tests/stages/test_find_surface.py -k known_offset"),
    M("rays turned against the head's turn", "sweep._swept", "rotation[k] @ rotation[m].T",
      "rotation[m] @ rotation[k].T", "tests/stages/test_find_surface.py -k known_offset"),
    M("the background is part of the band", "views.pose_views",
      "frame.valid & ~frame.clipped & shows_surface(scene, camera)",
      "frame.valid & ~frame.clipped", "tests/stages/test_find_surface.py -k background"),
    M("views are compared by what one alone shows", "sweep._Sweep.of",
      "(first.seen[i] > 0) & (second.seen[j] > 0)", "first.seen[i] > 0",
      "tests/stages/test_find_surface.py -k one_view_alone"),
    M("windows without contrast count", "sweep._Sweep.compare", "(variance > 2 * noise)", "True",
      "tests/stages/test_find_surface.py -k nothing_is_seen"),
    M("walls are held wherever they are", "displace.Walls.at", "lacks > 0", "lacks < 0",
      "tests/stages/test_find_surface.py -k a_wall"),
    M("views that are read beside the epipolar line read on it", "sweep._Sweep.compare", "[-beside, beside]",
      "[0.0, 0.0]", "tests/stages/test_find_surface.py -k off_its_calibration"),
    M("offsets that scatter are as precise", "sweep._precision", "FINEST**2 + scatter", "FINEST**2",
      "tests/stages/test_find_surface.py -k scatter"),
    M("a lone match is as precise", "sweep._precision", "share**2", "1.0",
      "tests/stages/test_find_surface.py -k scatter"),
    M("views across time by cameras, not by the head", "sweep.across_time",
      "normalize(image.camera.position - step.position.mean(axis=0)) @ rotation[k]",
      "normalize(image.camera.position - step.position.mean(axis=0))", "tests/stages/test_align_timesteps.py"),
    M("eyeballs off the backs of faces", "eyes._depth_outside", "(det > 0)", "(det < 0)", "tests/stages/test_eyes.py"),
    M("details moved against the head's turn", "refine_mesh.MeshRefiner.refine", "rotation.T",
      "rotation", "tests/stages/test_refine_mesh.py"),
    M("the other half of the face over what was seen", "fill.blend_unseen",
      "there * (1.0 - np.clip(known / BLEND, 0.0, 1.0))", "there * 10.0", "tests/stages/test_fill.py"),
    M("specular confidence of all that was seen", "fill.blend_unseen", "confidence * observability", "confidence",
      "tests/stages/test_fill.py"),
    M("factors of images that noise explains", "photometry.Solution.sure",
      "np.abs(self.value) > SURE * self.deviation", "True", "tests/stages/test_photometry.py"),
    M("either half shows the other's skin", "fill.bilateral_change", "(total + beyond)", "(2.0 * beyond)",
      "tests/stages/test_fill.py"),
    M("skin with fewer pigments is skin", "fill.beyond_pigments", "(amount >= 0).all(axis=1)", "True",
      "tests/stages/test_fill.py"),
    M("normals smoothed by a tenth", "refine_normals.frame_problem", "0.5 * config.laplacian_weight / WHITE",
      "0.05 * config.laplacian_weight / WHITE", "tests/stages/test_refine_normals.py tests/test_paper.py"),
    # Calibration.
    M("a camera turns about the world's origin", "check_calibration.explain_matches",
      "np.cross(np.eye(3), start.cameras[c, :3, 3]).T", "0.0", "tests/extras/test_calibrate_densely.py -k wrong"),
    # Solvers.
    M("a step that raises the energy is taken", "minimize.trust", "1e-4", "-10.0",
      "tests/optim/test_solve.py"),
    M("Geman and McClure's weight not squared", "minimize.geman_mcclure", "q * q", "q", "tests/optim/test_solve.py"),
    # Paper.
    M("1 / |F_view| dropped", "rendering.paper_problem", "max(len(view.index), 1)", "1", "tests/test_paper.py"),
    M("the paper's exponent 10", "models.PaperModel", "exponent = 5.0", "exponent = 10.0", "tests/test_paper.py"),
    M("lambda_H for values of 0..1", "config.FitConfig.paper", "0.001 / 255.0", "0.001", "tests/test_paper.py"),
    M("preset with w2 ten times the paper's", "config.FitConfig.paper", "0.3", "3.0", "tests/test_paper.py"),
    # What is kept.
    M("the cache's key without what a step is given", "fitting.keys", "{part: current[part] for part in step.inputs}",
      "{}", "tests/test_fitting.py tests/test_pipeline.py"),
    M("residual shown under another light", "reconstruction.Reconstruction.with_illumination",
      "replace(self, reflectance=reflectance, residual=None, environment=None, environment_rotation=None)",
      "replace(self, reflectance=reflectance, environment=None, environment_rotation=None)",
      "tests/output/test_residual_shown.py"),
)  # fmt: skip
"""Every change, with the tests that should notice."""


def copy_project(folder: Path) -> Path:
    """A copy of what the tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "*.svg", "*.gif"))
        elif source.exists():
            shutil.copy(source, folder / name)
    return folder


def run_tests(folder: Path, tests: str) -> tuple[int, str]:
    """Exit code of pytest in a copy, and its last line."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, f"stopped after {TIMEOUT} s"
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return done.returncode, (lines or done.stdout.splitlines() or [""])[-1]


def judge(mutation: Mutation, folder: Path) -> dict[str, Any]:
    """Make a change in a copy, run its tests, and undo it."""
    began = time.perf_counter()
    row: dict[str, Any] = {"change": mutation.name, "tests": mutation.tests}
    found = mutation.find(folder)
    if found is None:
        return {**row, "verdict": LOST}
    path, text, changed = found
    row["file"] = str(path.relative_to(folder))
    path.write_text(changed, encoding="utf-8")
    try:
        code, said = run_tests(folder, mutation.tests)
    finally:
        path.write_text(text, encoding="utf-8")
    verdict = {0: SURVIVED, 1: NOTICED}.get(code, BROKEN)
    return {**row, "verdict": verdict, "by": said[:160], "seconds": round(time.perf_counter() - began, 1)}


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table: what was changed, where, and what noticed it."""
    counts = Counter(row["verdict"] for row in rows)
    lines = [
        f"{counts[NOTICED]} of {len(rows)} changes are noticed; {counts[SURVIVED]} survive.",
        "",
        "| change | in | verdict |",
        "|---|---|---|",
    ]
    for row in rows:
        verdict = row["verdict"] if row["verdict"] == NOTICED else f"**{row['verdict']}**"
        lines.append(f"| {row['change']} | `{row.get('file', '-')}` | {verdict} |")
    return "\n".join(lines) + "\n"


def run(mutations: Sequence[Mutation], jobs: int) -> list[dict[str, Any]]:
    """Judge all changes, each job in a copy of its own; tests that fail in an unchanged copy notice nothing."""
    with tempfile.TemporaryDirectory(prefix="mifit-mutations-") as temporary:
        folders = [copy_project(Path(temporary) / str(i)) for i in range(jobs)]
        free = list(folders)

        def one(mutation: Mutation) -> dict[str, Any]:
            folder = free.pop()
            try:
                row = judge(mutation, folder)
            finally:
                free.append(folder)
            print(f"{row['verdict']:<14} {row['change']} ({row.get('seconds', 0)} s)", file=sys.stderr, flush=True)
            return row

        with ThreadPoolExecutor(jobs) as pool:
            rows = list(pool.map(one, mutations))
        # A test that fails without the change notices nothing: all of them together, and apart where that fails.
        noticed = [row for row in rows if row["verdict"] == NOTICED]
        sets = list(dict.fromkeys(row["tests"] for row in noticed))
        every = " ".join(dict.fromkeys(part for tests in sets for part in tests.split()))
        whole = not sets or run_tests(folders[0], every)[0] == 0
        failing = set() if whole else {tests for tests in sets if run_tests(folders[0], tests)[0] != 0}
        for row in noticed:
            if row["tests"] in failing:
                row["verdict"], row["by"] = BROKEN, "its tests fail without the change"
        return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="changes whose name holds this text; nothing is recorded")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--list", action="store_true", help="say where each change would be made, and run nothing")
    a = parser.parse_args()
    chosen = [m for m in MUTATIONS if not a.only or a.only in m.name]
    if a.list:
        for mutation in chosen:
            found = mutation.find(ROOT)
            print(f"{mutation.name}: {found[0].relative_to(ROOT) if found else LOST}")
        return 1 if any(m.find(ROOT) is None for m in chosen) else 0
    rows = run(chosen, a.jobs)
    if not a.only:
        record("mutations", {"changes": rows, "conditions": conditions()})
        write_text(RESULTS / "mutations.md", markdown(rows))
    print(markdown(rows))
    return 1 if any(row["verdict"] != NOTICED for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
