"""Matrices and numbers of OpenCV's YAML and XML files, read without OpenCV, whose own reader ends the process on some
damaged files.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from mifit.core.files import read_text
from mifit.core.limits import MAX_SETTINGS_BYTES
from mifit.errors import InputError

_FIELDS = ("rows", "cols", "dt")


Nodes = dict[str, NDArray[np.float64] | float]


def read_nodes(path: Path) -> Nodes:
    """Matrices and numbers at a file's top level by name; strings, lists and maps are left out.

    Raises
    ------
    InputError
        The file is missing, no YAML or XML of OpenCV's, or a matrix holds another number of values than it says.
    """
    text = read_text(path, MAX_SETTINGS_BYTES, "calibration file").lstrip("\ufeff \r\n\t")
    if not text.startswith(("%YAML", "<?xml", "<opencv_storage")):
        raise _unreadable(path, f"it starts with {text[:12]!r}, expected %YAML or <?xml")
    xml = text.startswith("<")
    found: Nodes = {}
    for name, matrix, value in _xml(text, path) if xml else _yaml(text, path):
        if matrix is not None:
            found[name] = _matrix(*matrix, f"{path}: {name}")
        elif (number := _number(value)) is not None:
            found[name] = number
    if not found:
        raise _unreadable(path, "no matrix and no number found")
    return found


Entry = tuple[str, "tuple[str, str, str, list[str]] | None", str]
"""Name, rows, cols, dt and data of a matrix, text of anything else."""


_Loader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""Builds text, lists and maps and nothing else, whatever the tags say; numbers are made of the text here."""


def _yaml(text: str, path: Path) -> Iterator[Entry]:
    text = re.sub(r"\A%YAML[: ]1\.\d", "%YAML 1.1", text)  # OpenCV 4 writes %YAML:1.0, 5 writes %YAML 1.2
    try:
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > 16:  # OpenCV's matrices are two deep
                raise _unreadable(path, "nested more than 16 deep")
            if isinstance(event, yaml.AliasEvent):
                raise _unreadable(path, "an alias, which OpenCV never writes")
        documents = list(yaml.load_all(text, Loader=_Loader))  # OpenCV appends as another document
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise _unreadable(path, str(error)) from None
    for document in documents:
        for name, value in document.items() if isinstance(document, dict) else ():
            if isinstance(value, dict) and isinstance(value.get("data"), list):
                rows, columns, kind = (str(value.get(key, "")) for key in _FIELDS)
                yield str(name), (rows, columns, kind, [str(v) for v in value["data"]]), ""
            else:
                yield str(name), None, str(value)


def _xml(text: str, path: Path) -> Iterator[Entry]:
    root = parse_xml(text, f"{path}: not a readable OpenCV YAML or XML file")
    for node in root:
        data = node.findtext("data")
        fields = ((node.findtext(name) or "").strip() for name in _FIELDS)
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


def parse_xml(text: str, where: str) -> ElementTree.Element:
    """The root element of a document.

    A document type is refused: it is what entities are declared in, which expand without bound or name other files.
    None of the programs that are read here writes one.

    Parameters
    ----------
    text : str
        The document; its size is bounded where it was read.
    where : str
        For messages: what was read, and what it should be.

    Raises
    ------
    InputError
        A document type, or no well-formed XML.
    """
    if "<!DOCTYPE" in text:
        raise InputError(f"{where} (a document type, which is refused)")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"{where} ({' '.join(str(error).split())[-80:]})") from None


def _unreadable(path: Path, reason: str) -> InputError:
    return InputError(f"{path}: not a readable OpenCV YAML or XML file ({' '.join(reason.split())[-80:]})")
