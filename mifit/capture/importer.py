"""``import_capture``: videos or image folders with OpenCV's or nerfstudio's cameras -> a capture folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from mifit.capture.capture import Capture
from mifit.capture.clips import aligned
from mifit.capture.landmark_files import read_landmarks, write_landmarks
from mifit.capture.sources import ImageFiles, Source, open_sources
from mifit.capture.stereo import read_stereo
from mifit.capture.transforms import UNITS_MM, Shot, View, read_transforms, write_transforms
from mifit.core.files import file_name, read_bytes, replacing_folder, write_bytes
from mifit.core.image import decode_image, image_kind
from mifit.core.limits import MAX_FILE_BYTES
from mifit.errors import InputError
from mifit.progress import Progress, silent

if TYPE_CHECKING:
    from typing_extensions import Unpack


@dataclass(frozen=True)
class Material:
    """What an import has found: images and views per camera, masks and landmarks of each image, unit of length."""

    sources: Sequence[Source]
    views: Sequence[View]
    annotated: Mapping[str, Sequence[Shot]]
    units: str


class Selection(TypedDict, total=False):
    """Which frames are kept, see `import_capture`, and who hears of its progress."""

    every: int
    start: int
    count: int | None
    starts: Sequence[float]
    trim: tuple[float, float] | None
    progress: Progress


def import_capture(
    out: str | Path,
    videos: Sequence[str | Path] = (),
    calibration: str | Path | None = None,
    images: Sequence[str | Path] = (),
    transforms: str | Path | None = None,
    units: str | None = None,
    **options: Unpack[Selection],
) -> Path:
    """Make a capture folder from what a lab has.

    Pixels come from ``videos`` or ``images``, one per camera, or else from the images that ``transforms`` names.
    Cameras come from ``calibration`` (two cameras, in the order of the videos or folders), or by name from
    ``transforms``; without either the capture is uncalibrated.

    Parameters
    ----------
    out : path
        Folder to make; it must be missing or empty. It is returned; nothing is left there when the import fails.
    videos, images : sequence of path
        One video per camera, whose lengths, rates and sizes may differ: frames are paired by time. Or one folder of
        images, in the order of the numbers in the file names, or one photograph each. Cameras are called after them.
    calibration, transforms : path, optional
        OpenCV stereo calibration, YAML; nerfstudio ``transforms.json``.
    units : str, optional
        Unit of length of the calibration: ``mm``, ``cm`` (default), ``dm`` or ``m``. A ``transforms.json`` that says
        its own keeps it.
    **options
        Every N-th frame (``every``) from ``start`` on is kept, at most ``count``, renumbered from 0. ``starts`` are
        seconds by which each video began later than the first one (`capture.clips`), by default all at once; ``trim``
        (float, float) those of the first video from which, and up to which, frames are taken; and ``progress``.

    Raises
    ------
    InputError
        Input that is missing, damaged, not synchronous, or doesn't fit together.
    """
    if calibration is not None and transforms is not None:
        raise InputError("found more than one of calibration, transforms, expected one")

    def gather() -> Material:
        unit = length_unit(units)
        if transforms is not None:
            return scene_material(Path(transforms), sources_of(videos, images), unit)
        sources = sources_of(videos, images)
        if not sources:
            raise InputError("nothing to import: expected videos, folders of images, or a calibration with its images")
        views: Sequence[View] = [View(source.name, *source.size) for source in sources]
        if calibration is not None:
            if len(sources) != 2:
                raise InputError(f"{calibration}: describes two cameras, but {len(sources)} are given")
            views = read_stereo(calibration, [source.name for source in sources], [source.size for source in sources])
        return Material(sources, views, {}, unit)

    return import_material(out, gather, **options)


def import_material(
    out: str | Path,
    gather: Callable[[], Material],
    every: int = 1,
    start: int = 0,
    count: int | None = None,
    starts: Sequence[float] = (),
    trim: tuple[float, float] | None = None,
    progress: Progress = silent,
) -> Path:
    """Make a capture folder of what ``gather`` finds; else as `import_capture`."""
    out = Path(out)
    if every < 1 or start < 0 or (count is not None and count < 1):
        raise InputError(f"every {every}, start {start}, count {count}: expected every >= 1, start >= 0, count >= 1")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already and not empty; name another folder")
    material = gather()
    sources = aligned(material.sources, starts, trim)
    if start >= sources[0].length:
        raise InputError(f"start: found {start}, expected less than the {sources[0].length} frames there are")
    numbers = range(start, sources[0].length, every)[:count]
    with replacing_folder(out) as part:
        shots = list(_copy(sources, part, numbers, progress))
        sizes = {view.name: (view.height, view.width) for view in material.views}
        shots = _copy_annotations(shots, material.annotated, part, numbers, sizes)
        write_transforms(part / "transforms.json", material.views, shots, material.units)
        Capture.load(part)  # nothing is handed over that can't be read back
    return out


def length_unit(units: str | None) -> str:
    """The unit of length of a calibration, centimetres by default; InputError for one that isn't known."""
    if units is not None and units not in UNITS_MM:
        raise InputError(f"units: found {units!r}, expected one of {', '.join(UNITS_MM)}")
    return units or "cm"


def sources_of(videos: Sequence[str | Path], images: Sequence[str | Path]) -> list[Source]:
    """One camera for each video or folder of images; none for none."""
    return open_sources(videos, images) if videos or images else []


def scene_material(where: Path, sources: list[Source], units: str) -> Material:
    """The cameras of a ``transforms.json`` (or of the one in a folder), for given images or else for its own."""
    scene = read_transforms(where / "transforms.json" if where.is_dir() else where, units)
    if sources:
        return Material(sources, match_views(sources, scene.views, str(where)), {}, scene.units)
    annotated = {view.name: [shot for shot in scene.shots if shot.camera == view.name] for view in scene.views}
    files = [ImageFiles.of(name, [shot.image for shot in shots]) for name, shots in annotated.items()]
    return Material(files, match_views(files, scene.views, str(where)), annotated, scene.units)


def match_views(sources: Sequence[Source], views: Iterable[View], where: str) -> list[View]:
    """The views by the names of the sources."""
    known = {view.name: view for view in reversed(list(views))}
    matched: list[View] = []
    for source in sources:
        if source.name not in known:
            raise InputError(f"{where}: has cameras {', '.join(known)}, expected one called {source.name!r}")
        view = known[source.name]
        if (view.width, view.height) != source.size:
            raise InputError(
                f"{where}: camera {source.name!r} is calibrated for {view.width} x {view.height} pixels, but its "
                f"images have {source.size[0]} x {source.size[1]}"
            )
        matched.append(view)
    return matched


def _copy_annotations(
    shots: Sequence[Shot],
    annotated: Mapping[str, Sequence[Shot]],
    folder: Path,
    numbers: Sequence[int],
    sizes: Mapping[str, tuple[int, int]],
) -> list[Shot]:
    """Bring the masks and landmarks of the source along; ``sizes`` are heights and widths of the cameras' images."""
    copied = []
    for shot in shots:
        if shot.camera not in annotated:
            copied.append(shot)
            continue
        source = annotated[shot.camera][numbers[shot.timestep]]
        if source.mask is not None:
            content = read_bytes(source.mask, MAX_FILE_BYTES, "mask")
            found, expected = decode_image(content, source.mask).pixels.shape[:2], sizes[shot.camera]
            if found != expected:
                raise InputError(
                    f"{source.mask}: found a mask of {found[1]} x {found[0]} pixels, expected {expected[1]} x "
                    f"{expected[0]} as the image"
                )
            name = f"{shot.timestep:04d}{image_kind(content, source.mask)}"
            mask = folder / "masks" / file_name(shot.camera) / name
            write_bytes(mask, content)
            shot = dataclasses.replace(shot, mask=mask)
        if source.landmarks is not None:
            landmarks = folder / "landmarks" / file_name(shot.camera) / f"{shot.timestep:04d}.json"
            write_landmarks(landmarks, read_landmarks(source.landmarks))
            shot = dataclasses.replace(shot, landmarks=landmarks)
        copied.append(shot)
    return copied


def _copy(sources: Sequence[Source], folder: Path, numbers: Sequence[int], progress: Progress) -> Iterable[Shot]:
    total = len(numbers) * len(sources)
    for s, source in enumerate(sources):
        target = folder / "images" / file_name(source.name)
        for t, (suffix, content) in enumerate(source.files(numbers)):
            progress("Importing", s * len(numbers) + t, total)
            image = target / f"{t:04d}{suffix}"
            write_bytes(image, content)
            yield Shot(source.name, t, image)
    progress("Importing", total, total)
