"""Stage 1b once more, with tracked timesteps of a video beside the fitted ones.

A head that turns through a video shows its surface from more sides than the few timesteps that were fitted jointly.
Whether the views then agree better is measured in timesteps that neither surface was made of.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mifit.config import SurfaceConfig
from mifit.core.estimate import FURTHER_FRAMES, GeometryEstimate
from mifit.core.threads import one_blas_thread
from mifit.progress import Progress, silent
from mifit.stages.eyes import behind_lids
from mifit.stages.geometry.displaced import object_shapes
from mifit.stages.surface.close_openings import LIDS, LIPS, close_again
from mifit.stages.surface.coarse_to_fine import Reached, Search, sweeps
from mifit.stages.surface.model_fit import landmarks_are_biased
from mifit.stages.surface.prediction_between_views import errors_between_views
from mifit.stages.surface.thin_walls import keep_walls
from mifit.stages.surface.views import Resolution

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

SWEEPS = 2
"""At the finest level: after two the frames that judge agree no better."""
COUNT_AS = 4.0
"""Timesteps that all together count as: what misleads the matching of a patch of skin does so in every one of them."""


@one_blas_thread()
def sweep_again(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    judged: Sequence[int],
    cameras: Sequence[str],
    config: SurfaceConfig | None = None,
    progress: Progress = silent,
) -> tuple[GeometryEstimate, dict[str, Any]]:
    """Displace a surface that was found before to where the views of more timesteps agree.

    Parameters
    ----------
    capture, model
        Images, and the model that was fitted.
    geometry : GeometryEstimate
        On a displaced surface (`find_surface`), at the timesteps to sweep and those to judge by.
    judged : sequence of int
        Timesteps of it that are not swept: in them the views must predict one another better through the new surface.
    cameras : sequence of str
        Two at least. No other camera of the capture is touched.
    config : SurfaceConfig, optional
    progress : Progress

    Returns
    -------
    geometry : GeometryEstimate
        The timesteps that were swept, on the surface that they show, or as they were where it isn't kept.
    details : dict
        What a report says of it: ``kept``, ``between_views`` (through the old surface and the new one), ``timesteps``.
    """
    began = time.perf_counter()
    config = config or SurfaceConfig()
    pairs = list(combinations(range(len(cameras)), 2))
    swept = [t for t in geometry.timesteps if t not in judged]
    given, unseen = geometry.at(swept), geometry.at(judged)
    centre = given.vertices[0].astype(np.float64).mean(axis=0)
    resolution = Resolution.of([capture.camera(name) for name in cameras], centre, pairs)
    finest = sweeps(resolution, config, capture.unit_mm)[-1:]
    beyond = landmarks_are_biased(geometry)
    search = Search(capture, model, cameras, resolution, pairs, config, progress, SWEEPS, beyond, COUNT_AS)
    last = search.descend(Reached.at(given), finest * SWEEPS)
    search.finish()
    openings = LIPS * config.close_lips + LIDS * config.close_lids
    found = close_again(model, last.estimate, openings_closed(last.estimate), openings)
    found = behind_lids(model, keep_walls(model, found)[0])
    assert found.displacement is not None and geometry.displacement is not None
    other = on_surface(model, unseen, found.displacement)
    between = errors_between_views(capture, model, cameras, judged, [unseen.vertices, other.vertices], geometry.gains)
    kept = between[1] < between[0]
    change = (found.displacement - geometry.displacement)[np.unique(model.faces[model.face_mask])]
    details = {
        "name": FURTHER_FRAMES,
        "outcome": last.outcome.value,
        "kept": kept,
        "timesteps": list(swept),
        "judged": list(judged),
        "between_views": between,
        "moved_last_mm": last.moved * capture.unit_mm,
        "matched": last.matched,
        "stiffness": last.stiffness,
        "change_mm": float(np.sqrt((change**2).sum(axis=1).mean())) * model.unit_mm,
        "seconds": time.perf_counter() - began,
    }
    return found if kept else given, details


def openings_closed(geometry: GeometryEstimate) -> dict[str, Any]:
    """What the surface stage has closed, by the timesteps that are in a geometry."""
    phases = [p for p in geometry.report.details.get("phases", []) if p["name"] == "surface"]
    found: dict[str, Any] = phases[-1].get("openings", {}) if phases else {}
    return {
        name: {**opening, "closed": [t for t in opening["closed"] if t in geometry.timesteps]}
        for name, opening in found.items()
    }


def on_surface(model: MorphableModel, geometry: GeometryEstimate, displacement: NDArray) -> GeometryEstimate:
    """The same poses and expressions on another neutral surface."""
    found = replace(geometry, displacement=displacement)
    objects = object_shapes(model, found)
    world = found.scale * objects @ found.rotation.transpose(0, 2, 1) + found.translation[:, None]
    return behind_lids(model, replace(found, vertices=world.astype(np.float32)))
