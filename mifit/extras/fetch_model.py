"""ICT-FaceKit Light (Li et al. 2020, MIT licence), fetched from its public repository when asked for."""

from __future__ import annotations

import hashlib
import json
import shutil
import urllib.request
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit

from mifit.core.files import write_bytes
from mifit.core.limits import MAX_DOCUMENT_BYTES
from mifit.errors import InputError, MifitError
from mifit.morphable.formats.ict import load_ict_folder
from mifit.morphable.recognise import fetched_model
from mifit.progress import Progress, silent

COMMIT = "da5f95a607f5e6b37755b38d3385d7f2853732e5"
ADDRESS = f"https://raw.githubusercontent.com/ICT-VGL/ICT-FaceKit/{COMMIT}/FaceXModel"
INDEX, NEUTRAL = "vertex_indices.json", "generic_neutral_mesh.obj"
IDENTITIES = 100
DIGEST = "8fc28905c645862e4162769898a01620bf2589538795190ccd530f86da1b115e"
"""SHA-256 over a line ``NAME SHA-256`` of each file, in the order of `wanted`."""


def wanted(index: bytes) -> list[str]:
    """Names of the model's files, given its index."""
    try:
        expressions = [str(name) for name in json.loads(index)["expressions"]]
    except (ValueError, KeyError, TypeError):
        raise MifitError(f"{INDEX}: isn't the index of ICT-FaceKit, expected 'expressions'") from None
    return [INDEX, NEUTRAL, *(f"identity{k:03d}.obj" for k in range(IDENTITIES)), *(f"{n}.obj" for n in expressions)]


def fetch_ict(address: str = ADDRESS, progress: Progress = silent) -> Path:
    """Fetch ICT-FaceKit Light, check it, and write it as ``auto`` finds it.

    Files that lie in the folder ``FaceXModel`` beside that place already, copied by hand or from a run that was
    stopped, are not fetched. They are removed once the model is written. ``address`` is the folder of the files.

    InputError for an address that is neither ``https`` nor ``http`` of this machine; MifitError where a file can't be
    fetched, or the files are not the expected ones.
    """
    place = urlsplit(address)
    if place.scheme != "https" and not (place.scheme == "http" and place.hostname in ("127.0.0.1", "localhost", "::1")):
        raise InputError(f"--from: found {address!r}, expected an https address")
    target = fetched_model("ict")
    folder = target.with_name("FaceXModel")
    names, digest = wanted(_content(address, folder, INDEX)), hashlib.sha256()
    for k, name in enumerate(names):
        progress("Fetching ICT-FaceKit", k, len(names))
        content = _content(address, folder, name)
        digest.update(f"{name} {hashlib.sha256(content).hexdigest()}\n".encode())
    if digest.hexdigest() != DIGEST:
        shutil.rmtree(folder)
        raise MifitError(
            f"{address}: files have the digest {digest.hexdigest()[:12]}..., expected {DIGEST[:12]}...; they were "
            "changed or damaged, and are removed; try again, or from another --from"
        )
    progress("Fetching ICT-FaceKit", len(names), len(names))
    load_ict_folder(folder).save(target)
    shutil.rmtree(folder)
    return target


def _content(address: str, folder: Path, name: str) -> bytes:
    """A file of the model, kept in the folder."""
    path = folder / name
    if path.is_file():
        return path.read_bytes()
    try:
        with urllib.request.urlopen(f"{address}/{name}", timeout=30) as answer:
            content = answer.read(MAX_DOCUMENT_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        if isinstance(error, HTTPError):
            error.close()
        raise MifitError(
            f"{address}/{name}: can't be fetched ({reason}); offline, copy the folder FaceXModel of the repository "
            f"ICT-VGL/ICT-FaceKit, commit {COMMIT[:7]}, to {folder}, and run this again"
        ) from None
    if len(content) > MAX_DOCUMENT_BYTES:
        raise MifitError(f"{address}/{name}: found more than {MAX_DOCUMENT_BYTES} bytes, expected a file of the model")
    write_bytes(path, content)
    return content
