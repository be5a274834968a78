"""Error of a reconstruction on a view, most honestly one that was not fitted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from mifit.capture import Capture
from mifit.core.calls import checked
from mifit.core.camera import Camera
from mifit.core.files import Document
from mifit.core.image import to_8_bit
from mifit.errors import InputError
from mifit.output.compare import Errors, pass_region, separation, skin_region
from mifit.output.deferred import shade_methods, visible_surface
from mifit.output.truth import landmarks_of, true_mesh, true_passes
from mifit.progress import Progress, silent
from mifit.render.image_based import BLENDS, image_based
from mifit.render.visible import trace_mesh
from mifit.result import Method, Reconstruction

Region = Literal["face", "skin", "truth"]


@dataclass(frozen=True)
class Comparison:
    """One view of one timestep beside the photograph, in 8-bit sRGB.

    ``region`` (H, W) are pixels that count, the same for all methods; ``renders`` (H, W, 4) by method are colour, 0
    where the model covers nothing, and coverage. ``baseline`` (H, W, 3) is image-based rendering from the fitted views
    on the fitted mesh (`render.image_based`) by several blends, the first one ``image_based``; ``seen`` (H, W) the
    pixels of the region whose point a fitted view sees, those that it is compared on.
    """

    timestep: int
    photograph: NDArray[np.uint8]
    region: NDArray[np.bool_]
    renders: dict[Method, NDArray[np.uint8]]
    baseline: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    seen: NDArray[np.bool_] | None = None


@checked
def evaluate(
    result: Reconstruction,
    capture: Capture,
    camera: str,
    timesteps: Sequence[int] | None = None,
    region: Region = "face",
    progress: Progress = silent,
    baseline: bool = False,
    watch: Callable[[Comparison], None] | None = None,
    passes: bool = False,
) -> Document:
    """Errors of renders against photographs over the face area, in 8-bit sRGB.

    The region is the same for all methods. A pixel of it that the fitted model doesn't cover counts as black; pixels
    without a value after undistortion don't count. Over several timesteps squared errors are pooled over all pixels.

    Parameters
    ----------
    result : Reconstruction
    capture : Capture
    camera : str
        A camera of the capture.
    timesteps : sequence of int, optional
        Of the result; default: all of it.
    region : {"face", "skin", "truth"}
        ``face``: face area of the fitted model, eroded by 2 pixels; ``truth``: that of the capture's true mesh;
        ``skin``: the hull of the landmarks without eyes and inner mouth (`output.compare.skin_region`), where a fitted
        view sees the true mesh, or the fitted one where there is none.
    progress : Progress
    baseline : bool
        Compare image-based rendering on the fitted mesh as well, by three blends (`render.image_based`).
    watch : callable, optional
        Given the comparison of each timestep.
    passes : bool
        Compare the model's diffuse and specular image of the capture's first timestep with the truth's.

    Returns
    -------
    dict
        ``camera``, ``timesteps``, ``region``, ``region_pixels``, ``methods``: by method what
        `output.compare.Errors.figures` gives; ``per_timestep``: a list of ``timestep``, ``region_pixels`` and
        ``methods``. With ``baseline`` also ``baseline``: ``region_pixels`` and ``methods`` over the pixels that a
        fitted view sees, ``image_based``, ``image_based_nearest`` and ``image_based_angle`` among them; with
        ``passes`` what `output.compare.separation` gives.

    Raises
    ------
    InputError
        Unknown camera or timestep, a camera without calibration, no ground truth, or a face area that is not visible.
    """
    steps = result.timesteps if timesteps is None else tuple(timesteps)
    if not steps:
        raise InputError("timesteps: found none, expected at least one")
    separated = separation_of(result, capture, camera) if passes else None
    per_timestep = []
    whole: dict[str, Errors] = defaultdict(Errors)
    seen: dict[str, Errors] = defaultdict(Errors)
    progress("Evaluating", 0, len(steps))
    for done, timestep in enumerate(steps):
        found = compare(result, capture, camera, timestep, region, baseline=baseline)
        renders = {str(method): render[..., :3] for method, render in found.renders.items()}
        figures = {m: whole[m].add(image, found.photograph, found.region) for m, image in renders.items()}
        if found.seen is not None:
            for name, image in {**found.baseline, **renders}.items():
                seen[name].add(image, found.photograph, found.seen)
        per_timestep.append({"timestep": timestep, "region_pixels": int(found.region.sum()), "methods": figures})
        if watch is not None:
            watch(found)
        progress("Evaluating", done + 1, len(steps))
    out = {
        "camera": camera,
        "timesteps": list(steps),
        "region": region,
        **_figures(whole),
        "per_timestep": per_timestep,
    }
    if baseline:
        out["baseline"] = _figures(seen)
    if separated is not None:
        out["passes"] = separated
    return out


def _figures(errors: Mapping[str, Errors]) -> Document:
    """Pixels, which all methods share, and figures by method."""
    pixels = next((e.pixels for e in errors.values()), 0)
    return {"region_pixels": pixels, "methods": {name: e.figures() for name, e in errors.items()}}


def separation_of(result: Reconstruction, capture: Capture, camera: str) -> dict[str, float]:
    """How well a result's diffuse and specular image of the first timestep agree with the truth's; see
    `compare.separation`.

    The result is rendered without its residual, which is neither. InputError where the truth has no passes, the first
    timestep wasn't fitted, or a fit is without reflectance.
    """
    truth, timestep = true_passes(capture, camera), capture.timesteps[0]
    if truth is None:
        raise InputError(f"{capture.path}: --passes needs truth/diffuse_{camera}.exr, which is missing")
    if timestep not in result.timesteps or "diffuse" not in result.methods:
        raise InputError(f"--passes: needs reflectance and timestep {timestep}, of which the truth's passes are")
    alone = replace(result, residual=None)
    view = result.seen(capture).camera(camera)
    surface = visible_surface(alone, view, timestep)
    linear = shade_methods(alone, surface, timestep, ("full", "diffuse"))
    full, diffuse = (linear[method] for method in ("full", "diffuse"))
    region = pass_region(landmarks_of(capture, camera, timestep), view) & (full[..., 3] > 0)
    parts = diffuse[..., :3], full[..., :3] - diffuse[..., :3]
    return separation(*parts, truth.diffuse, truth.specular, region)


def compare(
    result: Reconstruction,
    capture: Capture,
    camera: str,
    timestep: int,
    region: Region = "face",
    baseline: bool = False,
) -> Comparison:
    """Render one view by all methods and find the region in which to compare it; see `evaluate`."""
    if timestep not in capture.timesteps:
        raise InputError(f"timestep {timestep} is not in the capture; it has {', '.join(map(str, capture.timesteps))}")
    capture = result.seen(capture)
    view = capture.camera(camera)
    model, vertices = result.model, result.geometry.vertices[result.index(timestep)]
    frame = capture.frame(camera, timestep)
    linear = shade_methods(result, visible_surface(result, view, timestep), timestep, result.methods)
    if region == "face":
        area = face_area(vertices, model.faces, model.face_mask, view)
    elif region == "skin":
        true = None
        with suppress(InputError):  # a truth of unknown faces
            true = true_mesh(capture, timestep, model)
        points, faces = (vertices, model.faces) if true is None else (true.vertices, true.faces)
        sight = image_based(capture, result.cameras, view, timestep, points, faces, oversampling=2)
        area = skin_region(landmarks_of(capture, camera, timestep), view) & sight.seen
    elif region == "truth":
        truth = true_mesh(capture, timestep, result.model)
        if truth is None:
            raise InputError(
                f"{capture.path}: has no true mesh of timestep {timestep} (truth/{timestep:04d}.npz); --region truth "
                "needs the capture's ground truth, or use --region face"
            )
        area = face_area(truth.vertices, truth.faces, truth.face_mask, view)
    else:
        raise InputError(f"region: found {region!r}, expected 'face', 'skin' or 'truth'")
    area &= frame.valid
    if not area.any():
        raise InputError(f"camera {camera}, timestep {timestep}: the face area is not visible, nothing to evaluate")
    renders = {m: rgba_8_bit(image) for m, image in linear.items()}
    photograph = to_8_bit(frame.image)
    if not baseline:
        return Comparison(timestep, photograph, area, renders)
    base = image_based(capture, result.cameras, view, timestep, vertices, model.faces, blends=BLENDS, oversampling=2)
    names = {blend: "image_based" if blend == BLENDS[0] else f"image_based_{blend}" for blend in BLENDS}
    blended = {names[blend]: to_8_bit(image) for blend, image in base.colours.items()}
    return Comparison(timestep, photograph, area, renders, blended, area & base.seen)


def rgba_8_bit(linear: NDArray) -> NDArray[np.uint8]:
    """Linear colour with coverage -> 8-bit sRGB with linear alpha."""
    alpha = np.round(255 * np.clip(linear[..., 3:], 0, 1)).astype(np.uint8)
    return np.concatenate([to_8_bit(linear[..., :3]), alpha], axis=-1)


def face_area(vertices: NDArray, faces: NDArray, face_mask: NDArray, camera: Camera) -> NDArray[np.bool_]:
    """(H, W) pixels whose centre sees the front of a face-area triangle, eroded by 2 pixels."""
    surface = trace_mesh(vertices, faces, camera, 1)
    area = np.zeros(camera.height * camera.width, dtype=bool)
    area[surface.pixel] = face_mask[surface.face]
    # The image's border is no border of the face.
    return binary_erosion(area.reshape(camera.height, camera.width), np.ones((5, 5)), border_value=1)
