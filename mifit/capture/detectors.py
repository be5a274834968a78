"""Landmark detectors behind one small interface: an 8-bit RGB image in, 68 iBUG points or None out."""

from __future__ import annotations

import importlib.util
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mifit.capture.face_mesh import FaceMesh
from mifit.capture.face_networks import missing
from mifit.errors import InputError, MifitError

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
    """Open a detector by name.

    Parameters
    ----------
    name : str, optional
        ``mediapipe`` or ``face-alignment``; by default the latter, the paper's detector, where it is installed, else
        MediaPipe.

    Raises
    ------
    InputError
        An unknown name, or a package that is missing.
    MifitError
        The detector doesn't start.
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
    return {
        "mediapipe": not missing(),
        "face-alignment": importlib.util.find_spec("face_alignment") is not None,
    }


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
            self._aligner: Any = face_alignment.FaceAlignment(kind, device="cpu")
        except Exception as error:  # its weights come over the network on first use
            raise MifitError(f"detector face-alignment: doesn't start ({error}); its weights may be missing") from None

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """See `Detector.detect`; the largest face counts."""
        found = self._aligner.get_landmarks_from_image(image)
        if not found:
            return None
        faces = [np.asarray(points, dtype=np.float64)[:, :2] for points in found]
        return max(faces, key=lambda points: float(np.prod(np.ptp(points, axis=0)))) + 0.5
