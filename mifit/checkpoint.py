"""Stage results kept beside a result folder, so that a killed run goes on where it stopped.

One ``.npz`` per stage in ``RESULT/.checkpoint``: the arrays of an estimate, its scalars as JSON and the key of
all that it was computed from. A file whose key differs is not used. Written beside and renamed; loading one
never runs code.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mifit.core.estimate import Report
from mifit.core.files import replacing
from mifit.core.npz import read_npz

T = TypeVar("T")


def digest(value: Any) -> str:
    """Hex digest of a JSON value or a dataclass of JSON values."""
    plain = dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value  # type: ignore[call-overload]
    return hashlib.sha256(json.dumps(plain, sort_keys=True, default=str).encode()).hexdigest()


def save(folder: Path, stage: str, estimate: Any, key: str) -> None:
    """Write one stage's estimate (a dataclass of arrays, scalars and a ``Report``)."""
    arrays, scalars = {}, {}
    for field in dataclasses.fields(estimate):
        value = getattr(estimate, field.name)
        if isinstance(value, np.ndarray):
            arrays[field.name] = value
        elif isinstance(value, Report):
            scalars[field.name] = dataclasses.asdict(value)
        else:
            scalars[field.name] = value
    arrays["_meta"] = np.frombuffer(json.dumps({"key": key, "scalars": scalars}).encode(), dtype=np.uint8)
    with replacing(folder / f"{stage}.npz") as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def load(folder: Path, stage: str, cls: type[T], key: str) -> T | None:
    """Read a stage's estimate back; None when there is none, it is damaged, or it has another key."""
    path = folder / f"{stage}.npz"
    try:
        values: dict[str, Any] = dict(read_npz(path))
        meta = json.loads(bytes(values.pop("_meta")).decode())
        if meta["key"] != key:
            return None
        for name, value in meta["scalars"].items():
            if name == "report":
                value = Report(**{**value, "warnings": tuple(value["warnings"])})
            elif isinstance(value, list):
                value = tuple(value)
            values[name] = value
        return cls(**values)
    except (OSError, ValueError, KeyError, TypeError):  # InputError is a ValueError
        return None
