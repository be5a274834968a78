"""``import_capture``: videos, image folders, photogrammetry projects or data sets of heads -> a capture folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mifit.capture.capture import Capture
from mifit.capture.colmap import read_colmap
from mifit.capture.landmark_files import read_landmarks, write_landmarks
from mifit.capture.metashape import read_metashape
from mifit.capture.nersemble import read_nersemble
from mifit.capture.photos import PhotoFolders, group_photos, view_name
from mifit.capture.realitycapture import read_realitycapture
from mifit.capture.sources import ImageFiles, Source, check_synchronous, open_sources
from mifit.capture.stereo import read_stereo
from mifit.capture.transforms import UNITS_MM, Shot, View, read_transforms, write_transforms
from mifit.core.files import file_name, read_bytes, replacing_folder, write_bytes
from mifit.core.image import decode_image, image_kind
from mifit.core.limits import MAX_IMAGE_BYTES
from mifit.errors import InputError
from mifit.progress import Progress, silent

REGISTRATIONS = ("colmap", "metashape", "realitycapture")
"""Sources of cameras that name photographs."""
WHOLE = ("vhap", "nersemble")
"""Sources that bring images and cameras."""
METRES = ("metashape", "realitycapture", *WHOLE)
"""Sources whose unit of length is the metre where nothing else is said."""


@dataclass(frozen=True)
class _Material:
    """What an import has found: images and views per camera, masks and landmarks of each image, unit of length."""

    sources: Sequence[Source]
    views: Sequence[View]
    annotated: Mapping[str, Sequence[Shot]]
    units: str


def import_capture(
    out: str | Path,
    videos: Sequence[str | Path] = (),
    calibration: str | Path | None = None,
    images: Sequence[str | Path] = (),
    colmap: str | Path | None = None,
    transforms: str | Path | None = None,
    metashape: str | Path | None = None,
    realitycapture: str | Path | None = None,
    vhap: str | Path | None = None,
    nersemble: str | Path | None = None,
    photos: str | Path | None = None,
    every: int = 1,
    start: int = 0,
    count: int | None = None,
    units: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Make a capture folder from what a lab has.

    Pixels come from ``videos`` or ``images``, one per camera, or else from the images that the calibration names.
    Cameras come from ``calibration`` (two cameras, in the order of the videos or folders), or by name from one of
    ``colmap``, ``transforms``, ``metashape`` and ``realitycapture``; without any of them the capture is uncalibrated.
    ``vhap`` and ``nersemble`` are whole folders, images and masks included.

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
        Folder of a COLMAP model, text or binary (``cameras``, ``images``).
    transforms : path, optional
        nerfstudio ``transforms.json``.
    metashape : path, optional
        Cameras exported by Agisoft Metashape as XML.
    realitycapture : path, optional
        Folder of RealityCapture's XMP files, or its CSV of internal and external camera parameters.
    vhap : path, optional
        Folder that VHAP exports: a ``transforms.json`` with ``fg_masks``.
    nersemble : path, optional
        Folder of one sequence of NeRSemble, as released or as VHAP lays it out.
    photos : path, optional
        Folder of the photographs of ``colmap``, ``metashape`` or ``realitycapture``; default: beside the model.
    every, start, count : int
        Keep every N-th frame from `start` on, at most `count`; frames are renumbered from 0.
    units : str, optional
        Unit of length of the calibration: ``mm``, ``cm``, ``dm`` or ``m``; default: metres for ``metashape``,
        ``realitycapture``, ``vhap`` and ``nersemble``, else cm. A ``transforms.json`` that says its own keeps it.
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
    if units is not None and units not in UNITS_MM:
        raise InputError(f"units: found {units!r}, expected one of {', '.join(UNITS_MM)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already and not empty; name another folder")
    options = {
        "calibration": calibration,
        "colmap": colmap,
        "transforms": transforms,
        "metashape": metashape,
        "realitycapture": realitycapture,
        "vhap": vhap,
        "nersemble": nersemble,
    }
    given = [(name, Path(path)) for name, path in options.items() if path is not None]
    kind, where = given[0] if given else (None, None)
    if len(given) > 1:
        raise InputError(f"found more than one of {', '.join(name for name, _ in given)}, expected one")
    if videos and images:
        raise InputError("found videos and folders of images, expected one kind")
    if photos is not None and kind not in REGISTRATIONS:
        raise InputError(f"photos: found without a model to go with, expected one of {', '.join(REGISTRATIONS)}")
    if (videos or images) and kind in WHOLE:
        raise InputError(f"{kind}: brings its own images, found videos or folders of images as well; leave them out")
    material = _material(videos, images, kind, where, photos, units)
    sources = material.sources
    check_synchronous(sources)
    if start >= sources[0].length:
        raise InputError(f"start: found {start}, expected less than the {sources[0].length} frames there are")
    steps = len(range(start, sources[0].length, every))
    steps = steps if count is None else min(count, steps)
    with replacing_folder(out) as part:
        shots = list(_copy(sources, part, start, every, steps, progress))
        shots = _copy_annotations(shots, material.annotated, part, start, every)
        write_transforms(part / "transforms.json", material.views, shots, material.units)
        Capture.load(part)  # nothing is handed over that can't be read back
    return out


def _material(
    videos: Sequence[str | Path],
    images: Sequence[str | Path],
    kind: str | None,
    where: Path | None,
    photos: str | Path | None,
    units: str | None,
) -> _Material:
    unit = units or ("m" if kind in METRES else "cm")
    sources = open_sources(videos, images) if videos or images else []
    if kind is None or where is None:
        if not sources:
            raise InputError("nothing to import: expected videos, folders of images, or a calibration with its images")
        return _Material(sources, [View(source.name, *source.size) for source in sources], {}, unit)
    if kind == "calibration":
        if len(sources) != 2:
            raise InputError(f"{where}: describes two cameras, but {len(sources)} are given")
        views = read_stereo(where, [source.name for source in sources], [source.size for source in sources])
        return _Material(sources, views, {}, unit)
    if kind == "nersemble":
        sequence = read_nersemble(where)
        return _Material(sequence.sources, sequence.views, sequence.annotated, unit)
    if kind in ("transforms", "vhap"):
        scene = read_transforms(where / "transforms.json" if where.is_dir() else where, unit)
        if sources:
            return _Material(sources, _match(sources, scene.views, str(where)), {}, scene.units)
        annotated = {view.name: [shot for shot in scene.shots if shot.camera == view.name] for view in scene.views}
        files = [ImageFiles.of(name, [shot.image for shot in shots]) for name, shots in annotated.items()]
        return _Material(files, _match(files, scene.views, str(where)), annotated, scene.units)
    return _registered(kind, where, sources, photos, unit)


def _registered(kind: str, where: Path, sources: list[Source], photos: str | Path | None, units: str) -> _Material:
    """Photographs or other images with the cameras of a photogrammetry program."""
    folders = PhotoFolders.of(where, photos)
    if kind == "colmap":
        found = read_colmap(where)
    elif kind == "metashape":
        found = read_metashape(where)
    else:
        sizes = {source.name: source.size for source in sources}
        found = read_realitycapture(where, lambda name: sizes.get(view_name(name)) or folders.size(name))
    if sources:
        return _Material(sources, _match(sources, [photo.view for photo in found], str(where)), {}, units)
    cameras = group_photos(found)
    files = [ImageFiles.of(name, [folders.find(photo.name) for photo in group]) for name, group in cameras.items()]
    views = _match(files, [group[0].view for group in cameras.values()], str(where))
    return _Material(files, views, {}, units)


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


def _copy_annotations(
    shots: Sequence[Shot], annotated: Mapping[str, Sequence[Shot]], folder: Path, start: int, every: int
) -> list[Shot]:
    """Bring the masks and landmarks of the source along."""
    copied = []
    for shot in shots:
        if shot.camera not in annotated:
            copied.append(shot)
            continue
        source = annotated[shot.camera][start + every * shot.timestep]
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
