"""Stage 2 against a plain Mitsuba loop: error of the diffuse albedo over seconds.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.plain_loop [--size 128] [--seconds 120]

The plain loop is what one writes with Mitsuba alone: ``prb`` at 4 samples per pixel, `blinnphong` under `shenv`, Adam
on both albedo textures and the lighting, one image after the other, textures kept within 0..1. It starts from grey
textures and white light, and a second time from the morphable model's albedo, which `als` and `adam` know too. All
get the capture ``gloss`` at half its resolution: true geometry, the two input cameras, four timesteps.

Error: RMSE of the diffuse albedo over the texels that are seen well, after one scale for all channels (linear
reflectance). Time: wall seconds, with the loop's kernels compiled before the clock starts; `als` and `adam` count from
reading the images to the finished maps, and each of their points is a whole run with another budget; smaller maps are
enlarged. The figure asked
for is the time of the loop's best error over that of the fastest `als` run that is as good. Writes
``benchmarks/results/plain_loop.json`` and ``docs/images/plain_loop.svg``.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mifit
from benchmarks.figure import figure
from benchmarks.record import SHARED, record
from benchmarks.truth import true_geometry, true_maps
from mifit import Capture, MorphableModel
from mifit.capture.capture import Frame
from mifit.config import ReflectanceConfig
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate
from mifit.core.mesh import interpolate, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.render.sensor import make_sensor

MODEL = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "plain_loop.svg"
CAMERAS = ("left", "right")
TIMESTEPS = (0, 1, 2, 3)
SPP = 4
EXPONENT, BANDS = 150.0, 5
RATE = 0.01
"""Adam's step of textures and lighting; with 0.03 the error of the first minute grows instead of falling."""


@dataclass(frozen=True)
class Views:
    """Stands in for a Capture: cameras and frames."""

    cameras: dict[str, Any]
    frames: dict[tuple[str, int], Frame]

    def camera(self, name: str) -> Any:
        return self.cameras[name]

    def frame(self, name: str, timestep: int) -> Frame:
        return self.frames[name, timestep]


@dataclass(frozen=True)
class Task:
    """Images with what is known about them.

    Attributes
    ----------
    views : Views
    geometry : GeometryEstimate
        True meshes.
    model : MorphableModel
    truth : (S, S, 3)
        Painted diffuse albedo.
    judged : (S, S) bool
        Texels that enter the error.
    """

    views: Views
    geometry: GeometryEstimate
    model: MorphableModel
    truth: NDArray
    judged: NDArray[np.bool_]

    def error(self, diffuse: NDArray) -> float:
        """RMSE of a diffuse albedo map after one scale."""
        k = len(self.truth) // len(diffuse)
        diffuse = diffuse.repeat(k, axis=0).repeat(k, axis=1)
        estimate, truth = diffuse[self.judged].astype(np.float64), self.truth[self.judged]
        scale = (estimate * truth).sum() / max((estimate**2).sum(), 1e-12)
        return float(np.sqrt(np.mean((scale * estimate - truth) ** 2)))


class Scenes:
    """The true mesh of each timestep with `blinnphong` textures under `shenv`, and a sensor per camera."""

    def __init__(self, task_geometry: GeometryEstimate, model: MorphableModel, cameras: dict[str, Any]) -> None:
        self.model, self.geometry = model, task_geometry
        # One vertex per pair of position and UV, as Mitsuba's meshes have it.
        corners = np.stack([model.faces.ravel(), model.faces_uv.ravel()], axis=1)
        self.pairs, index = np.unique(corners, axis=0, return_inverse=True)
        self.faces = index.reshape(-1, 3)
        self.sensors = {name: make_sensor(camera, SPP) for name, camera in cameras.items()}

    def scene(self, step: int, diffuse: NDArray, specular: NDArray, radiance: NDArray) -> Any:
        import mitsuba as mi

        from mifit.render.gbuffer import make_mesh

        def texture(values: NDArray) -> dict:
            pixels = np.ascontiguousarray(values, dtype=np.float32).reshape(*values.shape[:2], -1)
            # Clamped and raw, as a map of an atlas in linear reflectance is.
            return {
                "type": "bitmap",
                "bitmap": mi.Bitmap(pixels),
                "raw": True,
                "format": "variant",
                "wrap_mode": "clamp",
            }

        bsdf = {
            "type": "blinnphong",
            "diffuse_reflectance": texture(diffuse),
            "specular_reflectance": texture(specular),
            "exponent": EXPONENT,
        }
        vertices = self.geometry.vertices[step]
        normals = vertex_normals(vertices, self.model.faces)
        at, uv = self.pairs.T
        # Maps have row 0 at v = 1, Mitsuba's bitmaps at v = 0.
        turned = self.model.uv[uv] * [1.0, -1.0] + [0.0, 1.0]
        mesh = make_mesh(vertices[at], self.faces, turned, normals[at], mi.load_dict(bsdf))
        light = {"type": "shenv", "coefficients": mi.TensorXf(np.asarray(radiance, dtype=np.float32))}
        return mifit.load_scene({"type": "scene", "mesh": mesh, "light": light})


def plain_loop(task: Task, start: NDArray, seconds: float, rate: float = RATE) -> list[tuple[float, float]]:
    """Seconds and albedo errors of the plain loop, measured a hundred times."""
    import drjit as dr
    import mitsuba as mi

    size = len(task.truth)
    scenes = Scenes(task.geometry, task.model, task.views.cameras)
    radiance = np.zeros((BANDS * BANDS, 3))
    radiance[0] = np.sqrt(4 * np.pi)
    built = [scenes.scene(i, start, np.full((size, size), 0.1), radiance) for i in range(len(task.geometry.timesteps))]
    parameters = [mi.traverse(scene) for scene in built]
    texture = "mesh.bsdf.{}_reflectance.data"
    keys = {"diffuse": texture.format("diffuse"), "specular": texture.format("specular"), "light": "light.coefficients"}
    integrator = mi.load_dict({"type": "prb", "max_depth": 2, "hide_emitters": True})
    images = {}
    for (name, timestep), frame in task.views.frames.items():
        known = _judged_pixels(task, name, timestep) & frame.valid & ~frame.clipped
        step = task.geometry.index(timestep)
        images[name, step] = mi.TensorXf(np.nan_to_num(frame.image)), mi.TensorXf(known[..., None].astype(np.float32))
    names = list(images)
    optimizer = mi.ad.Adam(lr=rate)
    for key in keys.values():
        optimizer[key] = mi.TensorXf(parameters[0][key])
    rng = np.random.default_rng(0)
    curve: list[tuple[float, float]] = []
    started = 0.0
    iteration = 0
    while True:
        if iteration == len(names):  # every kernel has been compiled
            started = time.perf_counter()
        if iteration % len(names) == 0:
            rng.shuffle(names)
        name, step = names[iteration % len(names)]
        target, weight = images[name, step]
        parameters[step].update(optimizer)
        image = mi.render(
            built[step], parameters[step], scenes.sensors[name], integrator=integrator, spp=SPP, seed=iteration
        )
        dr.backward(dr.sum(weight * dr.square(image[..., :3] - target), axis=None) / dr.sum(weight, axis=None))
        optimizer.step()
        for key in (keys["diffuse"], keys["specular"]):
            optimizer[key] = dr.clip(optimizer[key], 0.0, 1.0)
        dr.eval(*(optimizer[key] for key in keys.values()))
        iteration += 1
        if iteration > len(names) and iteration % len(names) == 0:
            dr.sync_thread()
            now = time.perf_counter() - started
            if not curve or now - curve[-1][0] > seconds / 100 or now > seconds:
                curve.append((now, task.error(np.array(optimizer[keys["diffuse"]]))))
                started += time.perf_counter() - started - now  # looking costs nothing
            if now > seconds:
                print(f"plain loop: {iteration} iterations in {now:.0f} s", file=sys.stderr, flush=True)
                return curve


def _judged_pixels(task: Task, name: str, timestep: int) -> NDArray[np.bool_]:
    """Pixels whose centre shows the face area."""
    from mifit.render.gbuffer import SurfaceScene

    vertices = task.geometry.vertices[task.geometry.index(timestep)]
    face = SurfaceScene(vertices, task.model.faces).gbuffer(task.views.camera(name)).face
    return (face >= 0) & task.model.face_mask[np.maximum(face, 0)]


def load_task(size: int) -> Task:
    """The path-traced capture ``gloss`` with half the pixels a side."""
    from mifit.stages.observations import Surface

    capture = Capture.load(SHARED / "captures" / "gloss")
    model = MorphableModel.load(MODEL)
    geometry = true_geometry(capture, model, TIMESTEPS)
    views = Views(
        {name: _half_camera(capture.camera(name)) for name in CAMERAS},
        {(name, t): _half_frame(capture.frame(name, t)) for name in CAMERAS for t in TIMESTEPS},
    )
    surface = Surface(views, model, geometry, CAMERAS, size)
    judged = surface.texels.to_map(surface.quality()) > 0.5
    return Task(views, geometry, model, true_maps(capture, size)["albedo"], judged)


def _half_camera(camera: Camera) -> Camera:
    sizes = {key: getattr(camera, key) // 2 for key in ("width", "height")}
    return replace(camera, **sizes, **{key: getattr(camera, key) / 2 for key in ("fx", "fy", "cx", "cy")})


def _half_frame(frame: Frame) -> Frame:
    def blocks(values: NDArray) -> NDArray:
        height, width = values.shape[:2]
        return values.reshape(height // 2, 2, width // 2, 2, *values.shape[2:])

    return replace(
        frame,
        image=blocks(frame.image).mean((1, 3)),
        valid=blocks(frame.valid).all((1, 3)),
        clipped=blocks(frame.clipped).any((1, 3)),
    )


def stage_2(task: Task, config: ReflectanceConfig) -> tuple[float, float]:
    """Seconds and albedo error of one whole run."""
    started = time.perf_counter()
    found = mifit.infer_reflectance(task.views, task.model, task.geometry, CAMERAS, config)
    return time.perf_counter() - started, task.error(found.diffuse)


def fast_runs(task: Task, size: int) -> dict[str, list[tuple[float, float]]]:
    """Points of `als` and `adam`: each a whole run with another budget."""
    base = ReflectanceConfig(texture_size=size, shading="prefiltered", exponent=EXPONENT)
    budgets = ((size // 4, 3, 1), (size // 2, 5, 3), (size, 5, 3), (size, 10, 10))
    als = [replace(base, texture_size=s, bands=b, max_iterations=i) for s, b, i in budgets]
    adam = [replace(base, bands=5, solver="adam", robust=False, max_iterations=4)]
    stage_2(task, als[0])  # compiles kernels, as the plain loop has done before its clock starts
    points = {"als": [stage_2(task, c) for c in als], "adam": [stage_2(task, c) for c in adam]}
    print(points, file=sys.stderr, flush=True)
    return points


def compare(task: Task, size: int, seconds: float) -> dict[str, Any]:
    """All curves, and the ratios of times to the loop's best error."""
    model_albedo = _model_albedo(task, size)
    fast = fast_runs(task, size)
    curves: dict[str, list[tuple[float, float]]] = {}
    for label, start in (("grey", np.full((size, size, 3), 0.5)), ("the model's albedo", model_albedo)):
        curves[f"plain loop from {label}"] = plain_loop(task, start, seconds)
    again = fast_runs(task, size)
    # Measured on both sides of the long reference, so that a change of load on the machine shows.
    for name, points in fast.items():
        curves[name] = [(0.5 * (a + b), error) for (a, error), (b, _) in zip(points, again[name], strict=True)]
    ratios = {}
    for label in [name for name in curves if name.startswith("plain")]:
        at, best = min(curves[label], key=lambda point: point[1])
        row: dict[str, Any] = {"best_error": best, "seconds": at}
        for name in ("als", "adam"):
            as_good = [t for t, error in curves[name] if error <= best]
            row[f"{name}_seconds"] = min(as_good, default=None)
            row[f"{name}_times_faster"] = at / min(as_good) if as_good else None
        ratios[label] = row
    return {
        "error_of_the_models_albedo": task.error(model_albedo),
        "texels": int(task.judged.sum()),
        "ratios": ratios,
        "curves": {name: [[round(t, 3), round(e, 5)] for t, e in curve] for name, curve in curves.items()},
        "fast_runs_before_and_after": {"before": fast, "after": again},
    }


def _model_albedo(task: Task, size: int) -> NDArray[np.float32]:
    texels = rasterize_uv(task.model.uv, task.model.faces_uv, size, task.model.face_mask)
    values = interpolate(task.geometry.vertex_albedo, task.model.faces, texels.face, texels.weights)
    out = np.full((size, size, 3), 0.5, np.float32)
    out[texels.mask] = values
    return out


def plot(figures: dict[str, Any], path: Path) -> None:
    with figure(path, (6.4, 4.2)) as axis:
        for label, curve in figures["curves"].items():
            t, error = np.array(curve).T
            whole = label in ("als", "adam")
            axis.plot(t, error, "o" if whole else "-", label=label + (", a whole run each" if whole else ""))
        axis.axhline(figures["error_of_the_models_albedo"], color="0.6", lw=1, ls=":", label="the model's mean albedo")
        axis.set(xscale="log", yscale="log", xlabel="seconds", ylabel="RMSE of the diffuse albedo")
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=7)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=128, help="side of the maps")
    parser.add_argument("--seconds", type=float, default=120.0, help="time of each plain loop")
    a = parser.parse_args()
    variant = mifit.set_variant("auto")
    mifit.register_plugins()
    figures = compare(load_task(a.size), a.size, a.seconds)
    record("plain_loop", {"variant": variant, "size": a.size, "spp": SPP, "rate": RATE, **figures})
    plot(figures, PICTURE)
    for label, row in figures["ratios"].items():
        print(label, row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
