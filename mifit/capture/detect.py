"""``detect_landmarks``: run a detector over a capture, judge what it found, write it into the capture."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.capture.capture import Capture
from mifit.capture.detectors import Detector, open_detector
from mifit.capture.landmark_files import COUNT, Landmarks, write_landmarks
from mifit.capture.lens import undistort_points
from mifit.capture.outliers import epipolar_outliers, temporal_outliers
from mifit.core.image import load_image, to_8_bit
from mifit.errors import InputError
from mifit.progress import Progress, silent


def detect_landmarks(path: str | Path, detector: str | Detector | None = None, progress: Progress = silent) -> str:
    """Find 68 landmarks in every image of a capture and write them into it.

    Landmarks that jump in time or lie off their epipolar line are marked invisible. A camera is judged by those
    before it in the capture (the first by the second), so a held-out camera that comes last changes nothing for the
    others. An image without a face gets no landmarks and is named.

    Parameters
    ----------
    path : path
        Capture folder; ``landmarks/CAMERA/NNNN.json`` and ``transforms.json`` are written there, whole or not at all.
    detector : str or Detector, optional
        See `open_detector`.
    progress : Progress

    Returns
    -------
    str
        What was found, in a few lines.

    Raises
    ------
    InputError
        The capture or an image can't be read, or no image has a face.
    MifitError
        The detector doesn't run.
    """
    capture = Capture.load(path)
    if detector is None or isinstance(detector, str):
        with open_detector(detector) as opened:
            name, scatter, points = opened.name, opened.scatter, _run(capture, opened, progress)
    else:
        name, scatter, points = detector.name, detector.scatter, _run(capture, detector, progress)
    without = [capture.shots[key].image for key, found in points.items() if not np.isfinite(found).all()]
    if len(without) == len(points):
        raise InputError(f"{capture.path}: detector {name} finds no face in any of {len(points)} images")
    hidden = _outliers(capture, points)
    shots = {}
    for key, shot in capture.shots.items():
        if shot.image in without:
            shots[key] = dataclasses.replace(shot, landmarks=None)
            continue
        file = capture.path / "landmarks" / shot.camera / f"{shot.timestep:04d}.json"
        deviation = scatter * float(np.ptp(points[key][:, 0]))
        write_landmarks(file, Landmarks(points[key], ~hidden[key], deviation))
        shots[key] = dataclasses.replace(shot, landmarks=file)
    dataclasses.replace(capture, shots=shots).save()
    marked = sum(int(hidden[key].sum()) for key, shot in shots.items() if shot.landmarks is not None)
    lines = [
        f"{name}: landmarks in {len(points) - len(without)} of {len(points)} images; "
        f"{marked} of {COUNT * (len(points) - len(without))} points contradict others and are marked invisible"
    ]
    lines += [f"no face found: {image}" for image in without]
    return "\n".join(lines)


def _run(capture: Capture, detector: Detector, progress: Progress) -> dict[tuple[str, int], NDArray[np.float64]]:
    """Landmarks per image in coordinates of the stored images; NaN where no face is found."""
    points = {}
    for i, (key, shot) in enumerate(capture.shots.items()):
        progress("Finding landmarks", i, len(capture.shots))
        found = detector.detect(to_8_bit(load_image(shot.image).pixels))
        points[key] = np.full((COUNT, 2), np.nan) if found is None else found
    progress("Finding landmarks", len(points), len(points))
    return points


def _outliers(
    capture: Capture, points: dict[tuple[str, int], NDArray[np.float64]]
) -> dict[tuple[str, int], NDArray[np.bool_]]:
    straight, hidden = {}, {}
    for name in capture.cameras:
        stack = np.stack([points[name, t] for t in capture.timesteps])
        hidden[name] = temporal_outliers(stack)
        if capture.calibrated:
            camera = capture.stored_camera(name)
            straight[name] = np.stack([undistort_points(camera, frame) for frame in stack])
    if capture.calibrated:
        for i, name in enumerate(capture.cameras):
            for other in capture.cameras[:2] if i >= 2 else capture.cameras[:2][1 - i : 2 - i]:
                pair = (capture.camera(name), capture.camera(other))
                hidden[name] |= epipolar_outliers(straight[name], straight[other], pair)
    return {(name, t): hidden[name][k] for name in capture.cameras for k, t in enumerate(capture.timesteps)}
