"""``mifit.refine``: surface, maps, lighting and normals anew, from more frames of a video than were fitted jointly.

Frames that lie far apart in pose are chosen, the face is followed into them, those that contradict the fit are left out
by name, and all stages after the model's fit run again with them. At most `MOST` frames enter, however long the video.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mifit.capture import Capture
from mifit.capture.choose_frames import choose_frames
from mifit.config import FitConfig, from_mapping
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.core.files import Document
from mifit.core.process import one_blas_thread
from mifit.errors import ConvergenceError, InputError
from mifit.progress import Progress, silent
from mifit.result import Reconstruction
from mifit.stages.eyes import behind_lids
from mifit.stages.find_residual import find_residual
from mifit.stages.find_surface import find_surface
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.normals.refine_mesh import refine_mesh
from mifit.stages.normals.refine_normals import refine_normals
from mifit.stages.photometry import find_photometry
from mifit.stages.refine_surface import refine_surface
from mifit.tracking import Follower

MOST = 16
"""Frames that enter, fitted ones included."""


@checked
@one_blas_thread()
def refine(
    result: Reconstruction,
    capture: Capture,
    timesteps: Sequence[int] | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Reconstruction:
    """A result with surface, maps, lighting and normals found anew, from further frames too.

    Parameters
    ----------
    result : Reconstruction
        With reflectance.
    capture : Capture
        The one that was fitted.
    timesteps : sequence of int, optional
        Frames to choose from; default: all of the capture. Those that the result has no geometry for are followed.
    seed : int
        As in `mifit.fit`.
    progress : Progress

    Returns
    -------
    Reconstruction
        With the timesteps that were fitted jointly; tracked ones, which belong to the old surface and maps, are to be
        tracked again. A fit in the model's span stays there. The reflectance's report (``"refined"``) says which
        frames entered and which were left out, and why.

    Raises
    ------
    InputError
        A result without reflectance, or a timestep that the capture lacks.
    ConvergenceError
        As in `mifit.infer_reflectance`.
    """
    if result.reflectance is None:
        raise InputError("refine: found a result without reflectance, expected one of 'mifit fit' with all stages")
    wanted = capture.timesteps if timesteps is None else tuple(timesteps)
    if unknown := [t for t in wanted if t not in capture.timesteps]:
        raise InputError(f"timestep {unknown[0]}: not in the capture; it has {', '.join(map(str, capture.timesteps))}")
    stored = {key: value for key, value in result.config.items() if key != "seed"}
    config = from_mapping(FitConfig, stored, "result.json: config")
    model, names = result.model, [camera.name for camera in result.cameras]
    plain, capture = capture.with_fitted(result.cameras), result.seen(capture)
    fitted = result.fitted
    further = [t for t in wanted if t not in fitted]
    chosen = choose_frames(capture, names, MOST - len(fitted), further, fitted) if further else None
    left_out = {} if chosen is None else {t: why for t, why in chosen.left_out.items() if t in further}
    geometry, failed = _followed(result, capture, () if chosen is None else chosen.timesteps, config, progress)
    if geometry.displacement is not None:
        found = find_surface(capture, model, geometry, names, config.surface, progress)
        geometry = behind_lids(model, found)
    if config.photometry.enabled:
        photometry = find_photometry(plain, model, geometry, names, config.photometry, seed, progress)
        geometry, capture = replace(geometry, photometry=photometry), plain.with_photometry(photometry)
    if geometry.displacement is not None and config.surface.shading:
        found = refine_surface(capture, model, geometry, names, config.reflectance, seed, progress)
        geometry = behind_lids(model, found)
    reflectance = infer_reflectance(capture, model, geometry, names, config.reflectance, seed, progress)
    refined = {
        "timesteps": list(geometry.timesteps),
        "left_out": {str(t): why for t, why in (left_out | failed).items()},
    }
    lines = tuple(
        Diagnostic("timestep-left-out", f"timestep {t}: left out of the refinement, {why}") for t, why in failed.items()
    )
    report = replace(reflectance.report, warnings=(*reflectance.report.warnings, *lines)).noting(refined=refined)
    reflectance = replace(reflectance, report=report)
    home = geometry.at(fitted)
    normals = refine_normals(capture, model, home, reflectance, names, config.normals, seed=seed, progress=progress)
    mesh = refine_mesh(model, home, normals, config.mesh, progress) if result.mesh is not None else None
    residual = None
    if result.residual is not None:
        given = capture, model, home, reflectance, normals, names
        residual = find_residual(*given, config.residual, progress)
    return replace(result, geometry=home, reflectance=reflectance, normals=normals, mesh=mesh, residual=residual)


def _followed(
    result: Reconstruction, capture: Capture, further: Sequence[int], config: FitConfig, progress: Progress
) -> tuple[GeometryEstimate, dict[int, str]]:
    """Geometry of the fitted and of further timesteps, and why some of these are left out."""
    cameras, fitted = [camera.name for camera in result.cameras], result.fitted
    home = result.geometry.at(fitted)
    usual = float(np.median([_difference(result, capture, home.at((t,))) for t in fitted]))
    follower: Follower | None = None
    found, failed = [home], {}
    for done, timestep in enumerate(further):
        progress("follow frames", done, len(further))
        try:
            if timestep in result.timesteps:
                one = result.geometry.at((timestep,))
            else:
                follower = follower or Follower(capture, result.model, home, cameras, config.geometry)
                one = follower.next(timestep)[0]
        except ConvergenceError:
            failed[timestep] = "the face isn't found in it"
            continue
        times = _difference(result, capture, one) / max(usual, 1e-6)
        if times > 3.0:  # relative to the fitted frames
            failed[timestep] = f"it differs {times:.1f} times as much from the fit as the fitted frames: its light?"
        else:
            found.append(one)
    progress("follow frames", len(further), len(further))
    timesteps = tuple(t for one in found for t in one.timesteps)
    names = ("expression", "rotation", "translation", "vertices")
    arrays: Document = {name: np.concatenate([getattr(one, name) for one in found]) for name in names}
    return replace(home, timesteps=timesteps, **arrays).at(sorted(timesteps)), failed


def _difference(result: Reconstruction, capture: Capture, geometry: GeometryEstimate) -> float:
    """Median difference of a frame, at one exposure, from what maps and lighting predict; the largest of the views."""
    predicted = replace(result, geometry=geometry, normals=None, mesh=None, residual=None)
    found = []
    for camera in result.cameras:
        frame = capture.frame(camera.name, geometry.timesteps[0])
        shown = predicted.render(camera, geometry.timesteps[0])
        usable = frame.valid & ~frame.clipped & (shown[..., 3] > 0.5)
        image, shown = frame.image[usable], shown[usable, :3]
        exposure = np.median(image) / max(float(np.median(shown)), 1e-6) if usable.any() else 1.0
        off = np.abs(image - exposure * shown).mean(axis=1) / max(exposure, 1e-6)
        found.append(float(np.median(off)) if usable.any() else np.inf)
    return max(found)
