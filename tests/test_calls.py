"""Public functions and what callers get wrong: mifit's own errors, or what Python itself says of a wrong type or value."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mifit
from mifit.errors import MifitError
from tests.hostile.cases import make_base

NAN, ONES = float("nan"), np.ones((16, 32, 3), np.float32)
PATHS = ("nothing", None, 3, "", b"x", "a\0b", "/proc/none")
VECTORS = ("x", None, np.zeros(2), np.zeros((2, 2)), {}, object())
NUMBERS = ("x", None, NAN, -1, 1e400, [])
MATRICES = ("x", None, np.eye(2), np.zeros((3, 3)), np.full((3, 3), NAN), {}, 3)
PAIR = ["left", "right"]
EYE = np.eye(4)
Call = Callable[[SimpleNamespace], Any]
CALLS: dict[str, list[Call]] = {}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, variant: str) -> SimpleNamespace:
    """A capture, a model, a result and lights that are sound."""
    folder = make_base(tmp_path_factory.mktemp("calls") / "base")
    result = mifit.Reconstruction.load(folder / "result")
    light = mifit.DistantLight(np.array([0.0, 0, 1]), 0.1, np.ones(3))
    return SimpleNamespace(
        folder=folder,
        capture=mifit.Capture.load(folder / "capture"),
        result=result,
        geometry=result.geometry,
        reflectance=result.reflectance,
        normals=result.normals,
        model=mifit.MorphableModel.load(folder / "ball.npz"),
        coarse=mifit.MorphableModel.load("builtin:coarse"),
        camera=result.cameras[0],
        light=light,
        lighting=mifit.Illumination.dark(3, [light]),
        sh=mifit.SHLighting(np.ones((9, 3))),
    )


def add(name: str, call: Callable[..., Any], *values: Any, **options: tuple) -> None:
    """Calls with each of the values, and with each option in turn out of its range."""
    calls = CALLS.setdefault(name, [])
    calls += [lambda m, v=v: call(m, v) for v in values]
    calls += [lambda m, k=k, v=v: call(m, **{k: v}) for k, bad in options.items() for v in bad]


def stage(name: str, *given: str, **fixed: Any) -> None:
    """A stage with arguments of other classes, of another model, of unknown cameras."""

    def call(m: SimpleNamespace, **bad: Any) -> Any:
        parts = {key: getattr(m, key) for key in ("capture", "model", *given)}
        return getattr(mifit, name)(**{**parts, "cameras": PAIR, **fixed, **bad})

    add(name, call, capture=(None, 3), model=(None, "x"), cameras=(3, ["x"], [["left"]]), config=(3, "x"))
    add(name, call, **dict.fromkeys(given, (3, "x")))
    add(name, lambda m, _: call(m, model=m.coarse), *(["another model"] if "geometry" in given else []))
    if "timesteps" in fixed:
        add(name, call, timesteps=([99], 3, ["0"]), seed=("x", -1, 1.5))


add("Capture.load", lambda m, v: mifit.Capture.load(v), *PATHS)
add("Capture.camera", lambda m, v: m.capture.camera(v), "nobody", None, 3, [], {})
add("Capture.stored_camera", lambda m, v: m.capture.stored_camera(v), "nobody", None, [])
add(
    "Capture.frame",
    lambda m, v: m.capture.frame(*v),
    ("left", 9),
    ("x", 0),
    ("left", "0"),
    ("left", None),
    ([], 0),
    ("left", NAN),
)
add("Capture.landmarks", lambda m, v: m.capture.landmarks(*v), ("left", 9), ("left", []), (None, 0))
add("Capture.digest", lambda m, v: m.capture.digest(*v), (["x"],), (["left"], [9]), ("left",), (3,), (["left"], 3))
add("Capture.with_estimate", lambda m, v: m.capture.with_estimate(v), [3], None)
add("Capture.with_photometry", lambda m, v: m.capture.with_photometry(v), 3, None)
add("MorphableModel.load", lambda m, v: mifit.MorphableModel.load(v), *PATHS, "builtin:x")
add("MorphableModel.load", lambda m, v: mifit.MorphableModel.load(m.folder / "ball.npz", kind=v), "x", 3)
add("MorphableModel.shape", lambda m, v: m.coarse.shape(v), "x", {}, [NAN], [1e400], np.zeros(999), np.zeros((2, 2)), 3)
add("MorphableModel.albedo", lambda m, v: m.coarse.albedo(v), "x", {}, [NAN], np.zeros(999), np.zeros((2, 2)))
add("MorphableModel.sample", lambda m, **k: m.coarse.sample(**k), seed=("x", -1, 1.5), scale=("x", NAN, 1e400))
add(
    "MorphableModel.subset",
    lambda m, **k: m.coarse.subset(**k),
    identity=("x", -1, 1.5),
    region=("x", np.zeros(3, bool), 3),
)
add("MorphableModel.save", lambda m, v: m.coarse.save(v), None, 3, "/proc/none/x.npz", "x.txt", "", "a\0b")
add(
    "Camera",
    lambda m, **k: mifit.Camera(
        **{
            "name": "a",
            "width": 9,
            "height": 9,
            "fx": 1.0,
            "fy": 1.0,
            "cx": 4.5,
            "cy": 4.5,
            "world_to_camera": EYE,
            **k,
        }
    ),
    width=(0, -1, 9.5, "x", None),
    fx=NUMBERS,
    cx=("x", None, NAN, 1e400),
    distortion=("x", 3, [NAN]),
    world_to_camera=("x", None, np.eye(3), np.zeros((4, 4)), np.full((4, 4), NAN), 2 * EYE),
)
add(
    "Camera.look_at",
    lambda m, **k: mifit.Camera.look_at(**{"eye": (0, 0, 1), **k}),
    eye=(*VECTORS, (0, 0, 0), (0, 1, 0), (0, 0, NAN)),
    up=(*VECTORS, (0, 0, 0)),
    fov=(0, 180, *NUMBERS),
    width=(0, "x", 1.5),
)
add(
    "Camera.orbit",
    lambda m, **k: m.camera.orbit(**k),
    yaw=("x", None, NAN, 1e400),
    distance=(0, -1, NAN, "x", 1e400),
    target=VECTORS,
    up=(*VECTORS, (0, 0, 0)),
)
add("Camera.resized", lambda m, v: m.camera.resized(v), 0, *NUMBERS, 1e9)
add("Camera.project", lambda m, v: m.camera.project(v), *VECTORS)
add("Camera.to_camera", lambda m, v: m.camera.to_camera(v), *VECTORS)
add("Camera.pixel_rays", lambda m, v: m.camera.pixel_rays(v), "x", None, np.zeros(3), np.zeros((2, 3)), {})
add("SHLighting", lambda m, v: mifit.SHLighting(v), *VECTORS, np.zeros((8, 3)), np.full((9, 3), NAN), np.zeros((0, 3)))
add(
    "SHLighting.from_envmap",
    lambda m, v: mifit.SHLighting.from_envmap(v),
    *PATHS,
    np.ones((16, 16, 3)),
    ONES[..., :2],
    NAN * ONES,
)
add("SHLighting.from_envmap", lambda m, v: mifit.SHLighting.from_envmap(ONES, v), 0, -1, "x", 1.5, 1000, None, NAN)
add("SHLighting.evaluate", lambda m, v: m.sh.evaluate(v), *VECTORS)
add("SHLighting.irradiance", lambda m, v: m.sh.irradiance(v), *VECTORS)
add("SHLighting.rotate", lambda m, v: m.sh.rotate(v), *MATRICES, np.diag([1.0, 1, -1]))
add("SHLighting.truncate", lambda m, v: m.sh.truncate(v), 0, -1, "x", 1.5, None)
add(
    "SHLighting.to_latlong",
    lambda m, v: m.sh.to_latlong(*v),
    (0, 0),
    (-1, 2),
    ("x", 2),
    (1.5, 3),
    (None, None),
    (10**7, 10**7),
)
add("Illumination", lambda m, v: mifit.Illumination(v), "x", None, np.zeros((8, 3)), np.zeros(3))
add("Illumination.dark", lambda m, v: mifit.Illumination.dark(v), 0, -1, "x", None, 1.5)
add("Illumination.rotated", lambda m, v: m.lighting.rotated(v), *MATRICES)
add("Illumination.scaled", lambda m, v: m.lighting.scaled(v), "x", None, NAN, [1, 2], {})
add("Illumination.with_unknowns", lambda m, v: m.lighting.with_unknowns(v), "x", None, np.zeros(3), {})
add(
    "DistantLight",
    lambda m, **k: mifit.DistantLight(**{"direction": np.array([0.0, 0, 1]), "radius": 0.1, "colour": np.ones(3), **k}),
    direction=(*VECTORS, np.zeros(3), [NAN] * 3),
    radius=("x", None, NAN, -1, 4.0),
    colour=(*VECTORS, [NAN] * 3),
)
add("DistantLight.samples", lambda m, v: m.light.samples(v), 0, -1, "x", None, 1.5)
add("DistantLight.with_colour", lambda m, v: m.light.with_colour(v), *VECTORS)
add("DistantLight.rotated", lambda m, v: m.light.rotated(v), *MATRICES)
add("DistantLight.coefficients", lambda m, v: m.light.coefficients(v), 0, "x", None)
add("FitConfig.load", lambda m, v: mifit.FitConfig.load(v), *PATHS)
add(
    "FitConfig",
    lambda m, **k: mifit.FitConfig(**k),
    nothing=(1,),
    geometry=(3,),
    surface=(3,),
    reflectance=(3,),
    normals=(None,),
)
for config in ("GeometryConfig", "SurfaceConfig", "ReflectanceConfig", "NormalsConfig", "MeshConfig", "ResidualConfig"):
    fields = dict.fromkeys((f.name for f in dataclasses.fields(getattr(mifit, config))), ("\0x", [], -1e300, object()))
    add(config, lambda m, config=config, **k: getattr(mifit, config)(**k), nothing=(1,), **fields)
add("set_variant", lambda m, v: mifit.set_variant(v), "x", "", None, 3, [])
add("load_scene", lambda m, v: mifit.load_scene(v), *PATHS, {"type": "x"}, {"type": 3}, [])
stage("fit", timesteps=[0])
add(
    "fit",
    lambda m, **k: mifit.fit(m.capture, m.model, PAIR, [0], **k),
    until=("x", None),
    checkpoints=(3,),
    progress=(3,),
)
add("fit", lambda m, v: mifit.fit(m.capture, m.model, v), [], "left")
stage("fit_geometry", timesteps=[0])
stage("find_surface", "geometry")
stage("refine_surface", "geometry")
stage("infer_reflectance", "geometry")
stage("refine_normals", "geometry", "reflectance", config=mifit.NormalsConfig())
stage("find_residual", "geometry", "reflectance")
add(
    "refine_mesh",
    lambda m, **k: mifit.refine_mesh(**{"model": m.model, "geometry": m.geometry, "normals": m.normals, **k}),
    model=(None,),
    geometry=(None,),
    normals=(None,),
    config=(3,),
)
add(
    "track",
    lambda m, **k: list(
        mifit.track(
            **{
                "capture": m.capture,
                "model": m.model,
                "geometry": m.geometry,
                "reflectance": m.reflectance,
                "normals": m.normals,
                "cameras": PAIR,
                "timesteps": [1],
                **k,
            }
        )
    ),
    capture=(None,),
    model=(None,),
    geometry=(None,),
    reflectance=(None,),
    cameras=([], 3, ["x"]),
    timesteps=([99], 3),
    config=(3,),
)
add(
    "refine",
    lambda m, **k: mifit.refine(**{"result": m.result, "capture": m.capture, **k}),
    result=(None,),
    capture=(None,),
    timesteps=([99], 3, "x"),
)
add(
    "choose_frames",
    lambda m, **k: mifit.choose_frames(**{"capture": m.capture, "cameras": PAIR, "count": 1, **k}),
    capture=(None,),
    cameras=([], 3, ["x"]),
    count=(0, -1, "x", 1.5, None),
    timesteps=([], [99]),
)
add("Reconstruction.load", lambda m, v: mifit.Reconstruction.load(v), *PATHS)
add("Reconstruction.load", lambda m, _: mifit.Reconstruction.load(m.folder / "result", m.coarse), "another model")
add("Reconstruction.save", lambda m, v: m.result.save(v), None, 3, "/proc/none", "a\0b")
add("Reconstruction.save", lambda m, v: m.result.save(m.folder / v), "capture", "ball.npz")
add(
    "Reconstruction.render",
    lambda m, **k: m.result.render(**{"camera": m.camera, **k}),
    camera=(None, "left"),
    timestep=(99, "x", None, []),
    method=("x", None),
    integrator=("x",),
    samples=(0, -1, "x", 1.5),
)
add(
    "Reconstruction.scene",
    lambda m, **k: m.result.scene(**k),
    integrator=("x", 3, {"type": "x"}),
    timestep=(99, "x"),
    cameras=([3], 3),
    method=("x",),
    samples=(0, "x"),
)
add(
    "Reconstruction.orbit",
    lambda m, **k: m.result.orbit(**k),
    yaw=("x", NAN),
    distance=(0, -1, "x", NAN),
    timestep=(99, "x"),
)
add("Reconstruction.relight", lambda m, v: m.result.relight(v), *PATHS, {}, [], np.ones((8, 8, 3)), NAN * ONES)
add(
    "Reconstruction.relight",
    lambda m, **k: m.result.relight(ONES, **k),
    rotate=("x", NAN, np.eye(2), 2 * np.eye(3)),
    exposure=("x", -1, NAN, None),
    rotations=(3, ["x"]),
)
add(
    "evaluate",
    lambda m, **k: mifit.evaluate(**{"result": m.result, "capture": m.capture, "camera": "left", **k}),
    result=(None,),
    capture=(None,),
    camera=("x", None, []),
    timesteps=([], [99], 3, ["0"]),
    region=("x",),
)
add(
    "export",
    lambda m, **k: mifit.export(**{"result": m.result, "format": "obj", "path": m.folder / "a.obj", **k}),
    result=(None,),
    format=("x", None, []),
    path=(None, 3, "", "a.txt", "/proc/none/x.obj"),
    timestep=(99, "x"),
    mesh=("x",),
    animate=(True,),
    fps=(0, NAN, "x"),
    units=("x",),
)
add(
    "synthesize",
    lambda m, **k: mifit.synthesize(
        **{"out": m.folder / "new", "width": 32, "height": 32, "spp": 1, "model": str(m.folder / "ball.npz"), **k}
    ),
    out=(None, 3, "/proc/none"),
    subjects=(0, "x"),
    timesteps=(0, None),
    env=("nothing.hdr", 3),
    model=("nothing", 3),
    width=(0, "x", 32.5),
    height=(-1,),
    spp=(0, "x"),
    tone=(5.0, "x"),
    outside=(NAN, "x", -1),
    landmark_bias=(NAN,),
    seed=(-1, "x"),
)
add("linear_to_srgb", lambda m, v: mifit.linear_to_srgb(v), "x", {}, [[1], [2, 3]], object())
add("srgb_to_linear", lambda m, v: mifit.srgb_to_linear(v), "x", {}, [[1], [2, 3]], object())


def test_every_public_name_is_tried():
    functions = {name for name in mifit.__all__ if callable(getattr(mifit, name)) and not name.endswith("Error")}
    assert {name.split(".")[0] for name in CALLS} == functions - {"register_plugins"}


@pytest.mark.parametrize("name", CALLS)
def test_bad_arguments_are_refused_in_words(name: str, made: SimpleNamespace, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number, call in enumerate(CALLS[name]):
        start = time.process_time()
        try:
            found = call(made)
        except (MifitError, TypeError, ValueError, OSError) as error:
            assert "\n" not in str(error) or not isinstance(error, MifitError)
        except Exception as error:
            raise AssertionError(f"{name}, call {number}: {type(error).__name__}: {error}") from error
        else:
            raise AssertionError(f"{name}, call {number}: accepted, {found!r:.80}")
        assert time.process_time() - start < 3  # it is told, not fitted
    assert not list(tmp_path.iterdir())


BEFORE = (
    "mifit.fit(capture, model)",
    "mifit.register_plugins()",
    "mifit.load_scene({'type': 'scene'})",
    "mifit.synthesize('out')",
    "result.render(result.cameras[0])",
    "result.scene()",
)
"""What needs a variant."""


@pytest.fixture(scope="module")
def said_before(made: SimpleNamespace) -> dict[str, str]:
    """What a process without a variant says of each call."""
    program = (
        "import json, mifit\ncapture = mifit.Capture.load('capture')\n"
        "model = mifit.MorphableModel.load('builtin:coarse')\nresult = mifit.Reconstruction.load('result')\nsaid = {}\n"
    )
    for call in BEFORE:
        program += f"try:\n    {call}\nexcept mifit.VariantError as error:\n    said[{call!r}] = str(error)\n"
    program += "print(json.dumps(said))"
    done = subprocess.run([sys.executable, "-c", program], cwd=made.folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    return json.loads(done.stdout)


@pytest.mark.parametrize("call", BEFORE)
def test_before_a_variant_is_set_the_error_says_so(call: str, said_before: dict[str, str]) -> None:
    assert "set_variant" in said_before[call]
