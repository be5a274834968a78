"""Scores of any program's images and meshes, in plain files, against a capture's photographs and truth.

Nothing of mifit's own results is needed. In the scored folder, with the capture's camera names and four-digit
timesteps:

=================================  =====================================================================================
``CAMERA_TTTT.png``                a view, compared with that camera's photograph
``diffuse_CAMERA.exr``             the first timestep's view without specular reflection
``specular_CAMERA.exr``            its specular part; both are compared with the truth's passes
``relit_ENV.exr``                  the truth's view under the environment ENV
``TTTT.ply``                       the mesh of a timestep, world space
=================================  =====================================================================================

Images may be PNG or JPEG (sRGB) or EXR or HDR (linear), meshes PLY or OBJ. Views have the size of the camera's
undistorted photographs. Relit views and passes are compared after one factor per channel, so their exposure is free.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.files import Document
from mifit.core.image import SUFFIXES, read_image, to_8_bit
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.output import compare, truth
from mifit.progress import Progress, silent
from mifit.render.image_based import image_based

MESHES = (".ply", ".obj")


def score(
    capture: Capture,
    folder: str | Path,
    fitted: Sequence[str] | None = None,
    model: MorphableModel | None = None,
    progress: Progress = silent,
) -> Document:
    """Figures of the files of a folder, named as the module says, against a capture's photographs and truth.

    Regions are those of the photograph's landmarks: ``face`` (their hull), ``skin`` (without eyes and inner mouth;
    where the capture has a true mesh, what the fitted cameras see of it) and ``whole`` (all that the true mesh covers;
    without one, every valid pixel).

    The cameras that the program was given, ``fitted``, are by default the first two; views of others count as held out.
    ``model`` gives the triangles of a truth that has vertices alone.

    Returns ``views``: per camera, and for ``held_out`` together, by region what `output.compare.Errors.figures` gives;
    ``relit``: PSNR per environment and their mean; ``passes``: per camera what `output.compare.separation` gives;
    ``meshes``: distances (mm) from true points that all fitted cameras see; ``ignored``: files without a meaning.

    InputError for no folder, nothing in it to score, an image of another size, or a truth that is missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected one with images to score, such as third_0000.png")
    cameras = capture.cameras[:2] if fitted is None else tuple(fitted)
    for name in cameras:
        capture.camera(name)
    found = _files(folder, capture)
    out: Document = {"capture": Path(capture.path).name, "fitted": list(cameras)}
    jobs = sum(len(files) for kind, files in found.items() if kind != "ignored")
    if not jobs:
        example = next((c for c in capture.cameras if c not in cameras), capture.cameras[-1])
        raise InputError(
            f"{folder}: found no file to score, expected names such as {example}_0000.png, relit_studio.exr, "
            f"diffuse_{example}.exr, specular_{example}.exr or 0000.ply"
        )
    progress("Scoring", 0, jobs)
    known = _Truths(capture, cameras, model)
    if found["views"]:
        out["views"] = _views(found["views"], known)
    if found["relit"]:
        out["relit"] = _relit(found["relit"], capture)
    if found["passes"]:
        of = dict.fromkeys(camera for camera, _ in found["passes"])
        out["passes"] = {camera: _passes(found["passes"], camera, capture) for camera in of}
    if found["meshes"]:
        out["meshes"] = _meshes(found["meshes"], known)
    out["ignored"] = list(found["ignored"])
    progress("Scoring", jobs, jobs)
    return out


def _files(folder: Path, capture: Capture) -> dict[str, dict[Any, Path]]:
    """The files of a folder by kind and by what their names mean; two files of one meaning are an error."""
    found: dict[str, dict[Any, Path]] = {kind: {} for kind in ("views", "relit", "passes", "meshes", "ignored")}
    for path in sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")):
        kind, key = _meaning(path, capture)
        if key in found[kind]:
            raise InputError(f"{path}: {found[kind][key].name} means the same; expected one of the two")
        found[kind][key] = path
    return found


def _meaning(path: Path, capture: Capture) -> tuple[str, object]:
    """Kind and key of a file: camera and timestep, environment, camera and pass, or timestep; else its name alone."""
    stem, suffix = path.stem, path.suffix.lower()
    if suffix in MESHES and stem.isdigit() and int(stem) in capture.timesteps:
        return "meshes", int(stem)
    if suffix in SUFFIXES:
        view = re.fullmatch(r"(.+)_(\d{4,})", stem)
        if view and view[1] in capture.cameras and int(view[2]) in capture.timesteps:
            return "views", (view[1], int(view[2]))
        kind, _, name = stem.partition("_")
        if kind == "relit" and name:
            return "relit", name
        if kind in ("diffuse", "specular") and name in capture.cameras:
            return "passes", (name, kind)
    return "ignored", path.name


class _Truths:
    """True meshes of a capture's timesteps, each read once, with what the fitted cameras see of them."""

    def __init__(self, capture: Capture, fitted: Sequence[str], model: MorphableModel | None) -> None:
        self.capture, self.fitted, self._model = capture, tuple(fitted), model
        self._meshes: dict[int, truth.TrueMesh | None] = {}

    def at(self, timestep: int) -> truth.TrueMesh | None:
        """The mesh of a timestep; None where there is none, or no triangles are known."""
        if timestep not in self._meshes:
            try:
                mesh = truth.true_mesh(self.capture, timestep, self._model)
            except InputError:
                if self._model is not None:
                    raise
                mesh = None
            self._meshes[timestep] = mesh
        return self._meshes[timestep]

    def regions(self, camera: str, timestep: int) -> dict[str, NDArray[np.bool_]]:
        """Pixels of one photograph that count, by region."""
        view, frame = self.capture.camera(camera), self.capture.frame(camera, timestep)
        marks = truth.landmarks_of(self.capture, camera, timestep)
        skin, whole, mesh = compare.skin_region(marks, view), frame.valid, self.at(timestep)
        if mesh is not None:
            cameras = [self.capture.camera(name) for name in self.fitted]
            shown = image_based(self.capture, cameras, view, timestep, mesh.vertices, mesh.faces)
            skin, whole = skin & shown.seen, whole & shown.hit
        regions = {"skin": skin & frame.valid, "face": compare.face_region(marks, view) & frame.valid, "whole": whole}
        for name, region in regions.items():
            if not region.any():
                raise InputError(
                    f"{self.capture.path}: camera {camera}, timestep {timestep}: no pixel of region {name} is visible, "
                    "nothing to score"
                )
        return regions


def _views(files: dict[tuple[str, int], Path], known: _Truths) -> Document:
    tallies: dict[str, dict[str, compare.Errors]] = {}
    for (camera, timestep), path in files.items():
        frame = known.capture.frame(camera, timestep)
        image = to_8_bit(_read(path, frame.image.shape[:2]))
        groups = [camera] if camera in known.fitted else [camera, "held_out"]
        for region, pixels in known.regions(camera, timestep).items():
            for group in groups:
                tally = tallies.setdefault(group, {}).setdefault(region, compare.Errors())
                tally.add(image, to_8_bit(frame.image), pixels)
    return {group: {region: e.figures() for region, e in found.items()} for group, found in tallies.items()}


def _relit(files: dict[str, Path], capture: Capture) -> dict[str, float]:
    truths = truth.relit_truths(capture)
    camera, timestep = capture.cameras[-1], capture.timesteps[0]
    region = compare.relit_region(truth.landmarks_of(capture, camera, timestep), capture.camera(camera))
    out = {}
    for name, path in files.items():
        if name not in truths:
            known = ", ".join(truths) or "none"
            raise InputError(f"{path}: the capture's truth has no view relit by {name!r}; it has {known}")
        out[name] = compare.scaled_psnr(_read(path, region.shape), truths[name].image, region)
    return {**out, "mean": float(np.mean(list(out.values())))}


def _passes(files: dict[tuple[str, str], Path], camera: str, capture: Capture) -> dict[str, float]:
    paths = {kind: path for (name, kind), path in files.items() if name == camera}
    missing = next((kind for kind in ("diffuse", "specular") if kind not in paths), None)
    if missing is not None:
        there = next(iter(paths.values()))
        raise InputError(f"{there}: found without {missing}_{camera}{there.suffix}, expected both passes")
    expected = truth.true_passes(capture, camera)
    if expected is None:
        raise InputError(f"{paths['diffuse']}: the capture's truth has no passes of camera {camera!r}")
    view, marks = capture.camera(camera), truth.landmarks_of(capture, camera, capture.timesteps[0])
    region = compare.pass_region(marks, view)
    diffuse, specular = (_read(paths[kind], region.shape) for kind in ("diffuse", "specular"))
    return compare.separation(diffuse, specular, expected.diffuse, expected.specular, region)


def _meshes(files: dict[int, Path], known: _Truths) -> dict[str, float]:
    distances = []
    for timestep, path in files.items():
        found = known.at(timestep)
        if found is None:
            raise InputError(
                f"{path}: the capture's truth has no mesh of timestep {timestep}, or vertices without triangles; name "
                "the model that it was made with"
            )
        points = truth.points_seen(found, known.capture, known.fitted, timestep)
        mesh = truth.read_mesh(path)
        distances.append(truth.nearest_points(points.position, mesh.vertices, mesh.faces)[0])
    return truth.distance_figures(np.concatenate(distances) * known.capture.unit_mm)


def _read(path: Path, shape: tuple[int, ...]) -> NDArray[np.float32]:
    image = read_image(path)
    if image.shape[:2] != shape:
        found, wanted = (f"{s[1]} x {s[0]}" for s in (image.shape, shape))
        raise InputError(f"{path}: found {found} pixels, expected {wanted}, the size of the photograph")
    return image


def summary(found: Document) -> str:
    """The scores as lines of text."""
    lines = []
    for group, regions in found.get("views", {}).items():
        for region, f in regions.items():
            lines.append(
                f"{group}, {region}: {f['psnr']:.2f} dB ({f['psnr_matched']:.2f} after one factor per channel), "
                f"SSIM {f['ssim']:.4f}, FLIP {f['flip']:.4f}"
            )
    lines += [f"relit by {name}: {value:.2f} dB" for name, value in found.get("relit", {}).items()]
    for camera, f in found.get("passes", {}).items():
        lines.append(
            f"passes of {camera}: specular correlation {f['correlation']:.3f} ({f['correlation_smooth']:.3f} "
            f"smoothed), error {f['error']:.3f}, share {f['share']:.3f} (truth {f['share_truth']:.3f}), "
            f"diffuse {f['diffuse_psnr']:.2f} dB (no separation {f['diffuse_psnr_unseparated']:.2f})"
        )
    if "meshes" in found:
        f = found["meshes"]
        lines.append(f"scan to mesh: median {f['median_mm']:.3f}, mean {f['mean_mm']:.3f}, 90 % {f['p90_mm']:.3f} mm")
    return "\n".join(lines)
