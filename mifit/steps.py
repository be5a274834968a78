"""The steps of a fit: a list of what runs, with which inputs and settings, and the cache that skips what is done.

A step sees nothing but what it is given: the source (capture, model, cameras, timesteps, seed), the estimates that it
names as inputs, and its settings. The key of its checkpoint
is made of exactly these, so that any change of one runs it anew, with all that depends on it, and a change of anything
else doesn't.

To add a step, write ``_name(source, inputs, progress, *settings)`` and put a `Step` into `steps`. A step whose
``part`` an earlier one has made already replaces that estimate for all that come after it.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import filelock

import mifit
from mifit import checkpoint
from mifit.config import (
    FitConfig,
    GeometryConfig,
    MeshConfig,
    NormalsConfig,
    ReflectanceConfig,
    ResidualConfig,
    SurfaceConfig,
)
from mifit.core.estimate import (
    GeometryEstimate,
    MeshEstimate,
    NormalsEstimate,
    ReflectanceEstimate,
    ResidualEstimate,
)
from mifit.progress import Progress

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

Stage = Literal["geometry", "reflectance", "normals"]
STAGES: tuple[Stage, ...] = ("geometry", "reflectance", "normals")
Part = Literal["geometry", "reflectance", "normals", "mesh", "residual"]
PARTS: dict[Part, type] = {
    "geometry": GeometryEstimate,
    "reflectance": ReflectanceEstimate,
    "normals": NormalsEstimate,
    "mesh": MeshEstimate,
    "residual": ResidualEstimate,
}


@dataclass(frozen=True)
class Source:
    """What every step starts from.

    Attributes
    ----------
    capture : Capture
        Calibrated, or with estimated cameras.
    digest : str
        Of the capture's files, for the chosen cameras and timesteps.
    model : MorphableModel
    cameras : tuple of str
    timesteps : tuple of int
    seed : int
    """

    capture: Capture
    digest: str
    model: MorphableModel
    cameras: tuple[str, ...]
    timesteps: tuple[int, ...]
    seed: int

    @property
    def key(self) -> dict[str, Any]:
        """All that a result depends on besides settings, as JSON values."""
        return {
            "version": mifit.__version__,
            "capture": self.digest,
            "model": self.model.digest,
            "cameras": list(self.cameras),
            "timesteps": list(self.timesteps),
            "seed": self.seed,
        }


Inputs = Mapping[Part, Any]


@dataclass(frozen=True)
class Step:
    """One step of a fit.

    Attributes
    ----------
    name : str
        Of its checkpoint; one of a kind in a list of steps.
    part : str
        What it makes: a key of `PARTS`.
    inputs : tuple of str
        Parts that it is given, each as the last step before it left it.
    settings : tuple of dataclass
        Settings that it is given.
    run : callable
        ``run(source, inputs, progress, *settings)`` -> estimate of the part; a function of the module, so that it can
        read nothing else.
    """

    name: str
    part: Part
    inputs: tuple[Part, ...]
    settings: tuple[Any, ...]
    run: Callable[..., Any]


def steps(config: FitConfig, until: Stage = "normals") -> list[Step]:
    """The steps of a fit with these settings, in order."""
    measured = replace(config.geometry, falloff=False, contrast=False)
    found = [Step("geometry", "geometry", (), (measured,), _fit_geometry)]
    if config.surface.enabled:
        found.append(Step("surface", "geometry", ("geometry",), (config.surface, measured), _find_surface))
    if config.geometry.falloff or config.geometry.contrast:
        found.append(Step("falloff", "geometry", ("geometry",), (config.geometry,), _find_falloff))
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
        found[step.name] = current[step.part] = checkpoint.digest(given)
    return found


def run_steps(
    listed: Sequence[Step],
    source: Source,
    progress: Progress,
    folder: Path | None = None,
    shared: bool = False,
    watch: Callable[[Mapping[Part, Any]], None] | None = None,
) -> tuple[dict[Part, Any], float]:
    """Run steps, or read their checkpoints from the folder where these were made of the same.

    Parameters
    ----------
    listed : sequence of Step
    source : Source
    progress : Progress
    folder : path, optional
        For checkpoints.
    shared : bool
        Whether fits with other settings use the folder too, at the same time perhaps: a checkpoint is then named after
        its key, and who needs a step that another is busy with waits for it.
    watch : callable, optional
        Called with the estimates after each step.

    Returns
    -------
    estimates : dict
        By part, as the last step of each left it.
    seconds : float
        Wall time of all steps, those that were read included.
    """
    estimates: dict[Part, Any] = {}
    before = 0.0
    made = keys(listed, source)
    for step in listed:
        key = made[step.name]
        name = f"{step.name}_{key[:16]}" if shared else step.name
        with _alone(folder / f"{name}.lock") if folder and shared else contextlib.nullcontext():
            done = checkpoint.load(folder, name, PARTS[step.part], key) if folder else None
            if done is None:
                inputs = {part: estimates[part] for part in step.inputs}
                done = step.run(_seen(source, inputs), inputs, progress, *step.settings)
                if folder:
                    checkpoint.save(folder, name, done, key)
        if step.part in estimates and step.part not in step.inputs:
            before += estimates[step.part].report.seconds  # one that goes on from another counts its time
        estimates[step.part] = done
        if watch:
            watch(estimates)
    return estimates, before + sum(estimate.report.seconds for estimate in estimates.values())


def _seen(source: Source, inputs: Inputs) -> Source:
    """The source without the exposures, falloff and contrast that its geometry has found."""
    found = inputs.get("geometry")
    if found is None or not found.corrects_images:
        return source
    capture = source.capture.with_exposures(found.exposed).with_lenses(found.falloff, found.contrast)
    return replace(source, capture=capture)


def _alone(path: Path) -> contextlib.AbstractContextManager:
    """A lock between processes, which the system takes back from one that is killed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return filelock.FileLock(path)


def _fit_geometry(source: Source, inputs: Inputs, progress: Progress, config: GeometryConfig) -> Any:
    from mifit.stages.eyes import behind_lids
    from mifit.stages.fit_geometry import fit_geometry

    found = fit_geometry(
        source.capture, source.model, source.cameras, source.timesteps, config, seed=source.seed, progress=progress
    )
    return behind_lids(source.model, found)


def _find_surface(
    source: Source, inputs: Inputs, progress: Progress, config: SurfaceConfig, geometry: GeometryConfig
) -> Any:
    from mifit.stages.eyes import behind_lids
    from mifit.stages.find_surface import find_surface

    found = find_surface(source.capture, source.model, inputs["geometry"], source.cameras, config, progress, geometry)
    return behind_lids(source.model, found)


def _find_falloff(source: Source, inputs: Inputs, progress: Progress, config: GeometryConfig) -> Any:
    from mifit.stages.falloff import find_falloff

    return find_falloff(source.capture, source.model, inputs["geometry"], source.cameras, config, source.seed, progress)


def _infer_reflectance(source: Source, inputs: Inputs, progress: Progress, config: ReflectanceConfig) -> Any:
    from mifit.stages.infer_reflectance import infer_reflectance

    return infer_reflectance(
        source.capture,
        source.model,
        inputs["geometry"],
        source.cameras,
        config,
        seed=source.seed,
        progress=progress,
    )


def _refine_normals(source: Source, inputs: Inputs, progress: Progress, config: NormalsConfig) -> Any:
    from mifit.stages.normals.normal_refinement import refine_normals

    return refine_normals(
        source.capture,
        source.model,
        inputs["geometry"],
        inputs["reflectance"],
        source.cameras,
        config,
        seed=source.seed,
        progress=progress,
    )


def _refine_mesh(source: Source, inputs: Inputs, progress: Progress, config: MeshConfig) -> Any:
    from mifit.stages.normals.mesh_refinement import refine_mesh

    return refine_mesh(source.model, inputs["geometry"], inputs["normals"], config, progress)


def _find_residual(source: Source, inputs: Inputs, progress: Progress, config: ResidualConfig) -> Any:
    from mifit.stages.find_residual import find_residual

    return find_residual(
        source.capture,
        source.model,
        inputs["geometry"],
        inputs["reflectance"],
        inputs["normals"],
        source.cameras,
        config,
        seed=source.seed,
        progress=progress,
    )
