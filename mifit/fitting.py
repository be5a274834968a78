"""Fitting into a result folder: checkpoints, resuming, and nothing lost that an earlier run has made."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mifit
from mifit.capture.choose_frames import FrameChoice
from mifit.config import FitConfig
from mifit.errors import InputError
from mifit.pipeline import choose, choose_timesteps, fit, fitted_model
from mifit.progress import Progress, silent
from mifit.reconstruction import Reconstruction
from mifit.result.ownership import CHECKPOINTS, check_ours, claim, locked
from mifit.result.reading import read_document
from mifit.steps import STAGES, Stage

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel


def fit_into(
    folder: str | Path,
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str] | None = None,
    timesteps: Sequence[int] | FrameChoice | None = None,
    config: FitConfig | None = None,
    until: Stage = "normals",
    seed: int = 0,
    progress: Progress = silent,
    resume: bool = False,
    force: bool = False,
    watch: Callable[[Reconstruction], None] | None = None,
) -> Reconstruction:
    """Fit, and write the result folder; stages that end are kept in it, so that a killed run goes on.

    Parameters
    ----------
    folder : path
        New, empty, or a result folder.
    capture, model, cameras, timesteps, config, until, seed, progress
        As in `mifit.fit`.
    resume : bool
        Go on with what an earlier run left. A result that has all that is asked for, and perhaps more, stays as it is.
    force : bool
        Replace an existing result, or write beside files that aren't ours; those are never deleted.
    watch : callable, optional
        Called with the result so far, as in `mifit.fit`.

    Returns
    -------
    Reconstruction

    Raises
    ------
    InputError
        Before any work: a folder with foreign files, or one that another process writes into; a result that is there
        already, or of which ``resume`` would lose tracked timesteps or stages. Else as `mifit.fit`.
    """
    folder, config = Path(folder), config or FitConfig()
    check_ours(folder, force)
    if (folder / "result.json").exists() and not (resume or force):
        raise InputError(f"--out {folder}: holds a result already; --resume goes on with it, --force replaces it")
    wanted = _identity(capture, model, choose("camera", capture.cameras, cameras, 2), timesteps, config, seed)
    if until not in STAGES:
        raise InputError(f"until: found {until!r}, expected one of {', '.join(STAGES)}")
    claim(folder, force)
    with locked(folder):
        if force:
            shutil.rmtree(folder / CHECKPOINTS, ignore_errors=True)
        elif (folder / "result.json").exists() and _is_there(folder, wanted, until):
            return Reconstruction.load(folder, model)
        result = fit(
            capture,
            model,
            cameras=cameras,
            timesteps=timesteps,
            config=config,
            until=until,
            seed=seed,
            progress=progress,
            checkpoints=folder / CHECKPOINTS,
            watch=watch,
        )
        result.save(folder, force)
    return result


def _identity(
    capture: Capture,
    model: MorphableModel,
    cameras: tuple[str, ...],
    timesteps: Sequence[int] | FrameChoice | None,
    config: FitConfig,
    seed: int,
) -> dict[str, Any]:
    """What decides a result, as ``result.json`` tells it."""
    steps = choose_timesteps(capture, timesteps)
    return {
        "version": mifit.__version__,
        "capture": capture.digest(cameras, steps),
        "model": fitted_model(model, config).digest,
        "cameras": list(cameras),
        "timesteps": list(steps),
        "config": json.loads(json.dumps({**dataclasses.asdict(config), "seed": seed})),
    }


def _is_there(folder: Path, wanted: dict[str, Any], until: Stage) -> bool:
    """Whether the folder's result has all that is wanted; InputError when a new one would lose some of it."""
    document = read_document(folder)
    try:
        stages = document["stages"]
        tracked = list(stages.get("normals", {}).get("details", {}).get("tracked", []))
        timesteps = [t["timestep"] for t in document["timesteps"]]
        found = {
            "version": document["mifit_version"],
            "capture": document["capture"]["digest"],
            "model": document["model"]["digest"],
            "cameras": [c["name"] for c in document["capture"]["cameras"]],
            "timesteps": [t for t in timesteps if t not in tracked],
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
