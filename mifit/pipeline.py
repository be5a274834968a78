"""``mifit.fit``: capture and model -> geometry -> reflectance -> normals, mesh -> reconstruction.

The steps are a list (`mifit.steps`); here is what is checked before and said after them.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from mifit.capture.choose_frames import FrameChoice
from mifit.config import FitConfig
from mifit.core.estimate import GeometryEstimate
from mifit.core.threads import one_blas_thread
from mifit.errors import InputError
from mifit.progress import Progress, silent
from mifit.steps import STAGES, Part, Source, Stage, run_steps, steps

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel
    from mifit.reconstruction import Reconstruction
    from mifit.result import Result

T = TypeVar("T")
ESTIMATED_CAMERAS = "the capture is uncalibrated: focal length, camera poses and so the scale are estimates"
BASELINE_DEGREES = 3.0
"""Angle between the views below which a person is told that distance is not measured."""


@one_blas_thread()
def fit(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str] | None = None,
    timesteps: Sequence[int] | FrameChoice | None = None,
    config: FitConfig | None = None,
    until: Stage = "normals",
    seed: int = 0,
    progress: Progress = silent,
    checkpoints: str | Path | None = None,
    shared: bool = False,
    watch: Callable[[Reconstruction], None] | None = None,
) -> Reconstruction:
    """Recover geometry, reflectance, lighting and normals of a face from a capture.

    Parameters
    ----------
    capture : Capture
        Images with cameras and landmarks.
    model : MorphableModel
        The face model to fit. One whose eyes are holes gets simple ones, unless ``[geometry] eyes`` is false: the
        result's ``model``, whose vertices begin with this one's.
    cameras : sequence of str, optional
        Cameras to use; no other camera's images are read. Default: the capture's first two.
    timesteps : sequence of int or FrameChoice, optional
        Timesteps to fit jointly, named in any order; default: the first four. A choice (`mifit.choose_frames`) is kept
        with its reasons in ``geometry.report.details["frames"]``.
    config : FitConfig, optional
        Settings of the stages.
    until : {"geometry", "reflectance", "normals"}
        Last stage to run; the mesh update goes with the normals.
    seed : int
        Seed of everything random.
    progress : Progress
        Called as work advances.
    checkpoints : path, optional
        Folder for finished stages. A stage found there, computed from the same inputs, isn't run again.
    shared : bool
        Whether fits with other settings use that folder too: the stages that they have in common run once.
    watch : callable, optional
        Called after each step with the result so far.

    Returns
    -------
    Reconstruction

    Raises
    ------
    InputError
        An unknown camera, timestep or stage, or inputs that a stage can't use.
    ConvergenceError
        A stage that ended without a usable result.

    Notes
    -----
    The three stages of Song, Zheng, Cai, Cham, "Recovering Facial Reflectance and Geometry from Multi-view
    Images", sections 4 to 6. A Mitsuba variant must be active (``mifit.set_variant``).
    """
    from mifit.reconstruction import Reconstruction
    from mifit.render.variant import check_active_variant

    check_active_variant()
    config = config or FitConfig()
    cameras = choose("camera", capture.cameras, cameras, 2)
    choice = timesteps if isinstance(timesteps, FrameChoice) else None
    timesteps = choose_timesteps(capture, timesteps)
    if until not in STAGES:
        raise InputError(f"until: found {until!r}, expected one of {', '.join(STAGES)}")
    check_images(capture, cameras, timesteps)
    digest = capture.digest(cameras, timesteps)
    given, model = model, fitted_model(model, config)
    estimated: tuple[str, ...] = ()
    if not capture.calibrated:
        from mifit.extras.calibrate_densely import calibrate_capture

        dense = calibrate_capture(capture, model, cameras, timesteps, progress)
        capture, estimated = dense.capture, (ESTIMATED_CAMERAS, dense.note)
    source = Source(capture, digest, model, cameras, timesteps, seed)

    def result(estimates: Mapping[Part, Any], seconds: float = 0.0) -> Reconstruction:
        return Reconstruction(
            model=model,
            **cast(dict, estimates),
            config={**dataclasses.asdict(config), "seed": seed},
            cameras=tuple(capture.camera(name) for name in cameras),
            capture_digest=digest,
            model_source=model.source,
            units=capture.units,
            unit_mm=capture.unit_mm,
            warnings=(
                *estimated,
                *one_place(capture, cameras, estimates["geometry"]),
                *eyes_note(given, model),
            ),
            seconds=seconds,
            peak_memory=peak_memory(),
        )

    estimates, seconds = run_steps(
        steps(config, until),
        source,
        progress,
        None if checkpoints is None else Path(checkpoints),
        shared,
        None if watch is None else lambda so_far: watch(result(so_far)),
    )
    if choice is not None:
        geometry = estimates["geometry"]
        details = {**geometry.report.details, "frames": choice.document()}
        report = dataclasses.replace(geometry.report, details=details)
        estimates["geometry"] = dataclasses.replace(geometry, report=report)
    return result(estimates, seconds)


def check_images(capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]) -> None:
    """Raise InputError for an image that is black or clipped throughout: nothing of the face can be measured in it."""
    for timestep in timesteps:
        for name in cameras:
            frame = capture.frame(name, timestep)
            if not (frame.image[frame.valid & ~frame.clipped] > 0).any():
                raise InputError(
                    f"camera {name}, timestep {timestep}: every usable pixel is black or clipped, expected a photo; "
                    "leave the camera or the timestep out, or check its mask"
                )


def fitted_model(model: MorphableModel, config: FitConfig) -> MorphableModel:
    """The model that a fit uses: the given one, with simple eyes where its own are holes and the settings want them."""
    from mifit.morphable.openings import lacks_eyes, with_eyes

    return with_eyes(model) if config.geometry.eyes and lacks_eyes(model) else model


def eyes_note(given: MorphableModel, fitted: MorphableModel) -> tuple[str, ...]:
    """What to say of the eyes: that the fit put some into a model, or that renders will look through holes."""
    from mifit.morphable.openings import STRIP, lacks_eyes

    if fitted is not given:
        return (
            f"the eyes of model {given.name} are holes: the fit put simple eyes and the inside of a mouth there, and "
            f"the layout of its maps lies {100 * STRIP:.0f} % higher than the model's own; [geometry] eyes = false "
            "leaves the model as it is",
        )
    if not lacks_eyes(fitted):
        return ()
    return (f"the eyes of model {fitted.name} are holes; [geometry] eyes = true puts simple ones there",)


def one_place(capture: Capture, cameras: Sequence[str], geometry: GeometryEstimate) -> tuple[str, ...]:
    """A warning when the landmarks are seen from so nearly one place that the head's distance isn't measured."""
    seen = [name for name in cameras if any(capture.frame(name, t).visible.any() for t in geometry.timesteps)]
    towards = np.array([capture.camera(name).position for name in seen]) - geometry.vertices[0].mean(axis=0)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    apart = float(np.degrees(np.arccos(np.clip((towards @ towards.T).min(), -1.0, 1.0))))
    if apart >= BASELINE_DEGREES:
        return ()
    place = f"landmarks in camera {seen[0]} alone" if len(seen) == 1 else f"cameras {apart:.1f} degrees apart"
    return (f"{place}: how far away and so how large the head is rests on the model's size more than on the images",)


def choose(kind: str, known: Sequence[T], wanted: Sequence[T] | None, default: int) -> tuple[T, ...]:
    """The wanted cameras or timesteps, checked, without repeats; the first ``default`` ones when none is named."""
    if wanted is None:
        return tuple(known[:default])
    for item in wanted:
        if item not in known:
            raise InputError(f"{kind} {item!r}: not in the capture; it has {', '.join(map(str, known))}")
    if not wanted:
        raise InputError(f"no {kind} named; the capture has {', '.join(map(str, known))}")
    return tuple(dict.fromkeys(wanted))


def choose_timesteps(capture: Capture, wanted: Sequence[int] | FrameChoice | None) -> tuple[int, ...]:
    """The timesteps of a fit, checked, in ascending order; the first four when none is named.

    Sums over timesteps round differently in another order, and a search may then end a millimetre elsewhere where the
    images hardly tell: the order in which a user names them must not matter.
    """
    named = wanted.timesteps if isinstance(wanted, FrameChoice) else wanted
    return tuple(sorted(choose("timestep", capture.timesteps, named, 4)))


def fitted_to(result: Result, capture: Capture) -> bool:
    """Whether a result was fitted to this very capture: its calibration, images, masks and landmarks."""
    names = [camera.name for camera in result.cameras]
    tracked = [] if result.normals is None else result.normals.report.details.get("tracked", [])
    timesteps = [t for t in result.timesteps if t not in tracked]
    if not set(names) <= set(capture.cameras) or not set(timesteps) <= set(capture.timesteps):
        return False
    return capture.digest(names, timesteps) == result.capture_digest


def peak_memory() -> int:
    """Largest resident memory of this process so far, in bytes; 0 where the system doesn't tell."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
