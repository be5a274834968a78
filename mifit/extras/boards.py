"""ChArUco calibration boards, printed and found in images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mifit.core.files import replacing
from mifit.core.image import decode_image, to_8_bit
from mifit.errors import InputError

DICTIONARY = "DICT_5X5_250"
COMMON = ("DICT_5X5_1000", "DICT_4X4_50", "DICT_4X4_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
"""Dictionaries to try where none was named; smaller ones of a size begin as these do."""
PRINT_DPI = 300


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board in one image: which ones, ``ids`` (N,), ascending, and where, ``pixels`` (N, 2).

    The first pixel's centre is at (0.5, 0.5).
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Board:
    """A flat board of ``columns`` x ``rows`` squares with points that can be told apart.

    ``size`` and ``marker`` are the sides of a square and of the marker in it, millimetres; ``dictionary`` is OpenCV's
    name of the set of markers. Where the user ``named`` it no other is tried.
    """

    columns: int
    rows: int
    size: float
    marker: float
    dictionary: str = DICTIONARY
    named: bool = False

    @classmethod
    def parse(cls, text: str) -> Board:
        """Read ``charuco:9x6:30:22``, a dictionary's name behind it or not; InputError for another form or sizes that
        no board has.
        """
        form = f"--board: found {text[:80]!r}, expected charuco:COLUMNSxROWS:SQUARE:MARKER, lengths in millimetres"
        kind, *rest = text.split(":")
        try:
            shape, side, inside, *names = rest
            columns, rows = (int(n) for n in shape.split("x"))
            size, marker = float(side), float(inside)
        except ValueError:
            raise InputError(form) from None
        if kind != "charuco" or len(names) > 1:
            raise InputError(form)
        if not (3 <= columns <= 50 and 3 <= rows <= 50 and 0.1 <= size <= 10_000):
            raise InputError(f"{form}; 3 to 50 columns and rows")
        if not 0 < marker < size:
            raise InputError(f"{form}; a marker smaller than its square")
        name = names[0] if names else DICTIONARY
        if not (name.startswith("DICT_") and hasattr(cv2.aruco, name)):
            raise InputError(
                f"--board: found dictionary {name[:40]!r}, expected a name of OpenCV's such as DICT_5X5_250"
            )
        board = cls(columns, rows, size, marker, name, bool(names))
        try:
            board._aruco  # noqa: B018 - OpenCV refuses what doesn't go together
        except cv2.error:
            raise InputError(f"--board {text}: needs more markers than dictionary {name} has") from None
        return board

    def of_other_dictionaries(self) -> list[Board]:
        """The same board with other common dictionaries that have markers enough."""
        enough = self.columns * self.rows // 2
        size = {name: len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList) for name in COMMON}
        return [replace(self, dictionary=name) for name in COMMON if size[name] >= enough]

    def describe(self) -> str:
        """What is looked for, in words."""
        others = ", ".join(name for name in (DICTIONARY, *COMMON) if name != self.dictionary)
        return (
            f"a ChArUco board of {self.columns} x {self.rows} squares of {self.size:g} mm with markers of "
            f"{self.marker:g} mm, dictionary {self.dictionary}" + ("" if self.named else f" (tried too: {others})")
        )

    @cached_property
    def _aruco(self) -> cv2.aruco.CharucoBoard:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        needed = self.columns * self.rows // 2
        if needed > len(markers.bytesList):
            raise cv2.error(f"{needed} markers")
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.size, self.marker, markers)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(P, 3) points in millimetres by their ids, z = 0."""
        return np.asarray(self._aruco.getChessboardCorners(), dtype=np.float64)

    @property
    def extent(self) -> tuple[float, float]:
        """Width and height of the pattern in millimetres."""
        return self.columns * self.size, self.rows * self.size

    def image(self, pixels_per_mm: float) -> NDArray[np.uint8]:
        """The pattern without a margin, 8-bit grey."""
        size = tuple(round(side * pixels_per_mm) for side in self.extent)
        return np.asarray(self._aruco.generateImage(size, marginSize=0, borderBits=1))

    def write(self, folder: Path) -> list[Path]:
        """Write ``board.png`` and ``board.pdf`` to print at 100 per cent, with a white margin of 10 mm."""
        from PIL import Image as Pillow

        scale = PRINT_DPI / 25.4
        page = np.pad(self.image(scale), round(10 * scale), constant_values=255)
        paths = [folder / "board.png", folder / "board.pdf"]
        for path in paths:
            with replacing(path) as temporary:
                options = {"dpi": (PRINT_DPI, PRINT_DPI)} if path.suffix == ".png" else {"resolution": PRINT_DPI}
                Pillow.fromarray(page).save(temporary, **options)
        return paths

    def find(self, grey: NDArray[np.uint8]) -> BoardPoints:
        """Points of the board in an 8-bit grey image (H, W); none when it isn't seen."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        corners, ids, *_ = cv2.aruco.CharucoDetector(self._aruco, detectorParams=parameters).detectBoard(grey)
        if ids is None or len(ids) == 0:
            return BoardPoints(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
        pixels: NDArray = corners.reshape(-1, 1, 2).astype(np.float32)
        window = int(np.clip(0.2 * _spacing(pixels.reshape(-1, 2)), 2, 8))
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
        pixels = cv2.cornerSubPix(grey, pixels, (window, window), (-1, -1), criteria)
        order = np.argsort(ids.ravel())
        return BoardPoints(ids.ravel().astype(np.int64)[order], pixels.reshape(-1, 2).astype(np.float64)[order] + 0.5)


def grey_image(content: bytes, where: str) -> NDArray[np.uint8]:
    """(H, W) 8-bit grey of an image file's content; ``where`` is for messages."""
    codes = to_8_bit(decode_image(content, where).pixels)
    return np.asarray(cv2.cvtColor(codes, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _spacing(pixels: NDArray) -> float:
    """Median distance of a point to its nearest neighbour."""
    if len(pixels) < 2:
        return 10.0
    return float(np.median(cKDTree(pixels).query(pixels, 2)[0][:, 1]))


def edge_width(grey: NDArray[np.uint8], found: BoardPoints) -> float:
    """Width of the edges at a board's points in pixels: contrast over steepest slope, the median of all points."""
    image = grey.astype(np.float32)
    slope = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8))
    reach = int(np.clip(0.35 * _spacing(found.pixels), 3, 25))
    widths = []
    for x, y in np.round(found.pixels - 0.5).astype(int):
        window = (slice(max(y - reach, 0), y + reach + 1), slice(max(x - reach, 0), x + reach + 1))
        low, high = np.percentile(image[window], (5, 95)) if image[window].size else (0, 0)
        widths.append((high - low) / max(float(slope[window].max()), 1e-3) if image[window].size else np.inf)
    return float(np.median(widths))
