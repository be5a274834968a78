"""A reconstruction under another lighting."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.appearance.illumination import Illumination
from mifit.core.files import file_name, replacing, write_text
from mifit.core.image import encode_png, read_image, to_8_bit, write_image
from mifit.core.metrics import psnr, rmse
from mifit.core.sh import LUMINANCE, SHLighting
from mifit.errors import InputError
from mifit.output.evaluate import face_area
from mifit.output.figures import HEAT_LIMIT, heat_map
from mifit.output.turntable import sheet
from mifit.progress import Progress, silent
from mifit.result.record import R

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.core.camera import Camera
    from mifit.result import Method, Result

MAP_ROWS = 512
"""Rows to which an environment is reduced; finer light than 0.35 degrees makes no difference on skin."""


def relit(
    reconstruction: R,
    environment: str | Path | NDArray,
    rotate: float = 0.0,
    exposure: float | None = None,
) -> R:
    """Replace the lighting of a reconstruction; see `Reconstruction.relight`."""
    reflectance = reconstruction.reflectance
    if reflectance is None:
        raise InputError("relighting needs reflectance, but this fit ended after the geometry stage; fit it further")
    name = environment if isinstance(environment, (str, Path)) else "environment"
    image = read_image(environment) if isinstance(environment, (str, Path)) else np.asarray(environment, np.float32)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 8 or not np.isfinite(image).all():
        raise InputError(f"{name}: found an image of shape {image.shape}, expected a finite lat-long image (H, W, 3)")
    if (image < 0).any() or not image.any():
        raise InputError(f"{name}: found negative or only black pixels, expected linear radiance")
    if image.shape[0] > MAP_ROWS:
        width = round(image.shape[1] * MAP_ROWS / image.shape[0])
        image = cv2.resize(image, (width, MAP_ROWS), interpolation=cv2.INTER_AREA)
    angle = np.radians(rotate)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    lighting = SHLighting.from_envmap(image, reconstruction.lighting.order).rotate(turn)
    before = float(reconstruction.lighting.coefficients[0] @ LUMINANCE)
    after = float(lighting.coefficients[0] @ LUMINANCE)
    if exposure is None:
        exposure = before / after
    if not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure: found {exposure!r}, expected a positive number")
    # The ambient term stands for light that the model leaves out, such as interreflection: it grows with the light.
    ambient = reflectance.illumination.ambient * exposure * after / before
    changed = replace(reflectance, illumination=Illumination(exposure * lighting.coefficients, ambient=ambient))
    return replace(reconstruction, reflectance=changed, environment=exposure * _turned(image, angle))


def _turned(image: NDArray[np.float32], angle: float) -> NDArray[np.float32]:
    """A lat-long image with the environment turned about +y: what came from azimuth phi comes from phi - angle."""
    width = image.shape[1]
    shift = -angle / (2 * np.pi) * width
    whole = int(np.floor(shift))
    part = np.float32(shift - whole)
    rolled = np.roll(image, whole, axis=1)
    return rolled * (1 - part) + np.roll(rolled, 1, axis=1) * part


def write_relit(
    reconstruction: Result,
    environment: str | Path,
    folder: str | Path,
    rotate: float = 0.0,
    exposure: float | None = None,
    samples: int = 128,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, float]:
    """Write views under a measured environment: the fast path, the path-traced one, and their difference.

    The first timestep is shown from every fitted camera. ``NAME_fast.png`` shades the visible surface under the
    environment's spherical harmonics; ``NAME_path.png`` traces paths under the whole environment, with shadows and
    interreflection; ``NAME_difference.png`` is the error between them; ``relight.png`` shows all in rows, and
    ``relight.json`` holds exposure and figures.

    Returns
    -------
    dict
        ``exposure``, and ``psnr`` (dB) and ``rmse`` (0..255) between fast path and path tracing in 8-bit sRGB, over
        the pixels that the head covers in all views.
    """
    folder = Path(folder)
    lit = relit(reconstruction, environment, rotate, exposure)
    timestep = lit.timesteps[0]
    rows, pairs = [], []
    total = 2 * len(lit.cameras)
    progress("Relighting", 0, total)
    for k, camera in enumerate(lit.cameras):
        fast = lit.render(camera, timestep)
        progress("Relighting", 2 * k + 1, total)
        path = lit.render(camera, timestep, integrator="path", samples=samples, seed=seed)
        progress("Relighting", 2 * k + 2, total)
        name = file_name(camera.name)
        write_image(folder / f"{name}_fast.png", fast)
        write_image(folder / f"{name}_path.png", path)
        covered = (fast[..., 3] == 1) & (path[..., 3] > 0.99)
        a, b = to_8_bit(fast[..., :3]), to_8_bit(path[..., :3])
        with replacing(folder / f"{name}_difference.png") as temporary:
            temporary.write_bytes(encode_png(heat_map(b, a, covered)))
        rows.append([fast, path])
        pairs.append((a[covered], b[covered]))
    fast_codes, path_codes = (np.concatenate([p[j] for p in pairs])[None] for j in (0, 1))
    used = float(lit.illumination.radiance[0] @ LUMINANCE)
    figures = {
        "psnr": psnr(fast_codes, path_codes),
        "rmse": rmse(fast_codes, path_codes),
        "mean_radiance": used / np.sqrt(4 * np.pi),
        "difference_limit": HEAT_LIMIT,
    }
    write_image(folder / "relight.png", sheet(rows))
    write_text(folder / "relight.json", json.dumps({"rotate": rotate, **figures}, indent=1) + "\n")
    return figures


def evaluate_relit(
    reconstruction: Result,
    environment: str | Path | NDArray,
    capture: Capture,
    camera: str,
    rotate: float = 0.0,
    integrator: Literal["local", "path"] = "local",
    samples: int = 64,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare a relit reconstruction with photographs of the same head, in the same poses, under that environment.

    The two captures' exposures are not known to each other, so each method gets one factor on its brightness: the
    least-squares one over the cameras that were fitted, in the new capture. The judged camera must be another one.

    Parameters
    ----------
    reconstruction : Result
        Fitted to the head under another lighting.
    environment, rotate
        As in `Reconstruction.relight`.
    capture : Capture
        The head under the environment.
    camera : str
        Camera to judge by.
    integrator, samples, seed
        As in `Reconstruction.render`.

    Returns
    -------
    dict
        ``camera``, ``timesteps``, ``region_pixels`` and ``methods``: PSNR (dB), RMSE (0..255) in 8-bit sRGB over the
        fitted model's face area, and the exposure, for ``diffuse`` and ``full``.

    Raises
    ------
    InputError
        The judged camera was fitted, or a camera or timestep is missing in the capture.
    """
    if camera in [c.name for c in reconstruction.cameras]:
        raise InputError(f"camera {camera}: was fitted; expected another one to judge by")
    lit = relit(reconstruction, environment, rotate)
    steps = [t for t in lit.timesteps if t in capture.timesteps]
    if not steps:
        raise InputError(f"the capture has none of the timesteps {', '.join(map(str, lit.timesteps))}")

    def views(name: str, timesteps: list[int], method: Method) -> tuple[NDArray, NDArray]:
        """Photographed and rendered linear colours (N, 3) in the face area."""
        view: Camera = capture.camera(name)
        photographs, renders = [], []
        for t in timesteps:
            frame = capture.frame(name, t)
            vertices = lit.geometry.vertices[lit.index(t)]
            area = face_area(vertices, lit.model.faces, lit.model.face_mask, view) & frame.valid
            render = lit.render(view, t, method, integrator, samples if integrator == "path" else None, seed)
            photographs.append(frame.image[area])
            renders.append(render[area][:, :3])
        return np.concatenate(photographs), np.concatenate(renders)

    methods = {}
    for method in ("diffuse", "full"):
        pairs = [views(c.name, steps[:1], method) for c in reconstruction.cameras]
        photograph, render = (np.concatenate(part).astype(np.float64) for part in zip(*pairs, strict=True))
        exposure = float((photograph * render).sum() / max(float((render * render).sum()), 1e-12))
        photograph, render = views(camera, steps, method)
        codes, expected = to_8_bit(exposure * render)[None], to_8_bit(photograph)[None]
        methods[method] = {"psnr": psnr(codes, expected), "rmse": rmse(codes, expected), "exposure": exposure}
    return {"camera": camera, "timesteps": steps, "region_pixels": len(photograph), "methods": methods}
