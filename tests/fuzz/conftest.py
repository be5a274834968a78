"""What the fuzz tests share: damage to bytes and documents, and the promise that every reader keeps."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any, TypeVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from mifit.errors import MifitError

T = TypeVar("T")


def bounded(examples: int, deadline: int | None = 20_000) -> settings:
    """The same examples in every run; one that takes 20 seconds (milliseconds are given) counts as a hang."""
    return settings(
        max_examples=examples,
        derandomize=True,
        database=None,
        deadline=deadline,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
    )


def read_or_refuse(read: Callable[[], T]) -> T | None:
    """What a reader gives, or None when it refuses with a message; any other exception is a failure."""
    try:
        return read()
    except MifitError as error:
        text = str(error)
        assert len(text) > 10 and "Traceback" not in text
        return None


NASTY: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from(
        [
            None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**400, -(10**400), 1e308, 5e-324, -0.0,
            "", " ", ".", "..", "/", "\0", "a\nb", "nan", "1e999", "x" * 5000, "\ud800", "é", [], {}, [[]], [None],
            {"a": 1}, [1, 2, 3], [[1, 2], [3]], [[10**400] * 4] * 4, [[0.0] * 4] * 4, [["a"] * 4] * 4,
            [[1e308] * 4] * 4, [[5e-324] * 4] * 4,
        ]
    ),
    st.floats(),
    st.integers(),
    st.text(max_size=5),
    st.lists(st.floats(width=32), max_size=5),
)  # fmt: skip
"""JSON values that belong nowhere."""


def places(document: Any, prefix: tuple = ()) -> list[tuple]:
    """Paths to all values of a nested document; long lists only at their ends."""
    found = [prefix] if prefix else []
    if isinstance(document, dict):
        for key, value in document.items():
            found += places(value, (*prefix, key))
    elif isinstance(document, list):
        for i in sorted({0, len(document) - 1}) if document else ():
            found += places(document[i], (*prefix, i))
    return found


@st.composite
def spoilt_documents(draw: st.DrawFn, document: Any) -> Any:
    """A JSON-like document with one to three values replaced, removed, doubled or renamed."""
    out = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        known = places(out)
        if not known:
            break
        *path, last = draw(st.sampled_from(known))
        parent = out
        for key in path:
            parent = parent[key]
        action = draw(st.sampled_from(["replace", "replace", "replace", "remove", "double"]))
        if action == "remove":
            del parent[last]
        elif action == "double" and isinstance(parent, list):
            parent.append(copy.deepcopy(parent[last]))
        else:
            parent[last] = copy.deepcopy(draw(NASTY))
    return out


@st.composite
def spoilt_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """A file's content cut off, with bytes changed, removed or repeated; most damage is near its start."""
    out = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        near = draw(st.sampled_from([64, 512, len(out)]))
        at = draw(st.integers(0, max(min(near, len(out)) - 1, 0)))
        action = draw(st.sampled_from(["change", "change", "cut", "remove", "repeat", "insert"]))
        if action == "change" and out:
            out[at] = draw(st.integers(0, 255))
        elif action == "cut":
            del out[at:]
        elif action == "remove":
            del out[at : at + draw(st.integers(1, 16))]
        elif action == "repeat":
            out[at:at] = out[at : at + draw(st.integers(1, 64))]
        else:
            out[at:at] = draw(st.binary(max_size=8))
    return bytes(out)


def as_json(document: Any) -> str:
    """JSON text, also of values that JSON doesn't have (NaN, infinities, lone surrogates)."""
    return json.dumps(document)
