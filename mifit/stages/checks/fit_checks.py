"""What a fit says of its capture: whether landmarks and images, and the views among one another, agree on one face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mifit.capture import Capture
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.morphable import MorphableModel
from mifit.morphable.topology import INNER
from mifit.stages.checks.capture_checks import SHIFTED, landmark_shots
from mifit.stages.checks.landmark_model import noise_of

CONTRADICTIONS = ("views-disagree", "skin-differs", "landmarks-shifted", "landmarks-unexplained", "landmarks-scatter")
"""Codes of what a fit that explains its images doesn't have."""
INCONSISTENT = "inconsistent"
"""Outcome of a stage whose search has ended where the views, or images and landmarks, contradict one another."""


def check_fit(
    capture: Capture, model: MorphableModel, geometry: GeometryEstimate, cameras: Sequence[str]
) -> list[Diagnostic]:
    """Contradictions between a fitted face and the landmarks of the images that it was fitted to; no other is read."""
    shots = landmark_shots(capture, cameras, geometry.timesteps)
    if not shots:
        return []
    off: dict[str, list] = {name: [] for name in cameras}
    for shot in shots:
        fitted = shot.camera.project(geometry.vertices[shot.step][model.landmarks[INNER]])
        off[shot.camera.name].append(shot.pixels[INNER] - fitted)
    x, y = np.mean([np.nanmedian(np.concatenate(mine), axis=0) for mine in off.values() if mine], axis=0)
    allowed = SHIFTED * noise_of(shots)
    if np.hypot(x, y) <= allowed:
        return []
    text = (
        f"landmarks lie ({x:.1f}, {y:.1f}) pixels from the face that the images show, in all cameras alike, expected "
        f"within {allowed:.1f}: run `mifit landmarks`, and check where pixel coordinates begin and the principal points"
    )
    return [Diagnostic("landmarks-shifted", text)]


def judged(estimates: Mapping[Any, Any], found: Sequence[Diagnostic]) -> dict[Any, Any]:
    """The estimates; all end `INCONSISTENT` where the capture has a named fault or the fit contradicts its images.

    ``estimates`` are by part, ``"geometry"`` among them; diagnostics of capture and fit have been ``found``.
    """
    found = (*found, *estimates["geometry"].report.warnings)
    if not any(one.severity == "fault" or one.code in CONTRADICTIONS for one in found):
        return dict(estimates)
    reports = {part: replace(estimate.report, outcome=INCONSISTENT) for part, estimate in estimates.items()}
    return {part: replace(estimate, report=reports[part]) for part, estimate in estimates.items()}
