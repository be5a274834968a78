"""MediaPipe Face Mesh as a landmark detector: three small networks, run in this process.

A face is found (BlazeFace, full range), a square about it that stands as upright as its eyes goes through the mesh
network (468 points), and squares about the eyes through the iris network, which places eyelids and iris. The mesh
tells better than the finder where its face is, so it is run again on the square about its own points. Where no face
is found, the image is tried turned and in parts: faces in profile, lying or far away.

References: Bazarevsky et al., "BlazeFace" (2019); Kartynnik et al., "Real-time facial surface geometry" (2019);
Ablavatski et al., "Real-time pupil tracking" (2020).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture.face_networks import Network
from mifit.core.files import Document

SCATTER = 0.045
"""Standard deviation that stage 1 gives the points, as a part of the face's width. Chosen among four values by the fits
of three captures. Their median error is 1.5 per cent, but neighbours share it and all images of a head repeat it, so
that a sum over all points must weigh less than if they were independent."""
POINTS, IRIS = 468, 5
"""Points of the mesh, and of each iris."""
MARGIN, EYE_MARGIN = 1.5, 2.3
"""Squares about a face and an eye, relative to the larger side of their points: what the networks were trained on."""
EYE_CORNERS = ((33, 133), (263, 362))
EYE_CONTOURS = (
    (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173),
    (263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398),
)
"""Mesh points on the rim of each eye, as the iris network lists them."""
LIDS = (((37, 41, 160, 144), (38, 40, 158, 153)), ((43, 47, 385, 380), (44, 46, 387, 373)))
"""Of each eye, two landmarks on the upper lid with those below them, and the mesh points of the rim at both."""


@cache
def _table() -> Document:
    return json.loads((resources.files("mifit.capture") / "face_mesh_68.json").read_text(encoding="utf-8"))


@cache
def landmark_map() -> NDArray[np.float64]:
    """(68, 478) weights, rows summing to 1: iBUG points as affine combinations of Face Mesh points.

    Fitted on rendered heads with known landmarks by ``benchmarks/face_mesh_map.py``.
    """
    weights = np.zeros((68, POINTS + 2 * IRIS))
    for row, (index, weight) in enumerate(zip(_table()["index"], _table()["weight"], strict=True)):
        weights[row, index] = weight
    return weights


@cache
def mirrored_points() -> NDArray[np.int64]:
    """(468,) for each mesh point the one that a mirror image of the face has in its place."""
    return np.array(_table()["mirror"], dtype=np.int64)


@dataclass(frozen=True)
class Face:
    """One face as the networks see it.

    ``points`` (478, 3) are Face Mesh points and two irises (centre, then four on its rim): x and y in pixels, the first
    pixel's centre at (0.5, 0.5), and depth in pixels, growing away from the camera, its origin within the head.
    """

    points: NDArray[np.float64]

    @property
    def area(self) -> float:
        """Of the box about the mesh, square pixels."""
        return float(np.ptp(self.points[:POINTS, :2], axis=0).prod())

    @property
    def angle(self) -> float:
        """Of the line through the eyes in the image, radians from x towards y; 0 for an upright head."""
        right, left = self.points[EYE_CORNERS[0][0]], self.points[EYE_CORNERS[1][0]]
        return float(np.arctan2(left[1] - right[1], left[0] - right[0]))

    @property
    def landmarks(self) -> NDArray[np.float64]:
        """(68, 2) iBUG points; those on closed lids lie as far apart as the iris network has them.

        That network has lids that are closed 0.05 to 0.10 of the eye's width apart and open ones 0.2 to 0.4; the table
        of landmarks, which is fitted on open eyes, 0.22 and more on both.
        """
        flat = self.points[:, :2]
        marks = landmark_map() @ flat
        for pairs, (one, other) in zip(LIDS, EYE_CORNERS, strict=True):
            gaps = [flat[above] - flat[below] for _, _, above, below in pairs]
            width = float(np.linalg.norm(flat[one] - flat[other]))
            if np.mean([np.linalg.norm(gap) for gap in gaps]) < 0.12 * width:
                for (upper, lower, _, _), gap in zip(pairs, gaps, strict=True):
                    middle = 0.5 * (marks[upper] + marks[lower])
                    marks[upper], marks[lower] = middle + 0.5 * gap, middle - 0.5 * gap
        return np.asarray(marks)


@dataclass(frozen=True)
class _Square:
    """A turned square in an image: centre (2,) and side in pixels, angle in radians (x towards y)."""

    centre: NDArray[np.float64]
    side: float
    angle: float

    def to_image(self) -> NDArray[np.float64]:
        """(2, 3) affine map from the unit square to image pixels."""
        c, s = self.side * np.cos(self.angle), self.side * np.sin(self.angle)
        turn = np.array([[c, -s], [s, c]])
        return np.column_stack([turn, self.centre - turn @ (0.5, 0.5)])

    def cut(self, image: NDArray, size: int, mirrored: bool = False) -> NDArray[np.float32]:
        """(size, size, 3) the square's content, 0..1; black beside the image."""
        step = self.to_image()
        if mirrored:
            step = np.column_stack([-step[:, 0], step[:, 1], step[:, 2] + step[:, 0]])
        matrix = np.column_stack([step[:, :2] / size, step @ (0.5 / size, 0.5 / size, 1.0) - 0.5])
        blur = self.side / size  # pixels of the image in one of the square's
        if blur > 1.5:
            image = cv2.GaussianBlur(image, (0, 0), 0.4 * blur)
        cut = cv2.warpAffine(image, matrix, (size, size), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return cut.astype(np.float32) / 255.0

    @classmethod
    def about(cls, points: NDArray, first: NDArray, second: NDArray, margin: float) -> _Square:
        """The square about points (N, 2) in which the way from ``first`` to ``second`` is level."""
        angle = float(np.arctan2(*(second - first)[::-1]))
        c, s = np.cos(angle), np.sin(angle)
        turned = points @ np.array([[c, -s], [s, c]])
        low, high = turned.min(axis=0), turned.max(axis=0)
        centre = np.array([[c, -s], [s, c]]) @ (0.5 * (low + high))
        return cls(centre, margin * float((high - low).max()), angle)


def _windows(image: NDArray) -> Iterator[list[_Square]]:
    """Where to look for faces: the image, the image turned, and parts of it."""
    height, width = image.shape[:2]
    middle, side = np.array([width / 2, height / 2]), float(max(height, width))
    yield [_Square(middle, side, 0.0)]
    yield [_Square(middle, side, np.radians(turn)) for turn in (35.0, -35.0, 90.0, -90.0, 180.0)]
    for part in (0.6, 0.35):
        reach = part * side
        columns, rows = (
            np.linspace(reach / 2, n - reach / 2, int(np.ceil(2 * n / reach)) - 1) if n > reach else [n / 2]
            for n in (width, height)
        )
        yield [_Square(np.array([x, y]), reach, 0.0) for y in rows for x in columns]


class FaceMesh:
    """The three networks behind the interface of a `Detector`; MifitError where the runtime or a file is missing."""

    name, scatter = "mediapipe", SCATTER

    def __init__(self) -> None:
        self._find, self._mesh, self._iris = map(
            Network, ("face_detection_full_range", "face_landmark", "iris_landmark")
        )

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(68, 2) iBUG points in pixels, the first pixel's centre at (0.5, 0.5), or None when no face is found."""
        face = self.face(image)
        return None if face is None else face.landmarks

    def face(self, image: NDArray[np.uint8]) -> Face | None:
        """The largest face of an RGB image (H, W, 3), or None."""
        image = np.ascontiguousarray(image)
        for windows in _windows(image):
            boxes = [(w, *box) for w in windows for box in self._boxes(image, w)]
            faces = [(score, face) for w, score, box in boxes if (face := self._upright(image, w, box)) is not None]
            if faces:
                return max(faces, key=lambda pair: pair[0] * pair[1].area)[1]
        return None

    def _upright(self, image: NDArray, window: _Square, box: _Square) -> Face | None:
        """The face in a box; None where it lies in its window: finders of upright faces find something else in one."""
        face = self._settle(image, box)
        if face is None:
            return None
        turned = np.angle(np.exp(1j * (face.angle - window.angle)))
        return face if abs(turned) < np.radians(30.0) else None

    def _boxes(self, image: NDArray, window: _Square) -> list[tuple[float, _Square]]:
        """The likeliest faces of a part of an image with their probabilities, at most two, of 0.3 and more."""
        size = self._find.size
        cells = size // 4  # one of the finder's anchors
        out = self._find(2.0 * window.cut(image, size) - 1.0)
        score = 1.0 / (1.0 + np.exp(-np.clip(out[cells * cells], -80, 80)))
        raw = out[cells * cells * 16].reshape(-1, 16)
        found: list[tuple[float, _Square]] = []
        taken: list[NDArray] = []
        for i in np.argsort(-score)[:50]:
            if score[i] < 0.3 or len(found) == 2:
                break
            anchor = (np.array([i % cells, i // cells]) + 0.5) / cells
            centre, extent = raw[i, :2] / size + anchor, raw[i, 2:4] / size
            if any(np.abs(centre - other).max() < 0.5 * extent.max() for other in taken):
                continue
            taken.append(centre)
            corners = centre + 0.5 * extent * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            eyes = raw[i, 4:8].reshape(2, 2) / size + anchor
            step = window.to_image()
            corners, eyes = (v @ step[:, :2].T + step[:, 2] for v in (corners, eyes))
            # The box stands upright in the window, the square as the eyes do: about the box's centre and side.
            side = MARGIN * float(extent.max()) * window.side
            angle = float(np.arctan2(*(eyes[1] - eyes[0])[::-1]))
            found.append((float(score[i]), _Square(corners.mean(axis=0), side, angle)))
        return found

    def _settle(self, image: NDArray, square: _Square) -> Face | None:
        """The mesh about a square, again about its own points, and a mean over turns of that; None for no face."""
        for _ in range(2):
            points, presence = self._look(image, square)
            if presence < 0.9:
                return None
            square = _Square.about(points[:, :2], points[EYE_CORNERS[0][0], :2], points[EYE_CORNERS[1][0], :2], MARGIN)
        turned = [replace(square, angle=square.angle + turn) for turn in (-0.2, 0.0, 0.2)]
        looks = [self._look(image, one, mirrored)[0] for one in turned for mirrored in (False, True)]
        return Face(self._with_eyes(image, np.mean(looks, axis=0)))

    def _look(self, image: NDArray, square: _Square, mirrored: bool = False) -> tuple[NDArray[np.float64], float]:
        """(468, 3) mesh points of a square, in pixels of the image, and the probability that it shows a face."""
        size = self._mesh.size
        out = self._mesh(square.cut(image, size, mirrored))
        raw = out[3 * POINTS].reshape(-1, 3).astype(np.float64) / size
        if mirrored:
            raw[:, 0] = 1.0 - raw[:, 0]
            raw = raw[mirrored_points()]
        step = square.to_image()
        points = np.column_stack([raw[:, :2] @ step[:, :2].T + step[:, 2], raw[:, 2] * square.side])
        return points, float(1.0 / (1.0 + np.exp(-np.clip(out[1][0], -80, 80))))

    def _with_eyes(self, image: NDArray, points: NDArray) -> NDArray[np.float64]:
        """Mesh points with the rims of the eyes as the iris network has them, and the irises after them."""
        points, irises = points.copy(), []
        size = self._iris.size
        level = points[EYE_CORNERS[1][0], :2] - points[EYE_CORNERS[0][0], :2]
        for k, (corners, contour) in enumerate(zip(EYE_CORNERS, EYE_CONTOURS, strict=True)):
            about = points[list(corners), :2]
            square = _Square.about(about, 0 * level, level, EYE_MARGIN)
            # The network knows one eye: the other is shown to it in a mirror.
            out = self._iris(square.cut(image, size, mirrored=k == 1))
            step = square.to_image()
            rim, iris = (out[n].reshape(-1, 3)[:, :2].astype(np.float64) / size for n in (213, 15))
            for values in (rim, iris):
                if k == 1:
                    values[:, 0] = 1.0 - values[:, 0]
            points[list(contour), :2] = rim[: len(contour)] @ step[:, :2].T + step[:, 2]
            depth = points[list(corners), 2].mean()
            irises.append(np.column_stack([iris @ step[:, :2].T + step[:, 2], np.full(IRIS, depth)]))
        return np.vstack([points, *irises])
