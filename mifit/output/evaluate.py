"""Error of a reconstruction on a view, most honestly one that was not fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from mifit.core.camera import Camera
from mifit.core.flip import flip
from mifit.core.image import to_8_bit
from mifit.core.metrics import mean_squared_error, psnr_from_rmse, ssim
from mifit.errors import InputError
from mifit.output.deferred import shade_methods, trace_mesh, visible_surface
from mifit.progress import Progress, silent

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Method, Result

EROSION = 2
"""Pixels by which the face area shrinks before errors are measured in it."""


@dataclass(frozen=True)
class Comparison:
    """One view of one timestep beside the photograph, in 8-bit sRGB.

    Attributes
    ----------
    timestep : int
    photograph : (H, W, 3) uint8
    region : (H, W) bool
        Pixels that count, the same for all methods.
    renders : dict of method to (H, W, 4) uint8
        Colour and coverage; colour is 0 where the model covers nothing.
    """

    timestep: int
    photograph: NDArray[np.uint8]
    region: NDArray[np.bool_]
    renders: dict[Method, NDArray[np.uint8]]


def evaluate(
    reconstruction: Result,
    capture: Capture,
    camera: str,
    timesteps: Sequence[int] | None = None,
    region: Literal["model", "truth"] = "model",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare renders with photographs over the face area.

    Values are 8-bit sRGB. The region is the face area visible in the camera, eroded by 2 pixels, and the same for
    all methods. A pixel of the region that the fitted model does not cover is an error pixel: it was rendered as 0.
    Pixels that undistortion left without a value do not count. Over several timesteps the squared error is pooled
    over all pixels before PSNR and RMSE are taken.

    Parameters
    ----------
    reconstruction : Result
    capture : Capture
    camera : str
        A camera of the capture.
    timesteps : sequence of int, optional
        Default: the timesteps that were fitted.
    region : {"model", "truth"}
        ``model``: face area of the fitted model; ``truth``: face area of the capture's ground-truth mesh.
    progress : Progress

    Returns
    -------
    dict
        ``{"camera", "timesteps", "region", "region_pixels", "methods": {method: {"psnr", "rmse", "ssim",
        "flip"}}, "per_timestep": [{"timestep", "region_pixels", "methods"}]}``; PSNR in dB, RMSE 0..255, FLIP 0..1.

    Raises
    ------
    InputError
        Unknown camera or timestep, no ground truth, or a face area that is not visible.
    """
    steps = reconstruction.timesteps if timesteps is None else tuple(timesteps)
    per_timestep = []
    # Sums over pixels of squared error, similarity and FLIP error.
    sums = {method: np.zeros(3) for method in reconstruction.methods}
    pixels = 0
    progress("Evaluating", 0, len(steps))
    for done, timestep in enumerate(steps):
        found = compare(reconstruction, capture, camera, timestep, region)
        count = int(found.region.sum())
        pixels += count
        figures = {}
        for method, render in found.renders.items():
            pair = (render[..., :3], found.photograph, found.region)
            means = np.array([mean_squared_error(*pair), ssim(*pair), flip(*pair)])
            sums[method] += count * means
            figures[method] = _figures(means)
        per_timestep.append({"timestep": timestep, "region_pixels": count, "methods": figures})
        progress("Evaluating", done + 1, len(steps))
    return {
        "camera": camera,
        "timesteps": list(steps),
        "region": region,
        "region_pixels": pixels,
        "methods": {m: _figures(total / pixels) for m, total in sums.items()},
        "per_timestep": per_timestep,
    }


def _figures(means: NDArray) -> dict[str, float]:
    squared, likeness, flipped = map(float, means)
    error = math.sqrt(squared)
    return {"psnr": psnr_from_rmse(error), "rmse": error, "ssim": likeness, "flip": flipped}


def compare(
    reconstruction: Result,
    capture: Capture,
    camera: str,
    timestep: int,
    region: Literal["model", "truth"] = "model",
    methods: tuple[Method, ...] | None = None,
    oversampling: int = 2,
) -> Comparison:
    """Render one view by some methods (default: all) and find the region in which to compare it; see `evaluate`."""
    capture = capture.with_fitted(reconstruction.cameras)
    view = capture.camera(camera)
    reconstruction.index(timestep)
    if timestep not in capture.timesteps:
        raise InputError(f"timestep {timestep} is not in the capture; it has {', '.join(map(str, capture.timesteps))}")
    frame = capture.frame(camera, timestep)
    surface = visible_surface(reconstruction, view, timestep, oversampling)
    linear = shade_methods(reconstruction, surface, timestep, methods or reconstruction.methods)
    if region == "model":
        model, i = reconstruction.model, reconstruction.index(timestep)
        area = face_area(reconstruction.geometry.vertices[i], model.faces, model.face_mask, view)
    elif region == "truth":
        vertices, faces, mask = _truth(capture, reconstruction, timestep)
        area = face_area(vertices, faces, mask, view)
    else:
        raise InputError(f"region: found {region!r}, expected 'model' or 'truth'")
    area &= frame.valid
    if not area.any():
        raise InputError(f"camera {camera}, timestep {timestep}: the face area is not visible, nothing to evaluate")
    renders = {m: rgba_8_bit(as_photographed(reconstruction, image, camera)) for m, image in linear.items()}
    return Comparison(timestep, to_8_bit(frame.image), area, renders)


def as_photographed(reconstruction: Result, image: NDArray, camera: str) -> NDArray:
    """A render (H, W, 4) with the exposure and white balance that the fit found for a camera."""
    gain = reconstruction.geometry.gain(camera)
    return image if (gain == 1).all() else image * np.append(gain, np.float32(1.0))


def rgba_8_bit(linear: NDArray) -> NDArray[np.uint8]:
    """Linear colour with coverage -> 8-bit sRGB with linear alpha."""
    alpha = np.round(255 * np.clip(linear[..., 3:], 0, 1)).astype(np.uint8)
    return np.concatenate([to_8_bit(linear[..., :3]), alpha], axis=-1)


def face_area(vertices: NDArray, faces: NDArray, face_mask: NDArray, camera: Camera) -> NDArray[np.bool_]:
    """(H, W) pixels whose centre sees the front of a face-area triangle, eroded by 2 pixels."""
    surface = trace_mesh(vertices, faces, camera, 1)
    area = np.zeros(camera.height * camera.width, dtype=bool)
    area[surface.index] = face_mask[surface.face]
    side = 2 * EROSION + 1
    # The image's border is no border of the face.
    return binary_erosion(area.reshape(camera.height, camera.width), np.ones((side, side)), border_value=1)


def _truth(capture: Capture, reconstruction: Result, timestep: int) -> tuple[NDArray, NDArray, NDArray[np.bool_]]:
    """Vertices, faces and face area of the capture's ground-truth mesh.

    The mesh's faces are those that the truth folder carries (``faces`` and ``face_mask`` in ``mesh.npz``), else
    the fitted model's when the vertex counts agree.
    """
    folder = Path(capture.path) / "truth"
    path = folder / f"{timestep:04d}.npz"
    try:
        with np.load(path, allow_pickle=False) as data:
            vertices = data["vertices"]
    except FileNotFoundError:
        raise InputError(
            f"{path}: missing; --region truth needs the capture's ground truth, or use --region model"
        ) from None
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not a readable ground-truth file with an array 'vertices' ({error})") from None
    mesh = folder / "mesh.npz"
    if mesh.exists():
        with np.load(mesh, allow_pickle=False) as data:
            if "faces" not in data:
                raise InputError(f"{mesh}: has no array 'faces'")
            faces = data["faces"]
            mask = data["face_mask"].astype(bool) if "face_mask" in data else np.ones(len(faces), dtype=bool)
        return vertices, faces, mask
    model = reconstruction.model
    if len(vertices) != len(model.mean):
        raise InputError(
            f"{path}: found {len(vertices)} vertices, but the fitted model {model.name!r} has {len(model.mean)}, "
            f"so its faces don't fit; expected {mesh} with the truth's faces, or use --region model"
        )
    return vertices, model.faces, model.face_mask
