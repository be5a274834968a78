"""A reconstruction under another lighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.appearance.environment import illumination_of
from mifit.appearance.illumination import Illumination
from mifit.core.camera import Camera
from mifit.core.files import Document, file_name, write_json
from mifit.core.image import check_environment, read_environment, reduced, to_8_bit, write_image
from mifit.core.metrics import psnr, rmse
from mifit.core.sh import LUMINANCE, SHLighting
from mifit.errors import InputError
from mifit.output.deferred import SampledMaterial, VisibleSurface, shade_methods, surface_material, visible_surface
from mifit.output.scene import render_view
from mifit.output.views import check_moving, sheet, write_moving
from mifit.progress import Progress, silent
from mifit.result import Reconstruction

AGREEMENT = 30.0
"""PSNR in dB between fast and path-traced views below which a person is warned. Five measured environments gave 31.6 to
36.9 dB on a fitted head, the least under a bare lamp at 256 samples a pixel."""
Lighting = str | Path | NDArray | SHLighting | Illumination
"""What a face can be put under: an environment file or image, spherical harmonics, or everything that lights it."""
Exposure = float | Literal["auto"]
"""Factor on a lighting's radiance; ``auto`` gives it the mean luminance of the capture's."""


def relit(
    result: Reconstruction, lighting: Lighting, rotations: Sequence[float | NDArray] = (0.0,), exposure: Exposure = 1.0
) -> list[Reconstruction]:
    """The face under a lighting that is turned in several ways; see `Reconstruction.relight`."""
    reflectance = result.reflectance
    if reflectance is None:
        raise InputError("relighting needs reflectance, but this fit ended after the geometry stage; fit it further")
    if exposure != "auto" and not (isinstance(exposure, (int, float)) and np.isfinite(exposure) and exposure > 0):
        raise InputError(f"exposure: found {exposure!r}, expected a positive number or 'auto'")
    turns = [_rotation(rotation) for rotation in rotations]
    if isinstance(lighting, Illumination):
        if exposure == "auto":
            raise InputError("exposure: found 'auto', expected a number: this lighting has a level of its own")
        lit = lighting.scaled(exposure)
        return [result.with_illumination(lit.rotated(turn)) for turn in turns]
    image, order = None, result.lighting.order
    if isinstance(lighting, SHLighting):
        found = Illumination(lighting.coefficients)
    else:
        image = _environment(lighting)
        plain = reflectance.lobe.fresnel is None  # the paper's model knows harmonics alone
        found = (
            Illumination(SHLighting.from_envmap(image, order).coefficients) if plain else illumination_of(image, order)
        )
    level = _level(result.lighting) / _level(found.smooth())
    factor = level if exposure == "auto" else float(exposure)
    # The ambient term stands for light that the model leaves out, such as interreflection: it grows with the light.
    lit = replace(found.scaled(factor), ambient=reflectance.illumination.ambient * factor / level)
    shown = None if image is None else (factor * image).astype(np.float32)
    return [
        replace(
            result.with_illumination(lit.rotated(turn)),
            environment=shown,
            environment_rotation=None if shown is None else turn,
        )
        for turn in turns
    ]


def _level(lighting: SHLighting) -> float:
    """Mean luminance over all directions."""
    level = float(lighting.coefficients[0] @ LUMINANCE) / float(np.sqrt(4 * np.pi))
    if not level > 0:
        raise InputError(f"lighting: found a mean luminance of {level:g}, expected one above 0")
    return level


def _environment(source: str | Path | NDArray) -> NDArray[np.float32]:
    """A lat-long image of linear radiance, checked and `reduced`."""
    if isinstance(source, (str, Path)):
        return reduced(read_environment(source))
    return reduced(check_environment("environment", np.asarray(source, np.float32)))


def _rotation(value: float | NDArray) -> NDArray[np.float64]:
    """(3, 3) rotation: itself, or about +y by degrees."""
    if np.ndim(value) == 0:
        if not np.isfinite(value):
            raise InputError(f"rotation: found {value}, expected a finite angle in degrees")
        return Rotation.from_euler("y", float(value), degrees=True).as_matrix()
    turn = np.asarray(value, dtype=np.float64)
    if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
        raise InputError(f"rotation: found {turn.tolist()}, expected degrees about +y or a rotation matrix (3, 3)")
    return turn


def write_relit(
    result: Reconstruction,
    environment: str | Path,
    folder: str | Path,
    cameras: Sequence[Camera] = (),
    rotations: Sequence[float] = (0.0,),
    exposure: Exposure = 1.0,
    video: str | Path | None = None,
    fps: float = 12.0,
    integrator: Literal["local", "path"] = "local",
    check: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Document:
    """Write views of the first timestep under a measured environment.

    ``NAME.png`` (RGBA) is a camera's view, or ``NAME_NNN.png`` where the light is turned several times; ``relight.png``
    shows several cameras side by side; ``relight.json`` holds what is returned.

    The cameras are by default the fitted ones. ``rotations`` are degrees by which the environment is turned about the
    vertical; what no light changes is computed once. ``exposure`` is as in `Reconstruction.relight`. The turning light
    goes into a ``video``, ``.mp4`` or ``.webp``, with ``fps`` rotations per second, in place of images. ``local``
    traces no paths, ``path`` 144 per pixel, see `Reconstruction.render`; ``check`` compares both in one small view: the
    first camera's at a quarter of the size.

    Returns ``exposure``; ``capture_exposure``, the one that gives the capture's mean luminance; ``mean_radiance``,
    ``rotations``, ``integrator``, ``files``; with ``check`` PSNR (dB) and RMSE (0..255) of the fast view against the
    path-traced one in 8-bit sRGB, over the pixels that the head covers.
    """
    folder = Path(folder)
    if video is not None:
        check_moving(video)
    image = _environment(environment)
    lits = relit(result, image, rotations, exposure)
    timestep, views = lits[0].timesteps[0], list(cameras) or list(result.cameras)
    if not views:
        raise InputError("this result has no cameras to show it from; give one")
    level = _level(SHLighting.from_envmap(image, 1))
    capture_exposure = _level(result.lighting) / level
    used = capture_exposure if exposure == "auto" else float(exposure)
    shared: list[tuple[VisibleSurface, SampledMaterial]] = []
    if integrator == "local":
        surfaces = [visible_surface(lits[0], camera, timestep) for camera in views]
        shared = [(surface, surface_material(lits[0], surface, timestep)) for surface in surfaces]
    total, written = len(lits) * len(views), []

    def shown(k: int) -> list[NDArray]:
        """Views of the k-th rotation; each is written as soon as it is there, unless for a video."""
        images = []
        for c, camera in enumerate(views):
            progress("Relighting", k * len(views) + c, total)
            if shared:
                surface, material = shared[c]
                image = shade_methods(lits[k], surface, timestep, ("full",), material)["full"]
            else:
                samples = 144 if integrator == "path" else None
                image = render_view(lits[k], camera, timestep, "full", integrator, samples, seed)
            images.append(image)
            if video is None:
                number = f"_{k:03d}" if len(lits) > 1 else ""
                written.append(f"{file_name(camera.name)}{number}.png")
                write_image(folder / written[-1], image)
        return images

    if video is not None:
        write_moving(video, (np.concatenate(shown(k), axis=1) for k in range(len(lits))), fps)
        written.append(str(video))
    else:
        first, *_ = [shown(k) for k in range(len(lits))]
        if len({image.shape for image in first}) == 1 < len(first):
            write_image(folder / "relight.png", sheet([first]))
            written.append("relight.png")
    progress("Relighting", total, total)
    figures: Document = {
        "environment": Path(environment).name,
        "exposure": used,
        "capture_exposure": capture_exposure,
        "mean_radiance": used * level,
        "rotations": list(rotations),
        "integrator": integrator,
        "files": written,
    }
    if check:
        figures["check"] = _check(lits[0], views[0].resized(0.25), timestep, seed)
    write_json(folder / "relight.json", figures)
    return figures


def _check(lit: Reconstruction, camera: Camera, timestep: int, seed: int) -> dict[str, float]:
    """Error of a fast view against the path-traced one, over the pixels that the head covers."""
    fast = render_view(lit, camera, timestep)
    path = render_view(lit, camera, timestep, integrator="path", samples=144, seed=seed)
    covered = (fast[..., 3] == 1) & (path[..., 3] > 0.99)
    a, b = to_8_bit(fast[..., :3])[covered][None], to_8_bit(path[..., :3])[covered][None]
    return {"psnr": psnr(a, b), "rmse": rmse(a, b)}
