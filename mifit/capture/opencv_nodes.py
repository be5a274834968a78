"""Matrices and numbers of OpenCV's YAML and XML files, read without OpenCV, whose own reader ends the process on some
damaged files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mifit.errors import InputError

MAX_BYTES = 2**20
"""A calibration is a few kilobytes."""

_ENTRY = re.compile(r"^([A-Za-z_][\w.-]*)[ \t]*:(.*?)(?=^\S|\Z)", re.MULTILINE | re.DOTALL)
_FIELD = {name: re.compile(rf"\b{name}[ \t]*:[ \t]*(\w+)") for name in ("rows", "cols", "dt")}
_DATA = re.compile(r"\bdata[ \t]*:[ \t\n]*\[([^\]]*)\]")


def read_nodes(path: Path) -> dict[str, NDArray[np.float64] | float]:
    """Matrices and numbers at a file's top level by name; strings, lists and maps are left out.

    Raises
    ------
    InputError
        The file is missing, no YAML or XML of OpenCV's, or a matrix holds another number of values than it says.
    """
    try:
        content = path.read_bytes()
        text = content.decode("utf-8-sig").lstrip()
    except FileNotFoundError:
        raise InputError(f"{path}: no such calibration file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, str(error)) from None
    if len(content) > MAX_BYTES:
        raise _unreadable(path, f"{len(content)} bytes, more than any calibration has")
    if not text.startswith(("%YAML", "<?xml", "<opencv_storage")):
        raise _unreadable(path, f"it starts with {text[:12]!r}, expected %YAML or <?xml")
    xml = text.startswith("<")
    found: dict[str, NDArray[np.float64] | float] = {}
    for name, matrix, value in _xml(text, path) if xml else _yaml(text):
        if matrix is not None:
            found[name] = _matrix(*matrix, f"{path}: {name}")
        elif (number := _number(value)) is not None:
            found[name] = number
    if not found:
        raise _unreadable(path, "no matrix and no number found")
    return found


Entry = tuple[str, "tuple[str, str, str, list[str]] | None", str]
"""Name, rows, cols, dt and data of a matrix, text of anything else."""


def _yaml(text: str) -> Iterator[Entry]:
    for entry in _ENTRY.finditer(text.replace("\r\n", "\n")):
        name, body = entry[1], entry[2]
        data = _DATA.search(body)
        if data is None:
            yield name, None, body.split("#")[0]
            continue
        fields = (pattern.search(body) for pattern in _FIELD.values())
        rows, columns, kind = (field[1] if field else "" for field in fields)
        yield name, (rows, columns, kind, data[1].replace(",", " ").split()), ""


def _xml(text: str, path: Path) -> Iterator[Entry]:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise _unreadable(path, str(error)) from None
    for node in root:
        data = node.findtext("data")
        fields = ((node.findtext(name) or "").strip() for name in _FIELD)
        if data is None:
            yield str(node.tag), None, node.text or ""
        else:
            rows, columns, kind = fields
            yield str(node.tag), (rows, columns, kind, data.split()), ""


def _matrix(rows: str, columns: str, kind: str, data: list[str], where: str) -> NDArray[np.float64]:
    values = [_number(word) for word in data]
    shaped = rows.isdecimal() and columns.isdecimal() and len(rows + columns) < 10
    if not shaped or int(rows) * int(columns) != len(values) or None in values or len(kind.strip('"')) > 1:
        raise InputError(
            f"{where}: found {len(values)} values for {rows or '?'} x {columns or '?'} of type {kind or '?'}, expected "
            "a matrix of single numbers, as many as rows times cols"
        )
    return np.array(values, dtype=np.float64).reshape(int(rows), int(columns))


def _number(text: str) -> float | None:
    """A number as OpenCV writes it (infinities are ``.Inf``, the other one ``.Nan``), or None."""
    word = text.strip()
    if word.lstrip("+-").lower() in (".inf", ".nan"):
        word = word.replace(".", "", 1)
    try:
        return float(word)
    except ValueError:
        return None


def _unreadable(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: not a readable OpenCV YAML or XML file ({' '.join(reason.split())[-80:]})")
