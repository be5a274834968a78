"""Stage 1 on path-traced captures: error in world space, basin of convergence, speed against a first-order route.

    python -m benchmarks.fit_geometry [--only accuracy,builtin,pair,basin,speed] [--starts 100]

Truth is compared with, never fitted. Parts that aren't named keep the figures of the last run. Times are of a machine
that may be busy; `speed` therefore gives ratios of processor time within one run.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import pstats
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mifit
from benchmarks.record import RESULTS, SHARED, record
from mifit.capture import Capture
from mifit.config import GeometryConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import vertex_sum_matrix
from mifit.morphable import MorphableModel
from mifit.morphable.register import distance_to_surface
from mifit.optim import minimize
from mifit.stages.fit_geometry import fit_geometry
from mifit.stages.geometry.appearance import fit_appearance, gather
from mifit.stages.geometry.normal import NormalEquations, prior_energy
from mifit.stages.geometry.parameters import Layout, cross_matrix, exponential, rotation_angle
from mifit.stages.geometry.refine import paper_problem, priors_of, refine_by_texture
from mifit.stages.geometry.start import State, bounds, fit_landmarks, initial_state, landmark_views
from mifit.stages.geometry.visibility import Visibility, spread_points

ICT = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
BOTH, ONE, STEPS = ("left", "right"), ("left",), (0, 1, 2, 3)


def load(name: str) -> Capture:
    return Capture.load(SHARED / "captures" / name)


def truth_of(capture: Capture, timestep: int) -> dict[str, np.ndarray]:
    with np.load(Path(capture.path) / "truth" / f"{timestep:04d}.npz") as data:
        return {key: data[key] for key in data}


def face_area() -> int:
    """Number of leading ICT vertices that make up the face area."""
    with np.load(ICT) as data:
        return int(data["face_area_vertices"])


def vertex_errors(capture: Capture, estimate: GeometryEstimate) -> dict[str, Any]:
    """Distances of the face area's vertices to the truth, world space, no alignment; and rotation errors."""
    mean, high, turn = [], [], []
    for k, timestep in enumerate(estimate.timesteps):
        truth = truth_of(capture, timestep)
        distance = capture.unit_mm * np.linalg.norm(estimate.vertices[k] - truth["vertices"], axis=1)[: face_area()]
        mean.append(float(distance.mean()))
        high.append(float(np.percentile(distance, 95)))
        turn.append(rotation_angle(estimate.rotation[k], truth["R"]))
    return {
        "mean_mm": float(np.mean(mean)),
        "p95_mm": float(np.mean(high)),
        "rotation_max_degrees": float(np.max(turn)),
        "mean_mm_per_timestep": mean,
        "rotation_degrees_per_timestep": turn,
        "seconds": estimate.report.seconds,
        "outcome": estimate.report.outcome,
    }


def accuracy() -> dict[str, Any]:
    """ICT model: two views, one view, the paper's objective, landmarks alone."""
    model = MorphableModel.load(ICT)
    variants = {
        "two views": (BOTH, GeometryConfig()),
        "one view": (ONE, GeometryConfig()),
        "two views, paper's objective": (BOTH, GeometryConfig(objective="paper")),
        "two views, landmarks alone": (BOTH, GeometryConfig(rounds=0)),
    }
    out: dict[str, Any] = {}
    for name in ("soft", "gloss", "hard"):
        capture = load(name)
        out[name] = {}
        for label, (cameras, config) in variants.items():
            out[name][label] = vertex_errors(capture, fit_geometry(capture, model, cameras, STEPS, config))
            print(name, label, {k: v for k, v in out[name][label].items() if "per" not in k}, flush=True)
        out[name]["one view over two"] = out[name]["one view"]["mean_mm"] / out[name]["two views"]["mean_mm"]
    return out


def builtin() -> dict[str, Any]:
    """Built-in model: point-to-surface distance of its face to the true surface."""
    model = MorphableModel.load("builtin")
    ict = MorphableModel.load(ICT)
    facial = np.unique(model.faces[model.face_mask])
    out: dict[str, Any] = {}
    for name in ("soft", "gloss", "hard"):
        capture = load(name)
        out[name] = {}
        for label, cameras in (("two views", BOTH), ("one view", ONE)):
            estimate = fit_geometry(capture, model, cameras, STEPS, GeometryConfig())
            distance = [
                capture.unit_mm
                * distance_to_surface(
                    estimate.vertices[k][facial].astype(np.float64),
                    truth_of(capture, t)["vertices"].astype(np.float64),
                    ict.faces,
                )
                for k, t in enumerate(STEPS)
            ]
            out[name][label] = {
                "point_to_surface_mean_mm": float(np.mean(distance)),
                "point_to_surface_p95_mm": float(np.percentile(distance, 95)),
                "seconds": estimate.report.seconds,
                "outcome": estimate.report.outcome,
            }
            print(name, label, out[name][label], flush=True)
    return out


def pair() -> dict[str, Any]:
    """One pair of images alone (the paper's unit of work), one view alone, and eight images."""
    model = MorphableModel.load(ICT)
    capture = load("soft")
    out = {}
    for label, cameras, steps in (("one pair", BOTH, (0,)), ("one image", ONE, (0,)), ("eight images", BOTH, STEPS)):
        errors = vertex_errors(capture, fit_geometry(capture, model, cameras, steps, GeometryConfig()))
        out[label] = {k: errors[k] for k in ("mean_mm", "rotation_max_degrees", "seconds")}
        print(label, out[label], flush=True)
    return out


def basin(starts: int, seed: int = 0) -> dict[str, Any]:
    """Random starts within 15 degrees and 5 cm, and one 20 degrees and 10 cm off: where landmarks and texture end."""
    model, capture = MorphableModel.load(ICT), load("soft")
    config = GeometryConfig(rounds=1, surface_points=1500)
    layout = Layout(1, model.n_identity, model.n_expression)
    views = landmark_views(capture, model, BOTH, (0,), config.landmark_noise)
    good = initial_state(model, views, 1, layout, model.unit_mm / capture.unit_mm)
    visibility = Visibility(capture, model, BOTH, (0,))
    points = spread_points(model, config.surface_points, seed)

    def run(state: State) -> float:
        found = fit_landmarks(model, views, state, config.landmark_noise, priors_of(config))
        state = found.state
        for _ in range(2):
            state, solution = refine_by_texture(model, state, found.views, visibility, points, config)
        return solution.energy

    def moved(rng: np.random.Generator, degrees: float, shift: float) -> State:
        axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        x = good.x.copy()
        x[layout.at("translation", 0)] += shift * direction
        turned = exponential(np.radians(degrees) * axis) @ good.frames.rotation
        return replace(good, x=x, frames=replace(good.frames, rotation=turned))

    best = run(good)
    rng = np.random.default_rng(seed)
    ends = []
    for _ in range(starts):
        ends.append(run(moved(rng, 15.0 * rng.random(), 5.0 * rng.random())))
    far = [run(moved(rng, 20.0, 10.0)) for _ in range(5)]
    out = {
        "starts": starts,
        "energy_from_the_closed_form_start": best,
        "within_1_percent": int(sum(abs(e - best) <= 0.01 * best for e in ends)),
        "worst_ratio": float(max(ends) / best),
        "20 degrees and 10 cm off, of 5 within 1 percent": int(sum(abs(e - best) <= 0.01 * best for e in far)),
    }
    print(out, flush=True)
    return out


def speed() -> dict[str, Any]:
    """One pair, built-in model, the paper's objective with all unknowns: Levenberg-Marquardt against Adam.

    Adam gets the gradient alone, by sparse products in reverse order, without the Jacobian's dense columns.
    """
    model, capture = MorphableModel.load("builtin"), load("soft")
    config = GeometryConfig(objective="paper")
    layout = Layout(1, model.n_identity, model.n_expression)
    views = landmark_views(capture, model, BOTH, (0,), config.landmark_noise)
    state = initial_state(model, views, 1, layout, model.unit_mm / capture.unit_mm)
    found = fit_landmarks(model, views, state, config.landmark_noise, priors_of(config))
    state, views, config = found.state, found.views, replace(config, landmark_noise=found.noise)
    visibility = Visibility(capture, model, BOTH, (0,))
    pixels = visibility.pixels(state, config.pixels, 1.0, 0)
    lit = fit_appearance(gather(model, visibility.world(state), pixels, 30.0, 1.0), 30).value
    problem, start = paper_problem(model, state, lit, views, visibility, config, 0)
    low, high = bounds(problem.layout, model.expression_bounds)

    def total(x: np.ndarray) -> float:
        return sum(problem.energies(x).values())

    first = total(start)
    profile = cProfile.Profile()
    began = time.process_time()
    trace: list[tuple[float, float]] = []  # processor seconds: other programs' load must not decide

    def note(_: int, terms: dict[str, float]) -> None:
        trace.append((time.process_time() - began, sum(terms.values())))

    solution = minimize(problem, start, lower=low, upper=high, max_iterations=60, energy_tolerance=1e-4, callback=note)
    whole = time.process_time() - began
    goal = 1.01 * solution.energy
    newton, steps_to_goal = next((t, i + 1) for i, (t, energy) in enumerate(trace) if energy <= goal)
    profile.enable()
    minimize(problem, start, lower=low, upper=high, max_iterations=5, energy_tolerance=1e-4)
    profile.disable()
    print("LM", first, solution.energy, whole, newton, steps_to_goal, solution.iterations, flush=True)
    attempts = {}
    for rate in (0.01, 0.03):
        seconds, steps, energy = adam_steps(problem, start, low, high, rate, goal, limit=32.0 * newton)
        attempts[str(rate)] = {"seconds": seconds, "steps": steps, "energy": energy, "reached": energy <= goal}
        print("Adam", rate, attempts[str(rate)], flush=True)
    reached = [a["seconds"] for a in attempts.values() if a["reached"]]
    slowest = min(reached) if reached else min(a["seconds"] for a in attempts.values())
    return {
        "vertices": model.n_vertices,
        "parameters": problem.layout.size,
        "pixels": int(sum(len(view.face) for view in problem.views)),
        "energy_start": first,
        "energy_end": solution.energy,
        "outcome": solution.outcome.value,
        "seconds_are": "processor time; start with OPENBLAS_NUM_THREADS=1 for one core",
        "goal": "1 % above the energy that Levenberg-Marquardt converges to",
        "newton_seconds": newton,
        "newton_steps": steps_to_goal,
        "newton_seconds_to_convergence": whole,
        "newton_iterations_to_convergence": solution.iterations,
        "adam": attempts,
        "adam_over_newton": slowest / newton,
        "adam_over_newton_is_a_lower_bound": not reached,
        "profile_share": shares(profile),
    }


def adam_steps(
    problem: Any, start: np.ndarray, low: np.ndarray, high: np.ndarray, rate: float, goal: float, limit: float
) -> tuple[float, int, float]:
    """Adam (Kingma and Ba 2015) with each group in its natural unit, until the goal or the time limit."""
    x, m, v = start.copy(), np.zeros_like(start), np.zeros_like(start)
    unit = np.ones(len(x))
    unit[problem.layout.at("rotation", 0)] = 0.05
    unit[problem.layout.at("ambient")] = 0.05
    began, best, steps = time.process_time(), np.inf, 0
    while time.process_time() - began < limit:
        steps += 1
        energy, g = value_and_gradient(problem, x)
        best = min(best, energy)
        if energy <= goal:
            break
        g = g * unit
        m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
        step = rate * (m / (1 - 0.9**steps)) / (np.sqrt(v / (1 - 0.999**steps)) + 1e-12)
        x = np.clip(x - step * unit, low, high)
    return time.process_time() - began, steps, float(best)


def value_and_gradient(problem: Any, x: np.ndarray) -> tuple[float, np.ndarray]:
    """Energy and gradient of the paper's objective in reverse order, one pass over the pixels."""
    layout, model = problem.layout, problem.model
    surfaces, albedo = problem._surfaces(x), problem._vertex_albedo(x)
    around = vertex_sum_matrix(model.faces, model.n_vertices)
    g = np.zeros(layout.size)
    energy = 0.0
    size = 3 * model.n_vertices
    for view in problem.views:
        surface = surfaces[view.step]
        o = problem._observe(view, surface, albedo, x, gradient=True)
        loss, weight = problem._loss(o)
        energy += loss
        pull = 2.0 * weight[:, None] * o.residual  # (n, 3)
        by_pixel, by_normal, through_position, through_normal = problem.by_vertex(view, surface, o, x)
        flat = pull.ravel().astype(np.float32)
        to_sum = (through_normal.T @ flat).reshape(-1, 3)
        to_face = around.T @ to_sum  # adjoint of summing face normals around vertices
        a, b, c = (surface.vertices[model.faces[:, i]] for i in range(3))
        vertex = (through_position.T @ flat).reshape(-1, 3).astype(np.float64)
        for corner, edge in enumerate((c - b, a - c, b - a)):
            back = np.cross(to_face, edge)
            for axis in range(3):
                vertex[:, axis] += np.bincount(model.faces[:, corner], back[:, axis], minlength=model.n_vertices)
        to_vertex = vertex.ravel().astype(np.float32)
        g[layout.at("identity")] += to_vertex @ model.identity.reshape(size, -1)
        g[layout.at("expression", view.step)] += to_vertex @ model.expression.reshape(size, -1)
        corners = model.faces[view.face]
        spread = 255.0 * (pull * o.shade)[:, None, :] * view.weights[:, :, None]
        to_albedo = np.stack(
            [np.bincount(corners.ravel(), spread[:, :, c].ravel(), minlength=model.n_vertices) for c in range(3)], 1
        )
        g[layout.at("albedo")] += to_albedo.ravel().astype(np.float32) @ model.albedo_modes.reshape(size, -1)
        g[layout.at("shading")] += 255.0 * (o.basis.T @ (pull * o.albedo)).ravel()
        g[layout.at("ambient")] += 255.0 * pull.sum()
        pose = problem.frames.pose(layout, x, view.step)
        by_pose = np.einsum("nc,nci->ni", pull, by_pixel)
        local = np.einsum("ni,nij->j", by_pose, o.projection.by_pose)
        turning = np.einsum("nc,nci->ni", pull, by_normal)
        local[:3] -= np.einsum("ni,nij->j", turning, cross_matrix(o.normal)) @ pose.left_jacobian
        g[layout.at("rotation", view.step)] += local[:3]
        g[layout.at("translation", view.step)] += local[3:]
    equations = NormalEquations(layout)
    problem.landmarks.accumulate(equations, layout, problem.frames, x)
    energy += problem.landmarks.energy(layout, problem.frames, x)
    equations.add_priors(x, problem.priors)
    energy += prior_energy(layout, x, problem.priors)
    return energy, g + 2.0 * equations.system().gradient


def shares(profile: cProfile.Profile) -> dict[str, float]:
    """Time by kind: linear algebra, shading (residuals and their derivatives), all else."""
    algebra = ("optim/systems", "geometry/normal", "scipy/linalg", "scipy/sparse", "_sparsetools", "numpy/linalg")
    shading = (
        "geometry/rendering",
        "geometry/images",
        "geometry/points",
        "core/sh",
        "core/mesh",
        "c_einsum",
        "bincount",
    )
    shading += ("geometry/landmarks", "geometry/parameters", "numpy.ufunc", "ndarray", "numpy._core", "numpy/_core")
    seconds = {"linear_algebra": 0.0, "shading": 0.0, "other": 0.0}
    for (file, _, function), (_, _, own, *_) in pstats.Stats(profile).stats.items():
        where = f"{file}:{function}"
        kind = "linear_algebra" if any(k in where for k in algebra) else "other"
        if kind == "other" and any(k in where for k in shading):
            kind = "shading"
        seconds[kind] += own
    whole = sum(seconds.values())
    return {kind: value / whole for kind, value in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="accuracy,builtin,pair,basin,speed")
    parser.add_argument("--starts", type=int, default=100)
    arguments = parser.parse_args()
    mifit.set_variant("auto")
    parts = {
        "accuracy": accuracy,
        "builtin": builtin,
        "pair": pair,
        "basin": lambda: basin(arguments.starts),
        "speed": speed,
    }
    for name in arguments.only.split(","):
        found = parts[name]()
        kept = RESULTS / "fit_geometry.json"  # read late: parts may run side by side
        figures = json.loads(kept.read_text())["figures"] if kept.exists() else {}
        record("fit_geometry", {**figures, name: found})


if __name__ == "__main__":
    main()
