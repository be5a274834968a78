"""``mifit.fit``: capture and model -> geometry -> reflectance -> normals, mesh -> reconstruction.

`steps` lists the steps in order, each with its inputs and settings. A step sees nothing but what it is given: the
source (capture, model, cameras, timesteps, seed), the estimates that it names as inputs, and its settings. The key in
the cache is made of exactly these, so that any change of one runs it anew, with all that depends on it, and a change of
anything else doesn't.

To add a step, write ``_name(source, inputs, progress, *settings)`` and put a `Step` into `steps`. A step whose
``part`` an earlier one has made already replaces that estimate for all that come after it.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar, cast, get_type_hints

import numpy as np

import mifit
from mifit.cache import Cache, digest
from mifit.capture.choose_frames import FrameChoice
from mifit.config import (
    FitConfig,
    GeometryConfig,
    MeshConfig,
    NormalsConfig,
    PhotometryConfig,
    ReflectanceConfig,
    ResidualConfig,
    SurfaceConfig,
)
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, MeshEstimate, NormalsEstimate, ReflectanceEstimate, ResidualEstimate
from mifit.core.files import Document
from mifit.core.process import one_blas_thread
from mifit.errors import InputError
from mifit.progress import Progress, silent
from mifit.result import Reconstruction
from mifit.result.ownership import CHECKPOINTS, check_ours, locked
from mifit.result.reading import read_document
from mifit.stages.checks.capture_checks import check_capture
from mifit.stages.checks.fit_checks import check_fit, judged
from mifit.stages.eyes import behind_lids
from mifit.stages.find_residual import find_residual
from mifit.stages.find_surface import find_surface
from mifit.stages.fit_geometry import fit_geometry
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.normals.refine_mesh import refine_mesh
from mifit.stages.normals.refine_normals import refine_normals
from mifit.stages.photometry import find_photometry
from mifit.stages.refine_surface import refine_surface

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

T = TypeVar("T")
ONE_COLOUR = 1e-3
"""Range of an image's pixels, over the largest, up to which it shows nothing."""
Stage = Literal["geometry", "reflectance", "normals"]
STAGES: tuple[Stage, ...] = ("geometry", "reflectance", "normals")
Part = Literal["geometry", "reflectance", "normals", "mesh", "residual"]
Estimate = GeometryEstimate | ReflectanceEstimate | NormalsEstimate | MeshEstimate | ResidualEstimate


class Estimates(TypedDict, total=False):
    """Estimates by part, as the last step of each left them."""

    geometry: GeometryEstimate
    reflectance: ReflectanceEstimate
    normals: NormalsEstimate
    mesh: MeshEstimate
    residual: ResidualEstimate


PARTS: dict[str, type[Estimate]] = get_type_hints(Estimates)


@dataclass(frozen=True)
class Source:
    """What every step starts from; ``digest`` is that of the capture's files, for these cameras and timesteps."""

    capture: Capture
    digest: str
    model: MorphableModel
    cameras: tuple[str, ...]
    timesteps: tuple[int, ...]
    seed: int

    @property
    def images(self) -> tuple[Capture, MorphableModel, tuple[str, ...]]:
        """Capture, model and cameras."""
        return self.capture, self.model, self.cameras

    @property
    def key(self) -> Document:
        """All that a result depends on besides settings, as JSON values."""
        return {
            "version": mifit.__version__,
            "capture": self.digest,
            "model": self.model.digest,
            "cameras": list(self.cameras),
            "timesteps": list(self.timesteps),
            "seed": self.seed,
        }

    def seen(self, inputs: Estimates) -> Source:
        """The source with the gains and exposures that its geometry holds divided out of the images."""
        if "geometry" not in inputs or not inputs["geometry"].photometry:
            return self
        return replace(self, capture=self.capture.with_photometry(inputs["geometry"].photometry))


@dataclass(frozen=True)
class Step:
    """One step of a fit: ``run(source, inputs, progress, *settings)`` makes the estimate of ``part``.

    ``name`` is that of its checkpoint; ``inputs`` are the parts that it is given, each as the last step before it left
    it. ``run`` is a function of the module, so that it can read nothing else.
    """

    name: str
    part: Part
    inputs: tuple[Part, ...]
    settings: tuple[DataclassInstance, ...]
    run: Callable[..., Estimate]


@checked
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
    tell: Callable[[Sequence[Diagnostic]], None] | None = None,
) -> Reconstruction:
    """A face's geometry, reflectance, lighting and normals, recovered from a capture.

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
        with its reasons in the geometry's report, ``"frames"``.
    config : FitConfig, optional
    until : {"geometry", "reflectance", "normals"}
        Last stage to run; the mesh update goes with the normals.
    seed : int
        Seed of everything random.
    progress : Progress
    checkpoints : path, optional
        Folder for finished stages. A stage found there, computed from the same inputs, isn't run again.
    shared : bool
        Whether fits with other settings use that folder too: the stages that they have in common run once.
    watch : callable, optional
        Called after each step with the result so far.
    tell : callable, optional
        Called before the first step with what is wrong with the capture, where something is.

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
    from mifit.render.variant import check_active_variant

    check_active_variant()
    config = config or FitConfig()
    cameras = choose("camera", capture.cameras, cameras, 2)
    choice = timesteps if isinstance(timesteps, FrameChoice) else None
    timesteps = choose_timesteps(capture, timesteps)
    if until not in STAGES:
        raise InputError(f"until: found {until!r}, expected one of {', '.join(STAGES)}")
    check_images(capture, cameras, timesteps)
    checked = check_capture(capture, model, cameras, timesteps)
    if checked and tell:
        tell(checked)
    capture_digest = capture.digest(cameras, timesteps)
    given, model = model, fitted_model(model, config)
    estimated: tuple[Diagnostic, ...] = ()
    if not capture.calibrated:
        from mifit.extras.calibrate_densely import calibrate_capture

        dense = calibrate_capture(capture, model, cameras, timesteps, progress)
        note = Diagnostic("calibration-estimated", dense.note, "note")
        text = "the capture is uncalibrated: focal length, camera poses and so the scale are estimates"
        capture, estimated = dense.capture, (Diagnostic("uncalibrated", text), note)
    source = Source(capture, capture_digest, model, cameras, timesteps, seed)

    def result(estimates: Estimates, seconds: float = 0.0) -> Reconstruction:
        geometry = estimates["geometry"]
        found = [*checked, *check_fit(capture, model, geometry, cameras)]
        return Reconstruction(
            model=model,
            **judged(estimates, found),
            config={**dataclasses.asdict(config), "seed": seed},
            cameras=tuple(capture.camera(name) for name in cameras),
            capture_digest=capture_digest,
            model_source=model.source,
            units=capture.units,
            unit_mm=capture.unit_mm,
            warnings=(*estimated, *found, *one_place(capture, cameras, geometry), *eyes_note(given, model)),
            seconds=seconds,
            peak_memory=peak_memory(),
        )

    estimates, seconds = run_steps(
        steps(config, until),
        source,
        progress,
        Cache(None if checkpoints is None else Path(checkpoints), shared),
        None if watch is None else lambda so_far: watch(result(so_far)),
    )
    if choice is not None:
        report = estimates["geometry"].report.noting(frames=choice.document())
        estimates["geometry"] = replace(estimates["geometry"], report=report)
    return result(estimates, seconds)


def fit_into(
    folder: str | Path,
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str] | None = None,
    timesteps: Sequence[int] | FrameChoice | None = None,
    config: FitConfig | None = None,
    until: Stage = "normals",
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    **options: Any,
) -> Reconstruction:
    """The result of a fit, written into its folder stage by stage, so that a killed run goes on.

    The folder is new, empty, or a result's; other parameters are those of `mifit.fit`. ``resume`` goes on with what an
    earlier run left; a result that has all that is asked for, and perhaps more, stays as it is. ``force`` replaces an
    existing result, or writes beside files that aren't ours; those are never deleted.

    InputError, before any work, for a folder with foreign files, or one that another process writes into; a result that
    is there already, or of which ``resume`` would lose tracked timesteps or stages. Else as `mifit.fit`.
    """
    folder, config = Path(folder), config or FitConfig()
    check_ours(folder, force)
    if (folder / "result.json").exists() and not (resume or force):
        raise InputError(f"--out {folder}: holds a result already; --resume goes on with it, --force replaces it")
    named, moments = choose("camera", capture.cameras, cameras, 2), choose_timesteps(capture, timesteps)
    source = Source(capture, capture.digest(named, moments), fitted_model(model, config), named, moments, seed)
    wanted = {**source.key, "config": json.loads(json.dumps({**dataclasses.asdict(config), "seed": seed}))}
    if until not in STAGES:
        raise InputError(f"until: found {until!r}, expected one of {', '.join(STAGES)}")
    with locked(folder, force):
        if force:
            shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
        elif (folder / "result.json").exists() and _is_there(folder, wanted, until):
            return Reconstruction.load(folder, model)
        kept = folder / CHECKPOINTS
        began = not kept.exists()
        try:
            result = fit(capture, model, cameras, timesteps, config, until, seed, checkpoints=kept, **options)
        except InputError:  # nothing to go on with
            if began:
                shutil.rmtree(kept, ignore_errors=True)
            raise
        result.save(folder, force)
    return result


def _is_there(folder: Path, wanted: Document, until: Stage) -> bool:
    """Whether the folder's result has all that is wanted; InputError when a new one would lose some of it."""
    document = read_document(folder)
    try:
        stages = document["stages"]
        timesteps = [t["timestep"] for t in document["timesteps"]]
        tracked = [t["timestep"] for t in document["timesteps"] if t["tracked"]]
        found = {
            "version": document["mifit_version"],
            "capture": document["capture"]["digest"],
            "model": document["model"]["digest"],
            "cameras": [c["name"] for c in document["capture"]["cameras"]],
            "timesteps": [t for t in timesteps if t not in tracked],
            "seed": document["config"]["seed"],
            "config": document["config"],
        }
    except (KeyError, TypeError, AttributeError):
        raise InputError(
            f"{folder / 'result.json'}: damaged, so there is nothing to go on with; --force replaces it"
        ) from None
    later = [stage for stage in STAGES[STAGES.index(until) + 1 :] if stage in stages]
    if found == wanted and until in stages:
        return True
    lost = [f"timesteps {', '.join(map(str, tracked))}, which were tracked"] if tracked else []
    lost += [f"stage {stage}" for stage in later]
    if lost:
        changed = ", ".join(key for key in wanted if wanted[key] != found[key]) or "the last stage"
        raise InputError(
            f"--out {folder}: its result has {' and '.join(lost)}, which going on with another {changed} would lose; "
            "--force replaces the result, or name another folder"
        )
    return False


def steps(config: FitConfig, until: Stage = "normals") -> list[Step]:
    """The steps of a fit with these settings, in order."""
    found = [Step("geometry", "geometry", (), (config.geometry,), _fit_geometry)]
    if config.surface.enabled:
        found.append(Step("surface", "geometry", ("geometry",), (config.surface,), _find_surface))
    if config.photometry.enabled:
        found.append(Step("photometry", "geometry", ("geometry",), (config.photometry,), _find_photometry))
    if config.surface.enabled and config.surface.shading and config.reflectance.robust:
        found.append(Step("shading", "geometry", ("geometry",), (config.reflectance,), _refine_surface))
    if until == "geometry":
        return found
    found.append(Step("reflectance", "reflectance", ("geometry",), (config.reflectance,), _infer_reflectance))
    if until == "reflectance":
        return found
    found += [
        Step("normals", "normals", ("geometry", "reflectance"), (config.normals,), _refine_normals),
        Step("mesh", "mesh", ("geometry", "normals"), (config.mesh,), _refine_mesh),
    ]
    if config.residual.enabled:
        given: tuple[Part, ...] = ("geometry", "reflectance", "normals")
        found.append(Step("residual", "residual", given, (config.residual,), _find_residual))
    return found


def keys(listed: Sequence[Step], source: Source) -> dict[str, str]:
    """The key of each step's checkpoint, by its name: a digest of all that the step is given."""
    found: dict[str, str] = {}
    current: dict[Part, str] = {}
    for step in listed:
        given = {
            "source": source.key,
            "step": step.run.__name__,
            "inputs": {part: current[part] for part in step.inputs},
            "settings": [[type(s).__name__, dataclasses.asdict(s)] for s in step.settings],
        }
        found[step.name] = current[step.part] = digest(given)
    return found


def run_steps(
    listed: Sequence[Step],
    source: Source,
    progress: Progress,
    cache: Cache,
    watch: Callable[[Estimates], None] | None = None,
) -> tuple[Estimates, float]:
    """Estimates by part, as the last step of each left it, and the wall time of all steps, those kept included."""
    estimates: Estimates = {}
    before = 0.0
    made = keys(listed, source)
    for step in listed:
        inputs = cast("Estimates", {part: estimates[part] for part in step.inputs})
        run = functools.partial(step.run, source.seen(inputs), inputs, progress, *step.settings)
        try:
            done: Estimate = cache.get(step.name, PARTS[step.part], made[step.name], run)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"{step.name}: equations without a solution ({error}), expected images of one face that all cameras "
                "show; `mifit doctor CAPTURE` examines them"
            ) from error
        if step.part in estimates and step.part not in step.inputs:
            before += estimates[step.part].report.seconds  # one that goes on from another counts its time
        estimates[step.part] = done
        if watch:
            watch(estimates)
    return estimates, before + sum(part.report.seconds for part in cast("dict[str, Estimate]", estimates).values())


def _fit_geometry(source: Source, inputs: Estimates, progress: Progress, config: GeometryConfig) -> GeometryEstimate:
    capture, model, cameras = source.images
    found = fit_geometry(capture, model, cameras, source.timesteps, config, seed=source.seed, progress=progress)
    return behind_lids(model, found)


def _find_surface(source: Source, inputs: Estimates, progress: Progress, config: SurfaceConfig) -> GeometryEstimate:
    capture, model, cameras = source.images
    return behind_lids(model, find_surface(capture, model, inputs["geometry"], cameras, config, progress))


def _find_photometry(
    source: Source, inputs: Estimates, progress: Progress, config: PhotometryConfig
) -> GeometryEstimate:
    (capture, model, cameras), geometry = source.images, inputs["geometry"]
    began = time.perf_counter()
    found = find_photometry(capture, model, geometry, cameras, config, source.seed, progress)
    report = replace(geometry.report, seconds=geometry.report.seconds + time.perf_counter() - began)
    return replace(geometry, photometry=found, report=report)


def _refine_surface(
    source: Source, inputs: Estimates, progress: Progress, config: ReflectanceConfig
) -> GeometryEstimate:
    (capture, model, cameras), geometry = source.images, inputs["geometry"]
    return behind_lids(model, refine_surface(capture, model, geometry, cameras, config, source.seed, progress))


def _infer_reflectance(
    source: Source, inputs: Estimates, progress: Progress, config: ReflectanceConfig
) -> ReflectanceEstimate:
    capture, model, cameras = source.images
    return infer_reflectance(capture, model, inputs["geometry"], cameras, config, seed=source.seed, progress=progress)


def _refine_normals(source: Source, inputs: Estimates, progress: Progress, config: NormalsConfig) -> NormalsEstimate:
    capture, model, cameras = source.images
    given = inputs["geometry"], inputs["reflectance"]
    return refine_normals(capture, model, *given, cameras, config, seed=source.seed, progress=progress)


def _refine_mesh(source: Source, inputs: Estimates, progress: Progress, config: MeshConfig) -> MeshEstimate:
    return refine_mesh(source.model, inputs["geometry"], inputs["normals"], config, progress)


def _find_residual(source: Source, inputs: Estimates, progress: Progress, config: ResidualConfig) -> ResidualEstimate:
    capture, model, cameras = source.images
    given = inputs["geometry"], inputs["reflectance"], inputs["normals"]
    return find_residual(capture, model, *given, cameras, config, progress)


def check_images(capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]) -> None:
    """Raise InputError for an image that is black, clipped or of one colour: nothing can be measured in it."""
    for timestep in timesteps:
        for name in cameras:
            frame = capture.frame(name, timestep)
            usable = frame.image[frame.valid & ~frame.clipped]
            black = not (usable > 0).any()
            if black or (np.ptp(usable, axis=0) <= ONE_COLOUR * usable.max()).all():
                raise InputError(
                    f"camera {name}, timestep {timestep}: every usable pixel is "
                    f"{'black or clipped' if black else 'of one colour'}, expected a photo; "
                    "leave the camera or the timestep out, or check its mask"
                )


def fitted_model(model: MorphableModel, config: FitConfig) -> MorphableModel:
    """The model that a fit uses: the given one, with simple eyes where its own are holes and the settings want them."""
    from mifit.morphable.openings import lacks_eyes, with_eyes

    return with_eyes(model) if config.geometry.eyes and lacks_eyes(model) else model


def eyes_note(given: MorphableModel, fitted: MorphableModel) -> tuple[Diagnostic, ...]:
    """What to say of the eyes: that the fit put some into a model, or that renders will look through holes."""
    from mifit.morphable.openings import STRIP, lacks_eyes

    if fitted is not given:
        text = (
            f"the eyes of model {given.name} are holes: the fit put simple eyes and the inside of a mouth there, and "
            f"the layout of its maps lies {100 * STRIP:.0f} % higher than the model's own; [geometry] eyes = false "
            "leaves the model as it is"
        )
        return (Diagnostic("eyes-added", text, "note"),)
    if not lacks_eyes(fitted):
        return ()
    text = f"the eyes of model {fitted.name} are holes; [geometry] eyes = true puts simple ones there"
    return (Diagnostic("eyes-are-holes", text, "note"),)


def one_place(capture: Capture, cameras: Sequence[str], geometry: GeometryEstimate) -> tuple[Diagnostic, ...]:
    """A warning when the landmarks are seen from so nearly one place that the head's distance isn't measured."""
    seen = [name for name in cameras if any(capture.frame(name, t).visible.any() for t in geometry.timesteps)]
    towards = np.array([capture.camera(name).position for name in seen]) - geometry.vertices[0].mean(axis=0)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    apart = float(np.degrees(np.arccos(np.clip((towards @ towards.T).min(), -1.0, 1.0))))
    if apart >= 3.0:
        return ()
    place = f"landmarks in camera {seen[0]} alone" if len(seen) == 1 else f"cameras {apart:.1f} degrees apart"
    text = f"{place}: how far away and so how large the head is rests on the model's size more than on the images"
    return (Diagnostic("distance-unmeasured", text),)


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


def fitted_to(result: Reconstruction, capture: Capture) -> bool:
    """Whether a result was fitted to this very capture: its calibration, images, masks and landmarks."""
    names = [camera.name for camera in result.cameras]
    timesteps = result.fitted
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
