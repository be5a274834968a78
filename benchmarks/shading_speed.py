"""Closed-form shading through a cached G-buffer against Mitsuba's path replay, value and gradients.

    python -m benchmarks.shading_speed [--quick]

One iteration: eight images of 680 x 480, their squared distance from targets, and its gradients by both 512 x 512
albedo maps, the normal correction map and the lighting. Reference: the same scene, plugins and gradients through
``mi.render`` with ``prb`` at 4 samples per pixel; and what users of the public path have, ``mi.render`` with
``shdirect``. Also how the sorted gradient of look-ups compares with a scattered
one, and what each shading model costs. Ratios are of medians within one run. Uses the ICT-FaceKit head of the data
folder where it is present, else a ball. Writes ``benchmarks/results/shading_speed.json``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

import mifit
from benchmarks.record import SHARED, record
from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals

EXPONENT, ORDER = 20.0, 3


def head() -> tuple[str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Name, vertices about the origin in cm, faces, UVs and UV faces."""
    path = SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz"
    if path.is_file():
        data = np.load(path)
        vertices = data["mean"].astype(np.float64)
        return "ICT-FaceKit head", vertices - vertices.mean(0), data["faces"], data["uv"], data["faces_uv"]
    import trimesh

    ball = trimesh.creation.icosphere(5, 12.0)
    n = np.array(ball.vertices) / 12.0
    uv = np.stack([0.5 + np.arctan2(n[:, 0], n[:, 2]) / (2 * np.pi), 0.5 + 0.49 * n[:, 1]], axis=1)
    return "ball", np.array(ball.vertices), np.array(ball.faces), uv, np.array(ball.faces)


def cameras(count: int, width: int, height: int) -> list[Camera]:
    """Cameras on an arc of 60 degrees, 60 cm away."""
    out = []
    for k, angle in enumerate(np.radians(np.linspace(-30, 30, count))):
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
        pose[:3, 3] = (0, 0, 60)
        focal = width * 1000 / 680
        out.append(Camera(f"view {k}", width, height, focal, focal, width / 2, height / 2, pose))
    return out


def median_seconds(run: Callable[[], object], repeats: int) -> float:
    """Median wall time after one warm-up, in which kernels are compiled."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


class Cached:
    """Eight G-buffers as sorted points, and one iteration over them."""

    def __init__(self, views: list[Camera], mesh: tuple, size: int, light: np.ndarray) -> None:
        import mitsuba as mi

        from benchmarks.mapped import MapSampler
        from mifit.appearance.occlusion import trace_transfer
        from mifit.render.gbuffer import SurfaceScene

        vertices, faces, uv, faces_uv = mesh
        scene = SurfaceScene(vertices, faces)
        smooth = vertex_normals(vertices, faces)
        traced = trace_transfer(scene, vertices, smooth, ORDER)
        points: dict[str, list] = {"uv": [], "normal": [], "view": [], "traced": []}
        for camera in views:
            g = scene.gbuffer(camera)
            face, weights = g.face[g.mask], g.weights[g.mask]
            points["uv"].append(interpolate(uv, faces_uv, face, weights))
            points["normal"].append(normalize(interpolate(smooth, faces, face, weights)))
            points["view"].append(-camera.pixel_rays(camera.pixel_centres())[g.mask])
            points["traced"].append(interpolate(traced, faces, face, weights))
        data = {key: np.concatenate(value) for key, value in points.items()}
        self.count = len(data["uv"])
        self.sampler = MapSampler(data["uv"], size)
        data = {key: value[self.sampler.order].astype(np.float32) for key, value in data.items()}
        across = normalize(np.cross(data["normal"], [0.3, 0.9, 0.2]))

        def vector(values: np.ndarray) -> mi.Vector3f:
            return mi.Vector3f(np.ascontiguousarray(values.T, dtype=np.float32))

        self.normal, self.view = vector(data["normal"]), vector(data["view"])
        self.tangent, self.bitangent = vector(across), vector(np.cross(data["normal"], across))
        self.traced = [mi.Float(np.ascontiguousarray(column)) for column in data["traced"].T]
        rng = np.random.default_rng(0)
        self.target = mi.Color3f(rng.uniform(0.0, 1.0, (3, self.count)).astype(np.float32))
        albedo = rng.uniform(0.3, 0.6, (4, size * size)).astype(np.float32)
        self.maps = [mi.Float(m) for m in albedo]
        self.maps += [mi.Float(m) for m in rng.uniform(-0.1, 0.1, (2, size * size)).astype(np.float32)]
        self.light = mi.Float(light.astype(np.float32).ravel())

    def iterate(self, model: str = "prefiltered", scattered: bool = False) -> list[np.ndarray]:
        """Gradients of the mean squared distance by the six channels of the maps and by the lighting."""
        import drjit as dr
        import mitsuba as mi

        from mifit.appearance import kernels, models
        from mifit.appearance.formation import form_image
        from mifit.appearance.lobe import Lobe

        parameters = [*self.maps, self.light]
        dr.enable_grad(parameters)
        look_up = self.sampler.look_up if scattered else self.sampler
        red, green, blue, gloss, a, b = look_up(self.maps)
        n = dr.normalize(self.normal + a * self.tangent + b * self.bitangent)
        coefficients = kernels.colours(self.light, ORDER, self.count)
        chosen = models.get(model)
        lobe = kernels.prepare(Lobe(EXPONENT, normalized=chosen.normalized), ORDER)
        white, specular = chosen.shade(n, self.view, lobe, coefficients, self.traced)
        residual = form_image(0.0, mi.Color3f(red, green, blue), white, gloss, specular) - self.target
        # The loss beside its gradient in one kernel, instead of a kernel for the sum and one that shades again.
        loss = dr.zeros(mi.Float, 1)
        value = dr.squared_norm(dr.detach(mi.Vector3f(residual))) / (3 * self.count)
        dr.scatter_reduce(dr.ReduceOp.Add, loss, value, dr.zeros(mi.UInt32, self.count), mode=dr.ReduceMode.Expand)
        dr.set_grad(residual, dr.detach(residual) * (2.0 / (3 * self.count)))
        dr.enqueue(dr.ADMode.Backward, residual)
        dr.traverse(dr.ADMode.Backward)
        gradients = [dr.grad(p) for p in parameters]
        dr.eval(gradients, loss)
        dr.sync_thread()
        dr.disable_grad(parameters)
        return [np.array(g) for g in gradients] + [np.array(loss)]


def rendered(
    views: list[Camera], mesh: tuple, size: int, light: np.ndarray, integrator: dict[str, object], spp: int
) -> Callable[[], object]:
    """The same iteration through ``mi.render`` with an integrator."""
    import drjit as dr
    import mitsuba as mi

    from mifit.render.gbuffer import make_mesh
    from mifit.render.sensor import make_sensor

    vertices, faces, uv, faces_uv = mesh
    # One vertex per corner pair of position and UV, as Mitsuba's meshes have it.
    pairs, index = np.unique(np.stack([faces.ravel(), faces_uv.ravel()], 1), axis=0, return_inverse=True)
    smooth = vertex_normals(vertices, faces)
    rng = np.random.default_rng(0)

    def bitmap(low: float, high: float, channels: int) -> dict:
        pixels = rng.uniform(low, high, (size, size, channels)).astype(np.float32)
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "format": "variant"}

    bsdf = {
        "type": "blinnphong",
        "diffuse_reflectance": bitmap(0.3, 0.6, 3),
        "specular_reflectance": bitmap(0.3, 0.6, 1),
        "exponent": EXPONENT,
        "normal_correction": bitmap(-0.1, 0.1, 3),
    }
    surface = make_mesh(
        vertices[pairs[:, 0]],
        index.reshape(-1, 3),
        uv[pairs[:, 1]],
        smooth[pairs[:, 0]],
        mi.load_dict(bsdf),
    )
    emitter = {"type": "shenv", "coefficients": mi.TensorXf(light.astype(np.float32))}
    scene = mifit.load_scene({"type": "scene", "mesh": surface, "light": emitter})
    sensors = [make_sensor(camera, spp) for camera in views]
    chosen = mi.load_dict({**integrator, "hide_emitters": True})
    parameters = mi.traverse(scene)
    keys = [k for k in parameters.keys() if k.endswith(("reflectance.data", "correction.data", "coefficients"))]
    assert len(keys) == 4, keys
    # A film with alpha gives images of four channels. Weighing the fourth by nothing costs a pass; image[..., :3] would
    # cost a scatter in the gradient, an eighth of the iteration.
    colour = mi.TensorXf(np.array([1.0, 1.0, 1.0, 0.0], np.float32).reshape(1, 1, 4) / 0.75)

    def run() -> None:
        for key in keys:
            dr.enable_grad(parameters[key])
            dr.set_grad(parameters[key], 0.0)
        parameters.update()
        for seed, sensor in enumerate(sensors):
            image = mi.render(scene, parameters, sensor=sensor, integrator=chosen, spp=spp, seed=seed)
            dr.backward(dr.mean(colour * dr.square(image - 0.5), axis=None))
        dr.eval([dr.grad(parameters[key]) for key in keys])
        dr.sync_thread()

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="images and maps of half the side, two views")
    quick = parser.parse_args().quick
    variant = mifit.set_variant("auto")
    mifit.register_plugins()
    count, width, height, size = (2, 340, 240, 256) if quick else (8, 680, 480, 512)
    name, *mesh = head()
    views = cameras(count, width, height)
    light = 0.1 * np.random.default_rng(0).normal(size=(ORDER * ORDER, 3))
    light[0] = 3.0
    cached = Cached(views, tuple(mesh), size, light)
    sorted_gradients, scattered_gradients = cached.iterate(), cached.iterate(scattered=True)
    agreement = max(
        float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(sorted_gradients, scattered_gradients, strict=True)
    )
    seconds = {
        model: median_seconds(lambda m=model: cached.iterate(m), 9) for model in ("paper", "prefiltered", "shadowed")
    }
    seconds["prefiltered, scattered gradients"] = median_seconds(lambda: cached.iterate(scattered=True), 9)
    closed = rendered(views, tuple(mesh), size, light, {"type": "shdirect"}, 1)
    seconds["mi.render, shdirect"] = median_seconds(closed, 9)
    replay = rendered(views, tuple(mesh), size, light, {"type": "prb", "max_depth": 2}, 4)
    seconds["prb, 4 spp"] = median_seconds(replay, 2 if not quick else 1)
    seconds["mi.render, shdirect, again"] = median_seconds(closed, 9)
    again = {
        model: median_seconds(lambda m=model: cached.iterate(m), 9) for model in ("paper", "prefiltered", "shadowed")
    }
    # Measured on both sides of the long reference, so that a change of load on the machine shows.
    both = {model: 0.5 * (seconds[model] + again[model]) for model in again}
    figures = {
        "variant": variant,
        "geometry": name,
        "images": f"{count} of {width} x {height}",
        "maps": f"{size} x {size}: diffuse 3, specular 1, normal correction 2 channels",
        "points": cached.count,
        "seconds": {**seconds, **{f"{model}, again": value for model, value in again.items()}},
        "ratios": {
            "prb over mi.render with shdirect": 2.0
            * seconds["prb, 4 spp"]
            / (seconds["mi.render, shdirect"] + seconds["mi.render, shdirect, again"]),
            "prb over prefiltered": seconds["prb, 4 spp"] / both["prefiltered"],
            "prb over paper": seconds["prb, 4 spp"] / both["paper"],
            "prb over shadowed": seconds["prb, 4 spp"] / both["shadowed"],
            "shadowed over paper": both["shadowed"] / both["paper"],
            "scattered over sorted": seconds["prefiltered, scattered gradients"] / both["prefiltered"],
        },
        "largest relative difference of sorted and scattered gradients": agreement,
    }
    path = record("shading_speed" if not quick else "shading_speed_quick", figures)
    for key, value in figures["ratios"].items():
        print(f"{key:28s} {value:.2f}")
    print(path)


if __name__ == "__main__":
    main()
