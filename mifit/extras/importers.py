"""``import_from``: photographs registered by other programs, or folders of data sets of heads -> a capture folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mifit.capture.importer import Material, Selection, import_material, match_views, scene_material, sources_of
from mifit.capture.sources import ImageFiles, Source
from mifit.errors import InputError
from mifit.extras.colmap import read_colmap
from mifit.extras.metashape import read_metashape
from mifit.extras.nersemble import read_nersemble
from mifit.extras.photos import PhotoFolders, group_photos, view_name
from mifit.extras.realitycapture import read_realitycapture

if TYPE_CHECKING:
    from typing_extensions import Unpack

REGISTRATIONS = ("colmap", "metashape", "realitycapture")
"""Sources of cameras that name photographs."""
WHOLE = ("vhap", "nersemble")
"""Sources that bring images and cameras."""
KINDS = (*REGISTRATIONS, *WHOLE)


def import_from(
    kind: str,
    where: str | Path,
    out: str | Path,
    videos: Sequence[str | Path] = (),
    images: Sequence[str | Path] = (),
    photos: str | Path | None = None,
    units: str | None = None,
    **options: Unpack[Selection],
) -> Path:
    """Make a capture folder from cameras of another program or a data set; else as `mifit.capture.import_capture`.

    Parameters
    ----------
    kind : str
        ``colmap`` (a folder with a text model), ``metashape`` (cameras exported as XML), ``realitycapture``
        (a folder of XMP files), ``vhap`` (a folder that VHAP
        exports) or ``nersemble`` (one sequence, as released).
    where : path
    out : path
        Folder to make; it must be missing or empty.
    videos, images : sequence of path
        Pixels in place of the photographs, for cameras of these names; not for ``vhap`` and ``nersemble``.
    photos : path, optional
        Folder of the photographs; default: beside the model.
    units : str, optional
        Default: cm for ``colmap``, else metres.
    **options
        ``every``, ``start``, ``count``, ``starts``, ``trim`` and ``progress``.

    Raises
    ------
    InputError
        Input that is missing, damaged, not synchronous, or doesn't fit together.
    """
    where, unit = Path(where), units or ("cm" if kind == "colmap" else "m")
    if kind not in KINDS:
        raise InputError(f"found {kind!r}, expected one of {', '.join(KINDS)}")
    if photos is not None and kind in WHOLE:
        raise InputError(f"photos: found without a model to go with, expected one of {', '.join(REGISTRATIONS)}")
    if (videos or images) and kind in WHOLE:
        raise InputError(f"{kind}: brings its own images, found videos or folders of images as well; leave them out")

    def gather() -> Material:
        if kind == "vhap":
            return scene_material(where, [], unit)
        if kind == "nersemble":
            sequence = read_nersemble(where)
            return Material(sequence.sources, sequence.views, {}, unit)
        return _registered(kind, where, sources_of(videos, images), photos, unit)

    return import_material(out, gather, units, **options)


def _registered(kind: str, where: Path, sources: list[Source], photos: str | Path | None, units: str) -> Material:
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
        return Material(sources, match_views(sources, [photo.view for photo in found], str(where)), {}, units)
    cameras = group_photos(found)
    files = [ImageFiles.of(name, [folders.find(photo.name) for photo in group]) for name, group in cameras.items()]
    return Material(files, match_views(files, [group[0].view for group in cameras.values()], str(where)), {}, units)
