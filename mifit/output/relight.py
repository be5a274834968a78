"""A reconstruction under another lighting."""

from __future__ import annotations

import json
from collections.abc import Sequence
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

AGREEMENT = 30.0
"""PSNR in dB between fast and path-traced views below which a person is warned. Five measured environments gave 31.6 to
36.9 dB on a fitted head, the least under a bare lamp at 256 samples a pixel."""
MAP_ROWS = 512
"""Rows to which an environment is reduced; finer light than 0.35 degrees makes no difference on skin."""


Lighting = str | Path | NDArray | SHLighting | Illumination
"""What a face can be put under: an environment file or image, spherical harmonics, or everything that lights it."""


def relit(reconstruction: R, lighting: Lighting, rotate: float | NDArray = 0.0, exposure: float | None = None) -> R:
    """Replace the lighting of a reconstruction; see `Reconstruction.relight`."""
    return relit_many(reconstruction, lighting, [rotate], exposure)[0]


def relit_many(
    reconstruction: R, lighting: Lighting, rotations: Sequence[float | NDArray], exposure: float | None = None
) -> list[R]:
    """Replace the lighting by one that is turned in several ways; an environment is read and projected once."""
    reflectance = reconstruction.reflectance
    if reflectance is None:
        raise InputError("relighting needs reflectance, but this fit ended after the geometry stage; fit it further")
    if exposure is not None and not (np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure: found {exposure!r}, expected a positive number")
    turns = [_rotation(rotation) for rotation in rotations]
    if isinstance(lighting, Illumination):
        lit = lighting if exposure is None else lighting.scaled(exposure)
        middle = reconstruction.geometry.middle
        return [reconstruction.with_illumination(lit.rotated(turn, middle)) for turn in turns]
    before = float(reconstruction.lighting.coefficients[0] @ LUMINANCE)
    image = None if isinstance(lighting, SHLighting) else _environment(lighting)
    smooth = SHLighting.from_envmap(image, reconstruction.lighting.order) if image is not None else lighting
    after = float(smooth.coefficients[0] @ LUMINANCE)
    if not after > 0:
        raise InputError(f"lighting: found a mean luminance of {after:g}, expected one above 0")
    if exposure is None:
        exposure = before / after if image is not None else 1.0
    # The ambient term stands for light that the model leaves out, such as interreflection: it grows with the light.
    ambient = reflectance.illumination.ambient * exposure * after / before
    lit = Illumination(exposure * smooth.coefficients, ambient=ambient)
    shown = None if image is None else (exposure * image).astype(np.float32)
    return [
        replace(
            reconstruction.with_illumination(lit.rotated(turn)),
            environment=shown,
            environment_rotation=None if shown is None else turn,
        )
        for turn in turns
    ]


def _environment(source: str | Path | NDArray) -> NDArray[np.float32]:
    """A lat-long image of linear radiance, checked, of at most `MAP_ROWS` rows."""
    name = source if isinstance(source, (str, Path)) else "environment"
    image = read_image(source) if isinstance(source, (str, Path)) else np.asarray(source, np.float32)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 8 or not np.isfinite(image).all():
        raise InputError(f"{name}: found an image of shape {image.shape}, expected a finite lat-long image (H, W, 3)")
    if (image < 0).any() or not image.any():
        raise InputError(f"{name}: found negative or only black pixels, expected linear radiance")
    if image.shape[0] > MAP_ROWS:
        width = round(image.shape[1] * MAP_ROWS / image.shape[0])
        image = cv2.resize(image, (width, MAP_ROWS), interpolation=cv2.INTER_AREA)
    return image


def _rotation(value: float | NDArray) -> NDArray[np.float64]:
    """(3, 3) rotation: itself, or about +y by degrees."""
    if np.ndim(value) == 0:
        if not np.isfinite(value):
            raise InputError(f"rotation: found {value}, expected a finite angle in degrees")
        angle = np.radians(float(value))
        return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turn = np.asarray(value, dtype=np.float64)
    if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
        raise InputError(f"rotation: found {turn.tolist()}, expected degrees about +y or a rotation matrix (3, 3)")
    return turn


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
    environment without tracing paths (``appearance.environment``); ``NAME_path.png``
    traces paths under the whole environment, with shadows and
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
    capture = capture.with_fitted(reconstruction.cameras)
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
