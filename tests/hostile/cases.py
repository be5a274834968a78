"""What the attack suite throws at mifit: for every reader and command, inputs that are damaged or made to harm."""

from __future__ import annotations

import copy
import json
import os
import pickle
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from mifit.capture.stereo import write_stereo
from mifit.core.image import encode_png, write_image
from mifit.morphable import MorphableModel
from tests.extras import photogrammetry as exports
from tests.extras.photogrammetry import write_colmap
from tests.morphable import layouts
from tests.output.conftest import ball_camera, ball_result

SIZE = 64


@dataclass(frozen=True)
class Case:
    """One command line and what is done to its inputs first.

    Attributes
    ----------
    arguments : tuple of str
        Of ``mifit``, run in the working folder.
    needs : tuple of str
        Files and folders of the base that are copied there.
    prepare : callable
        Gets the working folder.
    may_pass : bool
        Whether exit code 0 is right too: the change may leave the input sound.
    output : str
        Where a command that passes may write, relative to the working folder.
    """

    name: str
    arguments: tuple[str, ...]
    needs: tuple[str, ...] = ()
    prepare: Callable[[Path], None] = field(default=lambda work: None, repr=False)
    may_pass: bool = False
    output: str = "out"

    @property
    def group(self) -> str:
        """First part of the name."""
        return self.name.split(":")[0]

    def writes(self, name: str) -> bool:
        """Whether a file may be new after success."""
        return name.split(os.sep)[0].startswith(self.output)


def make_base(folder: Path) -> Path:
    """One sound input of every kind."""
    rng = np.random.default_rng(0)
    capture = folder / "capture"
    frames = []
    for name, angle in (("left", -15.0), ("right", 15.0)):
        camera = ball_camera(name, angle, SIZE)
        for t in range(2):
            write_image(capture / "images" / name / f"{t:04d}.png", rng.random((SIZE, SIZE, 3)))
            marks = capture / "landmarks" / name / f"{t:04d}.json"
            marks.parent.mkdir(parents=True, exist_ok=True)
            points = rng.uniform(10, SIZE - 10, (68, 2)).tolist()
            marks.write_text(json.dumps({"convention": "ibug68", "points": points, "visible": [True] * 68}))
            frames.append(
                {
                    "file_path": f"images/{name}/{t:04d}.png", "landmark_path": f"landmarks/{name}/{t:04d}.json",
                    "mask_path": "mask.png", "camera_id": name, "timestep_index": t, "w": SIZE, "h": SIZE,
                    "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "k1": 0.01, "k2": 0.0,
                    "p1": 0.0, "p2": 0.0, "transform_matrix": camera.camera_to_world_opengl.tolist(),
                    "gain": [1.0, 1.0, 1.0],
                }
            )  # fmt: skip
    write_image(capture / "mask.png", np.ones((SIZE, SIZE)))
    document = {"camera_model": "OPENCV", "units": "cm", "frames": frames}
    (capture / "transforms.json").write_text(json.dumps(document))
    result = ball_result()

    result.model.save(folder / "ball.npz")
    from dataclasses import replace

    replace(result, model_source=str(folder / "ball.npz")).save(folder / "result")
    cameras = [ball_camera(n, a, SIZE) for n, a in (("left", -15.0), ("right", 15.0))]
    write_stereo(folder / "stereo.yml", *cameras)
    for name in ("left", "right"):
        shutil.copytree(capture / "images" / name, folder / "pictures" / name)
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (SIZE, SIZE))
        for _ in range(5):
            writer.write((rng.random((SIZE, SIZE, 3)) * 255).astype(np.uint8))
        writer.release()
        shutil.copytree(capture / "images" / name, folder / "colmap" / "images" / name)
    write_colmap(folder / "colmap", [(c, f"{c.name}/{t:04d}.png") for c in cameras for t in range(2)])
    write_image(folder / "env.hdr", rng.random((16, 32, 3)) + 0.1)
    write_image(folder / "env.exr", rng.random((16, 32, 3)) + 0.1)
    (folder / "fit.toml").write_text("[reflectance]\ntexture_size = 64\n")
    (folder / "experiment.toml").write_text(
        'name = "e"\n[fit]\ncapture = "capture"\nmodel = "builtin:coarse"\n[sweep.grid]\n"fit.seed" = [0, 1]\n'
    )
    small = MorphableModel.load("builtin:coarse").subset(identity=3, expression=slice(4, 6), albedo=2)
    models = folder / "models"
    models.mkdir()
    layouts.write_bfm2009(models / "bfm.mat", small)
    layouts.write_bfm2009(models / "packed.mat", small, compress=True)
    layouts.write_bfm_h5(models / "bfm.h5", small)
    layouts.write_flame_pickle(models / "flame.pkl", small)
    layouts.write_flame_npz(models / "flame.npz", small)
    layouts.write_eos(models / "eos.bin", small, 4)
    small.save(models / "own.npz")
    return folder


def all_cases(base: Path) -> Iterator[Case]:
    """Every case; the order is the same in every run."""
    for group in (
        places, numbers, words, transforms, documents, images, landmarks, calibrations, colmap, photogrammetry,
        videos, models, results, result_files, experiments, names, links, planted, outputs, extremes, colours, shapes,
    ):  # fmt: skip
        yield from group(base)


# -- what a path may lead to ----------------------------------------------------------------------------------------


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _sparse(path: Path) -> None:
    with path.open("wb") as f:
        f.truncate(1 << 42)


KINDS: dict[str, Callable[[Path], None]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b"") and None,
    "folder": lambda path: path.mkdir(),
    "pipe": _pipe,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "sparse": _sparse,
    "text": lambda path: path.write_text("this is nothing of the kind\n") and None,
    "noise": lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000)) and None,
    "loop": lambda path: path.symlink_to(path.name),
    "zip": lambda path: path.write_bytes(b"PK\x05\x06" + bytes(18)) and None,
}

COMMANDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "fit capture": (("fit", "X", "--out", "out"), ()),
    "fit config": (("fit", "capture", "--out", "out", "--config", "X"), ("capture",)),
    "fit model": (("fit", "capture", "--out", "out", "--model", "X"), ("capture",)),
    "track capture": (("track", "X", "--result", "result"), ("result",)),
    "track result": (("track", "capture", "--result", "X"), ("capture",)),
    "evaluate result": (("evaluate", "X", "--capture", "capture", "--camera", "left", "--fitted"), ("capture",)),
    "evaluate capture": (("evaluate", "result", "--capture", "X", "--camera", "left", "--fitted"), ("result",)),
    "render result": (
        ("render", "X", "--capture", "capture", "--camera", "left", "--timestep", "0", "--out", "out.png"), ("capture",)
    ),
    "render capture": (
        ("render", "result", "--capture", "X", "--camera", "left", "--timestep", "0", "--out", "out.png"), ("result",)
    ),
    "turntable": (("turntable", "X", "--out", "out"), ()),
    "relight result": (("relight", "X", "--env", "env.hdr", "--out", "out"), ("env.hdr",)),
    "relight env": (("relight", "result", "--env", "X", "--out", "out"), ("result",)),
    "export": (("export", "X", "--format", "ply", "--out", "out.ply"), ()),
    "run": (("run", "X", "--out", "out"), ()),
    "model info": (("model", "info", "X"), ()),
    "model convert": (("model", "convert", "X", "out.npz"), ()),
    "landmarks": (("landmarks", "X"), ()),
    "synth env": (("synth", "--out", "out", "--env", "X", "--width", "32", "--height", "32"), ()),
    "synth model": (("synth", "--out", "out", "--model", "X", "--width", "32", "--height", "32"), ()),
    "import video": (("import", "--video", "X", "--video", "left.avi", "--out", "out"), ("left.avi",)),
    "import images": (("import", "--images", "X", "--out", "out"), ()),
    "import calibration": (
        ("import", "--images", "pictures/left", "--images", "pictures/right", "--calibration", "X", "--out", "out"),
        ("pictures",),
    ),
    "import colmap": (("import", "--colmap", "X", "--out", "out"), ()),
    "import transforms": (("import", "--transforms", "X", "--out", "out"), ()),
}  # fmt: skip


def places(base: Path) -> Iterator[Case]:
    """Every path of every command leads to something else."""
    for command, (arguments, needs) in COMMANDS.items():
        for kind, make in KINDS.items():
            if (command, kind) == ("fit config", "empty"):
                continue  # sound: all settings at their defaults
            named = tuple("X.bad" if a == "X" else a for a in arguments)
            yield Case(f"places:{command}:{kind}", named, needs, lambda work, make=make: make(work / "X.bad"))
    for out in ("capture", "capture/transforms.json", "/proc/none/x", "", "env.hdr/x", "x" * 300):
        yield Case(
            f"places:import out:{out[:20]}",
            ("import", "--images", "pictures/left", "--out", out),
            ("pictures", "capture", "env.hdr"),
        )
        yield Case(
            f"places:synth out:{out[:20]}",
            ("synth", "--out", out, "--width", "32", "--height", "32"),
            ("capture", "env.hdr"),
        )
    for out in ("/proc/none/x", "", "env.hdr/x", "x" * 300 + ".npz", "capture.npz"):

        def taken(work: Path) -> None:
            (work / "capture.npz").mkdir()

        yield Case(
            f"places:convert out:{out[:20]}", ("model", "convert", "ball.npz", out), ("ball.npz", "env.hdr"), taken
        )
        yield Case(f"places:fit out:{out[:20]}", ("fit", "nothing", "--out", out), ("env.hdr",))


# -- options --------------------------------------------------------------------------------------------------------

WHOLE = ("", "nan", "-1", "1e400", "1" + "0" * 30, "abc", "0x10", "1.5", "9" * 5000)
REAL = ("", "nan", "inf", "-inf", "1e400", "abc", "--", "1,5", "9" * 5000)
OPTIONS = {
    "--seed": (WHOLE, ("turntable", "result", "--out", "out")),
    "--timesteps": ((*WHOLE, "5-1", "0-", "-", "0-999999999", ",,", "0--1"), ("fit", "capture", "--out", "out")),
    "--steps": ((*WHOLE, "0"), ("turntable", "result", "--out", "out")),
    "--fps": ((*REAL, "0", "-1"), ("export", "result", "--format", "glb", "--animate", "--out", "out.glb")),
    "--from": (REAL, ("turntable", "result", "--out", "out")),
    "--to": (REAL, ("turntable", "result", "--out", "out")),
    "--rotate": (REAL, ("relight", "result", "--env", "env.hdr", "--out", "out")),
    "--timestep": (
        (*WHOLE, "99"),
        ("render", "result", "--capture", "capture", "--camera", "left", "--out", "out.png"),
    ),
    "--every": ((*WHOLE, "0"), ("import", "--images", "pictures/left", "--out", "out")),
    "--start": ((*WHOLE, "99"), ("import", "--images", "pictures/left", "--out", "out")),
    "--count": ((*WHOLE, "0"), ("import", "--images", "pictures/left", "--out", "out")),
    "--width": ((*WHOLE, "0", "15", "20000000"), ("synth", "--out", "out")),
    "--height": ((*WHOLE, "0", "15", "20000000"), ("synth", "--out", "out")),
    "--spp": ((*WHOLE, "0"), ("synth", "--out", "out")),
    "--subjects": ((*WHOLE, "0"), ("synth", "--out", "out")),
    "--tone": ((*REAL, "2", "-1"), ("synth", "--out", "out")),
}


def numbers(base: Path) -> Iterator[Case]:
    """Every number of every command out of its range or no number."""
    needs = ("result", "capture", "pictures", "env.hdr")
    for option, (values, command) in OPTIONS.items():
        for value in values:
            used = tuple(n for n in needs if n in command)
            used += ("pictures",) if "pictures/left" in command else ()
            yield Case(f"numbers:{option}:{value[:12]}", (*command, f"{option}={value}"), used)
    yield Case("numbers:synth:20000", ("synth", "--out", "out", "--width", "20000", "--height", "20000"))


def words(base: Path) -> Iterator[Case]:
    """Names that don't exist, are empty, or are made of control characters."""
    odd = ("", "nothing", "\x1b[31m", "../../x", "a" * 5000, "\u202e", "None")
    for value in odd:
        yield Case(
            f"words:variant:{value[:8]!r}", ("turntable", "result", "--out", "out", f"--variant={value}"), ("result",)
        )
        yield Case(
            f"words:units:{value[:8]!r}",
            ("import", "--images", "pictures/left", "--out", "out", f"--units={value}"),
            ("pictures",),
        )
        yield Case(
            f"words:kind:{value[:8]!r}",
            ("model", "convert", "ball.npz", "out.npz", f"--kind={value or '?'}"),
            ("ball.npz",),
        )
        yield Case(
            f"words:camera:{value[:8]!r}",
            ("evaluate", "result", "--capture", "capture", f"--camera={value}"),
            ("result", "capture"),
        )
        yield Case(
            f"words:cameras:{value[:8]!r}", ("fit", "capture", "--out", "out", f"--cameras={value}"), ("capture",)
        )
        yield Case(
            f"words:detector:{value[:8]!r}", ("landmarks", "capture", f"--detector={value or '?'}"), ("capture",)
        )
        yield Case(
            f"words:format:{value[:8]!r}", ("export", "result", f"--format={value}", "--out", "out.x"), ("result",)
        )
        yield Case(
            f"words:set:{value[:8]!r}",
            ("run", "experiment.toml", "--out", "out", "--set", value),
            ("experiment.toml", "capture"),
        )
        yield Case(f"words:command:{value[:8]!r}", (value,))
    for suffix in ("", ".gif", ".exr.exe", ".mp4"):
        yield Case(
            f"words:render out:{suffix}",
            (
                "render",
                "result",
                "--capture",
                "capture",
                "--camera",
                "left",
                "--timestep",
                "99",
                "--out",
                f"out{suffix}",
            ),
            ("result", "capture"),
        )


# -- documents ------------------------------------------------------------------------------------------------------

HUGE = 10**400
NASTY: tuple[Any, ...] = (
    None, True, -1, 0, 1.5, 2**63, HUGE, -HUGE, 1e308, "", " ", "..", "/", "/dev/zero", "a\0b", "\ud800", "x" * 5000, [], {},
    [[]], [None], {"a": 1}, [[1e308] * 4] * 4, [[float("nan")] * 4] * 4, float("nan"), float("inf"),
)  # fmt: skip


def _edit(document: Any, keys: tuple, value: Any) -> Any:
    out = copy.deepcopy(document)
    place = out
    for key in keys[:-1]:
        place = place[key]
    if value is _REMOVED:
        del place[keys[-1]]
    else:
        place[keys[-1]] = value
    return out


_REMOVED = object()


def _write_json(path: Path, document: Any) -> None:
    path.write_text(json.dumps(document))


def transforms(base: Path) -> Iterator[Case]:
    """Every key of a capture with values that belong nowhere; what an image of one camera says must fit the others."""
    document = json.loads((base / "capture" / "transforms.json").read_text())
    command = ("import", "--transforms", "capture/transforms.json", "--out", "out")
    for key in (*document["frames"][0], "camera_model", "units", "frames"):
        place: tuple = (key,) if key in document else ("frames", 0, key)
        for i, value in enumerate((*NASTY, _REMOVED)):
            changed = _edit(document, place, value)
            sound = value is None or value is _REMOVED or key in ("camera_id", "gain", "timestep_index", "mask_path")
            sound |= key in ("k1", "k2", "p1", "p2", "cx", "cy", "landmark_path", "fl_x", "fl_y", "w", "h")
            yield Case(
                f"transforms:{key}:{i}",
                command,
                ("capture",),
                lambda work, d=changed: _write_json(work / "capture" / "transforms.json", d),
                may_pass=sound and key not in ("file_path", "frames"),
            )


TEXTS = {
    "nested": "[" * 200_000,
    "digits": "9" * 100_000,
    "unclosed": '{"frames": [{"a": ',
    "latin1": b"\xff\xfe\xe9",
    "null": b"\0" * 1000,
    "list": "[1, 2, 3]",
    "number": "7",
    "empty object": "{}",
}


def documents(base: Path) -> Iterator[Case]:
    """JSON and TOML files that are none."""
    for name, text in TEXTS.items():
        data = text.encode() if isinstance(text, str) else text
        for file, arguments, needs in (
            ("capture/transforms.json", ("fit", "capture", "--out", "out"), ("capture",)),
            ("result/result.json", ("turntable", "result", "--out", "out"), ("result",)),
            (
                "capture/landmarks/left/0000.json",
                ("import", "--transforms", "capture/transforms.json", "--out", "out"),
                ("capture",),
            ),
            ("fit.toml", ("fit", "capture", "--out", "out", "--config", "fit.toml"), ("capture", "fit.toml")),
            ("experiment.toml", ("run", "experiment.toml", "--out", "out"), ("capture", "experiment.toml")),
        ):
            if file.endswith("toml") and name == "list":
                continue  # a table's head
            yield Case(
                f"documents:{file}:{name}",
                arguments,
                needs,
                lambda work, f=file, d=data: (work / f).write_bytes(d) and None,
            )
    for key, value in (
        ("texture_size", 10**9), ("texture_size", -1), ("texture_size", '"x"'), ("texture_size", "[]"), ("nothing", 1),
        ("bands", 99), ("exponent", -1), ("exponent", "nan"), ("exponent", "inf"), ("shading", '"x"'), ("exponent", "{}"),
    ):  # fmt: skip
        text = f"[reflectance]\n{key} = {value}\n"
        yield Case(
            f"documents:settings:{key}:{value}",
            ("fit", "capture", "--out", "out", "--config", "fit.toml"),
            ("capture", "fit.toml"),
            lambda work, t=text: (work / "fit.toml").write_text(t) and None,
        )


# -- pixels ---------------------------------------------------------------------------------------------------------


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, bits: int, data: bytes) -> bytes:
    """A PNG file with any claims."""
    header = struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def image_files(base: Path) -> dict[str, bytes]:
    """A sound image of every kind."""
    codes = (np.random.default_rng(0).random((SIZE, SIZE, 3)) * 255).astype(np.uint8)
    wide = codes.astype(np.uint16) * 257
    encoded = {
        name: cv2.imencode(suffix, image)[1].tobytes()
        for name, suffix, image in (
            ("jpg", ".jpg", codes), ("tif", ".tiff", codes), ("png16", ".png", wide), ("tif16", ".tiff", wide),
            ("hdr", ".hdr", codes.astype(np.float32) / 255),
        )
    }  # fmt: skip
    return {"png": encode_png(codes), **encoded, "exr": (base / "env.exr").read_bytes()}


def images(base: Path) -> Iterator[Case]:
    """Images cut short, with bytes changed, and with headers that claim anything."""
    command = ("import", "--images", "pictures/left", "--out", "out")

    def case(name: str, data: bytes, may_pass: bool = False) -> Case:
        def prepare(work: Path) -> None:
            (work / "pictures" / "left" / "0000.png").write_bytes(data)

        return Case(f"images:{name}", command, ("pictures",), prepare, may_pass)

    for kind, data in image_files(base).items():
        for part in (0.0, 0.01, 0.1, 0.5, 0.9, 0.99):
            loose = kind in ("jpg", "tif") or part > 0.98  # the last bytes may be padding
            yield case(f"{kind} cut at {part}", data[: int(part * len(data))], loose and part > 0.4)
        rng = np.random.default_rng(3)
        for i in range(4):
            spoilt = np.frombuffer(data, np.uint8).copy()
            spoilt[rng.integers(0, min(len(data), 300), 12)] = rng.integers(0, 256, 12)
            yield case(f"{kind} spoilt {i}", spoilt.tobytes(), True)
    zeros = zlib.compress(bytes(10_000_000))
    for name, data in {
        "png bomb": png(60_000, 60_000, 8, zeros),
        "png16 bomb": png(60_000, 60_000, 16, zeros),
        "png of no height": png(10, 0, 8, zeros),
        "png16 with bad pixels": png(SIZE, SIZE, 16, b"\x78\x9cgarbage"),
        "hdr bomb": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n" + bytes(99),
        "hdr of two sizes": b"#?RADIANCE\n# \n-Y 4 +X 4\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 30000\n" + bytes(64),
        "hdr without pixels": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8000 +X 8000\n",
        "hdr turned": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n+X 64 -Y 64\n" + bytes(9999),
        "exr of nothing": b"v/1\x01\x02\0\0\0\0",
        "exr magic": b"v/1\x01" + bytes(500),
        "tiff loop": b"II*\0\x08\0\0\0\x01\0\0\x01\x04\0\x01\0\0\0\x40\0\0\0\x08\0\0\0",
        "gif": b"GIF89a" + bytes(100),
        "svg": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
        "other size": encode_png(np.zeros((SIZE, SIZE + 1, 3), np.uint8)),
    }.items():  # fmt: skip
        yield case(name, data)


def landmarks(base: Path) -> Iterator[Case]:
    """Landmark files."""
    command = ("import", "--transforms", "capture/transforms.json", "--out", "out")
    document = json.loads((base / "capture" / "transforms.json").read_text())

    def case(name: str, suffix: str, data: bytes) -> Case:
        def prepare(work: Path) -> None:
            (work / "capture" / f"marks{suffix}").write_bytes(data)
            _write_json(
                work / "capture" / "transforms.json", _edit(document, ("frames", 0, "landmark_path"), f"marks{suffix}")
            )

        return Case(f"landmarks:{suffix}:{name}", command, ("capture",), prepare)

    points = [[i, i] for i in range(68)]
    for name, content in {
        "one point": [[9, 9]] * 68, "67": points[1:], "69": [*points, [1, 1]], "3d": [[1, 2, 3]] * 68, "text": "x", "none": [],
        "deep": [[[[1]]]] * 68, "ragged": [[1, 2], [3]] * 34, "convention": {"points": points, "convention": "x"},
        "flags": {"points": points, "visible": [True]}, "deviation": {"points": points, "deviation": -1},
        "deviation huge": {"points": points, "deviation": 1e300}, "deviation nan": {"points": points, "deviation": float("nan")}, "huge": [[HUGE, 1]] * 68, "map": {"a": 1},
    }.items():  # fmt: skip
        yield case(name, ".json", json.dumps(content).encode())
    yield case("suffix", ".xyz", b"")


# -- calibrations and videos ----------------------------------------------------------------------------------------


def calibrations(base: Path) -> Iterator[Case]:
    """OpenCV's YAML and XML."""
    command = ("import", "--images", "pictures/left", "--images", "pictures/right", "--out", "out", "--calibration")

    def case(name: str, file: str, data: str | bytes) -> Case:
        raw = data.encode() if isinstance(data, str) else data
        return Case(
            f"calibrations:{name}",
            (*command, file),
            ("pictures",),
            lambda work: (work / file).write_bytes(raw) and None,
        )

    for file in ("stereo.yml",):
        text = (base / file).read_text()
        for part in (0.0, 0.05, 0.3, 0.6):
            yield case(f"{file} cut at {part}", file, text[: int(part * len(text))])
        for i, (old, new) in enumerate(
            [
                ("M1", "N1"), ("R", "Q"), ("T", "U"), ("data", "atad"), ("rows", "r"), (str(SIZE), str(SIZE + 1)), ("3", "4"),
                ("1.", "x."), ("M2", "M2 M2"), ("d", "\0"),
            ]
        ):  # fmt: skip
            yield case(f"{file} changed {i}", file, text.replace(old, new))
    for name, data in {
        "quadratic": "%YAML:1.0\n" + "data: [" * 30_000, "deep flow": "%YAML:1.0\na: " + "[" * 100_000,
        "deep block": "%YAML:1.0\n" + "- " * 100_000, "python": "%YAML:1.0\n---\na: !!python/object/apply:os.system ['touch x']\n",
        "laughs": "%YAML:1.0\n---\na: &a [1,1]\n" + "".join(f"b{i}: &b{i} [*{'a' if i == 0 else f'b{i - 1}'},*a]\n" for i in range(50)),
        "merge": "%YAML:1.0\n---\na: &a {b: 1}\nc:\n  <<: *a\n", "keys": "%YAML:1.0\n---\n" + "".join(f"? [{i}]\n: 1\n" for i in range(2000)),
        "tabs": "%YAML:1.0\n\t\t\t- x", "binary": b"%YAML:1.0\n\xff\xfe", "no head": "M1: 3\n",
        "entities": '<?xml version="1.0"?><!DOCTYPE x [' + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "ha"}">' for i in range(12)) + "]><opencv_storage><M1>&a11;</M1></opencv_storage>",
        "outside": '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/passwd">]><opencv_storage><M1>&e;</M1></opencv_storage>',
        "xml deep": '<?xml version="1.0"?>' + "<a>" * 100_000, "xml empty": '<?xml version="1.0"?><opencv_storage/>',
        "large": "%YAML:1.0\n---\n" + "# x\n" * 400_000,
    }.items():  # fmt: skip
        yield case(name, "c.yml", data)


def colmap(base: Path) -> Iterator[Case]:
    """COLMAP text models."""
    command = ("import", "--colmap", "colmap", "--out", "out")
    for file in ("cameras.txt", "images.txt"):
        lines = (base / "colmap" / file).read_text().splitlines()
        row = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        words_ = lines[row].split()
        for i in range(len(words_)):
            for value in ("nan", "x", "1e999", "-1", "9" * 400, ""):
                if (file, i) in (("cameras.txt", 0), ("images.txt", 0), ("images.txt", 9)) and value != "":
                    continue  # a number of the file's own, or a name
                changed = [*lines]
                changed[row] = " ".join([*words_[:i], value, *words_[i + 1 :]])
                text = "\n".join(changed) + "\n"
                sound = (file == "images.txt" and 5 <= i <= 7 and value in ("-1",)) or (
                    file == "cameras.txt" and value == "-1" and i > 5
                )
                sound |= file == "images.txt" and 1 <= i <= 4 and value == "-1"
                yield Case(
                    f"colmap:{file} {i}:{value[:6]}",
                    command,
                    ("colmap",),
                    lambda work, f=file, t=text: (work / "colmap" / f).write_text(t) and None,
                    sound,
                )
        for name in ("../../../etc/passwd", "/etc/passwd", "..", "left/../../x"):
            if file == "images.txt":
                changed = [*lines]
                changed[row] = " ".join([*words_[:9], name])
                text = "\n".join(changed) + "\n"
                yield Case(
                    f"colmap:name {name}",
                    command,
                    ("colmap",),
                    lambda work, t=text: (work / "colmap" / "images.txt").write_text(t) and None,
                )


def photogrammetry(base: Path) -> Iterator[Case]:
    """A COLMAP text model: cut short, its numbers and names replaced."""
    cameras = [ball_camera(name, angle, SIZE) for name, angle in (("left", -15.0), ("right", 15.0))]
    folder = base / "programs"
    (folder / "photos").mkdir(parents=True)
    for name in ("left", "right"):
        shutil.copy(base / "pictures" / name / "0000.png", folder / "photos" / f"{name}.png")
    exports.write_colmap(folder / "model", [(camera, f"{camera.name}.png") for camera in cameras])
    command = ("--colmap", "programs/model", "--images", "programs/photos")
    kinds = {"model/cameras.txt": command, "model/images.txt": command}

    def case(file: str, name: str, data: bytes) -> Case:
        def prepare(work: Path) -> None:
            (work / "programs" / file).write_bytes(data)

        return Case(
            f"photogrammetry:{file} {name}", ("import", *kinds[file], "--out", "out"), ("programs",), prepare, True
        )

    for file in kinds:
        data = (folder / file).read_bytes()
        yield case(file, "as it is", data)
        for part in (0.0, 0.1, 0.5, 0.9):
            yield case(file, f"cut at {part}", data[: int(part * len(data))])
        found = [match.span() for match in re.finditer(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?", data)]
        for k in range(0, len(found), max(1, len(found) // 12)):
            start, stop = found[k]
            for value in (b"nan", b"1e999", b"-1", b"9" * 5000, b"x"):
                yield case(file, f"number {k} {value[:6].decode()}", data[:start] + value + data[stop:])
        for name in (b"../../../../evil", b"/etc/passwd", b"a/../../b", b"\xff\xfe", b"<!DOCTYPE a>", b"%s%n"):
            yield case(file, f"name {name!r}", data.replace(b"left", name))
        bomb = b'<?xml version="1.0"?><!DOCTYPE d [<!ENTITY a "ha"><!ENTITY b "' + b"&a;" * 999 + b'">]><d>&b;</d>'
        yield case(file, "entities", bomb)
        yield case(file, "deep", b"<a>" * 50_000 if not file.endswith(".json") else b"[" * 50_000)
        yield case(file, "long line", b"1," * 500_000)


def videos(base: Path) -> Iterator[Case]:
    """Videos cut short, spoilt, and of other kinds."""
    command = ("import", "--video", "left.avi", "--video", "right.avi", "--out", "out")
    data = (base / "left.avi").read_bytes()

    def case(name: str, content: bytes, may_pass: bool = False) -> Case:
        return Case(
            f"videos:{name}",
            command,
            ("left.avi", "right.avi"),
            lambda work: (work / "left.avi").write_bytes(content) and None,
            may_pass,
        )

    for part in (0.0, 0.01, 0.1, 0.4, 0.7):
        yield case(f"cut at {part}", data[: int(part * len(data))])
    rng = np.random.default_rng(2)
    for i in range(8):
        spoilt = np.frombuffer(data, np.uint8).copy()
        spoilt[rng.integers(0, 300 if i % 2 else len(data), 30)] = rng.integers(0, 256, 30)
        yield case(f"spoilt {i}", spoilt.tobytes(), True)
    for name, content in {
        "playlist": b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n", "concat": b"ffconcat version 1.0\nfile /etc/passwd\n",
        "riff": b"RIFF\xff\xff\xff\xffAVI LIST\xff\xff\xff\xff", "mp4": b"\0\0\0\x18ftypmp42" + bytes(100), "png": encode_png(np.zeros((SIZE, SIZE, 3), np.uint8)),
        "sdp": b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
    }.items():  # fmt: skip
        yield case(name, content)


# -- models ---------------------------------------------------------------------------------------------------------


def models(base: Path) -> Iterator[Case]:
    """Every kind of model cut short and spoilt, and what each format allows to be claimed."""

    def case(name: str, file: str, data: bytes, may_pass: bool = False) -> Case:
        return Case(
            f"models:{name}",
            ("model", "info", file),
            (),
            lambda work: (work / file).write_bytes(data) and None,
            may_pass,
        )

    for path in sorted((base / "models").iterdir()):
        if path.suffix == ".json":
            continue
        data = path.read_bytes()
        for part in (0.0, 0.001, 0.01, 0.2, 0.5, 0.9, 0.999):
            yield case(f"{path.name} cut at {part}", path.name, data[: int(part * len(data))], part > 0.99)
        rng = np.random.default_rng(5)
        for i in range(6):
            spoilt = np.frombuffer(data, np.uint8).copy()
            spoilt[rng.integers(0, min(len(data), 2000), 5)] = rng.integers(0, 256, 5)
            yield case(f"{path.name} spoilt {i}", path.name, spoilt.tobytes(), True)
    nested = b"\x80\x02})" + b"".join(b"q%c0h%ch%c\x86" % (i, i, i) for i in range(60)) + b"Ns."
    collisions = (
        b"\x80\x02}("
        + b"".join(b"\x8a\x0b" + (i * (2**61 - 1)).to_bytes(11, "little") + b"N" for i in range(1, 60_000))
        + b"u."
    )
    puts = b"\x80\x02}" + b"".join(b"p%d\n" % (i * (2**61 - 1)) for i in range(1, 60_000)) + b"."
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
    for name, data in {
        "pickle os.system": pickle.dumps({"v_template": _Runs()}, 2), "pickle 4": pickle.dumps({"v_template": _Runs()}, 4),
        "pickle eval": b"\x80\x02cbuiltins\neval\n(X\x04\x00\x00\x001+1\ntR.", "pickle ndarray": b"\x80\x02}X\x01\0\0\0fcnumpy\nndarray\n(K\x02\x85X\x02\0\0\0f8tRs.",
        "pickle nested": nested, "pickle collisions": collisions, "pickle puts": puts, "pickle long": b"\x80\x02\x8b\xff\xff\xff\x7f.",
        "pickle string": b"\x80\x04\x8e" + struct.pack("<Q", 10 << 30) + b"abc.", "pickle state": b"\x80\x02}U\x01f" + array + b"(K\x01\x8a\x05\0\0\0\0\x02\x85Ntbs.",
        "pickle setattr": b"\x80\x02ccopy_reg\n_reconstructor\nN}U\x04codeK\x01s\x86b.", "pickle persistent": b"\x80\x02U\x01xQ.", "pickle extension": b"\x80\x02\x82\x01.",
        "pickle loop": b"\x80\x02]q\0h\0a.", "pickle bare": b"\x80\x02.", "pickle marks": b"\x80\x02" + b"(" * 100_000 + b".", "pickle dup": b"\x80\x02}" + b"2" * 1_200_000 + b".",
    }.items():  # fmt: skip
        yield case(name, "m.pkl", data)
    for name, shape, dtype in (
        ("huge", "(1073741824, 3)", "<f4"),
        ("object", "(4, 3)", "|O"),
        ("deep", "(" * 2000, "<f4"),
        ("many", f"({'1,' * 2000})", "<f4"),
        ("negative", "(-4, 3)", "<f4"),
    ):

        def npz(work: Path, shape: str = shape, dtype: str = dtype) -> None:
            text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
            text = text.ljust(-(len(text) + 11) % 64 + len(text)) + "\n"
            with zipfile.ZipFile(work / "m.npz", "w") as archive:
                archive.writestr("mifit_model.npy", _npy(np.int64(1)))
                archive.writestr(
                    "mean.npy", b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text.encode() + bytes(64)
                )

        yield Case(f"models:npz {name}", ("model", "info", "m.npz"), (), npz)

    def bomb(work: Path) -> None:
        with zipfile.ZipFile(work / "m.npz", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("mifit_model.npy", _npy(np.int64(1)))
            archive.writestr("mean.npy", _npy(np.zeros((5_000_000, 3))))

    yield Case("models:npz bomb", ("model", "info", "m.npz"), (), bomb)
    for kind in ("claims", "scalar", "external", "chunk", "text", "group", "loop", "string"):
        yield Case(f"models:h5 {kind}", ("model", "info", "m.h5"), (), lambda work, k=kind: _h5(work / "m.h5", k))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    for kind in (0, 1, 9, 14, 15, 19, 20, 25, 1000, 2**31):
        body = (
            struct.pack("<IIII", 6, 8, 6, 0)
            + struct.pack("<IIii", 5, 8, 1, 1)
            + struct.pack("<II", 1, 7)
            + b"shapeMU\0"
        )
        body += struct.pack("<II", kind, 8) + bytes(8)
        yield case(f"mat type {kind}", "m.mat", head + struct.pack("<II", 14, len(body)) + body)
    for claimed in (0xFFFFFFFF, 0x7FFFFFFF, 0):
        yield case(f"mat claims {claimed}", "m.mat", head + struct.pack("<II", 14, claimed) + bytes(64))
        yield case(
            f"packed mat claims {claimed}",
            "m.mat",
            head + struct.pack("<II", 15, claimed) + zlib.compress(bytes(10**7)),
        )
    for values in ((1, 3 << 28, 1), (4, 12, 1), (2, -3, 1), (1, 12, 2**31 - 1)):
        yield case(f"eos {values}", "m.bin", struct.pack("<Iii", *values) + bytes(100))
    for name, index, mesh in (
        ("index", "{}", "v 0 0 0\n"),
        ("mesh", '{"idx_to_landmark_verts": [0], "expressions": []}', "v nan 0 0\nf 1/1 1/1 1/1\n"),
        ("names", '{"idx_to_landmark_verts": [0], "expressions": ["../../../etc/passwd"]}', "v 0 0 0\n"),
    ):

        def folder(work: Path, index: str = index, mesh: str = mesh) -> None:
            (work / "m").mkdir()
            (work / "m" / "vertex_indices.json").write_text(index)
            (work / "m" / "generic_neutral_mesh.obj").write_text(mesh)

        yield Case(f"models:ict {name}", ("model", "info", "m"), (), folder)


class _Runs:
    def __reduce__(self) -> tuple:
        return os.system, ("touch x",)


def _npy(array: np.ndarray) -> bytes:
    import io

    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _h5(path: Path, kind: str) -> None:
    with h5py.File(path, "w") as f:
        key = "shape/model/mean"
        if kind == "claims":
            f.create_dataset(key, (3 << 30,), "f4", chunks=(1 << 20,))
        elif kind == "chunk":
            f.create_dataset(key, (12,), "f8", chunks=(100_000_000,), maxshape=(None,), compression="gzip")
        elif kind == "external":
            f.create_dataset(key, (12,), "f4", external=[("/etc/passwd", 0, 48)])
        elif kind == "text":
            f[key] = ["a"] * 12
        elif kind == "group":
            f.create_group(key)
        elif kind == "loop":
            f[key] = h5py.SoftLink(f"/{key}")
        elif kind == "string":
            f.create_dataset(key, (12,), h5py.string_dtype())
        else:
            f[key] = np.zeros(12)
            f.create_dataset("version/majorVersion", (10**9,), "i4", chunks=(10**6,), compression="gzip")
            f["version/minorVersion"] = 9


# -- results and experiments ----------------------------------------------------------------------------------------


def _leaves(document: Any, prefix: tuple = ()) -> Iterator[tuple]:
    """Places of a document: every key, the first entry of a list."""
    if prefix:
        yield prefix
    if isinstance(document, dict):
        for key, value in document.items():
            yield from _leaves(value, (*prefix, key))
    elif isinstance(document, list) and document:
        yield from _leaves(document[0], (*prefix, 0))


def results(base: Path) -> Iterator[Case]:
    """Every key of ``result.json`` that is needed to read a result."""
    document = json.loads((base / "result" / "result.json").read_text())
    free = {
        "stages",
        "config",
        "seconds",
        "peak_memory",
        "warnings",
        "mifit_version",
        "digest",
        "photometry",
        "name",
        "status",
        "energies",
    }
    for place in _leaves(document):
        if len(place) > 4 or (free & set(map(str, place))):
            continue
        for i, value in enumerate((None, "x", -1, [], HUGE, float("nan"), _REMOVED)):
            changed = _edit(document, place, value)
            if place[-1] == 0 and value is _REMOVED:
                continue
            yield Case(
                f"results:{'.'.join(map(str, place))}:{i}",
                ("relight", "result", "--env", "missing.hdr", "--out", "out"),
                ("result", "ball.npz"),
                lambda work, d=changed: _write_json(work / "result" / "result.json", d),
            )


def result_files(base: Path) -> Iterator[Case]:
    """Files of a result missing, swapped, cut short and spoilt."""
    for path in sorted((base / "result").rglob("*")):
        name = str(path.relative_to(base))
        if (
            path.is_dir()
            or "scene" in name
            or path.suffix in (".png", ".html", ".json", ".xml")
            or "lighting.exr" in name
            or "confidence" in name
        ):
            continue
        data = path.read_bytes()
        for kind, change in {
            "missing": None, "empty": b"", "half": data[: len(data) // 2], "noise": np.random.default_rng(0).bytes(len(data)),
        }.items():  # fmt: skip

            def prepare(work: Path, name: str = name, change: bytes | None = change) -> None:
                (work / name).unlink() if change is None else (work / name).write_bytes(change)

            yield Case(
                f"result files:{name}:{kind}",
                ("relight", "result", "--env", "missing.hdr", "--out", "out"),
                ("result",),
                prepare,
            )


def experiments(base: Path) -> Iterator[Case]:
    """Experiment files."""
    values = ", ".join(map(str, range(1000)))
    for name, text in {
        "billion": '[render]\nscene = "s.xml"\n[sweep.grid]\n' + "".join(f"render.parameters.{c} = [{values}]\n" for c in "abc"),
        "no part": 'name = "x"\n', "both": '[fit]\ncapture = "capture"\n[render]\nscene = "x"\n', "jobs": 'jobs = 1000000000\n[fit]\ncapture = "capture"\n',
        "jobs text": 'jobs = "x"\n[fit]\ncapture = "capture"\n', "scene": '[render]\nscene = "/dev/zero"\n', "scene missing": '[render]\nscene = "none.xml"\n',
        "env": '[fit]\ncapture = "capture"\n[relight]\nenv = "/dev/zero"\n', "model": '[fit]\ncapture = "capture"\nmodel = "/dev/zero"\n',
        "capture": '[fit]\ncapture = "/etc"\n', "camera": '[fit]\ncapture = "capture"\n[evaluate]\ncamera = "nobody"\n', "held out": '[fit]\ncapture = "capture"\n[evaluate]\ncamera = "left"\n',
        "sweep": 'sweep = 3\n[fit]\ncapture = "capture"\n', "sweep empty": '[fit]\ncapture = "capture"\n[sweep]\nlist = []\n', "sweep text": '[fit]\ncapture = "capture"\n[sweep.grid]\n"fit.seed" = "x"\n',
        "twice": '[fit]\ncapture = "capture"\n[sweep.grid]\n"fit.seed" = [1, 1]\n', "key": '[fit]\ncapture = "capture"\nnothing = 1\n', "seed": '[fit]\ncapture = "capture"\nseed = -1\n',
        "seed huge": '[fit]\ncapture = "capture"\nseed = 99999999999999\n', "size": '[fit]\ncapture = "capture"\n[fit.reflectance]\ntexture_size = 1000000000\n', "timesteps": '[fit]\ncapture = "capture"\ntimesteps = [99]\n',
        "synth": "[fit.synth]\nwidth = 20000\nheight = 20000\n[fit]\n", "synth spp": "[fit]\n[fit.synth]\nspp = 0\n", "synth size": "[fit]\n[fit.synth]\nwidth = 200000\n", "digits": "a = " + "9" * 100_000, "deep": "a = " + "[" * 100_000,
        "dates": "name = 2020-01-01\n[fit]\ncapture = 12:00:00\n", "null": 'name = "a\\u0000b"\n[render]\nscene = "x\\u0000"\n', "dotted": '[fit]\ncapture = "capture"\n[sweep.grid]\n"fit..seed" = [1]\n', "tables": "[fit" + ".a" * 2000 + "]\n", "path key": '[fit]\ncapture = "capture"\n[sweep.grid]\n"../../x" = [1]\n',
    }.items():  # fmt: skip
        yield Case(
            f"experiments:{name}",
            ("run", "e.toml", "--out", "out"),
            ("capture",),
            lambda work, t=text: (work / "e.toml").write_text(t) and None,
        )


# -- names and links ------------------------------------------------------------------------------------------------

NAMES = (
    "../../evil", "/tmp/evil", "..", ".", " ", "a/b", "a\\b", "C:evil", "CON", ".hidden", "-rf", "x" * 300, "\u202egnp", "a\nb", "é" * 200,
    "$HOME", "~root", "*", "site-packages/evil.pth", "face", "skin", "rest", "$x", "<script>alert(1)</script>", "%s%n", "{0}", "a;touch x", "\x1b[31m",
)  # fmt: skip


def names(base: Path) -> Iterator[Case]:
    """Names of cameras that would be paths, options, markup: an import keeps them as names and writes in its folder."""
    document = json.loads((base / "capture" / "transforms.json").read_text())
    for name in NAMES:
        changed = copy.deepcopy(document)
        for frame in changed["frames"]:
            if frame["camera_id"] == "left":
                frame["camera_id"] = name
        yield Case(
            f"names:{name[:20]!r}",
            ("import", "--transforms", "capture/transforms.json", "--out", "out"),
            ("capture",),
            lambda work, d=changed: _write_json(work / "capture" / "transforms.json", d),
            True,
        )
    for suffix in (".pth", ".py", ".so", "", ".png.py", ".exe"):

        def prepare(work: Path, suffix: str = suffix) -> None:
            (work / "capture" / "images" / "left" / "0000.png").rename(work / "capture" / f"evil{suffix or '.x'}")
            _write_json(
                work / "capture" / "transforms.json",
                _edit(document, ("frames", 0, "file_path"), f"evil{suffix or '.x'}"),
            )

        yield Case(
            f"names:suffix {suffix}",
            ("import", "--transforms", "capture/transforms.json", "--out", "out"),
            ("capture",),
            prepare,
            True,
        )


def links(base: Path) -> Iterator[Case]:
    """Links in a capture that lead out of it."""
    for target in ("/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", "/proc/kcore", "/", "/nothing"):
        for file in (
            "capture/images/left/0000.png",
            "capture/transforms.json",
            "capture/landmarks/left/0000.json",
            "capture/mask.png",
        ):

            def prepare(work: Path, file: str = file, target: str = target) -> None:
                (work / file).unlink()
                (work / file).symlink_to(target)

            yield Case(
                f"links:{file}:{target}",
                ("import", "--transforms", "capture/transforms.json", "--out", "out"),
                ("capture",),
                prepare,
            )


# -- results from strangers, and outputs over what is there ---------------------------------------------------------

READERS: dict[str, tuple[str, ...]] = {
    "evaluate": ("evaluate", "result", "--capture", "capture", "--camera", "left"),
    "render": ("render", "result", "--out", "out.png"),
    "turntable": ("turntable", "result", "--out", "out"),
    "relight": ("relight", "result", "--env", "env.hdr", "--out", "out"),
    "export": ("export", "result", "--format", "obj", "--out", "out.obj"),
    "view": ("view", "result", "--port", "0"),
}
WRITERS: dict[str, tuple[str, ...]] = {
    "fit": ("fit", "capture", "--out", "result", "--model", "ball.npz", "--force"),
    "resume": ("fit", "capture", "--out", "result", "--model", "ball.npz", "--resume"),
    "track": ("track", "capture", "--result", "result"),
}


def planted(base: Path) -> Iterator[Case]:
    """A result whose own folder leads out of it: what is of the user there must neither move nor change."""

    def victims(work: Path) -> Path:
        (work.parent / ".ssh").mkdir()
        for name in (".ssh/id_rsa", "victim", "new", "checkpoints", "maps"):
            path = work.parent / name
            if name in ("new", "checkpoints", "maps"):
                path.mkdir()
                path = path / "victim"
            path.write_text("mine")
        return work.parent

    def interrupted(link: str) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            home, mark = victims(work), work / "result" / ".mifit"
            names = [".ssh/id_rsa", "victim", "../../victim", str(home / "victim"), "link/victim"]
            (work / "result" / "link").symlink_to(home)
            if link == "new":
                (mark / "new").symlink_to(home)
            else:
                (mark / "new").mkdir()
                (mark / "new" / link).symlink_to(home / link)
            (mark / "commit.json").write_text(json.dumps({"made": dict.fromkeys(names, ""), "stale": names}))

        return prepare

    def linked(place: str) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            home, path = victims(work), work / "result" / place
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            path.symlink_to(home / "maps" if place == "maps" else home)

        return prepare

    needs = ("result", "capture", "ball.npz", "env.hdr")
    for link in ("new", ".ssh", "victim"):
        for name, arguments in {**READERS, **WRITERS}.items():
            if link != "victim" or name in READERS:  # a link in place of a file is refused when its turn comes
                yield Case(f"planted:{link}:{name}", arguments, needs, interrupted(link))
    for place in (".mifit", "maps", "geometry", ".mifit/new", ".mifit/checkpoints", ".mifit/lock", ".mifit/files.json"):
        for name, arguments in WRITERS.items():
            yield Case(f"planted:{place}:{name}", arguments, needs, linked(place))


def outputs(base: Path) -> Iterator[Case]:
    """Outputs over files of the user, and with --force over those that the command reads."""
    needs = ("result", "capture", "ball.npz", "env.hdr")
    view = ("render", "result", "--capture", "capture", "--camera", "left", "--timestep", "0")
    judged = ("evaluate", "result", "--capture", "capture", "--camera", "left")
    obj = ("export", "result", "--format", "obj")
    for name, arguments, out in (
        ("render", (*view, "--out"), "capture/images/left/0000.png"), ("evaluate", (*judged, "--json"), "capture/transforms.json"),
        ("json", (*judged, "--json"), "result/result.json"), ("ply", ("export", "result", "--format", "ply", "--out"), "result/geometry/0000.ply"),
        ("convert", ("model", "convert", "ball.npz"), "ball.npz"),
        ("device", ("model", "convert", "ball.npz"), "/dev/null"), ("lock", (*view, "--out"), "capture/images/right/0001.png"),
    ):  # fmt: skip
        yield Case(f"outputs:{name}", (*arguments, out), needs)
        yield Case(f"outputs:{name} forced", (*arguments, out, "--force"), needs)
    for name, arguments, mine in (
        ("mtl", (*obj, "--out", "x.obj"), "x.mtl"), ("map", (*obj, "--out", "x.obj"), "x_diffuse.png"),
        ("turntable", ("turntable", "result", "--out", "x"), "x/notes.txt"), ("relight", ("relight", "result", "--env", "env.hdr", "--out", "x"), "x/left.png"),
        ("video", ("relight", "result", "--env", "env.hdr", "--out", "out", "--turn", "2", "--video", "x.mp4"), "x.mp4"),
        ("fit", ("fit", "capture", "--out", "x", "--model", "ball.npz"), "x/notes.txt"), ("import", ("import", "--transforms", "capture/transforms.json", "--out", "x"), "x/notes.txt"),
        ("board", ("calibrate", "--board", "charuco:9x6:30:22", "--out", "x"), "x/notes.txt"),
    ):  # fmt: skip

        def occupied(work: Path, mine: str = mine) -> None:
            (work / mine).parent.mkdir(exist_ok=True)
            (work / mine).write_text("mine")

        yield Case(f"outputs:{name}", arguments, needs, occupied)


# -- numbers beyond all bounds --------------------------------------------------------------------------------------


def extremes(base: Path) -> Iterator[Case]:
    """Numbers that are numbers, and no capture, model or result has."""
    transforms = json.loads((base / "capture" / "transforms.json").read_text())
    result = json.loads((base / "result" / "result.json").read_text())
    imported = ("import", "--transforms", "capture/transforms.json", "--out", "out")
    fitted = ("fit", "capture", "--out", "out", "--model", "ball.npz", "--until", "geometry")
    rendered = ("render", "result", "--capture", "capture", "--camera", "left", "--out", "out.png")
    needs = ("capture", "result", "ball.npz")
    for key, values in {
        "gain": ([1e300] * 3, [1e-300] * 3, [1e30, 1, 1]), "fl_x": (1e300, 1e30, 1e-300), "fl_y": (1e300,), "cx": (1e300, -1e300),
        "k1": (1e300, -1e30), "transform_matrix": (np.diag([1e300, 1e300, 1e300, 1]).tolist(), [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
    }.items():  # fmt: skip
        for i, value in enumerate(values):
            changed = copy.deepcopy(transforms)
            for frame in changed["frames"]:
                frame[key] = value

            def edited(work: Path, d: Any = changed) -> None:
                _write_json(work / "capture" / "transforms.json", d)

            for name, command in (("import", imported), ("fit", fitted), ("render", rendered)):
                sound = name == "render" and key == "gain"  # which a render doesn't need
                yield Case(f"extremes:{key}:{i}:{name}", command, needs, edited, may_pass=sound)
    inside = copy.deepcopy(transforms)
    for frame in inside["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = 0.0

    def within(work: Path) -> None:
        _write_json(work / "capture" / "transforms.json", inside)

    yield Case("extremes:inside:fit", fitted, needs, within, may_pass=True)
    yield Case("extremes:inside:render", rendered, needs, within, may_pass=True)
    for place, value in (
        (("capture", "unit_mm"), 1e300), (("capture", "unit_mm"), 0), (("capture", "unit_mm"), -1), (("model", "scale"), 1e300), (("model", "scale"), 0),
        (("model", "scale"), -1.0), (("timesteps", 0, "rotation"), np.zeros((3, 3)).tolist()), (("timesteps", 0, "rotation"), (3 * np.eye(3)).tolist()),
        (("timesteps", 0, "rotation"), np.diag([1, 1, -1]).tolist()), (("lighting", "exponent"), 1e300), (("lighting", "exponent"), -1), (("lighting", "ambient"), 1e300),
        (("timesteps", 0, "translation"), [1e300] * 3), (("lighting", "radiance"), np.full((9, 3), 1e300).tolist()), (("capture", "cameras", 0, "fx"), 1e300),
        (("model", "identity"), [1e30]), (("model", "albedo"), [1e300]), (("lighting", "lights"), [{"direction": [0, 0, 1], "radius": 0.1, "irradiance": [1, 1, 1]}] * 100),
        (("lighting", "lights"), [{"direction": [0, 0, 0], "radius": 0.1, "irradiance": [1, 1, 1]}]), (("lighting", "lights"), [{"direction": [0, 0, 1], "radius": 1e300, "irradiance": [1e300] * 3}]),
    ):  # fmt: skip
        changed = _edit(result, place, value)

        def spoilt(work: Path, d: Any = changed) -> None:
            _write_json(work / "result" / "result.json", d)

        for name, command in (("export", ("export", "result", "--format", "glb", "--out", "out.glb")), ("turntable", ("turntable", "result", "--steps", "1", "--out", "out"))):  # fmt: skip
            yield Case(f"extremes:result {place[-1]}:{value if np.ndim(value) == 0 else np.shape(value)}:{name}", command, needs, spoilt)  # fmt: skip
    for option in ("1e300", "1e9", "1e-300"):
        for name, command in (
            ("glb", ("export", "result", "--format", "glb", "--animate", "--out", "out.glb")),
            ("relight", ("relight", "result", "--env", "env.hdr", "--turn", "2", "--video", "out.mp4", "--out", "out")),
        ):  # fmt: skip
            yield Case(f"extremes:fps:{option}:{name}", (*command, "--fps", option), (*needs, "env.hdr"))
    for option in ("--yaw=1e300", "--pitch=1e300", "--distance=1e-300", "--distance=1e300", "--distance=0.5"):
        command = ("render", "result", "--out", "out.png", option)
        yield Case(f"extremes:{option}", command, needs, may_pass=option != "--distance=1e300")
    with np.load(base / "ball.npz") as stored:
        model = dict(stored)
    for key in ("mean", "identity", "expression", "albedo_modes", "mean_albedo", "uv"):
        for value in (1e30, np.nan, -1e38):

            def grown(work: Path, key: str = key, value: float = value) -> None:
                changed = {**model, key: model[key].copy()}
                changed[key].flat[0] = value
                np.savez(work / "bad.npz", **changed)

            small = ("--width", "32", "--height", "32", "--spp", "1", "--timesteps", "1")
            for name, command in (
                ("info", ("model", "info", "bad.npz")), ("synth", ("synth", "--out", "out", "--model", "bad.npz", *small)),
                ("fit", ("fit", "capture", "--out", "out", "--model", "bad.npz")),
            ):  # fmt: skip
                yield Case(f"extremes:model {key}:{value}:{name}", command, ("capture",), grown)


# -- colours ---------------------------------------------------------------------------------------------------------


def colours(base: Path) -> Iterator[Case]:
    """Images whose numbers are no linear Rec. 709, and environments that are none."""
    import OpenEXR

    rng = np.random.default_rng(0)

    def exr(names: str, folder: str = ".", **header: Any) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            channels = {n: rng.random((16, 32)).astype(np.float32) for n in names.split(",")}
            fields = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
            with OpenEXR.File(fields, channels) as file:
                file.write(str(work / "e.exr"))

        return prepare

    def radiance(text: bytes, size: bytes = b"-Y 16 +X 32") -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            (work / "e.hdr").write_bytes(b"#?RADIANCE\n" + text + b"\n" + size + b"\n" + rng.bytes(16 * 32 * 4))

        return prepare

    def lit(name: str) -> tuple[str, ...]:
        return ("synth", "--env", name, "--out", "out", "--width", "32", "--height", "32", "--spp", "1", "--timesteps", "1", "--model", "ball.npz")  # fmt: skip

    for name, prepare in {
        "luminance and chroma": exr("Y,RY,BY"), "xyz": exr("X,Y,Z"), "aces": exr("R,G,B", chromaticities=(0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)),
        "wrong primaries": exr("R,G,B", chromaticities=(0.0,) * 8),
    }.items():  # fmt: skip
        yield Case(f"colours:exr {name}", lit("e.exr"), ("ball.npz",), prepare, may_pass=name == "aces")
    for name, prepare in {
        "xyze": radiance(b"FORMAT=32-bit_rle_xyze\n"), "format": radiance(b"FORMAT=something\n"), "exposure 0": radiance(b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=0\n"),
        "exposure nan": radiance(b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=nan\n"), "exposure text": radiance(b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=x\n"),
        "exposure huge": radiance(b"FORMAT=32-bit_rle_rgbe\nEXPOSURE=1e-300\n"), "primaries": radiance(b"FORMAT=32-bit_rle_rgbe\nPRIMARIES=0.3 0.3 0.3 0.3 0.3 0.3 0.3 0.3\n"),
        "square": radiance(b"FORMAT=32-bit_rle_rgbe\n", b"-Y 16 +X 16"),
    }.items():  # fmt: skip
        yield Case(
            f"colours:hdr {name}",
            ("relight", "result", "--env", "e.hdr", "--out", "out"),
            ("result", "ball.npz"),
            prepare,
        )

    def eight_bits(work: Path) -> None:
        write_image(work / "e.png", rng.random((16, 32, 3)))

    yield Case("colours:8-bit environment", ("relight", "result", "--env", "e.png", "--out", "out"), ("result",), eight_bits)  # fmt: skip
    yield Case("colours:8-bit light", lit("e.png"), ("ball.npz",), eight_bits)

    def gamma(chunk: bytes, content: bytes) -> Callable[[Path], None]:
        def prepare(work: Path) -> None:
            for path in (work / "capture" / "images").rglob("*.png"):
                data = path.read_bytes()
                block = struct.pack(">I", len(content)) + chunk + content
                path.write_bytes(data[:33] + block + struct.pack(">I", zlib.crc32(chunk + content)) + data[33:])

        return prepare

    fitted = ("fit", "capture", "--out", "out", "--model", "ball.npz", "--until", "geometry")
    for name, chunk, content in (
        ("0", b"gAMA", struct.pack(">I", 0)), ("huge", b"gAMA", struct.pack(">I", 2**32 - 1)),
    ):  # fmt: skip
        yield Case(f"colours:png gamma {name}", fitted, ("capture", "ball.npz"), gamma(chunk, content))

    def small_mask(work: Path) -> None:
        write_image(work / "capture" / "mask.png", np.ones((SIZE // 2, SIZE)))

    def fisheye(work: Path) -> None:
        document = json.loads((work / "capture" / "transforms.json").read_text())
        document["frames"][1]["camera_model"] = "OPENCV_FISHEYE"
        _write_json(work / "capture" / "transforms.json", document)

    imported = ("import", "--transforms", "capture/transforms.json", "--out", "out")
    yield Case("colours:mask of another size", imported, ("capture",), small_mask)
    yield Case("colours:camera model of one image", imported, ("capture",), fisheye)


# -- arrays and lists of the right type that are none of the kind ----------------------------------------------------


def shapes(base: Path) -> Iterator[Case]:
    """Models without extent or skin, results with cameras and timesteps twice, a device that says it is a file."""
    with np.load(base / "ball.npz") as stored:
        model = dict(stored)
    small = ("--width", "32", "--height", "32", "--spp", "1", "--timesteps", "1")
    for key, change in {
        "landmarks": lambda a: 0 * a, "mean": lambda a: 0 * a, "faces": lambda a: 0 * a, "uv": lambda a: 0 * a, "uv beyond": lambda a: 1e6 * a,
        "mean_albedo": lambda a: 255 * a, "mean_albedo below": lambda a: a - 5,
    }.items():  # fmt: skip

        def changed(work: Path, key: str = key.split()[0], change: Callable = change) -> None:
            np.savez(work / "bad.npz", **{**model, key: change(model[key]).astype(model[key].dtype)})

        for name, command in (
            ("info", ("model", "info", "bad.npz", "--preview", "out.png")), ("synth", ("synth", "--out", "out", "--model", "bad.npz", *small)),
            ("fit", ("fit", "capture", "--out", "out", "--model", "bad.npz")),
        ):  # fmt: skip
            yield Case(f"shapes:model {key}:{name}", command, ("capture",), changed)
    result = json.loads((base / "result" / "result.json").read_text())
    steps, cameras = result["timesteps"], result["capture"]["cameras"]
    for place, value in (
        (("config",), []), (("timesteps",), []), (("timesteps",), steps[:1] * 2), (("capture", "cameras"), []), (("capture", "cameras"), cameras[:1] * 2),
    ):  # fmt: skip

        def spoilt(work: Path, place: tuple = place, value: Any = value) -> None:
            _write_json(work / "result" / "result.json", _edit(result, place, value))

        for name, command in (
            ("track", ("track", "capture", "--result", "result", "--timesteps", "1")), ("relight", ("relight", "result", "--env", "env.hdr", "--out", "out")),
        ):  # fmt: skip
            yield Case(
                f"shapes:result {place[-1]} {len(value)}:{name}",
                command,
                ("result", "capture", "ball.npz", "env.hdr"),
                spoilt,
            )
    transforms = json.loads((base / "capture" / "transforms.json").read_text())

    def memory(work: Path) -> None:
        _write_json(
            work / "capture" / "transforms.json", _edit(transforms, ("frames", 0, "file_path"), "/proc/self/mem")
        )

    yield Case(
        "shapes:memory:fit", ("fit", "capture", "--out", "out", "--model", "ball.npz"), ("capture", "ball.npz"), memory
    )
