"""Landmark detectors behind one small interface: an 8-bit RGB image in, 68 iBUG points or None out."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.face_mesh import FaceMesh
from mifit.capture.face_networks import missing
from mifit.errors import InputError, MifitError

DETECTORS = ("mediapipe", "face-alignment", "lbf:FOLDER")


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
        ``mediapipe``, ``face-alignment``, or ``lbf:FOLDER`` with ``lbfmodel.yaml`` and a face finder in the folder
        (``*.xml``, a Haar cascade, or ``*.onnx``, YuNet). By default face-alignment, the paper's detector, where it is
        installed, else MediaPipe.

    Raises
    ------
    InputError
        An unknown name, or files of the detector that are missing.
    MifitError
        The detector doesn't start.
    """
    if name is None:
        name = "face-alignment" if importlib.util.find_spec("face_alignment") else "mediapipe"
    kind, _, folder = name.partition(":")
    if kind == "mediapipe":
        return FaceMesh()
    if kind == "face-alignment":
        return FaceAlignment()
    if kind == "lbf" and folder:
        return Lbf(Path(folder))
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


class Lbf:
    """OpenCV's Facemark LBF (Ren et al. 2014) with a model file and a face finder from the user."""

    name, scatter = "lbf", 0.0

    def __init__(self, folder: Path) -> None:
        model = folder / "lbfmodel.yaml"
        finders = sorted([*folder.glob("*.xml"), *folder.glob("*.onnx")]) if folder.is_dir() else []
        if not model.is_file() or not finders:
            raise InputError(
                f"{folder}: found {int(model.is_file())} lbfmodel.yaml and {len(finders)} face finders, expected both "
                "(a Haar cascade .xml or a YuNet .onnx)"
            )
        try:
            self._facemark = cv2.face.createFacemarkLBF()
            self._facemark.loadModel(str(model))
            self._find = _yunet(finders[0]) if finders[0].suffix == ".onnx" else _cascade(finders[0])
        except (cv2.error, AttributeError) as error:
            raise InputError(f"{folder}: OpenCV can't load its files ({' '.join(str(error).split())[-120:]})") from None

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """See `Detector.detect`; the largest face counts."""
        bgr = np.ascontiguousarray(image[..., ::-1])
        boxes = self._find(bgr)
        if not len(boxes):
            return None
        box = max(boxes, key=lambda b: int(b[2]) * int(b[3]))
        ok, found = self._facemark.fit(bgr, np.array([box], dtype=np.int32))
        return np.asarray(found[0], dtype=np.float64).reshape(68, 2) + 0.5 if ok else None


def _cascade(path: Path) -> Any:
    try:
        cascade = cv2.CascadeClassifier(str(path))
        empty = cascade.empty()
    except (cv2.error, SystemError):
        empty = True
    if empty:
        raise InputError(f"{path}: not a readable Haar cascade; expected one as OpenCV ships them")
    return lambda image: cascade.detectMultiScale(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 1.1, 3)


def _yunet(path: Path) -> Any:
    finder = cv2.FaceDetectorYN.create(str(path), "", (320, 320))

    def find(image: NDArray) -> Any:
        finder.setInputSize((image.shape[1], image.shape[0]))
        boxes = finder.detect(image)[1]
        return [] if boxes is None else boxes[:, :4].astype(int)

    return find
