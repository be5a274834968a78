"""Where imported images come from: videos, folders of images, lists of files."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from mifit.core.files import check_file, read_bytes
from mifit.core.image import SUFFIXES, decode_image, encode_png, image_kind, load_image
from mifit.core.limits import MAX_COUNT, MAX_FILE_BYTES, MAX_PIXELS
from mifit.core.process import decoding
from mifit.errors import InputError


class Source(Protocol):
    """One camera's images in order."""

    @property
    def name(self) -> str:
        """Camera name."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""

    @property
    def length(self) -> int:
        """Number of frames."""

    def files(self, numbers: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """(suffix, content) of the frames of ascending numbers, each checked to decode."""


@dataclass(frozen=True)
class ImageFiles:
    """A camera's images as a list of files of one size."""

    name: str
    paths: tuple[Path, ...]
    size: tuple[int, int]

    @classmethod
    def folder(cls, path: Path, name: str) -> ImageFiles:
        """All images of a folder in the order of the numbers in their names."""
        if not path.is_dir():
            raise InputError(f"{path}: no such folder of images")
        found = sorted((p for p in path.iterdir() if p.suffix.lower() in SUFFIXES), key=_natural)
        if not found:
            raise InputError(f"{path}: found no image, expected files {', '.join(SUFFIXES)}")
        return cls.of(name, found)

    @classmethod
    def of(cls, name: str, paths: Sequence[Path]) -> ImageFiles:
        """Images in the given order; the first one gives the size."""
        height, width = load_image(paths[0]).pixels.shape[:2]
        return cls(name, tuple(paths), (width, height))

    @property
    def length(self) -> int:
        """Number of images."""
        return len(self.paths)

    def files(self, numbers: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Contents as they are on disk, once they have been seen to decode to the right size; suffix by content."""
        for path in (self.paths[i] for i in numbers):
            content = read_bytes(path, MAX_FILE_BYTES, "image file")  # once: what is checked is what is copied
            height, width = decode_image(content, path).pixels.shape[:2]
            if (width, height) != self.size:
                raise InputError(
                    f"{path}: found {width} x {height} pixels, expected {self.size[0]} x {self.size[1]} as in "
                    f"{self.paths[0].name}"
                )
            yield image_kind(content, path), content


@dataclass(frozen=True)
class Video:
    """A video file; frames come out as 8-bit PNG."""

    path: Path
    name: str
    size: tuple[int, int]
    length: int
    rate: float

    @classmethod
    def open(cls, path: Path, name: str) -> Video:
        """Read a video's header; InputError when it isn't one."""
        check_file(path, float("inf"), "video file")  # decoded frame by frame
        with opened_video(path) as reader:
            size = (int(reader.get(cv2.CAP_PROP_FRAME_WIDTH)), int(reader.get(cv2.CAP_PROP_FRAME_HEIGHT)))
            length, rate = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)), float(reader.get(cv2.CAP_PROP_FPS))
        if not 1 <= length <= MAX_COUNT or min(size) < 1 or size[0] * size[1] > MAX_PIXELS or not rate > 0:
            raise InputError(
                f"{path}: found {length} frames of {size[0]} x {size[1]} pixels at {rate:g} a second, expected a whole "
                "video"
            )
        return cls(path, name, size, length, rate)

    def files(self, numbers: Sequence[int]) -> Iterator[tuple[str, bytes]]:
        """Decode in order; frames between the wanted ones are passed over without conversion."""
        wanted = set(numbers)
        with opened_video(self.path) as reader:
            for i in range(max(wanted, default=-1) + 1):
                with decoding():
                    there = reader.grab()
                if not there:
                    raise InputError(
                        f"{self.path}: the header promises {self.length} frames but frame {i} can't be read: truncated "
                        "or damaged; copy or encode it again"
                    )
                if i in wanted:
                    ok, frame = reader.retrieve()
                    if not ok or frame is None or frame.shape[1::-1] != self.size:
                        raise InputError(f"{self.path}: frame {i} can't be decoded; copy or encode the video again")
                    yield ".png", encode_png(np.asarray(frame[..., ::-1], dtype=np.uint8))


@contextlib.contextmanager
def opened_video(path: Path) -> Iterator[cv2.VideoCapture]:
    """A video's reader, closed in the end; InputError for what is no video."""
    with decoding():
        reader = cv2.VideoCapture(str(path))
    try:
        if not reader.isOpened():
            raise InputError(f"{path}: not a readable video: truncated, damaged or of an unknown format")
        yield reader
    finally:
        reader.release()


def open_sources(
    videos: Sequence[str | Path], images: Sequence[str | Path], names: Sequence[str] | None = None
) -> list[Source]:
    """One camera for each video, or else for each folder of images or single photograph, named after it.

    InputError for both or none of them, a file or folder that can't be read, or names that don't tell the cameras
    apart.
    """
    if bool(videos) == bool(images):
        raise InputError(f"found {'videos and' if videos else 'no videos and no'} folders of images, expected one kind")
    paths = [Path(v) for v in videos or images]
    folders = not videos and not all(path.is_file() for path in paths)
    if names is None:
        named = _named(paths, stems=not folders)
    elif len(names) == len(paths) == len(set(names)):
        named = list(zip(paths, names, strict=True))
    else:
        raise InputError(f"names: found {', '.join(names)}, expected {len(paths)} different ones")
    if videos:
        return [Video.open(path, name) for path, name in named]
    return [ImageFiles.folder(path, name) if folders else ImageFiles.of(name, [path]) for path, name in named]


def _named(paths: list[Path], stems: bool) -> list[tuple[Path, str]]:
    """Camera names: the files' stems (folders' names), or their parents' where those coincide."""
    for names in (
        [path.stem if stems else Path(os.path.abspath(path)).name for path in paths],
        [Path(os.path.abspath(path)).parent.name for path in paths],
    ):
        if len(set(names)) == len(names) and all(names):
            return list(zip(paths, names, strict=True))
    raise InputError(f"found {', '.join(map(str, paths))}, expected files or folders with different names")


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key by the numbers in a name: frame2 before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]
