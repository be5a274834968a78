"""A rival's recipe against ours: Mitsuba's ``prb`` with Adam from landmarks to joint refinement, error over time.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.rival [--part 1.0] [--size 128] [--bands 3]

The closest rivals optimise everything by Adam through a differentiable path tracer, in a schedule: 2000 iterations of
pose, identity and expression against the landmarks; 400 of albedo, specular map and lighting (nine SH coefficients)
through ``prb`` with the geometry held; 500 of all together, the geometry through the vertices' gradients. Here it runs
with this project's plugins (`blinnphong` under `shenv`), on its captures and its model, one image an iteration, beside
``mifit.fit`` with its defaults on the same images: capture ``gloss`` at half its resolution, cameras left and right,
four timesteps. ``--part`` shortens the schedule. Judged by camera ``third`` over the face area of the true mesh, and by
the mesh's distance to the true one. Writes ``benchmarks/results/rival.json`` and ``.md`` and ``docs/images/rival.svg``.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mifit
from benchmarks.figure import figure
from benchmarks.plain_loop import CAMERAS, MODEL, TIMESTEPS, Scenes, Views, _half_camera, _half_frame
from benchmarks.record import RESULTS, SHARED, record
from benchmarks.truth import true_geometry
from mifit import Capture, MorphableModel
from mifit.core.files import write_text
from mifit.core.image import to_8_bit
from mifit.core.metrics import psnr
from mifit.output.evaluate import face_area

SCHEDULE = (2000, 400, 500)
LANDMARK_WEIGHT, PRIOR_WEIGHT = 10.0, 5e-3
RATES = {"shape": 0.02, "rotation": 0.003, "shift": 0.02, "maps": 0.01, "joint": 0.1}
"""Adam's steps: coefficients, radians, centimetres, textures and lighting; in the joint phase a tenth for the shape."""
SPP, EXPONENT = 4, 50.0
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "rival.svg"


class Clock:
    """Wall and processor seconds; the latter count all cores and do not grow with what else the machine does."""

    def __init__(self) -> None:
        self.before = (0.0, 0.0)
        self.go_on()

    def go_on(self) -> None:
        """Count from here."""
        self.since = time.perf_counter(), time.process_time()

    def stop(self) -> dict[str, float]:
        """What was counted so far."""
        now = time.perf_counter(), time.process_time()
        self.before = tuple(b + n - s for b, n, s in zip(self.before, now, self.since, strict=True))
        return {"seconds": round(self.before[0], 2), "processor_seconds": round(self.before[1], 2)}


class Adam:
    """Adam on NumPy arrays, one step length each."""

    def __init__(self, rates: dict[str, float]) -> None:
        self.rates, self.first, self.second, self.count = rates, {}, {}, 0

    def steps(self, gradients: dict[str, NDArray]) -> dict[str, NDArray]:
        """What to subtract from each variable."""
        self.count += 1
        out = {}
        for name, g in gradients.items():
            m = self.first[name] = 0.9 * self.first.get(name, 0.0) + 0.1 * g
            v = self.second[name] = 0.999 * self.second.get(name, 0.0) + 0.001 * g * g
            unbiased = m / (1 - 0.9**self.count), v / (1 - 0.999**self.count)
            out[name] = self.rates[name] * unbiased[0] / (np.sqrt(unbiased[1]) + 1e-8)
        return out


@dataclass
class Head:
    """Pose, identity and expression of all timesteps."""

    model: MorphableModel
    identity: NDArray
    expression: NDArray
    rotation: NDArray
    shift: NDArray

    def vertices(self, rows: Any = slice(None)) -> NDArray[np.float64]:
        """(T, V, 3) world positions of some of the model's vertices."""
        m = self.model
        shape = m.mean[rows] + m.identity[rows] @ self.identity
        moved = shape + np.einsum("vck,tk->tvc", m.expression[rows], self.expression)
        return np.einsum("tij,tvj->tvi", self.rotation, moved) + self.shift[:, None]

    def gradients(self, by_vertex: NDArray, rows: Any = slice(None)) -> dict[str, NDArray]:
        """Gradients of the unknowns from those (T, V, 3) of world positions."""
        m = self.model
        turned = self.vertices(rows) - self.shift[:, None]
        local = np.einsum("tij,tvi->tvj", self.rotation, by_vertex)
        return {
            "identity": np.einsum("vck,tvc->k", m.identity[rows], local) + 2 * PRIOR_WEIGHT * self.identity,
            "expression": np.einsum("vck,tvc->tk", m.expression[rows], local) + 2 * PRIOR_WEIGHT * self.expression,
            "rotation": np.cross(turned, by_vertex).sum(1),
            "shift": by_vertex.sum(1),
        }

    def step(self, steps: dict[str, NDArray]) -> None:
        """Subtract steps; expressions stay within the model's bounds."""
        self.identity = self.identity - steps["identity"]
        low, high = np.asarray(self.model.expression_bounds, float).T
        self.expression = np.clip(self.expression - steps["expression"], low, high)
        self.rotation = Rotation.from_rotvec(-steps["rotation"]).as_matrix() @ self.rotation
        self.shift = self.shift - steps["shift"]


@dataclass(frozen=True)
class MetricViews(Views):
    """Views whose unit of length is known, as stage 1 wants them: centimetres."""

    unit_mm: float = 10.0


@dataclass(frozen=True)
class Task:
    """Images of half the size, and what they are judged by."""

    views: Views
    model: MorphableModel
    truth: NDArray
    third: Any
    photographs: list[NDArray] = field(repr=False)
    regions: list[NDArray] = field(repr=False)

    def held_out(self, images: list[NDArray]) -> float:
        """PSNR in dB of linear images of the third camera over the true face area, all timesteps together."""
        pairs = [(to_8_bit(i)[r], p[r]) for i, p, r in zip(images, self.photographs, self.regions, strict=True)]
        a, b = (np.concatenate(part)[None] for part in zip(*pairs, strict=True))
        return psnr(a, b)

    def mesh_mm(self, vertices: NDArray) -> float:
        """Mean distance (mm) of the face area's vertices to the true ones."""
        area = np.unique(self.model.faces[self.model.face_mask])
        return float(np.linalg.norm(vertices[:, area] - self.truth[:, area], axis=2).mean()) * 10.0


def load_task() -> Task:
    """The capture ``gloss`` with half the pixels a side."""
    capture, model = Capture.load(SHARED / "captures" / "gloss"), MorphableModel.load(MODEL)
    truth = true_geometry(capture, model, TIMESTEPS).vertices
    frames = {(name, t): _halved(capture, name, t) for name in CAMERAS for t in TIMESTEPS}
    third = _half_camera(capture.camera("third"))
    held = [_half_frame(capture.frame("third", t)) for t in TIMESTEPS]
    regions = [face_area(v, model.faces, model.face_mask, third) & f.valid for v, f in zip(truth, held, strict=True)]
    cameras = {name: _half_camera(capture.camera(name)) for name in CAMERAS}
    return Task(Views(cameras, frames), model, truth, third, [to_8_bit(f.image) for f in held], regions)


def _halved(capture: Capture, name: str, timestep: int) -> Any:
    frame = capture.frame(name, timestep)
    return replace(_half_frame(frame), landmarks=0.5 * frame.landmarks)


def start(task: Task) -> Head:
    """The mean head where perspective-n-point of the first camera puts it."""
    model, name = task.model, CAMERAS[0]
    camera, rotations, shifts = task.views.camera(name), [], []
    for t in TIMESTEPS:
        frame = task.views.frame(name, t)
        points = model.mean[model.landmarks][frame.visible].astype(np.float64)
        _, turn, shift = cv2.solvePnP(
            points, frame.landmarks[frame.visible], camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP
        )
        rotations.append(camera.rotation.T @ cv2.Rodrigues(turn)[0])
        shifts.append(camera.rotation.T @ (shift[:, 0] - camera.translation))
    count = len(TIMESTEPS)
    return Head(
        model, np.zeros(model.n_identity), np.zeros((count, model.n_expression)), np.stack(rotations), np.stack(shifts)
    )


def landmark_gradient(task: Task, head: Head) -> NDArray[np.float64]:
    """Gradient (T, 68, 3) of the mean squared pixel distance of the landmarks, summed over views."""
    world = head.vertices(task.model.landmarks)
    total = np.zeros_like(world)
    for name in CAMERAS:
        camera = task.views.camera(name)
        for i, t in enumerate(TIMESTEPS):
            frame = task.views.frame(name, t)
            p = camera.to_camera(world[i])
            u = np.stack([camera.fx * p[:, 0], camera.fy * p[:, 1]], 1) / p[:, 2:] + (camera.cx, camera.cy)
            g = 2.0 * (u - frame.landmarks) * frame.visible[:, None] / max(int(frame.visible.sum()), 1)
            scaled = g * (camera.fx, camera.fy)
            by_camera = np.stack(
                [scaled[:, 0] / p[:, 2], scaled[:, 1] / p[:, 2], -(scaled * p[:, :2]).sum(1) / p[:, 2] ** 2], 1
            )
            total[i] += by_camera @ camera.rotation
    return total


def recipe(task: Task, size: int, bands: int, part: float) -> list[dict[str, float]]:
    """Run the schedule; seconds, held-out error and mesh error on the way."""
    import drjit as dr
    import mitsuba as mi

    counts = [max(1, round(part * n)) for n in SCHEDULE]
    head, curve, seed, rng = start(task), [], 0, np.random.default_rng(0)
    adam = Adam(
        {"identity": RATES["shape"], "expression": RATES["shape"] / 4, **{k: RATES[k] for k in ("rotation", "shift")}}
    )
    clock = Clock()
    for _ in range(counts[0]):
        head.step(adam.steps(head.gradients(landmark_gradient(task, head), task.model.landmarks)))
    geometry = true_geometry_like(task, head)
    scenes = Scenes(geometry, task.model, {**task.views.cameras, "third": task.third})
    radiance = np.zeros((bands * bands, 3))
    radiance[0] = np.sqrt(4 * np.pi)
    grey = np.full((size, size, 3), 0.4)
    built = [scenes.scene(i, grey, np.full((size, size), 0.1), radiance) for i in range(len(TIMESTEPS))]
    parameters = [mi.traverse(scene) for scene in built]
    keys = ["mesh.bsdf.diffuse_reflectance.data", "mesh.bsdf.specular_reflectance.data", "light.coefficients"]
    positions = "mesh.vertex_positions"
    integrator = mi.load_dict({"type": "prb", "max_depth": 2, "hide_emitters": True})
    optimizer = mi.ad.Adam(lr=RATES["maps"])
    for key in keys:
        optimizer[key] = mi.TensorXf(parameters[0][key])
    names = [(name, i) for name in CAMERAS for i in range(len(TIMESTEPS))]
    targets = {}
    for name, i in names:
        frame = task.views.frame(name, TIMESTEPS[i])
        seen = face_area(head.vertices()[i], task.model.faces, task.model.face_mask, task.views.camera(name))
        weight = (seen & frame.valid & ~frame.clipped)[..., None].astype(np.float32)
        targets[name, i] = mi.TensorXf(np.nan_to_num(frame.image)), mi.TensorXf(weight)

    def look(phase: str, iteration: int) -> None:
        dr.sync_thread()
        spent = clock.stop()
        images = []
        for i, scene in enumerate(built):
            parameters[i].update({key: optimizer[key] for key in keys})
            images.append(
                np.array(mi.render(scene, sensor=scenes.sensors["third"], spp=16, integrator=integrator))[..., :3]
            )
        found = {
            **spent,
            "phase": phase,
            "iteration": iteration,
            "third_db": round(task.held_out(images), 2),
            "mesh_mm": round(task.mesh_mm(head.vertices()), 3),
        }
        curve.append(found)
        print(found, file=sys.stderr, flush=True)
        clock.go_on()  # looking costs nothing

    look("geometry", counts[0])
    slow = Adam({k: RATES["joint"] * rate for k, rate in adam.rates.items()})
    at = scenes.pairs[:, 0]
    for phase, count in (("reflectance", counts[1]), ("joint", counts[2])):
        for iteration in range(count):
            name, i = names[rng.integers(len(names))]
            target, weight = targets[name, i]
            given = {key: optimizer[key] for key in keys}
            if phase == "joint":
                moved = mi.Float(head.vertices()[i][at].astype(np.float32).ravel())
                dr.enable_grad(moved)
                given[positions] = moved
            parameters[i].update(given)
            seed += 1
            image = mi.render(
                built[i], parameters[i], sensor=scenes.sensors[name], integrator=integrator, spp=SPP, seed=seed
            )
            loss = dr.sum(weight * dr.square(image[..., :3] - target), axis=None) / dr.sum(weight, axis=None)
            dr.backward(255.0**2 * loss)
            optimizer.step()
            for key in keys[:2]:
                optimizer[key] = dr.clip(optimizer[key], 0.0, 1.0)
            dr.eval(*(optimizer[key] for key in keys))
            if phase == "joint":
                by_vertex = np.zeros((len(TIMESTEPS), task.model.n_vertices, 3))
                gradient = np.nan_to_num(np.array(dr.grad(moved), dtype=np.float64).reshape(-1, 3))
                np.add.at(by_vertex[i], at, gradient)
                by_vertex[:, task.model.landmarks] += LANDMARK_WEIGHT * landmark_gradient(task, head)
                head.step(slow.steps(head.gradients(by_vertex)))
            if (iteration + 1) % max(1, count // 8) == 0:
                look(phase, iteration + 1)
    return curve


def true_geometry_like(task: Task, head: Head) -> Any:
    """A geometry record with the head's vertices, for `Scenes`."""
    return SimpleNamespace(vertices=head.vertices().astype(np.float32), timesteps=TIMESTEPS)


def ours(task: Task, size: int) -> dict[str, Any]:
    """``mifit.fit``'s stages with their defaults on the same images; the clock starts when they have been read."""
    from mifit.config import FitConfig
    from mifit.fitting import Source, run_steps, steps
    from mifit.reconstruction import Reconstruction

    config = FitConfig()
    config = replace(config, reflectance=replace(config.reflectance, texture_size=size))
    views = MetricViews(task.views.cameras, task.views.frames)
    source = Source(views, "", task.model, CAMERAS, TIMESTEPS, 0)  # type: ignore[arg-type]
    clock = Clock()
    found, _ = run_steps(steps(config), source, lambda *done: None)
    spent = clock.stop()
    result = Reconstruction(model=task.model, **found, cameras=tuple(task.views.cameras.values()))
    images = [result.render(task.third, t)[..., :3] for t in TIMESTEPS]
    return {
        **spent,
        "by_stage": {name: round(estimate.report.seconds, 2) for name, estimate in found.items()},
        "third_db": round(task.held_out(images), 2),
        "mesh_mm": round(task.mesh_mm(found["geometry"].vertices.astype(np.float64)), 3),
        "unconverged": [name for name, e in found.items() if e.report.outcome != "converged"],
    }


def markdown(curve: list[dict[str, Any]], fast: dict[str, Any], part: float) -> str:
    """The end of each phase beside our fit."""
    ends = {row["phase"]: row for row in curve}
    lines = [
        f"Capture `gloss` at 340 x 240, {part:g} of the rival's schedule, in one run. The machine did other",
        "work beside it (`machine` in the JSON): compare the processor's seconds, which count all cores.",
        "",
        "| | processor s | wall s | third view dB | mesh mm | unconverged |",
        "|---|---|---|---|---|---|",
    ]

    def figures(row: dict[str, Any]) -> str:
        seconds = f"{row['processor_seconds']:.0f} | {row['seconds']:.0f}"
        return f"{seconds} | {row['third_db']:.2f} | {row['mesh_mm']:.2f}"

    for phase, row in ends.items():
        lines.append(f"| `prb` + Adam, after {phase} ({row['iteration']}) | {figures(row)} | a schedule: not tested |")
    lines.append(f"| `mifit.fit`, defaults | {figures(fast)} | {', '.join(fast['unconverged']) or 'none'} |")
    return "\n".join(lines) + "\n"


def plot(curve: list[dict[str, Any]], fast: dict[str, Any], path: Path) -> None:
    with figure(path, (8.0, 3.4), columns=2) as axes:
        for axis, key, title in zip(axes, ("third_db", "mesh_mm"), ("third view, dB", "mesh, mm"), strict=True):
            seconds = [r["processor_seconds"] for r in curve]
            axis.plot(seconds, [r[key] for r in curve], label="prb + Adam, a rival's schedule")
            axis.plot(fast["processor_seconds"], fast[key], "o", label="mifit.fit, a whole run")
            axis.set(xscale="log", xlabel="processor seconds", ylabel=title)
            axis.grid(alpha=0.3, which="both")
        axes[0].legend(fontsize=7)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", type=float, default=1.0, help="of the schedule's iterations")
    parser.add_argument("--size", type=int, default=128, help="side of the maps")
    parser.add_argument("--bands", type=int, default=3)
    a = parser.parse_args()
    if not MODEL.exists():
        print(f"needs the data folder {SHARED}", file=sys.stderr)
        return 1
    variant = mifit.set_variant("auto")
    mifit.register_plugins()
    task = load_task()
    fast = ours(task, a.size)
    print(fast, file=sys.stderr, flush=True)
    curve = recipe(task, a.size, a.bands, a.part)
    settings = {"variant": variant, "size": a.size, "bands": a.bands, "spp": SPP, "part": a.part, "schedule": SCHEDULE}
    record("rival", {**settings, "rates": RATES, "curve": curve, "ours": fast})
    write_text(RESULTS / "rival.md", markdown(curve, fast, a.part))
    plot(curve, fast, PICTURE)
    print((RESULTS / "rival.md").read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
