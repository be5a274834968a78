"""``detect_landmarks``: run a detector over a capture, judge what it found, write it into the capture."""

from __future__ import annotations

import importlib.util
import itertools
import os
import shutil
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.capture.capture import Capture
from mifit.capture.face_mesh import FaceMesh
from mifit.capture.face_networks import missing
from mifit.capture.landmark_files import COUNT, Landmarks, write_landmarks
from mifit.capture.lens import undistort_points
from mifit.capture.outliers import epipolar_outliers, temporal_outliers
from mifit.capture.transforms import update_frames
from mifit.core.files import check_no_links, file_name, replacing_folder
from mifit.core.image import load_image, to_8_bit
from mifit.errors import InputError, MifitError
from mifit.progress import Progress, silent

DETECTORS = ("mediapipe", "face-alignment")


class Detector(Protocol):
    """Finds the landmarks of one face."""

    name: str
    scatter: float
    """Standard deviation that a coordinate's errors amount to, as a part of the face's width; 0: not known."""

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(68, 2) iBUG points in pixels of an RGB image (H, W, 3), the first pixel's centre at (0.5, 0.5).

        None when no face is found.
        """


def open_detector(name: str | None = None) -> Detector:
    """Open a detector: ``mediapipe`` or ``face-alignment``, by default the paper's, the latter, where it is installed.

    InputError for an unknown name, or a package that is missing; MifitError where the detector doesn't start.
    """
    if name is None:
        name = "face-alignment" if importlib.util.find_spec("face_alignment") else "mediapipe"
    if name == "mediapipe":
        return FaceMesh()
    if name == "face-alignment":
        return FaceAlignment()
    raise InputError(f"detector: found {name!r}, expected one of {', '.join(DETECTORS)}")


def available() -> dict[str, bool]:
    """Which detectors would start without installing anything."""
    return {"mediapipe": not missing(), "face-alignment": importlib.util.find_spec("face_alignment") is not None}


class FaceAlignment:
    """The paper's FAN (Bulat and Tzimiropoulos 2017), from the package face-alignment when it is installed."""

    name, scatter = "face-alignment", 0.0

    def __init__(self) -> None:
        try:
            import face_alignment
        except ImportError as error:
            raise InputError(
                f"detector face-alignment: can't be imported ({error}); pip install face-alignment, or use mediapipe"
            ) from None
        try:
            kind = getattr(face_alignment.LandmarksType, "TWO_D", None) or face_alignment.LandmarksType._2D
            self._aligner = face_alignment.FaceAlignment(kind, device="cpu")
        except Exception as error:  # its weights come over the network on first use
            raise MifitError(f"detector face-alignment: doesn't start ({error}); its weights may be missing") from None

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """See `Detector.detect`; the largest face counts."""
        found = self._aligner.get_landmarks_from_image(image)
        if not found:
            return None
        faces = [np.asarray(points, dtype=np.float64)[:, :2] for points in found]
        return max(faces, key=lambda points: float(np.prod(np.ptp(points, axis=0)))) + 0.5


def detect_landmarks(path: str | Path, detector: str | Detector | None = None, progress: Progress = silent) -> str:
    """Find 68 landmarks in every image of a capture, write them into it, and say in a few lines what was found.

    Landmarks that jump in time or lie off their epipolar line are marked invisible. A camera is judged by those
    before it in the capture (the first by the second), so a held-out camera that comes last changes nothing for the
    others. An image without a face gets no landmarks and is named.

    ``landmarks/CAMERA/NNNN.json`` and the paths to them in ``transforms.json`` are written into the capture's folder,
    each file whole or not at all. Landmarks that were there are kept in ``landmarks.before``. A ``detector`` may be a
    name, see `open_detector`.

    InputError where the capture or an image can't be read, or no image has a face; MifitError where the detector
    doesn't run.
    """
    capture = Capture.load(path)
    opened = open_detector(detector) if detector is None or isinstance(detector, str) else detector
    name, scatter = opened.name, opened.scatter
    points = _run(capture, opened, progress)
    without = [capture.shots[key].image for key, found in points.items() if not np.isfinite(found).all()]
    if len(without) == len(points):
        raise InputError(f"{capture.path}: detector {name} finds no face in any of {len(points)} images")
    hidden = _outliers(capture, points)
    found = {
        key: Landmarks(points[key], ~hidden[key], scatter * float(np.ptp(points[key][:, 0])))
        for key, shot in capture.shots.items()
        if shot.image not in without
    }
    names = {key: f"landmarks/{file_name(key[0])}/{key[1]:04d}.json" for key in found}
    for place in names.values():
        check_no_links(capture.path, capture.path / place)
    kept = _keep_landmarks(capture.path)
    for key, landmarks in found.items():
        write_landmarks(capture.path / names[key], landmarks)
    file = Path(path) if Path(path).is_file() else capture.path / "transforms.json"
    update_frames(file, {key: {"landmark_path": names.get(key)} for key in capture.shots})
    marked = sum(int(hidden[key].sum()) for key in found)
    lines = [
        f"{name}: landmarks in {len(points) - len(without)} of {len(points)} images; "
        f"{marked} of {COUNT * (len(points) - len(without))} points contradict others and are marked invisible"
    ]
    lines += [f"no face found: {image}" for image in without]
    lines += [f"the landmarks that were there are in {kept}"] if kept else []
    return "\n".join(lines)


def _keep_landmarks(folder: Path) -> Path | None:
    """Copy a capture's ``landmarks``, which may be hand-made, to ``landmarks.before``; None where there are none."""
    current = folder / "landmarks"
    if not current.is_dir() or not any(current.iterdir()):
        return None
    for i in itertools.count(1):
        kept = folder / f"landmarks.before{'' if i == 1 else i}"
        if not os.path.lexists(kept):
            break
    with replacing_folder(kept) as part:
        shutil.copytree(current, part, symlinks=True)
    return kept


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
