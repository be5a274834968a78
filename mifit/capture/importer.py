"""``import_capture``: videos, image folders, COLMAP models or nerfstudio scenes -> a capture folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

from mifit.capture.capture import Capture
from mifit.capture.colmap import read_colmap
from mifit.capture.landmark_files import read_landmarks, write_landmarks
from mifit.capture.sources import ImageFiles, Source, check_synchronous, open_sources
from mifit.capture.stereo import read_stereo
from mifit.capture.transforms import UNITS_MM, Shot, Transforms, View, read_transforms, write_transforms
from mifit.core.files import file_name, read_bytes, replacing_folder, write_bytes
from mifit.core.image import decode_image, image_kind
from mifit.core.limits import MAX_IMAGE_BYTES
from mifit.errors import InputError
from mifit.progress import Progress, silent


def import_capture(
    out: str | Path,
    videos: Sequence[str | Path] = (),
    calibration: str | Path | None = None,
    images: Sequence[str | Path] = (),
    colmap: str | Path | None = None,
    transforms: str | Path | None = None,
    every: int = 1,
    start: int = 0,
    count: int | None = None,
    units: str = "cm",
    progress: Progress = silent,
) -> Path:
    """Make a capture folder from what a lab has.

    Pixels come from ``videos`` or ``images``, one per camera, or else from the images that ``colmap`` or ``transforms``
    name. Cameras come from ``calibration`` (two cameras, in the order of the videos or folders), or by name from
    ``colmap`` or ``transforms``; without any of them the capture is uncalibrated.

    Parameters
    ----------
    out : path
        Folder to make; it must be missing or empty.
    videos : sequence of path
        One synchronised video per camera. Cameras are called after the files' stems.
    calibration : path, optional
        OpenCV stereo calibration, YAML or XML.
    images : sequence of path
        One folder of images per camera, in the order of the numbers in the file names.
    colmap : path, optional
        Folder with ``cameras.txt`` and ``images.txt``.
    transforms : path, optional
        nerfstudio ``transforms.json``.
    every, start, count : int
        Keep every N-th frame from `start` on, at most `count`; frames are renumbered from 0.
    units : str
        Unit of length of the calibration: ``mm``, ``cm``, ``dm`` or ``m``. A ``transforms.json`` that says its own
        keeps it.
    progress : Progress

    Returns
    -------
    Path
        ``out``; nothing is left there when the import fails.

    Raises
    ------
    InputError
        Input that is missing, damaged, not synchronous, or doesn't fit together.
    """
    out = Path(out)
    if every < 1 or start < 0 or (count is not None and count < 1):
        raise InputError(f"every {every}, start {start}, count {count}: expected every >= 1, start >= 0, count >= 1")
    if units not in UNITS_MM:
        raise InputError(f"units: found {units!r}, expected one of {', '.join(UNITS_MM)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already and not empty; name another folder")
    if sum(x is not None for x in (calibration, colmap, transforms)) > 1:
        raise InputError("found more than one of calibration, colmap and transforms, expected one")
    if videos and images:
        raise InputError("found videos and folders of images, expected one kind")
    scene = read_transforms(transforms) if transforms is not None else None
    sources = _sources(videos, images, colmap, scene)
    check_synchronous(sources)
    if start >= sources[0].length:
        raise InputError(f"start: found {start}, expected less than the {sources[0].length} frames there are")
    views = _views(sources, calibration, colmap, scene)
    if scene is not None:
        units = scene.units
    steps = len(range(start, sources[0].length, every))
    steps = steps if count is None else min(count, steps)
    with replacing_folder(out) as part:
        shots = list(_copy(sources, part, start, every, steps, progress))
        if scene is not None and not (videos or images):
            shots = _copy_annotations(shots, scene, part, start, every)
        write_transforms(part / "transforms.json", views, shots, units)
        Capture.load(part)  # nothing is handed over that can't be read back
    return out


def _sources(
    videos: Sequence[str | Path], images: Sequence[str | Path], colmap: str | Path | None, scene: Transforms | None
) -> list[Source]:
    if videos or images:
        return open_sources(videos, images)
    if colmap is not None:
        return _colmap_sources(Path(colmap))
    if scene is not None:
        return [
            ImageFiles.of(view.name, [shot.image for shot in scene.shots if shot.camera == view.name])
            for view in scene.views
        ]
    raise InputError("nothing to import: expected videos, folders of images, a COLMAP model or a transforms.json")


def _colmap_sources(folder: Path) -> list[Source]:
    by_camera: dict[str, list[Path]] = {}
    for image in read_colmap(folder):
        places = [
            base / image.name for base in (folder, folder / "images", *(p / "images" for p in folder.parents[:3]))
        ]
        found = next((place for place in places if place.is_file()), None)
        if found is None:
            raise InputError(f"{folder / image.name}: no such image; expected it beside the model or in 'images'")
        by_camera.setdefault(image.view.name, []).append(found)
    return [ImageFiles.of(name, sorted(paths)) for name, paths in by_camera.items()]


def _views(
    sources: Sequence[Source], calibration: str | Path | None, colmap: str | Path | None, scene: Transforms | None
) -> list[View]:
    if calibration is not None:
        if len(sources) != 2:
            raise InputError(f"{calibration}: describes two cameras, but {len(sources)} are given")
        return list(read_stereo(calibration, [source.name for source in sources], [source.size for source in sources]))
    if colmap is not None:
        return _match(sources, [image.view for image in read_colmap(colmap)], str(colmap))
    if scene is not None:
        return _match(sources, scene.views, "transforms")
    return [View(source.name, *source.size) for source in sources]


def _match(sources: Sequence[Source], views: Iterable[View], where: str) -> list[View]:
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


def _copy_annotations(shots: Sequence[Shot], scene: Transforms, folder: Path, start: int, every: int) -> list[Shot]:
    """Bring the masks and landmarks of a ``transforms.json`` along."""
    original = {name: [s for s in scene.shots if s.camera == name] for name in {s.camera for s in shots}}
    copied = []
    for shot in shots:
        source = original[shot.camera][start + every * shot.timestep]
        if source.mask is not None:
            content = read_bytes(source.mask, MAX_IMAGE_BYTES, "mask")
            decode_image(content, source.mask)
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


def _copy(
    sources: Sequence[Source], folder: Path, start: int, every: int, steps: int, progress: Progress
) -> Iterable[Shot]:
    total = steps * len(sources)
    for s, source in enumerate(sources):
        target = folder / "images" / file_name(source.name)
        files = source.files(start, every)
        for t in range(steps):
            progress("Importing", s * steps + t, total)
            suffix, content = next(files)
            image = target / f"{t:04d}{suffix}"
            write_bytes(image, content)
            yield Shot(source.name, t, image)
    progress("Importing", total, total)
