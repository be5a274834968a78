"""Hard cases: what the public API does with inputs at or beyond the edge of what can be fitted.

    OPENBLAS_NUM_THREADS=1 python -m benchmarks.hard_cases [NAMES ...] [--work out/hard_cases]

Every case is a small capture, path traced or made from one by damage, that `mifit.fit` and `evaluate` meet as a user's
would. A case fails when it ends in anything but a result or a mifit error, when a result holds values that aren't
finite, when it is wrong without a word of warning, or when it is refused though it could be fitted. Failing cases
stay in the table. Writes ``benchmarks/results/hard_cases.json`` and ``hard_cases.md``; captures are kept in the work
folder and made again when it is deleted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import mifit
from benchmarks.record import RESULTS, record
from benchmarks.truth import mesh_error
from mifit import Capture, MorphableModel, Reconstruction
from mifit.capture.landmark_files import Landmarks, read_landmarks, write_landmarks
from mifit.config import FitConfig, ReflectanceConfig
from mifit.core.files import write_text
from mifit.core.image import read_image, write_image
from mifit.errors import InputError, MifitError
from mifit.output.evaluate import evaluate
from mifit.synth import compose, head
from mifit.synth.procedural import studio_environment
from mifit.synth.skin import SkinMaps, SkinStyle

SEED = 7
WIDTH, HEIGHT, TIMESTEPS, SPP = 192, 144, 2, 16
MODEL = "builtin:coarse"

Make = Callable[[Path, Path], None]
"""Makes a capture in the second folder, from the base capture in the first where it needs one."""


# -- captures that are path traced ------------------------------------------------------------


def traced(
    light: Callable[[], NDArray] = lambda: studio_environment(SEED),
    skin: Callable[[SkinMaps], SkinMaps] = lambda maps: maps,
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
    angles: Sequence[float] = (-20.0, 20.0),
) -> Make:
    """A capture as `synthesize` makes it, with a choice of light, skin, head pose (pitch, yaw, roll) and views."""

    def make(base: Path, out: Path) -> None:
        model = MorphableModel.load(MODEL)
        subject = compose._draw_subject(model, SkinStyle.draw(SEED), TIMESTEPS, 512, head.OUTSIDE, 0.0)
        rotation = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        subject = dataclasses.replace(
            subject,
            skin={name: skin(maps) for name, maps in subject.skin.items()},
            poses=[
                dataclasses.replace(p, rotation=rotation @ p.rotation, translation=rotation @ p.translation)
                for p in subject.poses
            ],
        )
        cameras = compose.place_cameras(WIDTH, HEIGHT)
        cameras[:2] = [
            compose.camera_at(camera.name, WIDTH, HEIGHT, angle, 0.0)
            for camera, angle in zip(cameras, angles, strict=False)
        ]
        compose._write_capture(out, subject, cameras, light().astype(np.float32), SPP, lambda done: None)

    return make


def uniform() -> NDArray:
    return np.ones((64, 128, 3))


def spot(column: int, ambient: float = 0.01) -> Callable[[], NDArray]:
    """One small source of 3 degrees, a little above the horizon; column 64 of 128 is in front of the face."""

    def light() -> NDArray:
        image = np.full((64, 128, 3), ambient)
        image[24, column] = 3000.0
        return image

    return light


def recoloured(albedo: Callable[[NDArray], NDArray], **others: float) -> Callable[[SkinMaps], SkinMaps]:
    """Skin with another albedo, and other maps set to one value."""

    def change(maps: SkinMaps) -> SkinMaps:
        flat: dict[str, Any] = {name: np.full_like(maps.specular, value) for name, value in others.items()}
        return dataclasses.replace(maps, albedo=albedo(maps.albedo).astype(np.float32), **flat)

    return change


# -- captures that are damaged ------------------------------------------------------------


def damaged(
    images: Callable[[NDArray, np.random.Generator], NDArray] | None = None,
    cameras: tuple[str, ...] = ("left", "right", "third"),
    landmarks: Callable[[Landmarks, np.random.Generator], Landmarks] | None = None,
    document: Callable[[dict[str, Any]], None] | None = None,
    world: Callable[[NDArray], NDArray] | None = None,
    suffix: str = ".png",
) -> Make:
    """The base capture with other images (linear in, linear out; of some cameras), landmarks, transforms.json or world
    coordinates.
    """

    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        rng = np.random.default_rng(SEED)
        file = out / "transforms.json"
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            if images and frame["camera_id"] in cameras:
                path = out / frame["file_path"]
                frame["file_path"] = str(Path(frame["file_path"]).with_suffix(suffix))
                write_image(out / frame["file_path"], images(read_image(path), rng))
            if landmarks:
                path = out / frame["landmark_path"]
                write_landmarks(path, landmarks(read_landmarks(path), rng))
            if world:
                matrix = np.array(frame["transform_matrix"])
                matrix[:3, 3] = world(matrix[:3, 3])
                frame["transform_matrix"] = matrix.tolist()
        if world:
            for path in (out / "truth").glob("0*.npz"):
                truth = dict(np.load(path))
                np.savez(path, **{**truth, "vertices": world(truth["vertices"].astype(np.float64))})
        if document:
            document(content)
        file.write_text(json.dumps(content))

    return make


def exposed(factor: float) -> Make:
    return damaged(images=lambda x, rng: np.clip(factor * x, 0, 1))


def spoilt_exr(value: float) -> Make:
    """EXR images of the fitted cameras; 3 % of the pixels and a block in the face take a value that is no light."""

    def change(image: NDArray, rng: np.random.Generator) -> NDArray:
        out = image.copy()
        out[rng.random(out.shape[:2]) < 0.03] = value
        out[65:75, 90:100] = value
        return out

    return damaged(images=change, cameras=("left", "right"), suffix=".exr")


def moved(points: Callable[[NDArray, np.random.Generator], NDArray]) -> Make:
    return damaged(landmarks=lambda found, rng: Landmarks(points(found.points, rng), found.visible))


def noisy(image: NDArray, rng: np.random.Generator) -> NDArray:
    return np.clip(image + rng.normal(0, 0.1, image.shape), 0, 1)


MIRRORED = np.array(
    [*range(16, -1, -1), *range(26, 16, -1), *range(27, 31), *range(35, 30, -1), 45, 44, 43, 42, 47, 46, 39, 38, 37, 36,
     41, 40, 54, 53, 52, 51, 50, 49, 48, 59, 58, 57, 56, 55, 64, 63, 62, 61, 60, 67, 66, 65]
)  # fmt: skip
"""The 68 points as a detector names them that takes left for right."""


def outliers(points: NDArray, rng: np.random.Generator) -> NDArray:
    out = points.copy()
    out[rng.choice(68, 8, replace=False)] += rng.choice([-1.0, 1.0], (8, 2)) * 25.0
    return out


def anywhere(points: NDArray, rng: np.random.Generator) -> NDArray:
    return rng.uniform((0, 0), (WIDTH, HEIGHT), (68, 2))


def half_hidden(found: Landmarks, rng: np.random.Generator) -> Landmarks:
    return Landmarks(found.points, found.visible & (rng.random(68) < 0.5))


def without_landmarks(*cameras: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            if not cameras or frame["camera_id"] in cameras:
                del frame["landmark_path"]

    return change


def with_units(units: str) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(units=units)


def shuffled(content: dict[str, Any]) -> None:
    np.random.default_rng(SEED).shuffle(content["frames"])


def doubled(content: dict[str, Any]) -> None:
    """Camera ``left`` once more under the name ``copy``."""
    content["frames"] += [{**f, "camera_id": "copy"} for f in content["frames"] if f["camera_id"] == "left"]


def file_changed(change: Callable[[Path], object], name: str = "images/left/0001.png") -> Make:
    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        change(out / name)

    return make


def masked(covered: Callable[[NDArray], NDArray]) -> Make:
    """Masks that cover a part of every image (the function takes columns 0..1)."""

    def make(base: Path, out: Path) -> None:
        shutil.copytree(base, out)
        keep = ~covered(np.linspace(0, 1, WIDTH)[None].repeat(HEIGHT, 0))
        write_image(out / "mask.png", keep.astype(np.float32))
        content = json.loads((out / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["mask_path"] = "mask.png"
        (out / "transforms.json").write_text(json.dumps(content))

    return make


# -- the cases ------------------------------------------------------------

CONFIG = FitConfig(reflectance=ReflectanceConfig(texture_size=64))
WRONG_MM, WRONG_DB = 5.0, 20.0
"""A result is wrong when its vertices are further off, or its third view is worse, than this."""
FITTING = {
    "mesh": ("distance", "how far away", "landmarks", "standard deviations", "calibration", "units"),
    "view": ("clipped", "no pixel of the face", "exposure", "noise", "no camera measures"),
}
"""What a warning must speak of to fit a mesh that is wrong, or a view that is wrong though the mesh isn't."""
UNITS, MARKS = ("unit", "scale", "too large", "too small"), ("landmarks scatter", "landmarks of the left side")
SAME_MM = 0.01
"""Vertices of two results that are the same."""


@dataclass(frozen=True)
class Case:
    """One hard case.

    Attributes
    ----------
    name, group : str
    make : callable
    expect : {"fit", "refuse", "either"}
        What the toolkit should do.
    cameras, timesteps : tuple, optional
        As for `mifit.fit`.
    until : str
        Last stage.
    same : bool
        The result must be the base capture's.
    warning : tuple of str
        Words of which a warning must have one to fit a wrong result; default: those of `FITTING`.
    """

    name: str
    group: str
    make: Make
    expect: Literal["fit", "refuse", "either"] = "fit"
    cameras: tuple[str, ...] = ("left", "right")
    timesteps: tuple[int, ...] | None = None
    until: Literal["geometry", "reflectance", "normals"] = "reflectance"
    same: bool = False
    warning: tuple[str, ...] = ()


CASES = (
    Case("base", "reference", traced(), until="normals"),
    Case("uniform light", "light", traced(uniform)),
    Case("one small source in front", "light", traced(spot(64))),
    Case("one small source at the side", "light", traced(spot(90))),
    Case("one small source behind", "light", traced(spot(2, 0.05)), "either"),
    Case("black environment", "light", traced(lambda: np.zeros((64, 128, 3))), "refuse"),
    Case("one view", "views", damaged(), cameras=("left",)),
    Case("one timestep", "views", damaged(), timesteps=(0,)),
    Case("one view, one timestep", "views", damaged(), cameras=("left",), timesteps=(0,)),
    Case("two views from one place", "views", traced(angles=(-20.0, -20.0))),
    Case("views 1 degree apart", "views", traced(angles=(-0.5, 0.5))),
    Case("views 140 degrees apart", "views", traced(angles=(-70.0, 70.0))),
    Case("camera twice under two names", "views", damaged(document=doubled), cameras=("left", "copy")),
    Case("three times overexposed", "exposure", exposed(3.0)),
    Case("thirty times overexposed", "exposure", exposed(30.0), "either"),
    Case("all white", "exposure", exposed(1e6), "refuse"),
    Case("one fiftieth of the exposure", "exposure", exposed(0.02)),
    Case("exposed to two codes", "exposure", exposed(3e-4), "either"),
    Case("all black", "exposure", exposed(0.0), "refuse"),
    Case("noise of 0.1", "exposure", damaged(images=noisy, cameras=("left", "right"))),
    Case("8-bit grey", "exposure", damaged(images=lambda x, rng: x.mean(axis=-1))),
    Case("black skin", "skin", traced(skin=recoloured(lambda a: 0.05 * a))),
    Case("white skin", "skin", traced(skin=recoloured(lambda a: 0.95 + 0.0 * a))),
    Case("mirror-like skin", "skin", traced(skin=recoloured(lambda a: a, specular=1.0, roughness=0.05))),
    Case("millimetres", "numbers", damaged(world=lambda x: 10 * x, document=with_units("mm"))),
    Case("metres", "numbers", damaged(world=lambda x: x / 100, document=with_units("m"))),
    Case("centimetres declared as metres", "numbers", damaged(document=with_units("m")), "either", warning=UNITS),
    Case("world origin 100 m away", "numbers", damaged(world=lambda x: x + 1e4)),
    Case("world origin 10 km away", "numbers", damaged(world=lambda x: x + 1e6), "either"),
    Case("world origin 1000 km away", "numbers", damaged(world=lambda x: x + 1e8), "either"),
    Case("NaN pixels in EXR", "numbers", spoilt_exr(np.nan), until="normals"),
    Case("infinite pixels in EXR", "numbers", spoilt_exr(np.inf)),
    Case("pixels of 1e30 in EXR", "numbers", spoilt_exr(1e30)),
    Case("negative pixels in EXR", "numbers", spoilt_exr(-1.0)),
    Case("landmarks 4 pixels to the right", "landmarks", moved(lambda p, rng: p + np.array([4.0, 0.0]))),
    Case("landmarks 30 pixels to the right", "landmarks", moved(lambda p, rng: p + np.array([30.0, 0.0])), "either"),
    Case("left taken for right", "landmarks", moved(lambda p, rng: p[MIRRORED]), "either", warning=MARKS),
    Case("eight landmarks 35 pixels off", "landmarks", moved(outliers)),
    Case("half of the landmarks hidden", "landmarks", damaged(landmarks=half_hidden)),
    Case("all landmarks anywhere", "landmarks", moved(anywhere), "either", warning=MARKS),
    Case("all landmarks in one point", "landmarks", moved(lambda p, rng: 0 * p + 70.0), "either", warning=MARKS),
    Case("NaN landmarks", "landmarks", moved(lambda p, rng: p * np.nan), "either"),
    Case("no landmarks in one camera", "landmarks", damaged(document=without_landmarks("right"))),
    Case("no landmarks", "landmarks", damaged(document=without_landmarks()), "refuse"),
    Case("image missing", "data", file_changed(Path.unlink), "refuse"),
    Case("image cut off", "data", file_changed(lambda p: p.write_bytes(p.read_bytes()[:2000])), "refuse"),
    Case("image of another size", "data", file_changed(lambda p: write_image(p, np.ones((50, 60, 3)))), "refuse"),
    Case("landmarks missing", "data", file_changed(Path.unlink, "landmarks/left/0001.json"), "refuse"),
    Case("right half masked", "data", masked(lambda x: x > 0.5)),
    Case("everything masked", "data", masked(lambda x: x >= 0), "refuse"),
    Case("head rolled by 90 degrees", "pose", traced(turn=(0, 0, 90))),
    Case("head upside down", "pose", traced(turn=(0, 0, 180))),
    Case("head turned by 60 degrees", "pose", traced(turn=(0, 60, 0)), "either"),
    Case("head nodding by 40 degrees", "pose", traced(turn=(40, 0, 0))),
    Case("back of the head", "pose", traced(turn=(0, 180, 0)), "refuse"),
    Case("frames shuffled in the file", "order", damaged(document=shuffled), same=True),
    Case("cameras named in reverse", "order", damaged(), cameras=("right", "left"), same=True),
    Case("timesteps named in reverse", "order", damaged(), timesteps=(1, 0), same=True),
)


# -- running them ------------------------------------------------------------


def run_case(case: Case, work: Path, reference: NDArray | None) -> tuple[dict[str, Any], NDArray | None]:
    """Make, fit and judge one case; returns its row and the vertices that were found, by timestep."""
    row: dict[str, Any] = {"case": case.name, "group": case.group, "expect": case.expect}
    began, used = time.perf_counter(), time.process_time()
    vertices = None
    try:
        folder = work / "_".join(case.name.replace(",", "").split())
        if not (folder / "transforms.json").exists():
            shutil.rmtree(folder, ignore_errors=True)
            case.make(work / "base", folder)
        capture = Capture.load(folder)
        result = mifit.fit(
            capture,
            MorphableModel.load(MODEL),
            cameras=case.cameras,
            timesteps=case.timesteps,
            config=CONFIG,
            until=case.until,
        )
        order = np.argsort(result.timesteps)
        vertices = result.geometry.vertices[order]
        row |= {
            "outcome": "fitted",
            "finite": is_finite(result),
            "mesh_mm": mesh_error(result, folder)["mesh_mm"],
            "third_db": third_view(result, capture),
            "warnings": [one.text for one in result.diagnostics],
        }
        if case.same and reference is not None:
            row["difference_mm"] = float(np.abs(vertices - reference).max()) * result.unit_mm
    except MifitError as error:
        row |= {"outcome": "refused", "message": str(error).replace(f"{work}/", "")}
    except Exception as error:
        traceback.print_exc()
        row |= {"outcome": "traceback", "message": f"{type(error).__name__}: {error}"}
    row["seconds"] = round(time.perf_counter() - began, 1)
    row["cpu_seconds"] = round(time.process_time() - used, 1)
    return row, vertices


def third_view(result: Reconstruction, capture: Capture) -> float:
    """Held-out error in dB; 0 where the fitted face isn't even in the picture."""
    try:
        return evaluate(result, capture, "third")["methods"]["full"]["psnr"]
    except InputError:
        return 0.0


def is_finite(result: Reconstruction) -> bool:
    """Whether every number of a result is one."""
    arrays = [result.geometry.vertices, result.geometry.vertex_albedo, result.geometry.shading]
    if result.reflectance is not None:
        found = result.reflectance
        arrays += [found.diffuse, found.specular, found.confidence, found.illumination.unknowns]
    if result.normals is not None:
        arrays.append(result.normals.normal_object)
    return all(np.isfinite(array).all() for array in arrays)


def verdict(case: Case, row: dict[str, Any]) -> str:
    """``ok``, or why the case fails."""
    if row["outcome"] == "traceback":
        return "fails: no mifit error"
    if row["outcome"] == "refused":
        return "ok" if case.expect != "fit" else "fails: refused"
    if not row["finite"]:
        return "fails: not finite"
    if case.expect == "refuse":
        return "fails: not refused"
    if row.get("difference_mm", 0.0) > SAME_MM:
        return f"fails: differs by {row['difference_mm']:.2g} mm"
    wrong = "mesh" if not row["mesh_mm"] <= WRONG_MM else "view" if not row["third_db"] >= WRONG_DB else ""
    said = [text for text in row["warnings"] if any(word in text for word in case.warning or FITTING.get(wrong, ()))]
    if not wrong or said:
        return "ok"
    return "fails: wrong, and the warnings are of something else" if row["warnings"] else "fails: wrong without a word"


def markdown(rows: list[dict[str, Any]]) -> str:
    """All cases by group; a failing one says why."""
    passed = sum(row["verdict"] == "ok" for row in rows)
    lines = [
        f"{passed} of {len(rows)} cases are met well. Images of {WIDTH} x {HEIGHT}, {TIMESTEPS} timesteps, the coarse",
        "model; errors of vertices (face area, no alignment) and of the third view in the case's own exposure.",
        "A wrong result is met well only by a warning that speaks of what is wrong.",
        "",
        "| case | outcome | vertices mm | third dB | what is said | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        words = [row["message"]] if "message" in row else row["warnings"]
        text = _cell("; ".join(words))
        mm, db = (f"{row[key]:.2f}" if key in row else "" for key in ("mesh_mm", "third_db"))
        verdict = row["verdict"] if row["verdict"] == "ok" else f"**{row['verdict']}**"
        lines.append(f"| {row['group']}: {row['case']} | {row['outcome']} | {mm} | {db} | {text} | {verdict} |")
    return "\n".join(lines) + "\n"


def _cell(text: str, limit: int = 220) -> str:
    text = " ".join(text.split()).replace("|", "/")
    return text if len(text) <= limit else text[: limit - 3] + "..."


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="cases to run; the table is written when all are")
    parser.add_argument("--work", type=Path, default=Path("out/hard_cases"))
    a = parser.parse_args()
    unknown = set(a.names) - {case.name for case in CASES}
    if unknown:
        parser.error(f"no case {sorted(unknown)[0]!r}; there are {', '.join(case.name for case in CASES)}")
    mifit.set_variant("auto")
    judged, reference = list[dict[str, Any]](), None
    for case in CASES:
        if a.names and case.name not in {*a.names, "base"}:
            continue
        row, vertices = run_case(case, a.work, reference)
        reference = vertices if case.name == "base" else reference
        judged.append({**row, "verdict": verdict(case, row)})
        figures = " ".join(f"{key} {row[key]:.2f}" for key in ("mesh_mm", "third_db") if key in row)
        print(f"{case.name}: {row['outcome']} {figures}, {row['seconds']} s", file=sys.stderr, flush=True)
        if not a.names:  # after each case, so that a run that is broken off leaves what it measured
            record("hard_cases", {"cases": judged}, seeds=SEED)
            write_text(RESULTS / "hard_cases.md", markdown(judged))
    print(markdown(judged))
    return 0


if __name__ == "__main__":
    sys.exit(main())
