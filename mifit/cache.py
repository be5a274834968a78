"""What steps have computed, kept in files under a key of all that it was computed from.

One ``.npz`` for each estimate: its arrays, its scalars as JSON, a digest of both and its key. A file whose key differs,
or whose content isn't what was written, is not used; loading one never runs code. A fit keeps its steps in
``RESULT/.mifit/checkpoints``, so that a killed run goes on where it stopped; the fits of a sweep share one folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import filelock
import numpy as np

from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.lobe import Lobe
from mifit.core.arrays import content_key, read_npz
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import Report
from mifit.core.files import replacing
from mifit.core.photometry import Photometry

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")
RECORDS: dict[str, type] = {cls.__name__: cls for cls in (Report, Diagnostic, Illumination, DistantLight, Lobe)}
"""Dataclasses that an estimate may hold."""
ARRAY, RECORD, PHOTOMETRY = "$array", "$record", "$photometry"


def digest(value: object) -> str:
    """Hex digest of a JSON value or a dataclass of JSON values."""
    plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) and not isinstance(value, type) else value
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


@dataclass(frozen=True)
class Cache:
    """A folder of estimates; without one nothing is kept.

    Where it is ``shared``, processes with other settings use it too, at the same time perhaps: files are then named
    after their keys, and who needs what another is busy with waits for it.
    """

    folder: Path | None = None
    shared: bool = False

    def get(self, name: str, cls: type[T], key: str, make: Callable[[], T]) -> T:
        """The estimate of this name and key as it is kept, or what ``make`` returns, which is kept then."""
        if self.folder is None:
            return make()
        lock: contextlib.AbstractContextManager = contextlib.nullcontext()
        if self.shared:
            name = f"{name}_{key[:16]}"
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.folder / f"{name}.lock")  # the system takes it back from a killed process
        with lock:
            found = load(self.folder, name, cls, key)
            if found is None:
                found = make()
                save(self.folder, name, found, key)
        return found


def save(folder: Path, stage: str, estimate: DataclassInstance, key: str) -> None:
    """Write one stage's estimate (a dataclass of arrays, scalars and the records of `RECORDS`)."""
    arrays: dict[str, np.ndarray] = {}
    fields = {f.name: _plain(getattr(estimate, f.name), f.name, arrays) for f in dataclasses.fields(estimate)}
    values = json.loads(json.dumps(fields))  # as they will be read: keys as text, tuples as lists
    meta = {"key": key, "values": values, "content": _content(arrays, values)}
    arrays["_meta"] = np.frombuffer(json.dumps(meta).encode(), dtype=np.uint8)
    with replacing(folder / f"{stage}.npz") as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]


def load(folder: Path, stage: str, cls: type[T], key: str) -> T | None:
    """Read a stage's estimate back; None when there is none, it is damaged or changed, or it has another key."""
    path = folder / f"{stage}.npz"
    try:
        arrays: dict[str, np.ndarray] = dict(read_npz(path))
        meta = json.loads(bytes(arrays.pop("_meta")).decode())
        if meta["key"] != key or meta["content"] != _content(arrays, meta["values"]):
            return None
        return cls(**{name: _restored(value, arrays) for name, value in meta["values"].items()})
    except (OSError, ValueError, KeyError, TypeError):  # InputError is a ValueError
        return None


def _plain(value: object, name: str, arrays: dict[str, np.ndarray]) -> object:
    """A value as JSON, its arrays put aside under names made of ``name``."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {ARRAY: name}
    if dataclasses.is_dataclass(value) and type(value) in RECORDS.values():
        fields = dataclasses.fields(value)
        return {RECORD: type(value).__name__} | {
            f.name: _plain(getattr(value, f.name), f"{name}.{f.name}", arrays) for f in fields
        }
    if isinstance(value, Photometry):
        return {PHOTOMETRY: value.document()}
    if isinstance(value, (tuple, list)):
        return [_plain(item, f"{name}.{k}", arrays) for k, item in enumerate(value)]
    return value.item() if isinstance(value, np.generic) else value


def _restored(value: object, arrays: Mapping[str, np.ndarray]) -> object:
    """The value that `_plain` made JSON of; lists come back as tuples, but for those inside dictionaries."""
    if isinstance(value, list):
        return tuple(_restored(item, arrays) for item in value)
    if not isinstance(value, dict):
        return value
    if ARRAY in value:
        return arrays[value[ARRAY]]
    if PHOTOMETRY in value:
        return Photometry.from_document(value[PHOTOMETRY])
    if RECORD in value:
        return RECORDS[value[RECORD]](**{k: _restored(v, arrays) for k, v in value.items() if k != RECORD})
    return value


def _content(arrays: Mapping[str, np.ndarray], values: Mapping[str, object]) -> str:
    """Digest of what an estimate holds, so that a changed value or shape is noticed."""
    names = sorted(arrays)
    return content_key(json.dumps(values, sort_keys=True), names, *(arrays[name] for name in names)).hex()
